"""The bass node on a real ROS graph."""

from __future__ import annotations

import importlib
import json
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.audio.devices import libasound
from rosafe.audio.devices.scene import Scene
from rosafe.interface import ComponentError
from rosafe.ros1.component import serialization
from tests.audio import bags
from tests.harness import PATIENCE, Graph, Process, free_port, run_together, wait_for
from tests.ros1.afe.session import diagnosed

RATE, CHUNK, CHUNKS = 8000, 400, 4


def audio_class() -> Any:
    return serialization.message_class("bass", "::binaudio::portStruct")


def seconds(message: Any) -> float:
    return float(message.stamp["sec"]) + float(message.stamp["nsec"]) * 1e-9


@pytest.fixture
def wav(tmp_path: Path) -> tuple[str, np.ndarray]:
    """Write a file of half a second. Return its device name and the expected samples on the port, (2, frames)."""
    samples = np.random.default_rng(3).integers(-(2**15), 2**15, (2, 4100)).astype(np.int16)
    soundfile.write(tmp_path / "a.wav", samples.T, RATE, subtype="PCM_16")
    return f"file:{tmp_path / 'a.wav'}", samples.astype(np.int32) << 16


def acquire(graph: Graph, device: str, rate: int = 0, chunk: int = CHUNK, chunks: int = CHUNKS) -> Any:
    return graph.call("/bass/Acquire", device=device, sampleRate=rate, nFramesPerChunk=chunk, nChunksOnPort=chunks)


def live(graph: Graph) -> list[str]:
    """Return the names of the running activities according to genom_state."""
    state = graph.message("/bass/genom_state")
    return [activity.name for task in state.task for activity in task.activity]


def test_file_on_the_port(graph: Graph, bass_node: Process, wav: tuple[str, np.ndarray]) -> None:
    device, samples = wav
    with graph.collect("/bass/Audio", audio_class()) as messages:
        assert acquire(graph, device).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex == 4400)
    first = messages[0]
    assert first.lastFrameIndex == 0 and first.stamp == {"sec": 0, "nsec": 0}
    assert not first.left.any() and not first.right.any()
    stream = np.zeros((2, CHUNK * CHUNKS + 4400), np.int32)
    stream[:, CHUNK * CHUNKS : CHUNK * CHUNKS + 4100] = samples
    for message in messages:
        assert (message.sampleRate, message.nFramesPerChunk, message.nChunksOnPort) == (RATE, CHUNK, CHUNKS)
        window = stream[:, message.lastFrameIndex : message.lastFrameIndex + CHUNK * CHUNKS]
        assert np.array_equal(message.left, window[0]) and np.array_equal(message.right, window[1])
    indexes = [message.lastFrameIndex for message in messages]
    assert indexes == sorted(set(indexes)) and len(indexes) > 5
    # Stamps are the times of acquisition; their differences correspond to those of the frame indices.
    stamps = np.array([seconds(message) for message in messages[1:]])
    assert np.allclose(np.diff(stamps), np.diff(indexes[1:]) / RATE, atol=5e-3)
    wait_for(lambda: "Acquire" not in live(graph), what="normal end at the end of the file")


def test_end_of_file_is_a_normal_end_of_the_action(
    graph: Graph, bass_node: Process, wav: tuple[str, np.ndarray]
) -> None:
    import actionlib

    messages = importlib.import_module("bass.msg")  # mypy confuses it with the folder bass/ of this repository

    graph.client()
    client = actionlib.SimpleActionClient("/bass/Acquire", messages.AcquireAction)
    wait_for(lambda: client.wait_for_server(), what="action server")
    client.send_goal(messages.AcquireGoal(device=wav[0], sampleRate=0, nFramesPerChunk=CHUNK, nChunksOnPort=CHUNKS))
    wait_for(lambda: client.get_result() is not None)
    assert client.get_result().genom_success and client.get_result().genom_exdetail == ""
    client.send_goal(messages.AcquireGoal(device="hw:77,0"))
    wait_for(lambda: client.get_result() is not None)
    refused = json.loads(client.get_result().genom_exdetail)
    assert refused["ex"] == "::bass::e_device" and refused["what"].startswith("hw:77,0: ")
    client.send_goal(messages.AcquireGoal(device="scene:"))
    graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > 0 and m.sampleRate == 44100)
    client.cancel_goal()
    wait_for(lambda: client.get_result() is not None)
    assert client.get_result().genom_success


