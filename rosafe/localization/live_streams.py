"""The streams of sources while the sound arrives, on a thread of their own, without ROS."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import WARN, Status
from rosafe.localization.localizer import UPDATE_SECONDS
from rosafe.localization.speech import missing_detector
from rosafe.localization.streams import LAG, RATE, UNIT, SourcePart, SourceStreams
from rosafe.localization.tracker import Track

BLOCK_SECONDS = UNIT / RATE  # of sound that is read together
MAX_UPDATES = 100  # of tracks, that wait for the sound: ten seconds
_WAIT = 0.1  # s between two checks whether there are subscribers
_PATIENCE = 0.5  # s of waiting for the tracks of a block: those of a busy machine are late
_STEP = 0.05  # s after the last update of the tracks, when there are none any more
_PAUSE = 1.0  # s after an error
_SET = 0.5  # s, of a step in the times of the sound: they were those of another stream, or the clock has been set


class SoundBlock(NamedTuple):
    """Successive samples of the sound.

    Attributes
    ----------
    samples : ndarray of int32, (2, n)
    first : int
        Number of the first sample in the stream of sound, from 0.
    time : float
        Clock time of the first sample, s.
    """

    samples: np.ndarray
    first: int
    time: float


class LiveSound(Protocol):
    """Reads the sound of which the sources are separated; created when it is needed."""

    def read(self, seconds: float) -> SoundBlock | None:
        """Return the next block; None if it has not arrived within a time."""

    def close(self) -> None:
        """End."""


class LiveStreams:
    """Separates the sources of the localizer and detects speech, from `start` to `close`, for subscribers only.

    Parameters
    ----------
    publish : callable
        Called with a `SourcePart` and the clock time (s) of its first sample, on the thread of the streams.
    has_stream_subscribers, has_speech_subscribers : callable
        Return whether the streams, and whether the probabilities of speech, are used at present.
    status : Status
    """

    def __init__(
        self,
        publish: Callable[[SourcePart, float], None],
        has_stream_subscribers: Callable[[], bool],
        has_speech_subscribers: Callable[[], bool],
        status: Status,
    ) -> None:
        self._publish, self._status = publish, status
        self._has_streams, self._has_speech = has_stream_subscribers, has_speech_subscribers
        self._open: tuple[DirectionModel, Callable[[], LiveSound]] | None = None
        self._updates = _Updates()
        self._speech: dict[int, float] = {}
        self._ended = threading.Event()
        self._detects = True
        self._thread = threading.Thread(target=self._run, name="streams", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        if missing := missing_detector():
            self._detects = False
            self._status.warn(missing, "speech")
        self._status.value("speech", missing or "detected")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._updates.wake()
        if self._thread.ident is not None:
            self._thread.join()

    def connect(self, model: DirectionModel | None, open_sound: Callable[[], LiveSound] | None = None) -> None:
        """Use the sound that `open_sound` opens, with the model of the head; None: there is none."""
        self._updates.clear()
        self._open = (model, open_sound) if model is not None and open_sound is not None else None
        self._updates.wake()

    def begin_again(self, first_id: int) -> None:
        """Forget the present sources; ids of later tracks are counted from `first_id`."""
        self._updates.begin_again(first_id)

    def update(self, moment: float, tracks: Sequence[Track], yaw: float) -> None:
        """Use other tracks: those at a clock time (s), with the direction of the head in degrees."""
        self._updates.add(moment, tracks, yaw)

    def speech(self, id_: int) -> float:
        """Return the probability that the source with an id, counted from `first_id`, speaks; NaN if unknown."""
        return self._speech.get(id_, math.nan)

    # --- the thread ---

    def _wanted(self) -> bool:
        return self._has_streams() or (self._detects and self._has_speech())

    def _run(self) -> None:
        while not self._ended.is_set():
            opened = self._open
            if opened is None or not self._wanted():
                self._ended.wait(_WAIT)
                continue
            try:
                self._use(opened)
            except ValueError as problem:  # of the model
                self._status.set("streams", WARN, f"no streams of sources: {problem}")
                self._ended.wait(_PAUSE)
            except Exception as problem:  # the node continues
                self._status.set_error("streams", problem)
                self._ended.wait(_PAUSE)
            self._speech = {}

    def _use(self, opened: Any) -> None:
        model, open_sound = opened
        with contextlib.closing(open_sound()) as sound:
            self._separate(SourceStreams(model, self._detects), sound, opened)

    def _separate(self, streams: SourceStreams, sound: LiveSound, opened: Any) -> None:
        """Publish the parts of all sources while there are subscribers."""
        rate = opened[0].sample_rate
        begin, end = 0, -1  # numbers of samples: where the streams began, and after the last block
        start = math.inf  # clock time of the sample `begin`
        checked = 0.0
        while not self._ended.is_set() and self._open is opened:
            if time.monotonic() - checked > _WAIT:
                checked = time.monotonic()
                if not self._wanted():
                    return
            block = sound.read(_WAIT)
            if block is None:
                continue
            samples = block.samples
            if block.first != end or abs(block.time - (block.first - begin) / rate - start) > _SET:
                begin = _on_grid(block.first, rate)
                samples = samples[:, begin - block.first :]
                streams.reset()
            end = block.first + block.samples.shape[1]
            start = block.time - (block.first - begin) / rate
            needed = start + (end - begin) / rate - LAG - UPDATE_SECONDS
            updates = self._updates.take(needed, lambda: self._open is not opened or self._ended.is_set())
            if updates is None:
                end = -1  # begin again with the next block
                continue
            for moment, tracks, yaw in updates:
                streams.update(moment - start, tracks, yaw)
            for part in streams.process(samples):
                self._publish(part, start + part.time)
            self._speech = streams.speech
            self._status.clear("streams")


def _on_grid(first: int, rate: float) -> int:
    """Return the first sample from `first` on that is a whole number of units after the start of the sound, if any is.

    The streams that begin there have the frames of those that began at the start.
    """
    unit = rate * BLOCK_SECONDS
    return -int(-first // unit * unit) if unit == int(unit) else first


class _Updates:
    """The tracks that have not been used yet, with their clock times (s). The streams wait for those that are late."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: list[tuple[float, list[Track], float]] = []
        self._first_id, self._moment = 0, 0.0  # of the last update
        self._needed, self._follows = -math.inf, True  # time of the tracks for the sound; whether they came in time
        self._set_back = False  # whether the clock was

    def add(self, moment: float, tracks: Sequence[Track], yaw: float) -> None:
        """Add the tracks at a clock time."""
        with self._changed:
            if moment < self._moment - _SET:  # earlier updates have later times
                self._waiting, self._set_back = [], True
            self._moment, self._follows = moment, moment >= self._needed
            copies = [_Present.of(track, self._first_id) for track in tracks if track.id]
            self._waiting = [*self._waiting[-MAX_UPDATES:], (moment, copies, yaw)]
            self._changed.notify_all()

    def begin_again(self, first_id: int) -> None:
        """End all tracks; ids of later ones are counted from `first_id`."""
        with self._changed:
            self._first_id = first_id
            self._waiting.append((self._moment + _STEP, [], 0.0))

    def clear(self) -> None:
        """Forget all tracks."""
        with self._changed:
            self._waiting.clear()
            self._follows, self._set_back = True, False
            self._changed.notify_all()

    def wake(self) -> None:
        """Let `take` look whether it is over."""
        with self._changed:
            self._changed.notify_all()

    def take(self, needed: float, is_over: Callable[[], bool]) -> list[tuple[float, list[Track], float]] | None:
        """Return the new tracks, those at the time `needed` included, if they arrive in time.

        None: the clock was set back, or it is over.
        """
        with self._changed:
            self._needed = needed
            if self._follows:
                self._follows = self._changed.wait_for(lambda: self._moment >= needed or is_over(), _PATIENCE)
            if self._set_back or is_over():
                self._set_back = False
                return None
            found, self._waiting = self._waiting, []
            return found


class _Present(NamedTuple):
    """The values of a track that `SourceStreams.update` uses, which do not change."""

    id: int
    azimuth: float
    state: np.ndarray
    probability: float

    @classmethod
    def of(cls, track: Track, first_id: int) -> Any:
        return cls(first_id + track.id, track.azimuth, track.state.copy(), track.probability)
