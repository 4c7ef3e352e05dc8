"""The content of the ports: shapes, indices and values are bit-identical to rosafe.process."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import rosAFE.msg
import rosAFE.srv
import rospy

from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE, ros_type
from rosafe.ros import array_srv
from rosafe.ros1.component import serialization
from tests.harness import wait_for
from tests.ros1.afe.session import RATE, Session, assert_holds, expected, noise, windowed

CHAIN = ("PreProc", "GammatoneProc", "IhcProc", "IldProc", "RatemapProc", "CrossCorrelationProc")
FRAMED = ("ild", "ratemap", "crossCorrelation")
BLOCK = 1500  # frames, not a multiple of the hop


def rate_of(kind: str, values: Any) -> float:
    return float(values[f"{kind}_frameRate"]) if kind in FRAMED else float(RATE)


@pytest.mark.parametrize("seconds", [0.5, 0.013, 0.001])
def test_each_port_contains_the_result_of_process(afe: Session, seconds: float) -> None:
    """For windows of many blocks, of less than a block, and of less than a frame of framed representations."""
    afe.build(*CHAIN, block=BLOCK, bufferSize_s_port=seconds, fb_nChannels=3)
    signal = noise(4 * BLOCK)
    parameters = {"fb_nChannels": 3}
    with_nothing = expected(signal[:, :0], BLOCK, parameters)
    for kind in CORE_REPRESENTATIONS:
        message = afe.read(kind)
        empty = with_nothing[kind]
        assert message.lastFrameIndex == 0
        assert message.sampleRate == round(rate_of(kind, with_nothing))
        assert_holds(message, kind, windowed(empty, seconds, rate_of(kind, with_nothing)))
    assert afe.microphone is not None
    for blocks in range(1, 5):
        end = blocks * BLOCK
        afe.microphone.play(signal[:, end - BLOCK : end])
        truth = expected(signal[:, :end], BLOCK, parameters)
        for kind in CORE_REPRESENTATIONS:
            message = afe.read(kind, end + 1)
            assert_holds(message, kind, windowed(truth[kind], seconds, rate_of(kind, truth)))
            if kind in ("gammatone", "ihc", *FRAMED):
                assert message.numberOfChannels == 3
            if kind == "crossCorrelation":
                assert message.numberOfLags == len(truth["cc_lags"]) == message.left.shape[0]


def test_each_block_is_published_in_order_and_advances_the_window(afe: Session) -> None:
    microphone = afe.build("PreProc", block=BLOCK, bufferSize_s_port=0.3)
    signal = noise(6 * BLOCK)
    with afe.follow("preProc") as messages:
        assert messages[0].lastFrameIndex == 0, "the first message has zeros"
        for start in range(0, signal.shape[1], BLOCK):
            microphone.play(signal[:, start : start + BLOCK])
            wait_for(lambda: messages[-1].lastFrameIndex == microphone.index + 1)
        assert [m.lastFrameIndex for m in messages] == [0, *range(BLOCK + 1, 6 * BLOCK + 2, BLOCK)]
        for message in messages:
            end = max(0, message.lastFrameIndex - 1)
            assert_holds(message, "preProc", windowed(signal[:, :end] / (2**31 - 1), 0.3, RATE))


@pytest.mark.parametrize("kind", ["ild", "crossCorrelation"])
def test_serialized_bytes_are_those_of_the_generated_class(afe: Session, kind: str) -> None:
    requests = CHAIN[: CHAIN.index(CORE_REPRESENTATIONS[kind].request) + 1]
    microphone = afe.build(*requests, block=BLOCK, fb_nChannels=3, bufferSize_s_port=0.1)
    microphone.play(noise(BLOCK))
    raw = afe.graph.message(
        afe.topic(kind),
        rospy.AnyMsg,
        accept=lambda m: int.from_bytes(m._buff[4:12], "little") == BLOCK + 1,
    )._buff
    plain = getattr(rosAFE.msg, ros_type(ROSAFE.port(CORE_REPRESENTATIONS[kind].port).idl))().deserialize(raw)
    again = io.BytesIO()
    plain.serialize(again)
    assert again.getvalue() == raw
    if kind == "ild":
        assert plain.right.dataN == []
        assert len(plain.left.dataN) == 3 and len(plain.left.dataN[0].data) == plain.framesOnPort == 10
    if kind == "crossCorrelation":
        assert len(plain.left.dataNxN) == plain.numberOfLags
        assert len(plain.left.dataNxN[0].dataN) == plain.numberOfChannels == 3
        assert len(plain.left.dataNxN[0].dataN[0].data) == plain.framesOnPort


def test_a_change_of_the_hop_changes_the_port(afe: Session) -> None:
    microphone = afe.build(*CHAIN[:4], block=BLOCK, fb_nChannels=2, bufferSize_s_port=0.5)
    signal = noise(4 * BLOCK)
    microphone.play(signal[:, : 2 * BLOCK])
    assert afe.read("ild", 2 * BLOCK + 1).left.shape == (2, 50)
    afe.ok("modifyParameter", nameProc="ild", nameParam="ild_hSizeSec", newValue="0.004")
    microphone.play(signal[:, 2 * BLOCK :])
    message = afe.read("ild", 4 * BLOCK + 1)
    assert (message.sampleRate, message.framesOnPort, message.left.shape) == (250, 125, (2, 125))
    assert np.count_nonzero(message.left.any(axis=0)) > 30, "the frames since the change"
    assert np.all(message.left[:, :50] == 0.0), "and zeros before"


def test_the_true_frame_rate_is_rounded(afe: Session) -> None:
    afe.build(*CHAIN[:3], fb_nChannels=2)
    for name, hop in (("fast", 0.003), ("slow", 0.07), ("slower", 1.9)):
        afe.ok("IldProc", name=name, ild_hSizeSec=hop)
        true = RATE / round(hop * RATE)
        message = afe.read("ild", name=name)
        assert message.sampleRate == round(true)
        assert message.framesOnPort == int(true)


def test_ports_exist_as_long_as_their_processors(afe: Session) -> None:
    before = afe.graph.topics()
    assert {"/rosAFE/inputProcPort", "/rosAFE/dataObj"} <= before, "simple ports exist from the start"
    afe.build("PreProc")
    with afe.follow("preProc") as messages:
        first = len(messages)
        afe.ok("removeProcessor", name="preProc")
        assert afe.topic("preProc") not in afe.graph.topics()
        afe.ok("PreProc")
        wait_for(lambda: len(messages) > first, what="zeros from the new processor of the same name")
        assert messages[-1].lastFrameIndex == 0
        assert afe.microphone is not None
        afe.microphone.play(noise(1600))
        wait_for(lambda: messages[-1].lastFrameIndex == 1601, what="the subscriber follows to the new one")


def test_two_of_a_kind_and_names_with_a_slash(afe: Session) -> None:
    microphone = afe.build("PreProc", "GammatoneProc", block=BLOCK, fb_nChannels=3)
    afe.ok("GammatoneProc", name="wide/low", fb_nChannels=5, fb_highFreqHz=1000.0)
    signal = noise(BLOCK)
    microphone.play(signal)
    truth = expected(signal, BLOCK, {"fb_nChannels": 5, "fb_highFreqHz": 1000.0})
    message = afe.read("gammatone", BLOCK + 1, name="wide/low")
    assert_holds(message, "gammatone", windowed(truth["gammatone"], 1.0, RATE))
    assert afe.read("gammatone", BLOCK + 1).numberOfChannels == 3


def test_the_data_object_is_advertised_and_silent(afe: Session) -> None:
    microphone = afe.build("PreProc", block=BLOCK)
    with afe.graph.collect("/rosAFE/dataObj", serialization.message_class("rosAFE", "::rosAFE::dataObjSt")) as messages:
        microphone.play(noise(BLOCK))
        afe.read("preProc", BLOCK + 1)
        assert messages == []
    assert dict(rospy.get_published_topics())["/rosAFE/dataObj"] == "rosAFE/rosAFE_dataObjSt"


# --- getSignals -------------------------------------------------------------------------------------------------


def arrays(signals: Any, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return `left` and `right` (may be empty) of the only processor of a kind, from the generated class."""
    (message,) = getattr(signals, kind)
    if kind in ("input", "preProc"):
        return np.array(message.left.data), np.array(message.right.data)
    if kind == "crossCorrelation":
        return np.array([[c.data for c in lag.dataN] for lag in message.left.dataNxN]), np.zeros(0)
    return np.array([c.data for c in message.left.dataN]), np.array([c.data for c in message.right.dataN])


