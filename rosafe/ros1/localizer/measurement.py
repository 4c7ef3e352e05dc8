"""`rosafe localize --calibrate-noise`, and the new frames of a running rosAFE for this and for `--check`."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
import rospy

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import cues
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import OK, NewFrames, StreamRestartedError
from rosafe.localization.noise import NoiseCalibration, measured_level
from rosafe.localization.settings import LocalizerSettings, Models
from rosafe.ros import FrameClock
from rosafe.ros1.localizer.inputs import PortSource
from rosafe.ros1.localizer.settings import node_status
from rosafe.ros1.localizer.tree_link import LocalizerPorts, TreeLink
from rosafe.system.terminal import printable

WAIT_SECONDS = 30.0  # that may pass, besides those of the noise, while frames are missing
UNSTEADY_DB = 8.0  # of the loudest frames above the median
SOUND_SECONDS = 30.0  # without frames, until an error
_POLL_SECONDS = 0.5
_QUEUED = 1000


class NoFramesError(Exception):
    """No frames arrive; the text says why."""


class FrameListener:
    """The frames of the representations that the localizer needs; a context, which removes its own requests.

    Parameters
    ----------
    settings : LocalizerSettings
        Those of the localizer node. The model of its head is learned if there is none yet.

    Raises
    ------
    ValueError
        The file of the head is unsuitable.
    """

    def __init__(self, settings: LocalizerSettings) -> None:
        self._status = node_status(lambda: None)
        models = Models(settings)
        models.report = self._report_learning
        afe = rospy.resolve_name(settings.rosafe)
        self._clock = FrameClock(afe)
        self._lock = threading.Lock()  # of the source
        self._source: PortSource | None = None
        self._model: DirectionModel | None = None
        self._frames: queue.Queue[tuple[DirectionModel, NewFrames]] = queue.Queue(_QUEUED)
        self._link = TreeLink(afe, settings.connect, models.model_for, self._connect, self._status)

    def __enter__(self) -> FrameListener:
        self._link.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._link.close()
        self._connect(None)

    def _report_learning(self, part: float) -> None:
        self._status.set("rosAFE", OK, f"learning the directions of the head: {10 * int(10 * part)} %")

    def _connect(self, link: LocalizerPorts | None) -> None:
        source = PortSource(link.topics, link.format, self._clock, self._received) if link is not None else None
        with self._lock:
            before, self._source = self._source, source
            self._model = link.model if link is not None else None
        if before is not None:
            before.close()

    def _received(self) -> None:
        """Take the new frames; called on rospy's threads."""
        with self._lock, contextlib.suppress(StreamRestartedError, queue.Full):
            if self._source is not None and self._model is not None and (new := self._source.take()) is not None:
                self._frames.put_nowait((self._model, new))

    def discard(self) -> None:
        """Drop the frames that have arrived."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._frames.get_nowait()

    def listen(self, seconds: float) -> Iterator[tuple[DirectionModel, NewFrames]]:
        """Yield new frames for `seconds` of time after the first ones, with the model that gives their parameters.

        Raises
        ------
        NoFramesError
            There were no frames for 30 s. The time while a model is learned does not count.
        """
        end = None
        while end is None or time.monotonic() < end:
            item = self._next()
            end = time.monotonic() + seconds if end is None else end
            yield item

    def _next(self) -> tuple[DirectionModel, NewFrames]:
        waited = 0.0
        while waited < SOUND_SECONDS:
            with contextlib.suppress(queue.Empty):
                return self._frames.get(timeout=_POLL_SECONDS)
            level, text = self._status.state()
            waited += _POLL_SECONDS if level != OK or self._source is not None else 0.0
        raise NoFramesError(f"no frames of rosAFE for {SOUND_SECONDS:g} s: {text}")


def ear_levels(model: DirectionModel, frames: NewFrames) -> FloatArray:
    """Return the level (F, 2) of the left and the right ear in dB full scale."""
    power = np.asarray(frames.features["ratemap"]).sum(axis=1).T
    return np.asarray(10 * np.log10(np.maximum(power, 1e-30)) + model.level_gain_db)


def calibrate(listener: FrameListener, seconds: float, path: Path, say: Callable[[str], None]) -> NoiseCalibration:
    """Measure the noise for `seconds`, and write its level to a file.

    Raises
    ------
    NoFramesError
        rosAFE computes no frames.
    OutputError
        The file cannot be written.
    """
    say(f"measuring the noise for {seconds:g} s: no other sounds, please")
    parts: list[FloatArray] = []
    hop, frames = 0.0, 0
    for model, new in listener.listen(seconds + WAIT_SECONDS):
        hop = float(model.parameters["cc_hSizeSec"])
        parts.append(cues.quantize(new.features, cues.scaling_db(model.parameters), model.max_itd).level)
        frames += len(new.middles)
        if frames * hop >= seconds:
            break
    levels = np.concatenate(parts)
    level = measured_level(levels)
    calibration = NoiseCalibration(model.sample_rate, model.parameters, level)
    calibration.save(path)
    total = 10 * np.log10(np.sum(10 ** (levels / 10), axis=1)) + model.level_gain_db
    mean = 10 * np.log10(np.mean(10 ** (total / 10)))
    say(f"noise level {mean:.1f} dB full scale, from {frames * hop:.1f} s of sound; written to {printable(path)}")
    if np.quantile(total, 0.98) > np.median(total) + UNSTEADY_DB:
        say("the level was not steady: if there were other sounds than the noise, repeat the calibration")
    return calibration
