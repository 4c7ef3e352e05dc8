"""The device `topic:` on a real ROS graph: messages of audio_common from stock publishers, another bass, recordings."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.ros1.component import serialization
from tests.audio.test_received import noise
from tests.commands.command import ROSAFE
from tests.harness import PYTHON, Graph, Process, python_path, wait_for
from tests.ros1.afe.session import diagnosed
from tests.ros1.bass.driver import Driver

RATE, LENGTH, CHUNK = 16000, 160, 400
_numbers = itertools.count()


def audio_class() -> Any:
    return serialization.message_class("bass", "::binaudio::portStruct")


@pytest.fixture
def driver(graph: Graph) -> Iterator[Driver]:
    """A driver in this process with topics of its own; stamped messages of four channels."""
    graph.client()
    space = f"/driver{next(_numbers)}"
    driver = Driver(f"{space}/audio", RATE, info=f"{space}/audio_info")
    yield driver
    driver.close()


def acquire(graph: Graph, device: str, rate: int = 0, chunk: int = CHUNK, chunks: int = 200) -> Any:
    return graph.call("/bass/Acquire", device=device, sampleRate=rate, nFramesPerChunk=chunk, nChunksOnPort=chunks)


def refused(answer: Any) -> tuple[str, str]:
    assert not answer.genom_success
    error = json.loads(answer.genom_exdetail)
    return error["ex"], error.get("what", "")


@contextmanager
def program(
    graph: Graph, path: Path, samples: np.ndarray, *options: str, info: str = ""
) -> Iterator[tuple[str, Process]]:
    """Run a driver as a program of its own; yield its topic. It describes the format beside that, or on `info`."""
    np.save(path, samples)
    topic = f"/driver{next(_numbers)}/audio"
    info = info or f"{topic}_info"
    command = (PYTHON, "-m", "tests.ros1.bass.driver", topic, str(path), "--info", info, *options)
    with graph.start(*command, PYTHONPATH=python_path(graph)) as process:
        wait_for(lambda: topic in graph.topics(), what=lambda: str(process))
        yield topic, process


def window(message: Any) -> np.ndarray:
    return np.stack((message.left, message.right))


def moment(message: Any) -> float:
    return float(message.stamp["sec"] + 1e-9 * message.stamp["nsec"])


def place(message: Any, samples: np.ndarray) -> int:
    """Return the number of the frame of `samples`, (2, n), with which the stream in a message begins."""
    newest = int(message.lastFrameIndex)
    assert newest <= message.left.size
    sound = window(message)[:, message.left.size - newest :]
    at = next(a for a in range(samples.shape[1]) if np.array_equal(samples[:, a : a + 50], sound[:, :50]))
    assert np.array_equal(sound, samples[:, at : at + newest])
    return at


def test_a_program_with_lost_messages(graph: Graph, bass: Process, tmp_path: Path) -> None:
    """Two of four channels, 24 bits, the format from AudioInfo; losses with numbers, in the log and in diagnostics."""
    samples = noise(3 * RATE, 4)
    lost = (120, 121, 122, 200, 250)
    options = ("--form", "S24LE", "--lost", *map(str, lost))
    with program(graph, tmp_path / "a.npy", samples, *options) as (topic, process):
        assert acquire(graph, f"topic:{topic}?channels=2,3").genom_success, process
        expected = samples[:, 1:3].T.copy()
        for number in lost:
            expected[:, number * LENGTH : (number + 1) * LENGTH] = 0
        message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > 2.7 * RATE)
        assert message.sampleRate == RATE
        at = place(message, expected)
        graph.call("/bass/Stop")
    assert at % LENGTH == 0
    for frames in (480, 160):
        assert f"lost {frames} frames ({frames / RATE:.3f} s) after frame " in bass.err


def test_diagnostics_of_losses_and_pauses(graph: Graph, bass: Process, driver: Driver) -> None:
    samples = noise(60 * RATE)
    driver.describe(2)
    lost = {number for number in range(6000) if number % 100 in (50, 51)}
    with playing(driver, samples, lost=lost):
        assert acquire(graph, f"topic:{driver.topic}").genom_success
        wait_for(lambda: "lost 320 frames" in bass.err)
        capture = "bass: capture"
        diagnosed(graph, capture, lambda found: found["level"] == "1" and int(found["lost frames"]) % 320 == 0)
    wait_for(lambda: f"topic:{driver.topic}: no sound for 1.02 s; waiting for its publisher" in bass.err)
    silent = "capturing, but no sound for "
    assert diagnosed(graph, capture, lambda found: found["message"].startswith(silent))["level"] == "1"
    settled = driver.newest - 2 * CHUNK / RATE
    before = graph.message("/bass/Audio", audio_class(), lambda m: moment(m) > settled)
    driver.play(samples[: 150 * LENGTH], LENGTH)  # the stamps are those of the beginning: the clock was set
    wait_for(lambda: "the clock of the stamps was set back by " in bass.err)
    after = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > before.lastFrameIndex)
    assert after.lastFrameIndex <= before.lastFrameIndex + 150 * LENGTH + 2 * CHUNK
    graph.call("/bass/Stop")


@contextmanager
def playing(driver: Driver, samples: np.ndarray, **options: Any) -> Iterator[threading.Thread]:
    """Play on a thread of its own."""
    end = threading.Event()
    thread = threading.Thread(target=driver.play, args=(samples, LENGTH), kwargs={**options, "end": end})
    thread.start()
    yield thread
    end.set()
    thread.join()


def test_messages_without_stamps(graph: Graph, bass: Process) -> None:
    driver = Driver(f"/driver{next(_numbers)}/audio", 48000, "F32LE", stamped=False)
    samples = noise(30 * 48000, 1)
    with playing(driver, samples):
        device = f"topic:{driver.topic}?format=F32LE&rate=48000&of=1&channels=1,1"
        assert acquire(graph, device).genom_success
        message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > 24000)
    expected = np.rint(samples[:, [0, 0]].T / 2.0**31 * (2**31 - 1)).astype(np.int32)
    assert message.sampleRate == 48000 and place(message, expected) >= 0
    graph.call("/bass/Stop")
    driver.close()


def test_a_second_publisher(graph: Graph, bass: Process, driver: Driver, tmp_path: Path) -> None:
    samples, other = noise(60 * RATE), noise(60 * RATE, seed=7)
    driver.describe(2)
    np.save(tmp_path / "b.npy", other)
    command = (PYTHON, "-m", "tests.ros1.bass.driver", driver.topic, str(tmp_path / "b.npy"), "--name", "second")
    with playing(driver, samples):
        assert acquire(graph, f"topic:{driver.topic}").genom_success
        with graph.start(*command, PYTHONPATH=python_path(graph)) as process:
            text = f"topic:{driver.topic}: messages of a second publisher, /second, are not used"
            wait_for(lambda: text in bass.err, what=lambda: str(process))
            message = graph.message("/bass/Audio", audio_class())
            assert place(message, samples.T) >= 0
    graph.call("/bass/Stop")


def test_acquire_names_unusable_topics(graph: Graph, bass: Process, driver: Driver) -> None:
    """The running acquisition continues. tests/audio/test_received.py has the rules of formats and descriptions."""
    assert acquire(graph, "scene:").genom_success
    expected = {
        "topic:/nobody": ("e_device", "/nobody: the topic has no publisher; start the driver, or call Acquire of"),
        "topic:a b": ("e_device", "expected the name of a topic, such as /audio"),
        "topic:/bass/Audio": ("e_device", "expected the topic of another node, got the port of this bass"),
        "topic:/rosout": ("e_device", "got type rosgraph_msgs/Log"),
    }
    for device, (code, why) in expected.items():
        found = refused(acquire(graph, device))
        assert found[0] == f"::bass::{code}" and why in found[1], (device, found)
    driver.describe(4)
    assert refused(acquire(graph, f"topic:{driver.topic}"))[0] == "::bass::e_hwparams"
    index = graph.message("/bass/Audio", audio_class()).lastFrameIndex
    graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > index)
    wait_for(lambda: not driver.subscribed)


def written(data: bytes) -> Any:
    return lambda message, out: out.write(data)


def test_malformed_messages(graph: Graph, bass: Process, driver: Driver) -> None:
    driver.describe(2)
    samples = noise(60 * RATE)
    with playing(driver, samples):
        assert acquire(graph, f"topic:{driver.topic}").genom_success
        for data in (b"", b"\1", b"\xff" * 20):
            driver._publisher.publish(type("Broken", (driver._publisher.data_class,), {"serialize": written(data)})())
        index = graph.message("/bass/Audio", audio_class()).lastFrameIndex
        message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > index + RATE // 2)
    place(message, samples.T)
    assert "malformed messages are not used: " in bass.err and "Traceback" not in bass.err
    graph.call("/bass/Stop")


def test_record_and_replay(graph: Graph, bass: Process, tmp_path: Path) -> None:
    """`rosafe record` of the topic into a WAV and a bag; `rosbag record` and `rosbag play`; nothing is lost."""
    samples = noise(12 * RATE, 3)
    signal = samples[:, [2, 0]].T
    with program(graph, tmp_path / "a.npy", samples, "--form", "S32LE", info="/audio_info") as (topic, process):
        device = f"topic:{topic}?channels=3,1"
        record = (str(ROSAFE), "record", "--seconds", "1", "--device", device)
        with (
            graph.start(*record, "a.wav", cwd=tmp_path) as wav,
            graph.start(*record, "a.bag", cwd=tmp_path) as bag,
            graph.start("rosbag", "record", "-O", "b.bag", "--duration=6", topic, "/audio_info", cwd=tmp_path) as stock,
        ):
            assert [one.wait() for one in (wav, bag, stock)] == [0, 0, 0], (wav, bag, stock, process)
        for recording in (wav, bag):
            assert ": 1.000 s at 16000 Hz" in recording.out and " 0 frames lost" in recording.out, recording
    sound = np.asarray(soundfile.read(tmp_path / "a.wav", dtype="int32")[0].T)
    begins = signal[0].tobytes().find(sound[0].tobytes())
    assert begins >= 0 and begins % (4 * LENGTH) == 0 and sound[1].tobytes() in signal[1].tobytes()
    assert acquire(graph, f"bag:{tmp_path / 'a.bag'}").genom_success
    message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex >= RATE)
    assert place(window_only(message, RATE), signal) % LENGTH == 0
    played = graph.start("rosbag", "play", "--quiet", "--wait-for-subscribers", str(tmp_path / "b.bag"))
    with played:
        wait_for(lambda: topic in graph.topics(), what=lambda: str(played))
        assert acquire(graph, device).genom_success, played
        message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > 2 * RATE)
        place(message, signal)
        graph.call("/bass/Stop")


def window_only(message: Any, frames: int) -> Any:
    """Return a message with the first frames of its stream only."""
    newest = int(message.lastFrameIndex)
    begin = message.left.size - newest
    message.left, message.right = message.left[begin : begin + frames], message.right[begin : begin + frames]
    message.lastFrameIndex = frames
    return message