def test_defaults_and_scene_from_the_shell(graph: Graph, bass_node: Process) -> None:
    done = graph.run("rosservice", "call", "/bass/Acquire", "{device: 'scene:'}")
    assert "genom_success: True" in done.stdout
    message = graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex >= 3 * 2205)
    assert (message.sampleRate, message.nFramesPerChunk, message.nChunksOnPort) == (44100, 2205, 20)
    n = int(message.lastFrameIndex)
    expected = Scene(44100).frames(n)[:, -44100:]
    assert np.array_equal(message.left[-n:], expected[0]) and np.array_equal(message.right[-n:], expected[1])
    done = graph.run("rostopic", "type", "/bass/Audio")
    assert done.stdout.strip() == "bass/binaudio_portStruct"
    assert "lastFrameIndex: " in graph.run("rostopic", "echo", "-n1", "/bass/Audio").stdout


INVALID_REQUESTS: list[tuple[dict[str, Any], str, str]] = [
    ({"device": "hw:77,0"}, "e_device", "hw:77,0: "),
    ({"device": "WAV", "sampleRate": 44100}, "e_hwparams", "expected 44100 Hz, got 8000 Hz"),
    ({"device": "x" * 5000}, "e_hwparams", "4096 characters"),
    ({"device": "scene:", "sampleRate": 2**31}, "e_hwparams", "sampleRate"),
    ({"device": "scene:", "nFramesPerChunk": 2**32 - 1}, "e_hwparams", "nFramesPerChunk"),
    ({"device": "scene:", "nFramesPerChunk": 10**6, "nChunksOnPort": 10**5}, "e_hwparams", "frames on the port"),
]


def test_invalid_requests_change_nothing(graph: Graph, bass_node: Process, wav: tuple[str, np.ndarray]) -> None:
    assert acquire(graph, "scene:", RATE).genom_success
    with graph.collect("/bass/Audio", audio_class()) as messages:
        for request_values, exception, why in INVALID_REQUESTS:
            fields: dict[str, Any] = {"sampleRate": 0, "nFramesPerChunk": 0, "nChunksOnPort": 0, **request_values}
            fields["device"] = fields["device"].replace("WAV", wav[0])
            logged = len(bass_node.err.splitlines())
            response = graph.call("/bass/Acquire", **fields)
            assert not response.genom_success, request_values
            error = json.loads(response.genom_exdetail)
            assert error["ex"] == f"::bass::{exception}" and why in error["what"], request_values
            lines = bass_node.err.splitlines()[logged:]
            assert len(lines) == 1 and f"::bass::{exception}" in lines[0] and why in lines[0], (request_values, lines)
        known = len(messages)
        wait_for(lambda: len(messages) >= known + 3, what="further messages of the running acquisition")
    indexes = [message.lastFrameIndex for message in messages]
    assert indexes == sorted(set(indexes))
    assert {message.nFramesPerChunk for message in messages} == {CHUNK}
    wait_for(lambda: live(graph) == ["Acquire"])


