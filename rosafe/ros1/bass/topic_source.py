"""The source `topic:` in ROS 1: messages of audio_common, or the port Audio of a running bass or of `rosbag play`."""

from __future__ import annotations

import math
import struct
import threading
import time
from typing import Any

import rosgraph.names
import rospy

from rosafe.audio.devices.base import Chunk, check_sample_rate, device_error
from rosafe.audio.devices.received import DESCRIPTION_SECONDS, FIRST_SECONDS, ReceivedSource
from rosafe.audio.files.bagsound import MAX_MESSAGE, MD5SUM, TYPE
from rosafe.audio.files.windows import MAX_WINDOW, WindowStream, mismatch, new_samples, window_error
from rosafe.interface import BASS, ComponentError
from rosafe.ros1.component import serialization
from rosafe.ros1.transport import master

NO_PUBLISHER_SECONDS = 1.0  # timeout for the first message, if the topic has no publisher
MAX_CHUNK = int(BASS.service("Acquire").parameter("nFramesPerChunk").maximum or 0)
_AUDIO = BASS.port("Audio").idl
_HEADER, _LENGTH, _INFO = struct.Struct("<III"), struct.Struct("<I"), struct.Struct("<BI")
DATA, STAMPED, INFO = (f"audio_common_msgs/{name}" for name in ("AudioData", "AudioDataStamped", "AudioInfo"))
MD5SUMS = {  # by type, of messages that can be read
    DATA: "f43a8e1b362b75baa741461b46adc7e0",
    STAMPED: "3cdd84a06846af0dca4d0434908f9d96",
    INFO: "9413d9b7029680d3b1db6ed0ae535f88",
}


class _Message(rospy.AnyMsg):
    """A message of any type that is not decoded, with a limit of its length."""

    _slot_types = ("uint8[]",)
    longest_sequence = MAX_MESSAGE

    @property
    def publisher(self) -> str:
        """The name of the node that has sent it."""
        return str(self._connection_header.get("callerid", ""))

    @property
    def type(self) -> str:
        """The name of its type; `_AUDIO` for the port Audio, in any package."""
        name, md5sum = (self._connection_header.get(key, "") for key in ("type", "md5sum"))
        if md5sum == MD5SUM:
            return _AUDIO
        return name if MD5SUMS.get(name) == md5sum else f"{name} with md5 sum {md5sum}"


def _bytes(data: bytes, at: int) -> tuple[bytes, int]:
    """Return a text or a sequence of bytes of a message, and the position after it. Raises struct.error."""
    (length,) = _LENGTH.unpack_from(data, at)
    at += _LENGTH.size
    if at + length > len(data):
        raise struct.error(f"expected {at + length} bytes, got {len(data)}")
    return data[at : at + length], at + length


