"""A driver of microphones that publishes messages of audio_common with stock rospy; also a program.

    python3 -m tests.ros1.bass.driver TOPIC FILE.npy OPTIONS

publishes the samples of the file, int32 (frames, channels), in real time when it has a subscriber.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from genpy.dynamic import generate_dynamic

from tests.audio.test_received import encode

_DATA, _HEADER = "uint8[] data\n", "uint32 seq\ntime stamp\nstring frame_id\n"
_BREAK = "=" * 80 + "\nMSG: "
_TEXTS = {  # as in the package audio_common_msgs
    "AudioData": _DATA,
    "AudioDataStamped": "std_msgs/Header header\naudio_common_msgs/AudioData audio\n"
    f"{_BREAK}std_msgs/Header\n{_HEADER}{_BREAK}audio_common_msgs/AudioData\n{_DATA}",
    "AudioInfo": "uint8 channels\nuint32 sample_rate\nstring sample_format\nuint32 bitrate\nstring coding_format\n",
}
CLASSES: dict[str, Any] = {}
for _name, _text in _TEXTS.items():
    CLASSES[_name] = generate_dynamic(f"audio_common_msgs/{_name}", _text)[f"audio_common_msgs/{_name}"]


class Driver:
    """Publishes sound in successive messages, and their format if there is a topic for it."""

    def __init__(self, topic: str, rate: int, form: str = "S16LE", info: str = "", stamped: bool = True) -> None:
        self.topic, self.rate, self.form, self.stamped = topic, rate, form, stamped
        kind = CLASSES["AudioDataStamped" if stamped else "AudioData"]
        self._publisher = rospy.Publisher(topic, kind, queue_size=1000, tcp_nodelay=True)
        self._info = rospy.Publisher(info, CLASSES["AudioInfo"], latch=True, queue_size=1) if info else None
        self._begin = 0.0
        self.newest = 0.0  # clock time of the end of the last message

    def describe(self, channels: int, coding: str = "wave", form: str = "") -> None:
        """Publish the format."""
        assert self._info is not None
        self._info.publish(channels, self.rate, form or self.form, 0, coding)

    @property
    def subscribed(self) -> bool:
        """Whether there is a subscriber."""
        return self._publisher.get_num_connections() > 0

    def send(self, data: bytes, frame: int) -> None:
        """Publish a message whose first frame has this number."""
        if not self._begin:
            self._begin = time.time() - frame / self.rate
        message = CLASSES["AudioData"](data)
        if self.stamped:
            message = CLASSES["AudioDataStamped"](audio=message)
            message.header.stamp = rospy.Time.from_sec(self._begin + frame / self.rate)
        self._publisher.publish(message)

    def play(
        self, samples: np.ndarray, length: int, lost: Iterable[int] = (), end: threading.Event | None = None
    ) -> None:
        """Publish samples, int32 (frames, channels), in real time, without the messages with the numbers in `lost`."""
        for number in range(len(samples) // length):
            if rospy.is_shutdown() or (end is not None and end.is_set()):
                break
            frame = number * length
            if number not in lost:
                self.send(encode(samples[frame : frame + length], self.form), frame)
            self.newest = self._begin + (frame + length) / self.rate
            time.sleep(max(0.0, self.newest - time.time()))

    def close(self) -> None:
        """Unregister."""
        for publisher in filter(None, (self._publisher, self._info)):
            publisher.unregister()


def main() -> None:
    """Publish a file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("file", type=Path)
    parser.add_argument("--rate", type=int, default=16000)
    parser.add_argument("--form", default="S16LE")
    parser.add_argument("--length", type=int, default=160)
    parser.add_argument("--info", default="")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--lost", type=int, nargs="*", default=[])
    parser.add_argument("--name", default="microphones")
    options = parser.parse_args()
    rospy.init_node(options.name)
    driver = Driver(options.topic, options.rate, options.form, options.info, not options.plain)
    samples = np.load(options.file)
    if options.info:
        driver.describe(samples.shape[1])
    while not (driver.subscribed or rospy.is_shutdown()):
        time.sleep(0.01)
    driver.play(samples, options.length, set(options.lost))
    rospy.spin()


if __name__ == "__main__":
    main()
