"""`rosafe.Localizer`: directions of sound that comes block by block."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp.copies import OwnState
from rosafe.dsp.numeric_limits import FloatArray, as_numbers
from rosafe.localization import angles, cues
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.evidence import EvidenceWindow
from rosafe.localization.head import Head, checked_rate, computed_head
from rosafe.localization.mixture import DRY_SHARPNESS, candidates
from rosafe.localization.model_cache import model_of
from rosafe.localization.noise import SteadyNoise
from rosafe.localization.posterior import Estimate, Estimator
from rosafe.localization.tracker import MIN_LEVEL_DB, Track, Tracker
from rosafe.localization.training import Progress
from rosafe.processing.signals import ears_view
from rosafe.processing.stream import Stream

MAX_SECONDS = 60.0
MAX_UNITS = 2**21  # frames of channels in a window
UPDATE_SECONDS = 0.1  # between two updates of the tracks
TRACK_SECONDS = 0.5  # of sound for an update


class Localizer(OwnState):
    """Directions of sound that comes block by block, or as frames of representations.

    Copies by `copy` and `pickle` are independent and continue with the same numbers.

    Parameters
    ----------
    sample_rate : float
        Of the sound, Hz.
    head : Head or DirectionModel or str or Path
        `"sphere"`, `"pair:0.058"` (microphones with this spacing in m), a head, a model, or the path of a SOFA file
        or of a model that `rosafe head learn` has written.
    seconds : float
        Length of the window of integration, at most 60 s.
    parameters : mapping, optional
        Of the representations, as of `rosafe.process`; frames of correlation, ILD and ratemap must be equal.
    keep_history : bool
        Whether `tracks` has the history of all sources; without it, memory does not grow.

    Attributes
    ----------
    azimuths : ndarray, (A,)
        The grid in degrees.
    model : DirectionModel
        The model of the head.
    noise : SteadyNoise
        The level of the steady noise, which is not a source.

    Raises
    ------
    ValueError
        One line that names the parameter.

    Examples
    --------
    >>> import rosafe
    >>> localizer = rosafe.Localizer(44100, "sphere")  # doctest: +SKIP
    >>> new = localizer.process(block)  # doctest: +SKIP
    >>> new["azimuth"]  # doctest: +SKIP
    array([30., 30., 30.])
    """

    def __init__(
        self,
        sample_rate: float,
        head: Head | DirectionModel | str | os.PathLike[str] = "sphere",
        seconds: float = 0.5,
        parameters: Mapping[str, Any] | None = None,
        keep_history: bool = True,
    ) -> None:
        if not is_number(seconds) or not 0 < seconds <= MAX_SECONDS:
            raise ValueError(f"seconds: expected a number above 0, at most {MAX_SECONDS:g}, got {short_repr(seconds)}")
        self.model = find_model(head, sample_rate, parameters)
        self.azimuths = self.model.azimuths
        self._stream = Stream(sample_rate, self.model.parameters, list(cues.KINDS))
        described = self._stream.describe()
        self.hop = 1 / described["itd_frameRate"]
        self._window_seconds = described["parameters"]["cc_wSizeSec"]
        self._gain_db = cues.scaling_db(self.model.parameters)
        frames = max(1, round((seconds - self._window_seconds) / self.hop) + 1)
        if frames * self.model.channels > MAX_UNITS:
            raise ValueError(
                f"seconds: expected at most {MAX_UNITS // self.model.channels * self.hop:g} for {self.model.channels} "
                f"channels every {self.hop:g} s, got {seconds:g}"
            )
        self._estimator = Estimator(self.azimuths, self.model.is_sphere)
        self._frames = frames
        self._update_frames = max(1, round(UPDATE_SECONDS / self.hop))
        self._track_frames = min(frames, max(1, round(TRACK_SECONDS / self.hop)))
        self._keep_history = keep_history
        self.noise = SteadyNoise(self.model.channels)
        self._start()

    def _start(self) -> None:
        self._evidence = EvidenceWindow(self.model, self._frames)
        self._tracker = Tracker(self._keep_history)
        self._count = 0

    def reset(self, keep_noise: bool = False) -> None:
        """Forget all sound.

        Parameters
        ----------
        keep_noise : bool
            Whether the level of the noise is kept.
        """
        self._stream.reset()
        self._start()
        self.noise.reset(keep_noise)

    @property
    def tracks(self) -> list[dict[str, Any]]:
        """All sources that were present so far, as `tracks` of `rosafe.localize`."""
        return self._tracker.histories()

    @property
    def sources(self) -> list[Track]:
        """The sources at the moment, those with a low probability included; `id` is 0 until one was present."""
        return self._tracker.tracks

    @property
    def updated_at(self) -> float:
        """The time of the last update of `sources` in s, as `time` of `update`; -inf before the first one."""
        return self._tracker.time

    def process(self, block: Any, head_yaw: Any = 0.0) -> dict[str, Any]:
        """Localize the next block of sound.

        Parameters
        ----------
        block : array_like, (2, n) or (n, 2)
            Both ears, as for `rosafe.Stream.process`.
        head_yaw : float or sequence of [time, degrees]
            Direction of the head in world coordinates, left positive; times in s from the first sample.

        Returns
        -------
        dict
            As `update`.
        """
        view = ears_view(block)
        if view.shape[0] != 2:
            raise ValueError(f"sound: expected two ears, (2, N) or (N, 2), got shape {np.shape(block)}")
        yaw_at(head_yaw, np.empty(0))  # checked before the block counts
        features = self._stream.process(block)
        return self.update(features, features["itd_time"], head_yaw)

    def update(
        self, features: Mapping[str, Any], time: Any, head_yaw: Any = 0.0, last_only: bool = False
    ) -> dict[str, Any]:
        """Localize the next frames of representations.

        Parameters
        ----------
        features : mapping
            `itd`, `ild`, `ic` (C, F) and `ratemap` (2, C, F), computed with `model.parameters`.
        time : array_like, (F,)
            Middle of each frame in s, as `itd_time` of `rosafe.process`.
        head_yaw : float or sequence of [time, degrees]
            As for `process`.
        last_only : bool
            Return the estimates for the last frame only, with F = 1 below. This saves most of the time; `sources` and
            `tracks` are the same.

        Returns
        -------
        dict
            `time` (F,), the end of each frame in s; `azimuth` (F,) in degrees, NaN without evidence; `confidence`
            (F,); `azimuths` (A,), the grid; `posterior` (F, A); `level_db` (F,), mean level in the window in dB full
            scale.

        Raises
        ------
        ValueError
            Features of the wrong shape, or that are not finite; nothing has changed.
        """
        arrays = cues.check_features(features, self.model.channels)
        times = as_numbers("time", time)
        if times.shape != arrays["itd"].shape[1:]:
            raise ValueError(f"time: expected shape {arrays['itd'].shape[1:]}, got {times.shape}")
        if not (np.abs(times) <= angles.MAX_TIME).all():
            raise ValueError(f"time: expected finite times up to {angles.MAX_TIME:g} s, got {short_repr(times)}")
        yaw = yaw_at(head_yaw, times)
        quantized = cues.quantize(arrays, self._gain_db, self.model.max_itd)
        # Rows of contiguous memory: the order of a sum, and so its rounding, does not depend on the block length.
        power = (
            np.ascontiguousarray(arrays["ratemap"].transpose(2, 0, 1))
            .reshape(len(times), 2 * self.model.channels)
            .sum(axis=1)
        )
        ends = times + self._window_seconds / 2
        parts = self.update_parts(len(times)) if last_only else [slice(k, k + 1) for k in range(len(times))]
        count = min(1, len(times)) if last_only else len(times)
        azimuth, confidence, level = np.empty((3, count))
        posterior = np.empty((count, len(self.azimuths)))
        for part in parts:
            window, end = self._evidence, part.stop
            window.extend(quantized.select(part), power[part], yaw[part])
            self._count += end - part.start
            if not last_only or end == len(times):
                row = -1 if last_only else part.start
                azimuth[row], confidence[row], posterior[row] = self._estimate(yaw[end - 1])
                level[row] = window.power()
            if self._count % self._update_frames == 0:
                self._update_tracks(float(ends[end - 1]), yaw[end - 1])
        with np.errstate(divide="ignore"):
            level = np.maximum(10 * np.log10(level) + self.model.level_gain_db, MIN_LEVEL_DB)
        return {
            "time": ends[len(times) - count :],
            "azimuth": azimuth,
            "confidence": confidence,
            "azimuths": self.azimuths,
            "posterior": posterior,
            "level_db": level,
        }

    def update_parts(self, frames: int) -> list[slice]:
        """Return the parts of the next frames, of which each but the last ends with an update of `sources`."""
        first = self._update_frames - self._count % self._update_frames
        ends = [*range(first, frames, self._update_frames), frames] if frames else []
        return [slice(begin, end) for begin, end in itertools.pairwise([0, *ends])]

    def _update_tracks(self, time: float, yaw: float) -> None:
        window = self._evidence
        self.noise.update(window.lowest_level(self._update_frames))
        units = window.units(self._track_frames, self.noise.threshold)
        found = candidates(units, yaw, DRY_SHARPNESS if window.surroundings.dry else 1.0)
        found = self.noise.remove_from(found, time, yaw)
        self._tracker.update(found, time, yaw)

    def _estimate(self, yaw: float) -> Estimate:
        evidence = self._evidence
        return self._estimator.estimate(evidence.sums(), evidence.count_units(), yaw)


def find_model(
    head: Any, sample_rate: float, parameters: Mapping[str, Any] | None, progress: Progress | None = None
) -> DirectionModel:
    """Return the model for `Localizer`, learned if there is none yet; ValueError if an argument is unsuitable."""
    sample_rate = checked_rate(sample_rate)
    if isinstance(head, (str, os.PathLike)):
        head = open_head(head)
    if isinstance(head, DirectionModel):
        return _checked_model(head, sample_rate, parameters)
    if not isinstance(head, Head):
        raise ValueError(
            f"head: expected a Head, 'sphere', 'pair:SPACING' or the path of a SOFA file or a model, "
            f"got {short_repr(head)}"
        )
    return model_of(head, sample_rate, parameters, progress)


def open_head(name: str | os.PathLike[str], mirror: bool | None = None) -> Head | DirectionModel:
    """Return a head by its name or file, or the model in a file; `mirror` is that of `Head.from_sofa`.

    Raises
    ------
    ValueError
        The name or the file is unsuitable: one line.
    """
    text = os.path.expanduser(os.fspath(name))
    if text.lower().endswith(".sofa"):
        return Head.from_sofa(text, mirror)
    if mirror is not None:
        raise ValueError(f"mirror: expected a SOFA file as the head, got {short_repr(text)}; unset mirror")
    if text == "sphere":
        return SPHERE
    return computed_head(text) or DirectionModel.load(text)


def _checked_model(model: DirectionModel, sample_rate: float, parameters: Mapping[str, Any] | None) -> DirectionModel:
    """Return the model; ValueError if it was learned for another sample rate or other parameters."""
    if model.sample_rate != sample_rate:
        raise ValueError(
            f"sample_rate: expected {model.sample_rate:g} Hz, for which the model was learned, got {sample_rate:g}"
        )
    if parameters is not None:
        values = cues.model_parameters(cues.describe(sample_rate, parameters))
        for name in parameters:
            learned = model.parameters.get(name, values.get(name))
            if values.get(name) != learned:
                raise ValueError(
                    f"{name}: expected {learned}, with which the model was learned, got {values.get(name)}"
                )
    return model


SPHERE = Head.sphere()


def yaw_at(head_yaw: Any, times: FloatArray) -> FloatArray:
    """Return the yaw of the head at `times` in degrees, of a number or a list of [time, degrees].

    Between two entries the yaw is interpolated linearly, the shorter way round; outside it is held.
    """
    if is_number(head_yaw):
        if not angles.in_limits(head_yaw):
            raise ValueError(f"head_yaw: expected a number {angles.LIMITS}, got {short_repr(head_yaw)}")
        return np.full(len(times), float(head_yaw))
    if not isinstance(head_yaw, (Sequence, np.ndarray)) or isinstance(head_yaw, str):
        raise ValueError(f"head_yaw: expected a number or a list of [time, degrees], got {short_repr(head_yaw)}")
    try:
        points = np.asarray(head_yaw, np.float64)
    except (TypeError, ValueError, OverflowError):  # ragged, or not numbers
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
        raise ValueError(f"head_yaw: expected finite [time, degrees], got {short_repr(head_yaw)}")
    if not angles.in_limits(points[:, 1]) or not (np.abs(points[:, 0]) <= angles.MAX_TIME).all():
        raise ValueError(
            f"head_yaw: expected numbers {angles.LIMITS} and times up to {angles.MAX_TIME:g} s, "
            f"got {short_repr(head_yaw)}"
        )
    if (np.diff(points[:, 0]) < 0).any():
        raise ValueError(f"head_yaw: expected ascending times, got {short_repr(head_yaw)}")
    return np.interp(times, points[:, 0], angles.unwrap(points[:, 1]))
