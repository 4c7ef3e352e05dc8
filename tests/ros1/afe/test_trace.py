"""`rosafe trace` on a real node and on a file: it shows the work of the tree, and has no effect when off."""

from __future__ import annotations

import itertools
import json
import os
import queue
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rospy
import soundfile
from std_msgs.msg import String

from rosafe.commands import trace
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.ros1.afe import trace_port
from rosafe.ros1.afe.trace_port import TracePort, read
from rosafe.ros1.component import startup
from rosafe.tree.processor import Observer
from rosafe.tree.states import State
from tests.commands.command import refused, rosafe
from tests.harness import PATIENCE, SCRIPTS, Graph, wait_for
from tests.ros1.afe.session import Session, noise

CHAIN = ("PreProc", "GammatoneProc", "IhcProc", "IldProc", "RatemapProc", "CrossCorrelationProc")
BLOCK = 8000  # each processor takes longer for it than the pool's threshold for a second worker
BURST = 20  # blocks that arrive at once; of many more, some would be lost
BLOCKS = 3 * BURST  # beside busy programs, one burst can be computed without simultaneous parents and children


def spans(path: Path, of_workers: bool = False) -> dict[str, list[tuple[str, int | None, int, int]]]:
    """Return state, block, begin and end of all spans by row, of the processors or of the workers."""
    events = json.loads(path.read_text())["traceEvents"]
    named = {(e["pid"], e["tid"]): e["args"]["name"] for e in events if e["name"] == "thread_name"}
    rows = {row: name for row, name in named.items() if name.startswith("worker ") == of_workers}
    found: dict[str, list[tuple[str, int | None, int, int]]] = {name: [] for name in rows.values()}
    for e in events:
        if e["ph"] == "X" and (e["pid"], e["tid"]) in rows:
            found[rows[e["pid"], e["tid"]]].append((e["cat"], e["args"].get("block"), e["ts"], e["ts"] + e["dur"]))
    return found


def simultaneous_blocks(one: list[Any], other: list[Any], ahead: int) -> int:
    """Return how often `one` computed block n + `ahead` while `other` computed block n."""
    work = {block: (begin, end) for state, block, begin, end in other if state == "exec"}
    pairs = [((begin, end), work.get(block - ahead, (0, 0))) for state, block, begin, end in one if state == "exec"]
    return sum(max(a[0], b[0]) < min(a[1], b[1]) for a, b in pairs)


