"""The direction of the source, from the recorded sound, and its error against the truth of a scene."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rosafe.demo.recorder import PortRecorder
from rosafe.localization import angles
from rosafe.localization.head import Head
from rosafe.localization.localizer import SPHERE, Localizer
from rosafe.localization.model_cache import model_of
from rosafe.localization.scene import Truth

SECONDS = 0.5  # window of integration
UPDATE_SECONDS = 0.1
LEARN_NOTE_SECONDS = 3.0  # between two lines while the model of a head is learned


class DirectionFinder:
    """Localizes the sound of the input port while it is recorded.

    Parameters
    ----------
    sample_rate : int
        Hz.
    head : Head or None
        The head; None for the sphere.
    show : callable
        Prints a line; called while the model of the head is learned, which takes up to 30 s at its first use.

    Raises
    ------
    ValueError
        A model for this sample rate does not exist.
    """

    def __init__(self, sample_rate: int, head: Head | None, show: Callable[[str], None]) -> None:
        self.head = head or SPHERE
        model_of(self.head, sample_rate, None, _progress(show))
        self._rate = sample_rate
        self._localizer = Localizer(sample_rate, self.head, SECONDS)
        self._position = (0, 0)  # after the sound that has been localized
        self._begin = 0.0  # s of the audio
        self._parts: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def following(self, recorder: PortRecorder) -> Iterator[None]:
        """Localize the sound on a thread while the body runs, and all of the rest at its end."""
        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(UPDATE_SECONDS):
                self.update(recorder)

        thread = threading.Thread(target=follow, name="directions", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
        self.update(recorder)

    def update(self, recorder: PortRecorder) -> None:
        """Localize the sound that has been recorded since the previous call."""
        (starts, first), samples = recorder.ports["input"].take_sound()
        if (starts, first) != self._position:  # the beginning, or the audio has restarted
            self._localizer.reset()
            self._parts.clear()
            self._begin = first / self._rate
        self._position = starts, first + samples.shape[1]
        if samples.shape[1]:
            self._parts.append(self._localizer.process(samples))

    @property
    def azimuth(self) -> float:
        """The newest azimuth (degrees, left positive); NaN without a source."""
        found = self._parts[-1]["azimuth"] if self._parts else np.zeros(0)
        return float(found[-1]) if len(found) else float("nan")

    def result(self, end: float) -> dict[str, Any]:
        """Return the complete windows until `end` (s of the audio), as `rosafe.localize`.

        `time` is the middle of each window, in seconds of the audio: then a moving source was in the mean direction.
        """
        names = ("time", "azimuth", "confidence", "posterior")
        joined = {name: np.concatenate([part[name] for part in self._parts] or [np.zeros(0)]) for name in names}
        inside = (joined["time"] >= SECONDS) & (joined["time"] <= end - self._begin)
        joined["time"] += self._begin - SECONDS / 2
        return {**{name: values[inside] for name, values in joined.items()}, "azimuths": self._localizer.azimuths}


def true_azimuths(truth: Callable[[float], Truth], times: np.ndarray, folded: bool) -> dict[str, np.ndarray]:
    """Return the true azimuths (degrees) of each source by name, (T,); NaN while it is silent.

    `folded`: azimuths behind the head are mirrored to the front, as by the sphere.
    """
    series: dict[str, np.ndarray] = {}
    for place, moment in enumerate(times):
        now = truth(float(moment))
        for name, azimuth in zip(now.names, now.azimuths, strict=True):
            series.setdefault(name, np.full(len(times), np.nan))[place] = azimuth
    return {name: angles.lateral(values) for name, values in series.items()} if folded else series


def nearest(azimuths: np.ndarray, truth: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return name and azimuth (T,) of the true source nearest to each estimate; NaN if no source sounds."""
    names, all_truth = np.array([*truth]), np.stack([*truth.values()])
    distance = np.abs(angles.difference(all_truth, np.nan_to_num(azimuths)))
    best = np.where(np.isfinite(distance), distance, np.inf).argmin(axis=0)
    return names[best], all_truth[best, np.arange(len(azimuths))]


def _progress(show: Callable[[str], None]) -> Callable[[float], None]:
    due = 0.0

    def report(part: float) -> None:
        nonlocal due
        if time.monotonic() >= due:
            due = time.monotonic() + LEARN_NOTE_SECONDS
            show(f"learning the directions of the head, which is necessary only once: {100 * part:.0f} %")

    return report
