"""Irregular audio at the node: gaps, restarts, garbage, other rates, and the reports about them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.harness import Graph, wait_for
from tests.ros1.afe.session import RATE, Session, assert_holds, expected, noise, own_node, windowed

BLOCK = 2000
CHAIN = ("PreProc", "GammatoneProc", "IhcProc", "IldProc")


@pytest.fixture
def fresh(graph: Graph) -> Iterator[Session]:
    """Start a node for one test, with counters at zero."""
    with own_node(graph) as afe:
        yield afe
        assert afe.process.alive
        assert "Traceback" not in afe.process.err, afe.process.err


def normal(signal: np.ndarray) -> np.ndarray:
    return signal / (2**31 - 1)


def test_a_gap_is_filled_with_zeros_counted_and_located(fresh: Session) -> None:
    microphone = fresh.build(*CHAIN, block=BLOCK, fb_nChannels=2)
    signal = noise(5 * BLOCK)
    microphone.play(signal[:, :3000])
    microphone.lose(signal[:, 3000:8200])  # all except the newest 4000 - 200 frames are in the next message
    microphone.play(signal[:, 8200:])
    received = signal.copy()
    received[:, 3000 : 8200 + 400 - 4000] = 0
    truth = expected(received, BLOCK, {"fb_nChannels": 2})
    for kind in ("input", "preProc", "gammatone", "ihc", "ild"):
        message = fresh.read(kind, 5 * BLOCK + 1)
        rate = truth["ild_frameRate"] if kind == "ild" else RATE
        assert_holds(message, kind, windowed(truth[kind], 1.0, rate))
    health = fresh.health(lambda entries: entries["lost"] != "0")
    assert (health["lost"], health["gaps"]) == ("1600", "1")
    assert health["last loss"] == "1600 frames from frame 3001 on"
    assert health["level"] == "1" and "1600 frames lost in 1 gaps" in health["message"]
    assert fresh.process.err.count("lost 1600 frames from frame 3001 on") == 1


def test_no_loss_is_reported_without_a_loss(fresh: Session) -> None:
    microphone = fresh.listen(chunk=441, chunks=1)
    fresh.ok("InputProc", nFramesPerBlock=882)
    fresh.ok("PreProc")
    signal = noise(882 * 20)
    microphone.play(signal)  # windows of one chunk, as fast as possible
    for _ in range(3):
        microphone.publish()  # the same again
    assert_holds(fresh.read("preProc", 882 * 20 + 1), "preProc", windowed(normal(signal), 1.0, RATE))
    health = fresh.health(lambda entries: entries["messages"] == "44")
    assert {health[name] for name in ("lost", "gaps", "dropped", "breaks", "refused")} == {"0"}
    assert (health["level"], health["message"], health["streams"]) == ("0", "no frames lost", "1")
    assert health["topic"] == microphone.topic and health["sample rate (Hz)"] == str(RATE)


def test_garbage_is_ignored_and_the_connection_is_kept(fresh: Session) -> None:
    microphone = fresh.build("PreProc", block=BLOCK)
    signal = noise(2 * BLOCK)
    microphone.play(signal[:, :BLOCK])
    bad = [b"", b"\1\2\3", bytes(35), b"\xff" * 100, bytes(20) + b"\xff\xff\xff\xff" + bytes(64), bytes(10**6)]
    for data in bad:
        microphone.publish_bytes(data)
    rate, window = microphone.sample_rate, microphone.window
    microphone.sample_rate = 2**32 - 1
    microphone.publish()
    microphone.sample_rate, microphone.window = rate, window[:, :0]
    microphone.publish()
    microphone.window = window
    microphone.play(signal[:, BLOCK:])
    assert_holds(fresh.read("preProc", 2 * BLOCK + 1), "preProc", windowed(normal(signal), 1.0, RATE))
    health = fresh.health(lambda entries: entries["refused"] == str(len(bad) + 2))
    assert (health["lost"], health["streams"], health["level"]) == ("0", "1", "1")
    assert fresh.process.err.count("malformed messages are ignored") == 1, "reported once"


def test_audio_of_another_rate_is_not_passed_to_the_tree(fresh: Session) -> None:
    microphone = fresh.build("PreProc", block=BLOCK)
    signal = noise(2 * BLOCK)
    microphone.play(signal[:, :BLOCK])
    fresh.read("preProc", BLOCK + 1)
    microphone.sample_rate, microphone.index = 2 * RATE, 0
    microphone.play(noise(3 * BLOCK, 2))
    health = fresh.health(lambda entries: entries["level"] == "2")
    assert str(2 * RATE) in health["message"] and "call Stop" in health["message"]
    assert health["frames waiting"] == "0", "the tree does not wait for these frames"
    assert fresh.read("preProc").lastFrameIndex == BLOCK + 1
    microphone.sample_rate, microphone.index = RATE, 0
    microphone.play(signal)
    message = fresh.read("preProc", 2 * BLOCK + 1)
    np.testing.assert_array_equal(message.left[-2 * BLOCK :], normal(signal)[0])
    fresh.ok("Stop")
    microphone.sample_rate, microphone.index = 2 * RATE, 0
    microphone.publish()
    wait_for(lambda: fresh.health(lambda entries: entries["sample rate (Hz)"] == str(2 * RATE)))
    fresh.ok("InputProc", nFramesPerBlock=BLOCK)
    assert fresh.read("input", 0).sampleRate == 2 * RATE


def test_a_tree_that_is_too_slow_loses_frames_and_reports_it(fresh: Session) -> None:
    """With a minute of audio at once, each frame that is not computed is counted."""
    microphone = fresh.listen(chunk=4000, chunks=2)
    for request in ("InputProc", *CHAIN):
        fresh.ok(request)
    total = 60 * RATE
    signal = noise(RATE)
    for _ in range(total // RATE):
        microphone.play(signal)
    health = fresh.health(
        lambda entries: int(entries["messages"]) == total // 4000 + 1 and int(entries["frames waiting"]) < 12000
    )
    assert int(health["lost"]) > 0 and health["level"] == "1"
    blocks = int(fresh.health(lambda entries: True, "processors")["input"].split(", ")[2].split()[0])
    assert int(health["lost"]) + blocks * 12000 + int(health["frames waiting"]) == total
    assert fresh.read("ild").lastFrameIndex + int(health["frames waiting"]) == total + 1
    assert f"Audio: lost {health['last loss']}" in fresh.process.err