class TopicSource(ReceivedSource):
    """The sound that is published on a topic after the source was created. Create it after `rospy.init_node`.

    Parameters
    ----------
    text, sample_rate, frames_per_chunk, stopping, patience
        As for `ReceivedSource`.

    Attributes
    ----------
    newest : int
        Number of the frame before the first one that is read, if the topic is a port Audio; otherwise 0.
    port_chunk : int
        Frames per chunk according to the first message of a port Audio; otherwise 0.

    Raises
    ------
    ComponentError
        ``::bass::e_device`` if no message arrives, or none of its types can be used; ``::bass::e_hwparams`` for another
        sample rate, or a format that cannot be used.
    """

    def __init__(
        self,
        text: str,
        sample_rate: int,
        frames_per_chunk: int,
        stopping: threading.Event,
        patience: float = math.inf,
    ) -> None:
        super().__init__(text, sample_rate, frames_per_chunk, stopping, patience)
        if not rosgraph.names.is_legal_name(self.topic):
            raise device_error(f"{self.name}: expected the name of a topic, such as /audio")
        self.topic = rospy.resolve_name(self.topic)
        self.newest = self.port_chunk = 0
        self._windows: WindowStream | None = None  # joins the messages of a port Audio
        self._window_class = serialization.tolerant_message_class("bass", _AUDIO, MAX_WINDOW)
        published = master.bounded(_published, None, stopping.is_set, NO_PUBLISHER_SECONDS)
        if published is None:
            raise device_error(f"{self.name}: no ROS master answers; start roscore")
        if self.topic == f"{rospy.get_name()}/Audio":
            raise device_error(f"{self.name}: expected the topic of another node, got the port of this bass")
        self._check_type(published.get(self.topic))
        self._subscribers = [self._subscribe(self.topic, self._receive)]
        if self.needs_description:
            beside = f"{self.topic.rpartition('/')[0]}/audio_info"
            self._subscribers.append(
                self._subscribe(beside if beside in published else "/audio_info", self._receive_info)
            )
        try:
            if self.topic not in published:
                self.begin("the topic has no publisher", NO_PUBLISHER_SECONDS)
            else:
                is_described = self.needs_description and published[self.topic] in (DATA, STAMPED)
                self.begin(seconds=DESCRIPTION_SECONDS if is_described else FIRST_SECONDS)
        except ComponentError:
            self.close()
            raise

    def _subscribe(self, topic: str, callback: Any) -> rospy.Subscriber:
        # No message is dropped: a pause of this thread would otherwise lose sound.
        return rospy.Subscriber(topic, _Message, callback, queue_size=None, buff_size=2**17, tcp_nodelay=True)

    def _check_type(self, name: str | None) -> None:
        if name is not None and name not in (DATA, STAMPED) and name.rpartition("/")[2] != TYPE:
            raise device_error(f"{self.name}: expected {DATA}, {STAMPED} or a port Audio, got type {name}")

    # --- threads of rospy ---

    def _receive(self, message: _Message) -> None:
        data = message._buff
        try:
            if message.type == _AUDIO:
                self._receive_window(message)
            elif message.type == DATA:
                self.receive(_bytes(data, 0)[0], publisher=message.publisher)
            elif message.type == STAMPED:
                number, seconds, nanoseconds = _HEADER.unpack_from(data)
                _, at = _bytes(data, _HEADER.size)
                stamp = seconds * 1_000_000_000 + nanoseconds
                self.receive(_bytes(data, at)[0], stamp, number, message.publisher)
            else:
                self._refuse(f"messages of type {message.type} are not used")
        except struct.error as problem:
            self._refuse(f"malformed messages are not used: {problem}")

    def _refuse(self, text: str) -> None:
        with self.arrived:
            self._remark(text[:40], text)

    def _receive_info(self, message: _Message) -> None:
        data = message._buff
        try:
            if message.type != INFO:
                raise struct.error(f"type {message.type}")
            channels, rate = _INFO.unpack_from(data)
            form, at = _bytes(data, _INFO.size)
            coding, _ = _bytes(data, at + _LENGTH.size)
        except struct.error as problem:
            self._refuse(f"malformed descriptions of the format are not used: {problem}")
            return
        self.describe(channels, rate, form.decode("ascii", "replace"), coding.decode("ascii", "replace"))

    def _receive_window(self, message: _Message) -> None:
        window, now = self._window_class().deserialize(message._buff), time.monotonic()
        with self.arrived:
            if self._end or window.problem or window_error(window) or not self._is_ours(message.publisher, now):
                return  # the next window contains the same frames, or they count as lost
            if self._windows is None and (problem := self._unusable_port(int(window.sampleRate))):
                self._fail(problem)
                self.arrived.notify_all()
                return
            self._append_window(window)
            self._note_message(now)

    def _unusable_port(self, rate: int) -> ComponentError | None:
        if self._options:
            return device_error(f"{self.name}: expected no options for a port Audio, got {', '.join(self._options)}")
        try:
            check_sample_rate(self.name, self._requested_rate, rate)
        except ComponentError as problem:
            return problem
        return None

    def _append_window(self, window: Any) -> None:
        if self._windows is None:
            self._windows = WindowStream(with_first=False)
            new_samples(self._windows, window)
            self.sample_rate, self.newest = int(window.sampleRate), int(window.lastFrameIndex)
            self.port_chunk = min(max(1, int(window.nFramesPerChunk)), MAX_CHUNK)
        elif why := mismatch(self._windows, self.sample_rate, window):
            self.end(f"a new stream begins ({why}); call Acquire")
        else:
            gap, samples = new_samples(self._windows, window)
            if gap or samples.shape[1]:
                self.put(gap, samples, window.stamp["sec"] + window.stamp["nsec"] * 1e-9)

    # --- the thread that reads ---

    def read(self) -> Chunk | None:
        """Return the next chunk, as `ReceivedSource` does; ``::bass::e_device`` if a port had no new frame at all."""
        chunk = super().read()
        if chunk is None and self._windows is not None and not self._taken[1] and not self._stopping.is_set():
            raise device_error(
                f"{self.name}: expected new frames, got only old ones for {self._patience:g} s; call Acquire"
            )
        return chunk

    def close(self) -> None:
        """End the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.unregister()


def _published() -> dict[str, str] | None:
    """Return the type of each published topic; None without a master."""
    try:
        return dict(rospy.get_published_topics())
    except master.FAILURES:
        return None
