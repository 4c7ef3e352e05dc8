"""The throttled log: the first event at once, many events as one line with their number, and none uncounted."""

from __future__ import annotations

import itertools
import re
import time

from rosafe.system.log_throttle import MAX_KINDS, ThrottledLog
from tests.harness import run_together, wait_for


def event_count(lines: list[str]) -> int:
    """Return the number of events that the lines report."""
    counts = [re.search(r"\((\d+) like it in", line) for line in lines]
    return sum(int(count[1]) if count else 1 for count in counts)


def test_kinds_are_independent() -> None:
    lines: list[str] = []
    log = ThrottledLog(lines.append, period=60.0)
    for number in range(3):
        log(f"lost {number} frames ({number / 7:.3f} s)")
        log(f"a new stream at {number} Hz")
    assert lines == ["lost 0 frames (0.000 s)", "a new stream at 0 Hz"]


def test_many_events_are_one_line_per_period_with_the_last_event() -> None:
    lines: list[str] = []
    log = ThrottledLog(lines.append, period=0.2)
    for number in range(1000):
        log(f"lost frame {number}")
    wait_for(lambda: event_count(lines) == 1000)
    assert lines[0] == "lost frame 0" and lines[-1].startswith("lost frame 999 (")
    assert len(lines) < 100
    wait_for(lambda: not log._suppressed)
    log("lost frame 1000")
    assert lines[-1] == "lost frame 1000", "immediately again"


def test_continuous_events_are_never_two_lines_at_a_time() -> None:
    """The line with the number is not followed directly by a line for the next event."""
    times: list[float] = []
    log = ThrottledLog(lambda line: times.append(time.monotonic()), period=0.5)

    def five_lines() -> bool:
        log("lost 1 frame")
        return len(times) >= 5

    wait_for(five_lines)
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert min(gaps) > 0.01, gaps


def test_a_kind_can_be_named_and_the_number_of_kinds_is_limited() -> None:
    """Events with texts from clients cannot fill the log."""
    lines: list[str] = []
    log = ThrottledLog(lines.append, period=60.0)
    for text in ("a", "b"):
        log(f"peer says {text}", kind="peer")
    assert lines == ["peer says a"]
    for number in range(1000):
        log("x", kind=f"peer {number}")
    assert len(lines) == MAX_KINDS + 1, "the last kind contains all others"


def test_events_from_many_threads_are_all_counted() -> None:
    lines: list[str] = []
    log = ThrottledLog(lines.append, period=0.05)
    run_together(8, lambda thread: storm(log))
    wait_for(lambda: event_count(lines) == 4000, what=lambda: str(event_count(lines)))


def storm(log: ThrottledLog) -> None:
    for number in range(500):
        log(f"event {number}")