def test_signals_are_the_new_frames(afe: Session) -> None:
    parameters = {"fb_nChannels": 2}
    microphone = afe.build(*CHAIN, block=BLOCK, bufferSize_s_getSignal=0.5, **parameters)
    signal = noise(5 * BLOCK)
    first = afe.ok("getSignals").signals
    for kind in CORE_REPRESENTATIONS:
        (message,) = getattr(first, kind)
        assert (message.lastFrameIndex, message.framesOnPort) == (0, 0), "before any data"
    seen = dict.fromkeys(CORE_REPRESENTATIONS, 0)
    for blocks in (1, 3, 5):
        end = blocks * BLOCK
        microphone.play(signal[:, (microphone.index) : end])
        for kind in CORE_REPRESENTATIONS:
            afe.read(kind, end + 1)
        signals = afe.ok("getSignals").signals
        truth = expected(signal[:, :end], BLOCK, parameters)
        for kind in CORE_REPRESENTATIONS:
            (message,) = getattr(signals, kind)
            left, right = arrays(signals, kind)
            new = truth[kind][..., seen[kind] :]
            seen[kind] = truth[kind].shape[-1]
            assert (message.lastFrameIndex, message.framesOnPort) == (end + 1, new.shape[-1])
            assert message.sampleRate == round(rate_of(kind, truth))
            if kind == "crossCorrelation":
                np.testing.assert_array_equal(left, new.swapaxes(0, 1))
            elif kind == "ild":
                np.testing.assert_array_equal(left, new)
                assert message.right.dataN == []
            else:
                np.testing.assert_array_equal(left, new[0])
                np.testing.assert_array_equal(right, new[1])
    again = afe.ok("getSignals").signals
    for kind in CORE_REPRESENTATIONS:
        (message,) = getattr(again, kind)
        assert (message.lastFrameIndex, message.framesOnPort) == (5 * BLOCK + 1, 0), "no new frames"
        assert arrays(again, kind)[0].size == 0
    assert len(again.gammatone[0].left.dataN) == 2, "channels without frames"


