"""Localization while the sound arrives, without ROS: frames that wait, the head that turns, the robot that speaks."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head_check import HeadCheck
from rosafe.localization.localizer import UPDATE_SECONDS, Localizer
from rosafe.localization.tracker import Track

OK, WARN, ERROR = 0, 1, 2  # levels of the status, as in diagnostic_msgs/DiagnosticStatus

MAX_WAIT = 0.2  # s that a frame waits for its transform
MAX_TILT = 15.0  # degrees of pitch or roll
JUMP_SECONDS = 1.0  # a step back of the time by more than this is another run: `rosbag play` in a loop
AFTER_SECONDS = 0.3  # after the robot has spoken, for the reverberation of its voice
PERIOD = 0.1  # s between two messages
SLACK = 0.05  # s that new frames may be late before a message without them is published
SILENCE_SECONDS = 0.5  # without new frames, in addition to a block, until no source is published
TIME_SLACK = 0.1  # s by which the time of frames may go back, when the clock of the stream is fitted
MAX_PAUSE = 2.0  # s between two frames; later ones begin again
GAP_SECONDS = 0.5  # of lost frames after which localization begins again
CHECK_SECONDS = 5.0  # between two reports on the head
CHECK_BLOCKS = 50  # of 0.1 s with sound from one direction, for a report
_MAX_INTERVALS = 100  # in which the robot speaks


class Status(Protocol):
    """The state of the parts of a node, in its log and diagnostics."""

    def set(self, part: str, level: int, text: str, log: bool = True) -> None:
        """Set the state of a part."""

    def set_error(self, part: str, problem: Exception) -> None:
        """Report an unexpected error of a part that continues."""

    def warn(self, line: str, kind: str) -> None:
        """Write a line of a kind to the log, once in some seconds."""

    def clear(self, part: str) -> None:
        """Remove the state of a part."""

    def value(self, key: str, value: Any) -> None:
        """Set an entry of the diagnostics."""

    def count(self, key: str, number: int) -> None:
        """Add to a number in the diagnostics."""


@dataclass(frozen=True)
class FrameFormat:
    """The frames of the ports: sizes in samples.

    Attributes
    ----------
    sample_rate : float
        Hz.
    channels : int
        Number of channels.
    window, hop, block : int
        Length and distance of frames, and the block of the input, in samples.
    """

    sample_rate: float
    channels: int
    window: int
    hop: int
    block: int

    @property
    def rest(self) -> float:
        """Samples after the newest frame of a message: exact if the hop divides the block, otherwise an estimate."""
        return -self.window % self.hop if self.block % self.hop == 0 else self.hop / 2


@dataclass(frozen=True)
class NewFrames:
    """Successive frames of all representations.

    Attributes
    ----------
    features : mapping
        As for `Localizer.update`.
    middles : ndarray, (F,)
        The clock time of the middle of each frame, s.
    lost : int
        Number of frames that are missing before them.
    """

    features: Mapping[str, FloatArray]
    middles: FloatArray
    lost: int

    def select(self, frames: Any) -> NewFrames:
        """Return some of the frames: a slice, or an array of bool."""
        features = {kind: array[..., frames] for kind, array in self.features.items()}
        return NewFrames(features, self.middles[frames], 0)

    @staticmethod
    def joined(parts: Sequence[NewFrames]) -> NewFrames:
        """Return all frames of `parts`."""
        if len(parts) == 1:
            return parts[0]
        features = {
            kind: np.concatenate([part.features[kind] for part in parts], axis=-1) for kind in parts[0].features
        }
        return NewFrames(features, np.concatenate([part.middles for part in parts]), 0)


class StreamRestartedError(Exception):
    """The index of the stream has fallen; the text says from where to where."""


class Rotation(NamedTuple):
    """The rotation for the first `len(yaw)` frames of those that were looked up; the others have to wait.

    Attributes
    ----------
    yaw : ndarray, (n,)
        Direction of the head in degrees in world coordinates.
    known : ndarray of bool, (n,)
        False for frames without a rotation, which are dropped.
    """

    yaw: FloatArray
    known: NDArray[np.bool_]


class HeadRotation(Protocol):
    """A source of the rotation of the head."""

    def lookup(self, times: FloatArray) -> Rotation:
        """Return the rotation at clock times in s; called again for those that wait."""


class Transforms(Protocol):
    """The transforms from the frame of the head to that of the world."""

    def rotation(self, moment: float) -> tuple[float, float, float, float] | None:
        """Return the quaternion x, y, z, w at a clock time in s; None if it is not known."""

    def clear(self) -> None:
        """Forget all transforms except the static ones."""


class FixedHead:
    """A head whose rotation is not used: azimuths are relative to it."""

    def lookup(self, times: FloatArray) -> Rotation:
        """Return a rotation of 0."""
        return Rotation(np.zeros(len(times)), np.ones(len(times), bool))


class TransformedHead:
    """A head whose rotation relative to a world frame is known from tf.

    Parameters
    ----------
    transforms : Transforms
        Those that have arrived.
    world_frame, head_frame : str
        Names of the coordinate frames; the head's has x ahead, y left and z up.
    audio_delay : float
        Latency of the sound card in s: a frame was heard earlier than its time says by this.
    status : Status
        Reports whether transforms are missing, and of a tilted head.
    """

    def __init__(
        self, transforms: Transforms, world_frame: str, head_frame: str, audio_delay: float, status: Status
    ) -> None:
        self._transforms = transforms
        self._names = f"from {head_frame} to {world_frame}"
        self._delay = audio_delay
        self._status = status
        self._first: dict[float, float] = {}  # time of a frame -> when it was looked up first (time.monotonic)
        self._latest = -math.inf  # time of a frame that was looked up
        self._known = False
        self._tilted = False
        status.set("rotation", WARN, f"waiting for the transform {self._names} on /tf", log=False)

    def lookup(self, times: FloatArray) -> Rotation:
        """See `HeadRotation`."""
        if len(times) and times[0] < self._latest - JUMP_SECONDS:
            self._transforms.clear()
            self._first.clear()
            self._latest = -math.inf
        now = time.monotonic()
        moments = times.tolist()
        first = self._first = {moment: self._first.get(moment, now) for moment in moments}
        yaws: list[float] = []
        for moment in moments:
            found = self._transforms.rotation(moment - self._delay)
            if found is None and now - first[moment] < MAX_WAIT:
                break
            self._latest = max(self._latest, moment)
            yaws.append(math.nan if found is None else self._yaw(*found))
        yaw = np.array(yaws)
        known = np.isfinite(yaw)
        if len(yaw):
            self._report(known)
        return Rotation(np.where(known, yaw, 0.0), known)

    def _yaw(self, x: float, y: float, z: float, w: float) -> float:
        """Return the rotation about the vertical axis of a quaternion in degrees, and report pitch and roll."""
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        tilt = math.degrees(max(abs(pitch), abs(roll)))
        if (tilt > MAX_TILT) != self._tilted:
            self._tilted = not self._tilted
            if self._tilted:
                text = f"the head is tilted by {tilt:.0f} degrees; directions are for a head that is upright"
                self._status.set("tilt", WARN, text)
            else:
                self._status.set("tilt", OK, "the head is upright", log=False)
        return math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

    def _report(self, known: NDArray[np.bool_]) -> None:
        dropped = int(np.count_nonzero(~known))
        if dropped:
            self._status.count("frames without a transform", dropped)
        if known[-1] != self._known:
            self._known = bool(known[-1])
            if self._known:
                self._status.set("rotation", OK, f"the rotation of the head is known {self._names}", log=False)
            else:
                self._status.set("rotation", WARN, f"no transform {self._names} on /tf; the frames are dropped")


class Mute:
    """Whether the robot speaks: its own voice is not localized.

    Parameters
    ----------
    audio_delay : float
        Latency of the sound card in s: a frame was heard earlier than its time says by this.
    status : Status
        Reports whether the localizer is muted.
    clock : callable
        Returns the clock time in s.
    """

    def __init__(self, audio_delay: float, status: Status, clock: Callable[[], float]) -> None:
        self._delay = audio_delay
        self._status = status
        self._lock = threading.Lock()
        self._intervals: list[list[float]] = []  # begin and end (inf: not yet) in clock time, s
        self._now = 0.0  # the latest time
        status.value("muted", "no")
        self._clock = clock

    def set(self, speaks: bool) -> None:
        """Begin or end."""
        with self._lock:
            now = self._advance()
            on = bool(self._intervals) and self._intervals[-1][1] == math.inf
            if speaks and not on:
                self._intervals = [*self._intervals[1 - _MAX_INTERVALS :], [now, math.inf]]
            elif not speaks and on:
                self._intervals[-1][1] = now + AFTER_SECONDS
        if speaks:
            self._status.value("muted", "yes")
            self._status.set("mute", OK, "muted: ~mute is true, and sound is not used")
        elif on:
            self._status.value("muted", "no")
            self._status.clear("mute")

    def _advance(self) -> float:
        """Return the present time. If it has jumped back, forget the intervals, except one that has not ended."""
        now = self._clock()
        if now < self._now - JUMP_SECONDS:
            self._intervals = [[now, end] for _, end in self._intervals[-1:] if end == math.inf]
            self._now = now
        self._now = max(self._now, now)
        return now

    @property
    def active(self) -> bool:
        """Whether sound is not used at present."""
        if not self._intervals:
            return False
        with self._lock:
            now = self._advance()
            return bool(self._intervals) and self._intervals[-1][1] > now

    def muted(self, times: FloatArray) -> NDArray[np.bool_]:
        """Return whether frames at clock times in s are muted."""
        found = np.zeros(len(times), bool)
        if not self._intervals:
            return found
        with self._lock:
            self._advance()
            intervals = list(self._intervals)
        heard = times - self._delay
        for begin, end in intervals:
            found |= (heard >= begin) & (heard <= end)
        return found


class TurnedFrames(NamedTuple):
    """Frames with the direction of the head (F,) in degrees in world coordinates."""

    frames: NewFrames
    yaw: FloatArray


class FrameQueue:
    """Frames in their order; those without a rotation, and muted ones, are dropped.

    Parameters
    ----------
    rotation : HeadRotation
    mute : Mute

    Attributes
    ----------
    received_at, used_at : float
        When frames were added and used last (time.monotonic).
    """

    def __init__(self, rotation: HeadRotation, mute: Mute) -> None:
        self._rotation = rotation
        self._mute = mute
        self._waiting: list[NewFrames] = []
        self.received_at = self.used_at = 0.0

    @property
    def muted(self) -> bool:
        """Whether the robot speaks."""
        return self._mute.active

    def __len__(self) -> int:
        """The number of frames that wait."""
        return sum(len(frames.middles) for frames in self._waiting)

    def clear(self) -> None:
        """Drop all frames."""
        self._waiting.clear()

    def append(self, frames: NewFrames) -> None:
        """Add frames."""
        self.received_at = time.monotonic()
        self._waiting.append(frames)

    def take(self, least: int) -> TurnedFrames | None:
        """Return all frames whose rotation is known; None if these are none, or if less than `least` frames wait."""
        if len(self) < least:
            return None
        joined = NewFrames.joined(self._waiting)
        yaw, known = self._rotation.lookup(joined.middles)
        ready = len(yaw)
        later = joined.select(slice(ready, None))
        self._waiting = [later] if len(later.middles) else []
        kept = known & ~self._mute.muted(joined.middles[:ready])
        if not self._waiting and kept.all():  # mostly; copies are saved
            return TurnedFrames(joined, yaw) if ready else None
        now = joined.select(slice(ready))
        return TurnedFrames(now.select(kept), yaw[kept]) if kept.any() else None


class FrameSource(Protocol):
    """New frames of the representations, from the threads that receive them to the one that localizes.

    Attributes
    ----------
    format : FrameFormat
    least : int
        Samples of new sound for which `take` waits.
    """

    format: FrameFormat
    least: int

    @property
    def problem(self) -> str:
        """Why messages cannot be used; empty if they can."""

    @property
    def missing(self) -> str:
        """The kind of message that does not arrive."""

    def take(self) -> NewFrames | None:
        """Return the frames since the last call; None if they are not enough. Raises StreamRestartedError."""

    def close(self) -> None:
        """End."""


class Publishing(Protocol):
    """Publishes the state of the localizer."""

    def begin_again(self) -> None:
        """Prepare for tracks that are numbered from 1 again."""

    def publish(self, time: float, tracks: Sequence[Track], gain_db: float, estimate: tuple[Any, Any]) -> None:
        """Publish the state at a clock time (s): the tracks, from their power to their level, grid and posterior."""


class HeadReporter:
    """Reports every few seconds whether the cues belong to the head.

    Parameters
    ----------
    status : Status
    """

    def __init__(self, status: Status) -> None:
        self._status = status
        self._check: HeadCheck | None = None
        self._due = 0.0

    def begin(self, model: DirectionModel | None) -> None:
        """Forget all sound; `model` is that of the head, None if there is none."""
        self._check = HeadCheck(model) if model is not None else None
        self._status.clear("head")

    def add(self, frames: NewFrames) -> None:
        """Check frames."""
        if self._check is None:
            return
        self._check.update(frames.features)
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + CHECK_SECONDS
            report = self._check.report(CHECK_BLOCKS)
            if report is not None and report.problem:
                self._status.set("head", WARN, f"the cues do not fit the head: {report.problem}")
            else:
                self._status.clear("head")


class _Callbacks(NamedTuple):
    """Functions that the loop calls; see `LocalizationLoop`."""

    suspicious: Callable[[], None]
    updated: Callable[[float, Sequence[Track], float], None]


class LocalizationLoop:
    """Localizes and publishes, on a thread of its own, from `start` to `close`.

    Parameters
    ----------
    localizer_for : callable
        Called with the model of the head; returns the localizer.
    publishing : Publishing
    queue : FrameQueue
    status : Status
    suspicious : callable
        Called if messages do not fit the processors that were requested.
    clock : callable
        Returns the clock time in s.
    updated : callable
        Called after each update of the tracks, with its clock time (s), the tracks, and the direction of the head
        (degrees).
    """

    def __init__(
        self,
        localizer_for: Callable[[DirectionModel], Localizer],
        publishing: Publishing,
        queue: FrameQueue,
        status: Status,
        suspicious: Callable[[], None],
        clock: Callable[[], float],
        updated: Callable[[float, Sequence[Track], float], None] = lambda time, tracks, yaw: None,
    ) -> None:
        self._localizer_for = localizer_for
        self._publishing = publishing
        self._clock = clock
        self._queue = queue
        self._status = status
        self._callbacks = _Callbacks(suspicious, updated)
        self._arrived = threading.Event()
        self._closing = False
        self._lock = threading.Lock()  # of the link
        self._source: FrameSource | None = None
        self._localizer: Localizer | None = None
        self._head_report = HeadReporter(status)
        self._newest = 0.0  # end of the newest frame that was used, clock time in s; 0 before the first one
        self._estimate: tuple[Any, Any] = angles.grid(), uniform(angles.grid())
        self._thread = threading.Thread(target=self._run, name="localization", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and all subscriptions."""
        self._closing = True
        self._arrived.set()
        self._thread.join()
        self.connect(None)

    def connect(
        self,
        model: DirectionModel | None,
        open_source: Callable[[Callable[[], None]], FrameSource] | None = None,
    ) -> None:
        """Use a source of frames, which is opened with a function that it calls for new ones; None: there is none."""
        localizer = self._localizer_for(model) if model is not None else None
        source = open_source(self._arrived.set) if open_source is not None else None
        with self._lock:
            before, self._source = self._source, source
            self._queue.used_at = self._queue.received_at = time.monotonic()
            self._begin_again()
            self._localizer = localizer
            self._head_report.begin(model)
        if before is not None:
            before.close()
        if source is None:
            self._status.clear("frames")

    def is_stalled(self) -> bool:
        """Return whether no frames have arrived for too long."""
        source = self._source
        return source is not None and time.monotonic() - self._queue.received_at > self._limit(source)

    @staticmethod
    def _limit(source: FrameSource) -> float:
        """Return for how long frames may be missing, s."""
        return SILENCE_SECONDS + source.format.block / source.format.sample_rate

    def _begin_again(self) -> None:
        """Forget all sound."""
        self._newest = 0.0
        self._queue.clear()
        self._estimate = angles.grid(), uniform(angles.grid())
        if self._localizer is not None:
            self._publishing.begin_again()
            self._localizer.reset(keep_noise=True)

    # --- the thread ---

    def _run(self) -> None:
        due = time.monotonic() + PERIOD
        while not self._closing:
            self._arrived.wait(max(0.0, due - time.monotonic()))
            self._arrived.clear()
            with self._lock:
                used = self._attempt(self._use_new_frames)
                now = time.monotonic()
                if used or now >= due:
                    due = now + PERIOD + (SLACK if used else 0.0)
                    if self._attempt(self._publish) and used:
                        self._status.clear("localization")

    def _attempt(self, step: Callable[[], bool]) -> bool:
        """Return the result of a step. After an unexpected error, False: localization begins again."""
        try:
            return step()
        except Exception as problem:  # messages continue
            self._status.set_error("localization", problem)
        with contextlib.suppress(Exception):  # the first error is reported
            self._begin_again()
        return False

    def _use_new_frames(self) -> bool:
        """Localize with the frames that have arrived, if they are enough for an update; return whether they were."""
        source, localizer = self._source, self._localizer
        if source is None or localizer is None:
            return False
        least = round(UPDATE_SECONDS / localizer.hop)
        try:
            new = source.take()
        except StreamRestartedError as restart:
            self._status.warn(f"a new stream of sound: {restart}; localization begins again", "stream")
            self._begin_again()
            return False
        if source.problem:
            self._status.set("frames", WARN, f"messages of rosAFE cannot be used: {source.problem}")
            self._callbacks.suspicious()
        if new is not None:
            self._append(new, localizer)
        used = self._queue.take(least)
        source.least = max(0, least - len(self._queue)) * source.format.hop
        if used is None:
            return False
        middles = used.frames.middles
        steps = np.diff(middles, prepend=self._newest or middles[0])
        if steps.min() < -TIME_SLACK or steps.max() > MAX_PAUSE:
            jump = f"{steps[np.abs(steps).argmax()]:.3f} s"
            advice = "localization begins again; with use_sim_time, check /clock"
            self._status.warn(f"the time jumped by {jump}; {advice}", "time")
            self._begin_again()
            return False
        middles = np.maximum.accumulate(middles)
        try:
            result = self._localize(localizer, used, middles)
        except ValueError as problem:  # not finite
            self._status.set("values", WARN, f"messages of rosAFE cannot be used: {problem}")
            self._begin_again()
            return False
        self._status.clear("values")
        self._head_report.add(used.frames)
        steady = ", ".join(f"{azimuth:.0f}" for azimuth in localizer.noise.azimuths)
        self._status.value("directions of steady noise (degrees)", steady or "none")
        self._estimate = result["azimuths"], result["posterior"][0]
        self._newest, self._queue.used_at = float(result["time"][0]), time.monotonic()
        return True

    def _localize(self, localizer: Localizer, used: TurnedFrames, middles: FloatArray) -> dict[str, Any]:
        """Return the estimate for the last frame. Each update of the tracks is reported, also those of a long block."""
        yaw = np.stack((middles, used.yaw), axis=1) if used.yaw.any() else 0.0
        for part in localizer.update_parts(len(middles)):
            features = {kind: array[..., part] for kind, array in used.frames.features.items()}
            result = localizer.update(features, middles[part], yaw, last_only=True)
            self._callbacks.updated(localizer.updated_at, localizer.sources, float(used.yaw[part][-1]))
        return result

    def _append(self, new: NewFrames, localizer: Localizer) -> None:
        if new.lost:
            self._status.count("lost frames", new.lost)
            self._status.warn(f"{new.lost} frames of rosAFE were lost before {new.middles[0]:.3f} s", "lost")
            if new.lost * localizer.hop > GAP_SECONDS:
                self._begin_again()
        self._queue.append(new)

    def _check_frames(self) -> bool:
        """Return whether frames were used lately; otherwise the sources are unknown until the next frames arrive."""
        now = time.monotonic()
        source = self._source
        if source is None:
            return False
        if self._newest and self._queue.muted:
            self._begin_again()
        limit = self._limit(source)
        if now - self._queue.received_at <= limit:
            self._status.clear("frames")
        elif not source.problem:
            self._status.set("frames", WARN, f"waiting for {source.missing}")
        return bool(self._newest) and now - self._queue.used_at <= limit

    def _publish(self) -> bool:
        """Publish the state; return True."""
        known = self._check_frames()
        localizer = self._localizer
        sources = localizer.sources if localizer is not None and known else []
        gain_db = localizer.model.level_gain_db if localizer is not None else 0.0
        estimate = self._estimate if known else (self._estimate[0], uniform(self._estimate[0]))
        self._publishing.publish(self._newest if known else self._clock(), sources, gain_db, estimate)
        return True


def uniform(azimuths: FloatArray) -> FloatArray:
    """Return the posterior without evidence."""
    return np.full(len(azimuths), 1 / len(azimuths))