def test_a_real_run_shows_simultaneous_parents_children_and_siblings(afe: Session, tmp_path: Path) -> None:
    """The audio of a burst arrives faster than the tree computes, so that it does not wait. Ctrl-C ends the trace."""
    afe.listen(chunk=BLOCK, chunks=2)
    microphone = afe.build(*CHAIN, block=BLOCK, bufferSize_s_port=0.01, bufferSize_s_getSignal=0.01)
    path = tmp_path / "trace.json"
    command = afe.graph.start(str(SCRIPTS / "rosafe"), "trace", "--seconds", "100", "-o", str(path))
    with command:
        wait_for(lambda: afe.connections("/rosAFE/trace"))
        afe.graph.message("/rosAFE/trace", String)  # it has begun
        with afe.follow("ild") as messages:
            for _ in range(BLOCKS // BURST):
                microphone.play(noise(BLOCK * BURST))
                wait_for(lambda: messages[-1].lastFrameIndex == microphone.index + 1)
        with afe.graph.collect("/rosAFE/trace", String) as traces:
            wait_for(lambda: len(traces) > 2, what="two more messages for the command")
        assert command.stop(signal.SIGINT) == 0, command
    rows, workers = spans(path), spans(path, of_workers=True)
    assert 1 <= len(workers) <= len(os.sched_getaffinity(0)) + 1
    assert sum(len(row) for row in workers.values()) >= BLOCKS * len(rows), "each block belongs to a worker"
    assert list(rows) == [
        f"{name} ({kind})"
        for kind, name in zip(CORE_REPRESENTATIONS, [*list(CORE_REPRESENTATIONS)[:-1], "crosscorrelation"], strict=True)
    ]
    for row in rows.values():
        assert [block for state, block, _, _ in row if state == "exec"] == list(range(BLOCKS))
        assert {state for state, _, _, _ in row} == {"waitExec", "exec", "waitRelease", "release"}
        assert all(first[3] == second[2] for first, second in itertools.pairwise(row)), "no time is missing"
    family = [("gammatone (gammatone)", "ihc (ihc)"), ("ihc (ihc)", "crosscorrelation (crossCorrelation)")]
    assert sum(simultaneous_blocks(rows[parent], rows[child], 1) for parent, child in family) > 0
    siblings = [rows["ild (ild)"], rows["ratemap (ratemap)"], rows["crosscorrelation (crossCorrelation)"]]
    assert simultaneous_blocks(siblings[0], siblings[2], 0) + simultaneous_blocks(siblings[1], siblings[2], 0) > 0
    for parent, child in family:
        assert simultaneous_blocks(rows[parent], rows[child], 2) == 0, "never two blocks ahead"
    assert "gammatone and ihc" in command.out and f"written to {path}" in command.out
    assert "ended early" in command.err
    afe.ok("getParameters")


def test_messages_received_before_an_interrupt_are_part_of_the_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted(queue.SimpleQueue[int]):
        """Ctrl-C arrives before the second message is taken."""

        waits = 0

        def get(self, block: bool = True, timeout: float | None = None) -> int:
            self.waits += timeout is not None
            if self.waits == 2 and timeout is not None:
                raise KeyboardInterrupt
            return super().get(block, timeout)

    class Subscriber:
        def __init__(self, topic: str, message_class: Any, callback: Callable[[int], None], **options: Any) -> None:
            for message in range(3):
                callback(message)

        def unregister(self) -> None:
            pass

    monkeypatch.setattr(rospy, "Subscriber", Subscriber)
    monkeypatch.setattr(startup, "become_node", lambda name: None)
    monkeypatch.setattr(trace_port, "read", lambda message: [message])
    monkeypatch.setattr(trace, "queue", SimpleNamespace(SimpleQueue=Interrupted, Empty=queue.Empty))
    assert trace._listen("/rosAFE", 100.0) == [0, 1, 2]


def test_a_node_without_processors_and_a_missing_node(afe: Session, tmp_path: Path) -> None:
    env: Any = {name: afe.graph.env[name] for name in ("ROS_MASTER_URI", "ROS_IP", "HOME")}
    there = tmp_path / "there.json"
    there.write_text("mine")
    refused(rosafe("trace", "-o", there, **env), "already exists", "--force")
    refused(rosafe("trace", "-o", tmp_path / "no" / "t.json", **env), "does not exist")
    refused(rosafe("trace", "--seconds", "0.1", "-o", there, "--force", **env), "/rosAFE has no processors")
    refused(rosafe("trace", "--node", "absent", **env), "/absent does not publish a trace")
    assert there.read_text() == "mine"
    for wrong in ("nan", "1e9"):
        refused(rosafe("trace", f"--seconds={wrong}"), "seconds", code=2)


def test_a_sound_file_without_ros(tmp_path: Path) -> None:
    sound, path = tmp_path / "sound.wav", tmp_path / "trace.json"
    soundfile.write(sound, np.random.default_rng(1).uniform(-0.5, 0.5, (44100, 2)), 44100)
    nowhere: Any = {"ROS_MASTER_URI": "http://127.0.0.1:1"}
    done = rosafe("trace", sound, "-o", path, "--block", "882", "--seconds", "0.5", **nowhere)
    assert done.returncode == 0, done
    rows = spans(path)
    assert len(rows) == len(CORE_REPRESENTATIONS)
    for row in rows.values():
        assert [block for state, block, _, _ in row if state == "exec"] == list(range(25))
    soundfile.write(sound, np.zeros((100, 1)), 44100)
    refused(rosafe("trace", sound, **nowhere), "expected two channels")
    refused(rosafe("trace", tmp_path / "none.wav", **nowhere), "none.wav")


def test_without_a_subscriber_nothing_is_traced(graph: Graph) -> None:
    graph.client()
    begun: list[Observer] = []
    ended = threading.Event()

    def observe(observer: Observer) -> Callable[[], None]:
        begun.append(observer)
        ended.clear()
        return ended.set

    port = TracePort("/of_the_test/trace", observe)
    assert begun == []
    for count in (1, 2):
        got: list[String] = []
        subscriber = rospy.Subscriber("/of_the_test/trace", String, got.append)
        wait_for(lambda: len(begun) == count)  # noqa: B023
        processor = type("Fake", (), {"name": "p", "kind": "ild", "parent": None})()
        begun[-1](processor, State.EXEC, 3)
        wait_for(lambda: any(read(m) for m in got))  # noqa: B023
        (event,) = (event for message in got for event in read(message))
        assert event[1:] == ("p", "ild", "", "exec", 3, "")
        subscriber.unregister()
        assert ended.wait(PATIENCE), "the last subscriber has disconnected"
    assert len(begun) == 2
    assert isinstance(port, TracePort)