def test_short_blocks_that_nobody_observes(afe: Session) -> None:
    """They are combined, but getSignals and a late subscriber get all that has arrived, and then each block."""
    block, parameters = 16, {"fb_nChannels": 2}
    microphone = afe.listen(chunk=block)
    afe.build(*CHAIN, block=block, bufferSize_s_getSignal=2.0, **parameters)
    before = int(afe.health(lambda audio: audio["sample rate (Hz)"] != "0")["messages"])
    signal = noise(30 * block)
    truth = expected(signal, block, parameters)
    microphone.play(signal[:, : 7 * block])
    after = (before + 7, 0)  # after a pause of the sound
    afe.health(lambda audio: (int(audio["messages"]), int(audio["frames waiting"])) == after)
    microphone.play(signal[:, 7 * block : 10 * block])
    afe.health(lambda audio: int(audio["messages"]) == before + 10)
    signals = afe.ok("getSignals").signals
    assert {getattr(signals, kind)[0].lastFrameIndex for kind in CORE_REPRESENTATIONS} == {10 * block + 1}
    np.testing.assert_array_equal(arrays(signals, "ihc")[0], truth["ihc"][0, :, : 10 * block])
    microphone.play(signal[:, 10 * block : 20 * block])
    with afe.follow("ihc") as messages:
        wait_for(lambda: messages[-1].lastFrameIndex == 20 * block + 1, what="the blocks that had arrived before")
        microphone.play(signal[:, 20 * block :])
        wait_for(lambda: messages[-1].lastFrameIndex == 30 * block + 1, what="the end")
        assert [m.lastFrameIndex for m in messages][-10:] == [(20 + n) * block + 1 for n in range(1, 11)]


def test_signals_are_kept_for_the_length_of_the_buffer(afe: Session) -> None:
    """Only the newest frames are kept: for the requested time, and at least two blocks."""
    for seconds, frames in ((0.25, 5000), (0.001, 2 * BLOCK)):
        afe.ok("Stop")
        microphone = afe.listen()
        afe.ok("InputProc", nFramesPerBlock=BLOCK, bufferSize_s_getSignal=seconds)
        signal = noise(6 * BLOCK)
        microphone.play(signal)
        afe.read("input", 6 * BLOCK + 1)
        left, _ = arrays(afe.ok("getSignals").signals, "input")
        np.testing.assert_array_equal(left, signal[0, -frames:] / (2**31 - 1))


def test_signals_follow_the_order_of_the_parameters(afe: Session) -> None:
    afe.build("PreProc")
    for name in ("b", "a", "c"):
        afe.ok("GammatoneProc", name=name, fb_nChannels={"b": 2, "a": 3, "c": 4}[name])
    afe.ok("removeProcessor", name="a")
    afe.ok("GammatoneProc", name="a", fb_nChannels=5)
    assert afe.processors()["gammatone"] == ["b", "c", "a"]
    assert [s.numberOfChannels for s in afe.ok("getSignals").signals.gammatone] == [2, 4, 5]


def test_signals_as_arrays(afe: Session) -> None:
    microphone = afe.build("PreProc", "GammatoneProc", block=BLOCK, fb_nChannels=2)
    signal = noise(BLOCK)
    microphone.play(signal)
    afe.read("gammatone", BLOCK + 1)
    response = rospy.ServiceProxy("/rosAFE/getSignals", array_srv(rosAFE.srv.getSignals))()
    assert response.genom_success
    truth = expected(signal, BLOCK, {"fb_nChannels": 2})
    (message,) = response.signals.gammatone
    np.testing.assert_array_equal(message.left, truth["gammatone"][0])
    np.testing.assert_array_equal(response.signals.preProc[0].right, truth["preProc"][1])
    for wrong in (rosAFE.msg.rosAFE_dataObjSt, None, rosAFE.srv.getSignalsRequest):
        with pytest.raises(TypeError):
            array_srv(wrong)


def test_two_clients_share_the_new_frames(afe: Session) -> None:
    microphone = afe.build(block=BLOCK)
    microphone.play(noise(2 * BLOCK))
    afe.read("input", 2 * BLOCK + 1)
    counts = [afe.ok("getSignals").signals.input[0].framesOnPort for _ in range(2)]
    assert counts == [2 * BLOCK, 0]
