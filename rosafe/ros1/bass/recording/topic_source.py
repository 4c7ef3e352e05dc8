"""A source that subscribes to a port Audio, of a running bass or `rosbag play`."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from typing import Any

import numpy as np
import rosgraph.names
import rospy

from rosafe.audio.devices.base import Chunk, check_sample_rate, device_error
from rosafe.audio.files.windows import MAX_WINDOW, WindowStream, mismatch, new_samples, window_error
from rosafe.interface import BASS, ComponentError
from rosafe.ros1.component import serialization

FIRST_SECONDS = 3.0  # timeout for the first message
NO_PUBLISHER_TIMEOUT = 1.0  # s for the first message, if the topic has no publisher
STALL_SECONDS = 5.0  # without new frames, plus the length of a chunk, until the stream counts as ended
POLL_SECONDS = 0.1
MAX_WAITING = 2**24  # received frames that wait to be read, 128 MB; further frames are lost
MAX_CHUNK = int(BASS.service("Acquire").parameter("nFramesPerChunk").maximum or 0)


class TopicSource:
    """The frames that are published on a topic after the source was created. Create it after `rospy.init_node`.

    Parameters
    ----------
    topic : str
        Such as ``/bass/Audio``.
    sample_rate : int
        Hz; must be the stream's own, or 0.

    Attributes
    ----------
    newest : int
        Index of the frame before the first one that is read.
    frames_per_chunk : int
        According to the first message.

    Raises
    ------
    ComponentError
        ``::bass::e_device`` if no message arrives, or the topic is not a port Audio; ``::bass::e_hwparams`` for another
        sample rate.
    """

    def __init__(self, topic: str, sample_rate: int, stopping: threading.Event) -> None:
        if not rosgraph.names.is_legal_name(topic):
            raise device_error(f"expected the name of a topic, got {topic}")
        self.name = topic = rospy.resolve_name(topic)
        self.overruns = 0
        self.lost_frames = 0
        self._stopping = stopping
        self._stream = WindowStream(with_first=False)
        self.sample_rate = 0  # Hz, of the first message
        # The first message; then (gap, samples, time) of each message, or the reason why the stream has ended.
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._put = self._taken = 0  # number of frames added to the queue and removed; each is counted by one thread
        self._missed = 0  # number of frames since the newest one in the queue that were dropped, as it was full
        self._ended = False  # whether the reason is in the queue
        self._begun = False  # whether a chunk was read
        message_class = serialization.tolerant_message_class("bass", BASS.port("Audio").idl, MAX_WINDOW)
        published = dict(rospy.get_published_topics()).get(topic)
        if published is not None and published.rpartition("/")[2] != message_class.__name__:
            raise device_error(f"expected {topic} to be a port Audio, got type {published}")
        self._subscriber = rospy.Subscriber(topic, message_class, self._receive, buff_size=2**24, tcp_nodelay=True)
        try:
            first = self._await_first(published is not None)
            self.newest = int(first.lastFrameIndex)
            self.frames_per_chunk = min(max(1, int(first.nFramesPerChunk)), MAX_CHUNK)
            check_sample_rate(topic, sample_rate, self.sample_rate)
        except ComponentError:
            self.close()
            raise

    def _await_first(self, published: bool) -> Any:
        message = self._next_item(FIRST_SECONDS if published else NO_PUBLISHER_TIMEOUT)
        if message is not None:
            return message
        if self._stopping.is_set():
            raise device_error(f"{self.name}: stopped before the first message arrived")
        problem = (
            "no message was published; call Acquire of its bass"
            if published
            else "the topic has no publisher; start bass-ros"
        )
        raise device_error(f"{self.name}: {problem}, or record a --device without ROS")

    def _next_item(self, timeout: float) -> Any:
        """Return the next item of the queue; None after a stop or `timeout` seconds."""
        end = time.monotonic() + timeout
        while not self._stopping.is_set() and time.monotonic() < end:
            with contextlib.suppress(queue.Empty):
                return self._queue.get(timeout=POLL_SECONDS)
        return None

    def _receive(self, message: Any) -> None:
        if self._ended or message.problem or window_error(message):
            return  # the next window contains the same frames, or they count as lost
        if not self.sample_rate:
            self.sample_rate = int(message.sampleRate)
            new_samples(self._stream, message)
            self._queue.put(message)
        elif why := mismatch(self._stream, self.sample_rate, message):
            self._ended = True
            self._queue.put(f"{self.name}: a new stream begins ({why})")
        else:
            stamp = message.stamp["sec"] + message.stamp["nsec"] * 1e-9
            gap, samples = new_samples(self._stream, message)
            frames = samples.shape[1]
            if self._put - self._taken + frames > MAX_WAITING:
                self._missed += gap + frames
            elif frames:
                self._put += frames
                self._queue.put((gap + self._missed, samples, time.monotonic() - (time.time() - stamp)))
                self._missed = 0

    def read(self) -> Chunk | None:
        """Return the new frames, in any number; None if no new frame arrives for some seconds.

        Raises ``::bass::e_device`` if a new stream begins, or there was no new frame at all.
        """
        item = self._next_item(STALL_SECONDS + self.frames_per_chunk / self.sample_rate)
        if item is None:
            if self._begun or self._stopping.is_set():
                return None
            raise device_error(
                f"{self.name}: expected new frames, got only old ones for {STALL_SECONDS:g} s; call Acquire"
            )
        if isinstance(item, str):
            raise device_error(item)
        gap, samples, moment = item
        self._begun = True
        self._taken += samples.shape[1]
        self.overruns += gap > 0
        self.lost_frames += gap
        return Chunk(np.asarray(samples), gap, moment)

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.unregister()
