"""A tree that is slower than the stream is reported, with a block size that is sufficient."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosafe.audio.stream.ring import BLOCK_SIZES, LAG_SECONDS, LagMonitor
from tests.harness import Graph, Process, wait_for
from tests.ros1.afe.session import own_node

MESSAGE = 2205  # frames between two audio messages
RATE = 44100.0


def run(block: int, block_seconds: float, seconds: float) -> list[tuple[float, str]]:
    """Return the reports, with their times, about a tree that needs `block_seconds` for each block of a stream."""
    now = 0.0
    lines: list[tuple[float, str]] = []
    monitor = LagMonitor(RATE, block, lambda line: lines.append((now, line)))
    arrived = read = 0
    free_at = 0.0  # when the tree reads the next block
    while now < seconds:
        arrived += MESSAGE
        monitor.update(arrived - read, now)
        until = now + MESSAGE / RATE
        free_at = max(free_at, now)
        while arrived - read >= block and free_at < until:
            now = free_at
            read += block
            monitor.blocks_read(1)
            monitor.update(arrived - read, now)
            free_at += block_seconds
        now = until
    return lines


def proposed_size(line: str) -> int:
    found = re.search(r"nFramesPerBlock (\d+)", line)
    assert found is not None, line
    return int(found[1])


def test_a_fast_enough_tree_is_not_reported() -> None:
    assert run(220, 0.9 * 220 / RATE, 5.0) == []
    assert run(44100, 0.9, 20.0) == []


@given(st.sampled_from([1, 10, 100, 220]), st.floats(1.1, 12.0))
def test_a_too_short_block_is_reported_in_time_with_a_sufficient_size(block: int, load: float) -> None:
    """Here the time for a block does not depend on its length."""
    cost = load * block / RATE
    (when, line), *more = run(block, cost, 3.0)
    assert when <= LAG_SECONDS + 0.5 and not more
    assert "does not keep up" in line
    size = proposed_size(line)
    assert size in BLOCK_SIZES
    assert run(size, cost, 3.0) == []


def test_no_too_long_block_size_is_proposed() -> None:
    ((_, line),) = run(12000, 2 * 12000 / RATE, 20.0)
    assert "longer blocks do not help" in line and "channels" in line


def test_the_end_of_a_lag_is_reported() -> None:
    lines: list[str] = []
    monitor = LagMonitor(RATE, 10, lines.append)
    monitor.update(100, 0.0)
    monitor.update(9, 0.3)
    monitor.update(100, 0.5)
    monitor.update(5000, 0.8)
    assert not lines
    monitor.update(20000, 1.0)
    assert "keep up" in monitor.problem
    monitor.update(30000, 2.0)
    assert len(lines) == 1
    monitor.update(9, 3.0)
    assert monitor.problem == ""
    assert lines[1:] == ["Audio: the tree has caught up"]


@pytest.mark.ros
def test_the_node_reports_too_short_blocks(graph: Graph, bass_node: Process) -> None:
    """In log and /diagnostics; the proposed size solves the problem."""
    with own_node(graph) as own:
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        own.ok("connect_port", local="Audio", remote="bass/Audio")
        own.ok("InputProc", nFramesPerBlock=10)
        for request in ("PreProc", "GammatoneProc", "IhcProc", "RatemapProc", "IldProc"):
            own.ok(request)
        with own.follow("preProc"):  # each block has new samples; otherwise blocks are combined
            status = own.health(lambda entries: "keep up" in entries["message"])
        assert status["level"] == "1"
        line = wait_for(lambda: re.search(r"Audio: the tree does not keep up.*", own.process.err))
        assert line is not None
        size = proposed_size(line[0])
        assert size == proposed_size(status["message"]) > 10
        own.ok("Stop")
        own.ok("InputProc", nFramesPerBlock=max(size, 2205))
        own.health(lambda entries: "keep up" not in entries["message"] and int(entries["frames waiting"]) < 44100)
        assert graph.call("/bass/Stop").genom_success