@pytest.mark.parametrize("window_seconds", [10, 250])
def test_long_windows_lose_nothing(graph: Graph, bass_node: Process, window_seconds: int) -> None:
    """With windows of 10 s all frames arrive; with longer ones (16 MB a message) the newest, in overlapping windows."""
    with graph.collect("/bass/Audio", audio_class()) as messages:
        assert acquire(graph, "scene:", RATE, chunks=window_seconds * RATE // CHUNK).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex >= RATE)
        newest = messages[-1]
    indexes = [message.lastFrameIndex for message in messages]
    assert max(np.diff(indexes)) <= window_seconds * RATE // 2
    expected = Scene(RATE).frames(int(newest.lastFrameIndex))
    assert (
        np.array_equal(newest.left[-expected.shape[1] :], expected[0]) and not newest.left[: -expected.shape[1]].any()
    )


def test_acquire_replaces_and_stop_keeps_the_port(graph: Graph, bass_node: Process) -> None:
    assert acquire(graph, "scene:", RATE).genom_success
    graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex >= 3 * CHUNK)
    with graph.collect("/bass/Audio", audio_class()) as messages:
        assert acquire(graph, "scene:?seed=1", 16000, 800, 2).genom_success
        wait_for(lambda: messages and messages[-1].sampleRate == 16000 and messages[-1].lastFrameIndex >= 1600)
        after = [m for m in messages if m.sampleRate == 16000]
        assert after[0].lastFrameIndex == 0 and not after[0].left.any()
        assert (
            messages[-len(after) :] == after
        )  # no frame of the old acquisition follows the first frame of the new one
        wait_for(lambda: live(graph) == ["Acquire"])
        assert graph.call("/bass/Stop").genom_success
        wait_for(lambda: live(graph) == [])
    kept = graph.message("/bass/Audio", audio_class())  # latched, for later subscribers
    assert kept.lastFrameIndex == messages[-1].lastFrameIndex and np.array_equal(kept.left, messages[-1].left)
    assert kept.left.any()
    assert graph.call("/bass/Stop").genom_success  # a second time has no effect
    assert acquire(graph, "scene:", RATE).genom_success
    graph.message("/bass/Audio", audio_class(), lambda m: m.sampleRate == RATE and m.lastFrameIndex > 0)


def test_of_many_simultaneous_acquires_one_remains(graph: Graph, bass_node: Process) -> None:
    answers = run_together(8, lambda index: acquire(graph, f"scene:?seed={index}", RATE))
    assert any(answer.genom_success for answer in answers)
    for answer in answers:
        assert answer.genom_success or answer.genom_exdetail == (
            '{"ex":"::genom::interrupted","detail":{"by":"Acquire"}}'
        )
    wait_for(lambda: live(graph) == ["Acquire"])
    newest = graph.message("/bass/Audio", audio_class()).lastFrameIndex
    graph.message("/bass/Audio", audio_class(), lambda m: m.lastFrameIndex > newest)


def test_list_devices_prints_on_stdout(graph: Graph, bass_node: Process) -> None:
    try:
        expected = [f"hw:{c},{d} [{card}] [{pcm}]" for c, d, card, pcm in libasound.capture_devices()]
        exdetail = ""
    except ComponentError as problem:
        expected, exdetail = [], problem.exdetail
        assert '"what":"no sound card (/proc/asound/card* is empty)"' in exdetail
    answer = graph.call("/bass/ListDevices")
    assert (answer.genom_success, answer.genom_exdetail) == (not exdetail, exdetail)
    lines = bass_node.out.splitlines()
    assert [line for line in lines if line.startswith("hw:")] == expected
    assert [line.split(" ")[0] for line in lines][:5] == [
        "file:PATH",
        "bag:PATH",
        "topic:/NAME",
        "scene:FILE.yaml",
        "scene:",
    ]


def test_common_requests(graph: Graph, bass_node: Process) -> None:
    assert graph.call("/bass/connect_port", local="Audio", remote="bass/Audio").genom_exdetail == (
        '{"ex":"::genom::no_such_inport","what":"no input port \'Audio\'; there are: none"}'
    )
    assert graph.call("/bass/connect_service", local="a", remote="b").genom_exdetail == (
        '{"ex":"::genom::no_such_remote","what":"bass has no remote services"}'
    )
    assert graph.call("/bass/abort_activity", activity=4711).genom_exdetail == (
        '{"ex":"::genom::no_such_activity","what":"no activity 4711; there are: none"}'
    )
    assert acquire(graph, "scene:", RATE).genom_success
    state = graph.message("/bass/genom_state", accept=lambda m: any(task.activity for task in m.task))
    number = next(activity.id for task in state.task for activity in task.activity)
    assert graph.call("/bass/abort_activity", activity=number).genom_success
    wait_for(lambda: live(graph) == [])
    assert acquire(graph, "scene:", RATE).genom_success
    assert graph.call("/bass/kill").genom_success
    assert bass_node.wait() == 0


