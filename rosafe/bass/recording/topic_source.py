"""A source that listens: what a running bass, or `rosbag play`, publishes on a port Audio."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import numpy as np
import rosgraph.names
import rospy

from rosafe.bass.sources.base import Chunk, device_error, hwparams_error
from rosafe.component import serialization
from rosafe.interface import BASS, ComponentError
from rosafe.sound.windows import MAX_WINDOW, WindowStream, window_error

FIRST_SECONDS = 3.0  # for a first message
NO_PUBLISHER_TIMEOUT = 1.0  # for one where nobody publishes the topic
STALL_SECONDS = 5.0  # without anything new, the stream counts as ended; besides a chunk's own length
POLL_SECONDS = 0.1
MAX_WAITING = 2**24  # frames that came and were not read yet, 128 MB; more are lost
MAX_CHUNK = int(BASS.service("Acquire").parameter("nFramesPerChunk").maximum or 0)


class TopicSource:
    """The frames that are new on a topic from now on. Make it after `rospy.init_node`.

    Parameters
    ----------
    topic : str
        Such as ``/bass/Audio``.
    sample_rate : int
        Hz; must be the stream's own, or 0.

    Attributes
    ----------
    newest : int
        Number of the frame before the first one that is read.
    frames_per_chunk : int
        As the first message says.

    Raises
    ------
    ComponentError
        ``::bass::e_device`` where nothing comes, or something else than sound; ``::bass::e_hwparams`` for another
        sample rate.
    """

    def __init__(self, topic: str, sample_rate: int, stopping: threading.Event) -> None:
        if not rosgraph.names.is_legal_name(topic):
            raise device_error(f"{topic} is no name of a topic")
        self.name = topic = rospy.resolve_name(topic)
        self.overruns = 0
        self.lost_frames = 0
        self._stopping = stopping
        self._stream = WindowStream(with_first=False)
        self._news: queue.SimpleQueue[Any] = queue.SimpleQueue()  # (gap, samples, time), or why the stream has ended
        self._put = self._taken = 0  # frames into the queue and out of it; each is counted by one thread
        self._missed = 0  # frames that found no room since the last that did
        self._ended = False  # whether the queue says so
        self._begun = False
        self._first: Any = None
        self._arrived = threading.Event()
        message_class = serialization.tolerant_message_class("bass", BASS.port("Audio").idl, MAX_WINDOW)
        kinds = dict(rospy.get_published_topics())
        kind = kinds.get(topic)
        if kind is not None and kind.rpartition("/")[2] != message_class.__name__:
            raise device_error(f"{topic} is no port Audio, but of type {kind}")
        self._subscriber = rospy.Subscriber(topic, message_class, self._hear, buff_size=2**24, tcp_nodelay=True)
        try:
            first = self._await_first(kind is not None)
            self.sample_rate = int(first.sampleRate)
            self.newest = int(first.lastFrameIndex)
            self.frames_per_chunk = min(max(1, int(first.nFramesPerChunk)), MAX_CHUNK)
            if sample_rate not in (0, self.sample_rate):
                raise hwparams_error(
                    f"{topic} has a sample rate of {self.sample_rate} Hz, asked for were {sample_rate}"
                )
        except ComponentError:
            self.close()
            raise
        self._patience = STALL_SECONDS + self.frames_per_chunk / self.sample_rate

    def _await_first(self, published: bool) -> Any:
        end = time.monotonic() + (FIRST_SECONDS if published else NO_PUBLISHER_TIMEOUT)
        while not self._arrived.wait(POLL_SECONDS) and not self._stopping.is_set():
            if time.monotonic() > end:
                what = (
                    "has published nothing: call Acquire of its bass"
                    if published
                    else "is published by nobody: start bass-ros"
                )
                raise device_error(f"{self.name} {what}, or record a --device without ROS")
        if self._first is None:
            raise device_error(f"{self.name}: interrupted before a first message came")
        return self._first

    def _hear(self, message: Any) -> None:
        if self._ended or message.problem or window_error(message):
            return  # the next window shows what it would have shown
        if self._first is None:
            self._first = message
            self._stream.fresh(message)
            self._arrived.set()
        elif why := self._stream.join_state(message):
            self._ended = True
            self._news.put(f"{self.name}: a new stream begins ({why})")
        else:
            stamp = message.stamp["sec"] + message.stamp["nsec"] * 1e-9
            gap, samples = self._stream.fresh(message)
            frames = samples.shape[1]
            if self._put - self._taken + frames > MAX_WAITING:
                self._missed += gap + frames
            elif frames:
                self._put += frames
                self._news.put((gap + self._missed, samples, time.monotonic() - (time.time() - stamp)))
                self._missed = 0

    def read(self) -> Chunk | None:
        """What is new, of any length; None once nothing new has come for some seconds.

        Raises ``::bass::e_device`` where another stream begins, or none was there at all.
        """
        end = time.monotonic() + self._patience
        while not self._stopping.is_set():
            try:
                news = self._news.get(timeout=POLL_SECONDS)
            except queue.Empty:
                if time.monotonic() < end:
                    continue
                if not self._begun:
                    raise device_error(
                        f"{self.name} shows old sound only, nothing new has come for {STALL_SECONDS:g} s: call Acquire"
                    ) from None
                return None
            if isinstance(news, str):
                raise device_error(news)
            gap, samples, moment = news
            self._begun = True
            self._taken += samples.shape[1]
            self.overruns += gap > 0
            self.lost_frames += gap
            return Chunk(np.asarray(samples), gap, moment)
        return None

    def close(self) -> None:
        """Listen no more."""
        self._subscriber.unregister()
