"""Traces: every transition of every processor, the format for viewers, and the figures of the summary."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from rosafe.tree.states import State
from rosafe.tree.trace import Event, Trace, Tracer
from rosafe.tree.tree import Tree
from tests.harness import PATIENCE

from .support import Feed, Plain, Recorder, use_plain_stages

FRAMES, WORKERS = 1, 3


def test_overlap_of_parent_and_child_and_of_siblings(
    tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Barriers in the stages enforce it: the siblings meet, and then the parent meets them in its next block."""
    last = 5
    siblings_meet, all_meet = threading.Barrier(2), threading.Barrier(3)

    class Parent(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            if block[0, 0] > 0:
                all_meet.wait(PATIENCE)
            return block

    class Sibling(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            siblings_meet.wait(PATIENCE)
            if block[0, 0] < last:
                all_meet.wait(PATIENCE)
            return block

    use_plain_stages(monkeypatch, preProc=Parent, gammatone=Sibling)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    tree.add("preProc", "parent", "input")
    siblings = [tree.add("gammatone", name, "parent") for name in ("a", "b")]
    tracer = Tracer()
    stop = tree.observe(tracer)
    feed.put(count=last + 1)
    for one in siblings:
        listener.wait_blocks(one, last + 1)
    stop()
    trace = Trace(tracer.take())

    assert list(trace.processors) == ["input", "parent", "a", "b"], "parents first"
    assert set(trace.related_pairs()) == {
        ("input", "parent", "parent and child"),
        ("parent", "a", "parent and child"),
        ("parent", "b", "parent and child"),
        ("a", "b", "siblings"),
    }
    for name in trace.processors:
        assert [interval.block for interval in trace.of(name, State.EXEC)] == list(range(last + 1))
        assert [interval.block for interval in trace.of(name, State.RELEASE)] == list(range(last + 1))
    assert trace.workers == ["worker 1", "worker 2", "worker 3"]
    assert all(interval.worker in trace.workers for interval in trace.intervals if interval.state == State.EXEC.value)
    for name in ("a", "b"):
        overlapping = {(one.block, other.block) for one, other in trace.overlap("parent", name)}
        assert {(n + 1, n) for n in range(last)} <= overlapping, "the parent at block n + 1, the child at block n"
    assert {(n, n) for n in range(last + 1)} <= {(a.block, b.block) for a, b in trace.overlap("a", "b")}


def test_no_event_is_recorded_after_the_end(tree: Tree, listener: Recorder, feed: Feed) -> None:
    tracer = Tracer()
    stop = tree.observe(tracer)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    feed.put(count=1)
    listener.wait_blocks(tree.find("input"), 1)
    stop()
    assert tracer.take()
    feed.put(count=1)
    listener.wait_blocks(tree.find("input"), 2)
    assert tracer.take() == []


def test_processors_that_are_added_and_removed_during_a_trace(tree: Tree, listener: Recorder, feed: Feed) -> None:
    tracer = Tracer()
    tree.observe(tracer)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    tree.add("preProc", "p", "input")
    feed.put(count=2)
    listener.wait_blocks(tree.find("p"), 2)
    tree.remove("p")
    events = tracer.take()
    assert {event.name: event.parent for event in events} == {"input": "", "p": "input"}
    assert [e.state for e in events if e.name == "p"][-1] == "removed"
    trace = Trace(events)
    ends = [interval.end for interval in trace.intervals if interval.name == "p"]
    assert max(ends) == [e.time for e in events if e.name == "p"][-1]


# --- figures ----------------------------------------------------------------------------------------------------

EVENTS = [
    Event(0, "child", "preProc", "root", "waitExec", None),
    Event(0, "root", "input", "", "exec", 7),
    Event(400, "root", "input", "", "waitRelease", 7),
    Event(400, "root", "input", "", "release", 7),
    Event(500, "child", "preProc", "root", "exec", 7),
    Event(500, "root", "input", "", "waitExec", None),
    Event(600, "root", "input", "", "exec", 8),
    Event(900, "child", "preProc", "root", "waitRelease", 7),
    Event(1000, "child", "preProc", "root", "removed", None),
]


def test_intervals_overlap_and_shares() -> None:
    trace = Trace(EVENTS)
    assert (trace.begin, trace.end) == (0, 1000)
    assert [(s.begin, s.end, s.block) for s in trace.of("root", State.EXEC)] == [(0, 400, 7), (600, 1000, 8)]
    assert [(a.block, b.block) for a, b in trace.overlap("root", "child")] == [(8, 7)]
    assert trace.concurrency() == {0: 100, 1: 600, 2: 300}
    summary = "\n".join(trace.summary())
    assert "at least one processor computes in 90.0% of the time; during this time, two or more compute in " in summary
    assert "33%, and 1.33 on average" in summary
    assert "root and child           0.3 ms  (parent and child)" in summary
    (row,) = (line.split() for line in summary.splitlines() if line.startswith("child"))
    assert row == ["child", "1", "0.40", "0.40", "50.0%", "40.0%", "10.0%", "0.0%"]


def test_chrome_format() -> None:
    shown = json.loads(json.dumps(Trace(EVENTS).chrome("/rosAFE")))["traceEvents"]
    names = {e["tid"]: e["args"]["name"] for e in shown if e["name"] == "thread_name"}
    assert names == {1: "root (input)", 2: "child (preProc)"}, "a row for each, parents first"
    intervals = [e for e in shown if e["ph"] == "X"]
    assert {"name", "cat", "ph", "ts", "dur", "pid", "tid", "args"} == set(intervals[0])
    assert [(e["name"], e["ts"], e["dur"], e["args"]) for e in intervals if e["tid"] == 2] == [
        ("waitExec", 0, 500, {}),
        ("exec 7", 500, 400, {"block": 7}),
        ("waitRelease 7", 900, 100, {"block": 7}),
    ]


def test_workers_have_a_row_each_and_their_share() -> None:
    """A row shows the computations of its worker. A release is often done by another worker."""
    events = [event._replace(worker=f"worker {1 + (event.name == 'child')}") for event in EVENTS]
    trace = Trace(events)
    shown = trace.chrome("/rosAFE")["traceEvents"]
    processes = {e["pid"]: e["args"]["name"] for e in shown if e["name"] == "process_name"}
    assert processes == {1: "/rosAFE", 2: "workers"}
    rows = {e["tid"]: e["args"]["name"] for e in shown if e["name"] == "thread_name" and e["pid"] == 2}
    intervals = [(rows[e["tid"]], e["name"], e["ts"], e["dur"]) for e in shown if e["ph"] == "X" and e["pid"] == 2]
    assert intervals == [
        ("worker 1", "root 7", 0, 400),
        ("worker 2", "child 7", 500, 400),
        ("worker 1", "root 8", 600, 400),
    ]
    assert len({e["tid"] for e in shown if e["name"] == "thread_name"}) == 4
    lines = [line.split() for line in trace.summary() if line.startswith("worker")]
    assert [(line[1], line[2], line[-4]) for line in lines] == [("1", "2", "80.0%"), ("2", "1", "40.0%")]


def test_an_empty_trace() -> None:
    trace = Trace([])
    assert trace.intervals == [] and trace.chrome("x")["traceEvents"]
    assert "at least one processor computes in 0.0% of the time" in "\n".join(trace.summary())


def test_unknown_parents_and_circles_are_accepted() -> None:
    """A parent that was replaced while it was traced, or a name that came back elsewhere in the tree."""
    events = [
        Event(0, "a", "x", "b", "exec", 0),
        Event(1, "b", "x", "a", "exec", 0),
        Event(2, "c", "x", "?", "exec", 0),
    ]
    assert set(Trace(events).processors) == {"a", "b", "c"}