def test_loss_in_the_window_the_log_and_diagnostics(graph: Graph, bass_node: Process, tmp_path: Path) -> None:
    samples = bags.stream(4000)
    indexes = (0, 400, 800, 2400, 2800, 3200)  # the window of frame 2400 starts with frame 2001
    bags.write(tmp_path / "a.bag", [bags.message(samples, index, 400, RATE, 400) for index in indexes])
    with graph.collect("/bass/Audio", audio_class()) as messages:
        assert acquire(graph, f"bag:{tmp_path / 'a.bag'}?loop=1", chunks=8).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex >= 3200)
        window = next(message for message in messages if message.lastFrameIndex >= 3200)
    samples[:, 800:2000] = 0
    shown = np.stack((window.left, window.right))[:, : 3200 + 3200 - window.lastFrameIndex]
    assert np.array_equal(shown, samples[:, 3200 - shown.shape[1] : 3200])
    wait_for(lambda: "lost 1200 frames (0.150 s) after frame 800 (0.10 s)" in bass_node.err)
    state = diagnosed(graph, "bass: capture", lambda entries: "lost 1200 frames" in entries["last loss"])
    assert state["level"] == "1" and state["device"].startswith("bag:")


def request(connection: socket.socket, count: int, first: int) -> tuple[int, int, int, np.ndarray]:
    connection.sendall(b"Read Port - N %d - nfr %d\n" % (count, first))
    stream = connection.makefile("rb")
    n, loss, following = struct.unpack("<iiq", stream.read(16))
    return n, loss, following, np.frombuffer(stream.read(8 * n), "<i4").reshape(2, n)


def test_dedicated_socket(graph: Graph, bass_node: Process, wav: tuple[str, np.ndarray]) -> None:
    import rospy

    graph.client()
    port = free_port()
    rospy.set_param("/bass/socket_port", port)
    assert graph.call("/bass/DedicatedSocket").genom_success
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection:
        assert request(connection, 10, 1)[:3] == (0, 0, 1)
        assert acquire(graph, wav[0], chunks=20).genom_success
        pieces, following, end = [], 1, time.monotonic() + PATIENCE
        while following <= 4400:
            assert time.monotonic() < end
            _, loss, following, samples = request(connection, 300, following)
            assert loss == 0
            pieces.append(samples)
        received = np.concatenate(pieces, axis=1)
        assert np.array_equal(received[:, :4100], wav[1]) and not received[:, 4100:].any()
        wait_for(lambda: live(graph) == ["DedicatedSocket"])
        assert graph.call("/bass/CloseSocket").genom_success
        assert connection.recv(1) == b""
    with socket.create_server(("127.0.0.1", port)):
        answer = graph.call("/bass/DedicatedSocket")
    assert answer.genom_exdetail.startswith('{"ex":"::genom::syserr","detail":{"code":98')
    why = f"cannot serve 127.0.0.1:{port}: Address already in use; set the ROS parameter /bass/socket_port or "
    assert why in bass_node.err
    assert graph.call("/bass/DedicatedSocket").genom_success
    assert graph.call("/bass/DedicatedSocket").genom_success  # the second replaces the first
    wait_for(lambda: live(graph) == ["DedicatedSocket"])
    rospy.set_param("/bass/socket_port", "none")
    assert graph.call("/bass/DedicatedSocket").genom_exdetail.startswith(
        '{"ex":"::genom::syserr","detail":{"code":22},"what":"cannot serve 127.0.0.1:none: '
    )
    rospy.delete_param("/bass/socket_port")
