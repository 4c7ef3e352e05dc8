"""`rosafe.ros.PortReader` on a running node: each frame once, equal to the result of `rosafe.process`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rospy
from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct

from rosafe.ros import Frames, PortReader, array_msg
from tests.harness import wait_for
from tests.ros1.afe.session import RATE, Microphone, Session, expected, noise
from tests.ros1.afe.test_frame_time import Stamped

CHAIN = ("PreProc", "GammatoneProc", "IhcProc")
FRAMED = (*CHAIN, "IldProc", "RatemapProc", "CrossCorrelationProc")
TOPICS = {
    "input": "/rosAFE/inputProcPort",
    "gammatone": "/rosAFE/gammatonePort/gammatone",
    "ild": "/rosAFE/ildPort/ild",
    "ratemap": "/rosAFE/ratemapPort/ratemap",
    "crossCorrelation": "/rosAFE/crossCorrelationPort/crosscorrelation",
}


@pytest.fixture
def ild(afe: Session) -> Iterator[PortReader]:
    with contextlib.closing(PortReader(TOPICS["ild"])) as reader:
        yield reader


def read_until(reader: PortReader, index: int) -> list[Frames]:
    """Read until the message with a lastFrameIndex."""
    found: list[Frames] = []
    while not found or found[-1].index != index:
        found.append(reader.read(30.0))
    return found


@pytest.mark.parametrize("block", [1600, 1000, 130])
def test_each_frame_once_as_computed_offline(afe: Session, block: int) -> None:
    """The block has eight hops of 200 frames, five, or less than one. One port is read by a callback, too."""
    signal = noise(60 * block)
    result = expected(signal, block)
    microphone = afe.build(*FRAMED, block=block)
    called: list[Frames] = []
    readers = {kind: PortReader(topic) for kind, topic in TOPICS.items()}
    readers["called"] = PortReader(TOPICS["ratemap"], called.append)
    try:
        for topic in TOPICS.values():
            wait_for(lambda: afe.connections(topic), what=topic)  # noqa: B023
        for start in range(0, signal.shape[1], 10 * block):  # faster, the large messages would be too many
            microphone.play(signal[:, start : start + 10 * block])
            wait_for(lambda: readers["gammatone"]._stream.end == microphone.index)
        for kind in TOPICS:
            parts = read_until(readers[kind], signal.shape[1] + 1)
            check(parts, result[kind], kind)
        wait_for(lambda: called and called[-1].index == signal.shape[1] + 1)
        check(called, result["ratemap"], "ratemap")
        assert called[0].axes == ("ear", "channel", "time") and called[0].rate == 100
    finally:
        for reader in readers.values():
            reader.close()


def check(parts: list[Frames], result: np.ndarray, kind: str) -> None:
    """Check that frames follow each other, and that they are those of a result."""
    at = parts[0].first_frame
    assert at <= 1
    for part in parts:
        assert (part.first_frame, part.lost, part.restarted, part.kind) == (at, 0, False, kind)
        np.testing.assert_array_equal(part.data, result[..., at : part.after])
        at = part.after
    assert at == result.shape[-1]


def test_lost_frames_are_counted_and_located(afe: Session, ild: PortReader) -> None:
    """Windows have ten frames. After twenty missed messages, the next one has the frames of the last."""
    signal = noise(60 * 1600)
    result = expected(signal, 1600)["ild"]
    microphone = afe.build(*CHAIN, "IldProc", block=1600, bufferSize_s_port=0.1)
    wait_for(lambda: afe.connections(TOPICS["ild"]))
    microphone.play(signal[:, : 10 * 1600])
    read_until(ild, 16001)
    receive = ild._receive
    ild._subscriber.unregister()
    microphone.play(signal[:, 16000:48000])
    wait_for(lambda: afe.read("ild").lastFrameIndex == 48001)
    ild._subscriber = rospy.Subscriber(TOPICS["ild"], ild._message_class, receive)
    (again,) = read_until(ild, 48001)
    assert (again.lost, ild.lost, again.restarted) == (160 - 10, 150, False)
    np.testing.assert_array_equal(again.data, result[:, again.first_frame : again.after])
    assert again.after == (48000 - 400) // 200 + 1


def test_restarts_and_changes_begin_again(afe: Session, ild: PortReader) -> None:
    microphone = afe.build(*CHAIN, "IldProc", block=1600)
    wait_for(lambda: afe.connections(TOPICS["ild"]))
    microphone.play(noise(16000))
    assert not any(part.restarted for part in read_until(ild, 16001))
    microphone.window[:], microphone.index = 0, 0
    microphone.publish()
    sound = noise(8000)
    sound[:, :1600] = 0  # silence is not left out
    microphone.play(sound)
    first, *others = read_until(ild, 8001)
    assert first.restarted and first.first_frame == 0 and not any(part.restarted for part in others)
    afe.ok("modifyParameter", nameProc="gammatone", nameParam="fb_nChannels", newValue="7")
    microphone.play(noise(16000, 2))
    changed = read_until(ild, 24001)
    assert next(part.restarted for part in changed if part.data.shape[0] == 7) and changed[-1].data.shape[0] == 7
    assert ild.problem == ""


def test_a_processor_of_running_sound(afe: Session, ild: PortReader) -> None:
    """Its window is full of zeros before its first block. They are skipped."""
    microphone = afe.build(block=1600)
    before, sound = noise(16000), noise(16000, 2)
    microphone.play(before)
    afe.read("input", 16001)
    for request in (*CHAIN, "IldProc"):
        afe.ok(request)
    wait_for(lambda: afe.connections(TOPICS["ild"]))
    microphone.play(sound)
    found = Frames.joined(read_until(ild, 32001))
    result = expected(np.concatenate((before[:, -1600:], sound), axis=1), 1600)["ild"]  # from the newest block on
    np.testing.assert_array_equal(found.data, result)
    assert (found.first_frame, found.lost, found.restarted) == (72, 0, False)


def test_stamps(afe: Session, ild: PortReader) -> None:
    microphone = afe.microphone = Stamped(afe.graph)
    afe.ok("connect_port", local="Audio", remote=microphone.topic)
    afe.build(*CHAIN, "IldProc", block=1600)
    wait_for(lambda: afe.connections(TOPICS["ild"]) and afe.connections("/rosAFE/frameTime"))
    stamps: list[tuple[int, float]] = []
    for block in range(30):
        microphone.play(noise(1600, block))
        stamps += [(one.first_frame, one.stamp) for one in read_until(ild, microphone.index + 1) if one.stamp]
    assert stamps
    clock = ild._clock
    assert clock is not None
    for first, stamp in stamps[-1:]:
        assert stamp == pytest.approx(clock.time(first * 200 + 200).ros.to_sec(), abs=1e-3)


def test_sound_of_bass(afe: Session) -> None:
    microphone = Microphone(afe.graph)
    sound = noise(40_000)
    try:
        with contextlib.closing(PortReader(microphone.topic)) as reader:
            wait_for(lambda: microphone.subscribed)
            microphone.play(sound[:, :12_000])
            parts = read_until(reader, 12_000)
            microphone.lose(sound[:, 12_000:20_000])
            microphone.play(sound[:, 20_000:])
            parts += read_until(reader, 40_000)
    finally:
        microphone.close()
    assert parts[0].first_frame == 0 and (parts[0].kind, parts[0].axes, parts[0].rate) == (
        "Audio",
        ("ear", "time"),
        RATE,
    )
    assert sum(part.lost for part in parts) == 8000 + 400 - 4000
    for part in parts:
        np.testing.assert_array_equal(part.data, sound[:, part.first_frame : part.after])


def test_a_full_queue_drops_the_oldest_frames(afe: Session) -> None:
    microphone = afe.build(*CHAIN, "IldProc", block=1600)
    with contextlib.closing(PortReader(TOPICS["ild"], queue_size=3)) as reader:
        wait_for(lambda: afe.connections(TOPICS["ild"]))
        for block in range(10):
            microphone.play(noise(1600, block))
            afe.read("ild", microphone.index + 1)
            wait_for(lambda: reader._stream.end == microphone.index)
        found = reader.read(0)
        assert (found.first_frame, found.lost, found.after) == (7 * 8 - 1, 7 * 8 - 1, 79)
        with pytest.raises(TimeoutError, match=r"/rosAFE/ildPort/ild: expected new frames, got none"):
            reader.read(0.01)


def test_bad_messages_are_one_line(afe: Session, ild: PortReader, capfd: pytest.CaptureFixture[str]) -> None:
    """A second publisher sends other shapes, rates and indices; the frames of the node still arrive."""
    message_class = array_msg(rosAFE_TimeFrequencySignalPortStruct)
    publisher = rospy.Publisher(TOPICS["ild"], message_class, queue_size=100)
    try:
        microphone = afe.build(*CHAIN, "IldProc", block=1600)
        wait_for(lambda: afe.connections(TOPICS["ild"]) and publisher.get_num_connections())
        microphone.play(noise(16000))
        read_until(ild, 16001)
        for index, rate, channels in ((16001, 100, 3), (2**63, 100, 31), (17000, 16000, 31)):
            for _ in range(10):
                publisher.publish(message_class(rate, index, 5, channels, np.ones((channels, 5)), np.zeros(0)))
        wait_for(lambda: "sampleRate: expected 100 Hz, got 16000" in ild._problems._text)
        microphone.play(noise(16000, 2))
        assert all(part.lost == 0 and not part.restarted for part in read_until(ild, 32001))
        assert ild.problem
    finally:
        publisher.unregister()


def test_another_topic_is_rejected(afe: Session) -> None:
    with pytest.raises(
        ValueError, match="topic: expected a port such as /rosAFE/ildPort/ild or /bass/Audio, got /rosout"
    ):
        PortReader("/rosout")


@pytest.mark.parametrize("size", [0, -1, 1.5, True, None, "3"])
def test_a_queue_without_room_is_rejected(size: Any) -> None:
    with pytest.raises(ValueError, match="queue_size: expected a whole number from 1 on, got "):
        PortReader(TOPICS["ild"], queue_size=size)


def test_a_timeout_is_a_number(ild: PortReader) -> None:
    for timeout in (float("nan"), "1", True, 10**400, -float("inf")):
        with pytest.raises(ValueError, match="timeout: expected seconds or None, got "):
            ild.read(timeout)  # type: ignore[arg-type]
    with pytest.raises(TimeoutError):
        ild.read(-1.0)


def test_a_reader_and_a_subscriber_in_one_process(afe: Session) -> None:
    """rospy uses the message class of the first one for both."""
    microphone = afe.build(*CHAIN, "IldProc", block=1600)
    with (
        afe.graph.collect(TOPICS["ild"], rosAFE_TimeFrequencySignalPortStruct) as messages,
        contextlib.closing(PortReader(TOPICS["ild"])) as reader,
    ):
        microphone.play(noise(16000))
        data = read_until(reader, 16001)[-1].data
        wait_for(lambda: messages and messages[-1].lastFrameIndex == 16001)
        newest = [channel.data[-1] for channel in messages[-1].left.dataN]
    np.testing.assert_array_equal(data[:, -1], newest)
