"""The thread that localizes: takes new frames, updates the tracks, and publishes at 10 Hz."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rospy

from rosafe.localization import angles
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.localizer import UPDATE_SECONDS, Localizer
from rosafe.ros import FrameClock
from rosafe.ros1.localizer.frame_queue import FrameQueue
from rosafe.ros1.localizer.frame_source import FrameSource, NewFrames, StreamRestartedError
from rosafe.ros1.localizer.publishers import Publishers, uniform
from rosafe.ros1.localizer.status import WARN, NodeStatus
from rosafe.ros1.localizer.tree_link import Link
from rosafe.ros1.transport.log_throttle import ThrottledLog

PERIOD = 0.1  # s between two messages
LOG_SECONDS = 10.0  # in which lost frames are logged once
SLACK = 0.05  # s that new frames may be late before a message without them is published
SILENCE_SECONDS = 0.5  # without new frames, in addition to a block, until no source is published
TIME_SLACK = 0.1  # s by which the time of frames may go back, when the clock of the stream is fitted
MAX_PAUSE = 2.0  # s between two frames; later ones begin again
GAP_SECONDS = 0.5  # of lost frames after which localization begins again

_report = ThrottledLog(rospy.logwarn, LOG_SECONDS)


class LocalizationLoop:
    """Localizes and publishes, on a thread of its own, from `start` to `close`.

    Parameters
    ----------
    localizer_for : callable
        Called with the model of the head; returns the localizer.
    publishers : Publishers
    clock : FrameClock
    queue : FrameQueue
    status : NodeStatus
    suspicious : callable
        Called if messages do not fit the processors that were requested.
    """

    def __init__(
        self,
        localizer_for: Callable[[DirectionModel], Localizer],
        publishers: Publishers,
        clock: FrameClock,
        queue: FrameQueue,
        status: NodeStatus,
        suspicious: Callable[[], None],
    ) -> None:
        self._localizer_for = localizer_for
        self._publishers = publishers
        self._clock = clock
        self._queue = queue
        self._status = status
        self._suspicious = suspicious
        self._arrived = threading.Event()
        self._closing = False
        self._lock = threading.Lock()  # of the link
        self._source: FrameSource | None = None
        self._localizer: Localizer | None = None
        self._newest = 0.0  # end of the newest frame that was used, clock time in s; 0 before the first one
        self._used_at = 0.0  # when it was used (time.monotonic)
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

    def connect(self, link: Link | None) -> None:
        """Use the representations of a link; None: there are none any more."""
        localizer = source = None
        if link is not None:
            localizer = self._localizer_for(link.model)
            source = FrameSource(link.topics, link.format, self._clock, self._arrived.set)
        with self._lock:
            before, self._source = self._source, source
            self._used_at = self._queue.received_at = time.monotonic()
            self._begin_again()
            self._localizer = localizer
        if before is not None:
            before.close()
        if link is None:
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
            self._publishers.begin_again()
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
            _report(f"a new stream of sound: {restart}; localization begins again", "stream")
            self._begin_again()
            return False
        if source.problem:
            self._status.set("frames", WARN, f"messages of rosAFE cannot be used: {source.problem}")
            self._suspicious()
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
            _report(f"the time jumped by {jump}; localization begins again; with use_sim_time, check /clock", "time")
            self._begin_again()
            return False
        middles = np.maximum.accumulate(middles)
        yaw = np.stack((middles, used.yaw), axis=1) if used.yaw.any() else 0.0
        try:
            result = localizer.update(used.frames.features, middles, yaw, last_only=True)
        except ValueError as problem:  # not finite
            self._status.set("values", WARN, f"messages of rosAFE cannot be used: {problem}")
            self._begin_again()
            return False
        self._status.clear("values")
        steady = ", ".join(f"{azimuth:.0f}" for azimuth in localizer.noise.azimuths)
        self._status.value("directions of steady noise (degrees)", steady or "none")
        self._estimate = result["azimuths"], result["posterior"][0]
        self._newest, self._used_at = float(result["time"][0]), time.monotonic()
        return True

    def _append(self, new: NewFrames, localizer: Localizer) -> None:
        if new.lost:
            self._status.count("lost frames", new.lost)
            _report(f"{new.lost} frames of rosAFE were lost before {new.middles[0]:.3f} s")
            if new.lost * localizer.hop > GAP_SECONDS:
                self._begin_again()
        self._queue.append(new)

    def _check_silence(self) -> None:
        """Forget the sources if no frames were used for too long."""
        now = time.monotonic()
        source = self._source
        if source is None:
            return
        limit = self._limit(source)
        if self._newest and (self._queue.muted or now - self._used_at > limit):
            self._begin_again()
        if now - self._queue.received_at <= limit:
            self._status.clear("frames")
        elif not source.problem:
            self._status.set("frames", WARN, f"waiting for {source.missing}")

    def _publish(self) -> bool:
        """Publish the state; return True."""
        self._check_silence()
        localizer = self._localizer
        sources = localizer.sources if localizer is not None and self._newest and not self._queue.muted else []
        gain_db = localizer.model.level_gain_db if localizer is not None else 0.0
        stamp = self._newest or rospy.get_time()
        self._publishers.publish(stamp, sources, gain_db, self._estimate)
        return True
