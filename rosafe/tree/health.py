"""The state of the processors of a node for its diagnostics: load, failures, slow calls."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from rosafe.declarations.errors import forget_frames
from rosafe.dsp.plugin_checks import plugin_of
from rosafe.system.log_throttle import ThrottledLog
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Failure, Tree

OK, WARN, ERROR = 0, 1, 2  # levels of diagnostic_msgs/DiagnosticStatus
LOAD_SECONDS = 1.0  # minimum time over which the load is measured; in less, one cycle would look like overload
SLOW_SECONDS = 1.0  # a call of a stage is slow if it takes longer than this,
SLOW_BLOCKS = 10.0  # and longer than this many lengths of its block
SHOWN_SECONDS = 60.0  # for which a slow call is reported after its end
FAILED, SLOW = "failed", "slow"  # keys in /diagnostics, before the name of the processor
NEXT_STEP = "correct it, restart rosAFE if it is a plugin, and request it again"
LOG_SECONDS = 60.0  # between two lines about one processor


class TaskStatistics:
    """Measurements of one task of the component: number and duration of its cycles, and its load.

    The load is the time spent in cycles divided by the elapsed time. It can exceed 1 if a task has several processors.

    Attributes
    ----------
    cycle : callable
        Count a cycle of some seconds. It may be called from any thread, thousands of times per second.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.load = self.load_max = 0.0
        self._pending: deque[float] = deque()  # the cycles since the last snapshot, of which there is one per second
        self.cycle: Callable[[float], None] = self._pending.append
        self._cycles = 0
        self._last = self._longest = self._total = self._busy = 0.0
        self._since = self._start = time.monotonic()
        self._lock = threading.Lock()

    def _count_pending(self) -> None:
        for _ in range(len(self._pending)):
            self._last = self._pending.popleft()
            self._longest = max(self._longest, self._last)
            self._total += self._last
            self._busy += self._last
            self._cycles += 1

    def snapshot(self) -> dict[str, Any]:
        """Return the member `rusage` of genom_state: timings in seconds, and the load of about the last second."""
        with self._lock:
            self._count_pending()
            now = time.monotonic()
            if now - self._since >= LOAD_SECONDS:
                self.load = self._busy / (now - self._since)
                self.load_max = max(self.load_max, self.load)
                self._busy, self._since = 0.0, now
            average = self._total / self._cycles if self._cycles else 0.0
            return {
                "cycles": self._cycles % 2**32,
                "timings": {"last": self._last, "max": self._longest, "avg": average},
                "load": {
                    "last": self.load,
                    "max": self.load_max,
                    "avg": self._total / max(now - self._start, 1e-9),
                },
            }


class SlowCalls:
    """Detects calls of stages that take too long, including those that never return. Safe from any thread."""

    def __init__(self, tree: Tree, warn: Callable[[str], object]) -> None:
        self._tree = tree
        self._lock = threading.Lock()
        self._computing: dict[Processor, tuple[int, float]] = {}  # block, and when it was first seen
        self._found: dict[Processor, tuple[int, float, str]] = {}  # block, when it was last seen, the line
        self._log = ThrottledLog(warn, LOG_SECONDS)

    def poll(self) -> None:
        """Check all processors. Called about once a second."""
        now = time.monotonic()
        processors = self._tree.processors
        with self._lock:
            before, self._computing = self._computing, {}
            for processor in processors:
                if processor.state is State.EXEC:
                    block = processor.blocks
                    since = before.get(processor, (block, now))
                    self._computing[processor] = since if since[0] == block else (block, now)
            running = [(processor, block, now - since) for processor, (block, since) in self._computing.items()]
            self._found = {p: found for p, found in self._found.items() if now - found[1] < SHOWN_SECONDS}
        for processor, block, seconds in running:
            if _is_slow(processor, seconds):
                self._report(processor, block, f"one call has been running for {seconds:.1f} s")
                self._tree.skip(processor, block)

    def executed(self, processor: Processor, seconds: float) -> None:
        """Register a call that took `seconds`."""
        if _is_slow(processor, seconds):
            self._report(processor, processor.blocks - 1, f"one call took {seconds:.1f} s")

    def _report(self, processor: Processor, block: int, duration: str) -> None:
        length, origin = _block_seconds(processor), plugin_of(processor.stage) or processor.kind
        line = f"{processor.name} ({origin}) is slow: {duration} for a block of {length:.3g} s; "
        line += "make it faster or remove it"
        with self._lock:
            known = self._found.get(processor)
            self._found[processor] = (block, time.monotonic(), line)
        if known is None or known[0] != block:
            self._log(line, processor.name)

    def forget(self, processor: Processor) -> None:
        """Remove a processor that has ended."""
        with self._lock:
            self._computing.pop(processor, None)
            self._found.pop(processor, None)

    @property
    def lines(self) -> dict[str, str]:
        """A line for each processor that is slow, or was recently, by its name."""
        with self._lock:
            return {processor.name: line for processor, (_, _, line) in self._found.items()}


def _block_seconds(processor: Processor) -> float:
    block = processor.current_block
    return block.parts[0].shape[-1] / block.signal.rate if block is not None else 0.0


def _is_slow(processor: Processor, seconds: float) -> bool:
    return seconds > max(SLOW_SECONDS, SLOW_BLOCKS * _block_seconds(processor))


class ProcessorHealth:
    """The part of `/diagnostics` about processors, with their loads.

    Parameters
    ----------
    tree : Tree
    warn, error : callable
        Write a line to the log.
    unknown_words : callable
        Returns lines about unknown words that were replaced.
    """

    def __init__(
        self,
        tree: Tree,
        warn: Callable[[str], object],
        error: Callable[[str], object],
        unknown_words: Callable[[], list[str]] = list,
    ) -> None:
        self._tree, self._error, self._unknown_words = tree, error, unknown_words
        self._slow = SlowCalls(tree, warn)
        self._meters: dict[Processor, tuple[TaskStatistics, TaskStatistics | None]] = {}

    def added(self, processor: Processor, task: TaskStatistics | None = None) -> None:
        """Register a processor that is about to start; its computing time is added to that of `task`."""
        self._meters[processor] = TaskStatistics(processor.name), task

    def executed(self, processor: Processor, seconds: float) -> None:
        """Register the computation of a block, which took `seconds`."""
        meters = self._meters.get(processor)  # None if it has ended
        if meters is not None:
            meters[0].cycle(seconds)
            if meters[1] is not None:
                meters[1].cycle(seconds)
            if seconds > SLOW_SECONDS:
                self._slow.executed(processor, seconds)

    def ended(self, processor: Processor) -> None:
        """Register the end of a processor; log the reason of a failure with its traceback."""
        self._meters.pop(processor, None)
        self._slow.forget(processor)
        if processor.error is not None:
            failure = next((f for f in self._tree.failures if f.name == processor.name), Failure.of(processor))
            trace = "".join(traceback.format_exception(processor.error.__cause__ or processor.error))
            self._error(f"{failure}; {NEXT_STEP}\n{trace}")
            forget_frames(processor.error)

    def report(self, status: Any) -> Any:
        """Fill in a status of /diagnostics."""
        self._slow.poll()
        processors, warnings, slow = self._tree.processors, self._unknown_words(), self._slow.lines
        failures = {failure.name: f"{failure}; {NEXT_STEP}" for failure in self._tree.failures}
        for level, lines, more in (
            (ERROR, [*failures.values()], "failed processors"),
            (WARN, [*slow.values()], "slow processors"),
            (WARN, warnings, "unknown words"),
            (OK, [f"{len(processors)} processors"], ""),
        ):
            if lines:
                rest = f" (and {len(lines) - 1} more {more})" if len(lines) > 1 else ""
                status.summary(level, f"{lines[0]}{rest}")
                break
        for key, lines_by_name in ((FAILED, failures), (SLOW, slow)):
            for name, line in lines_by_name.items():
                status.add(f"{key} {name}", line)
        for warning in warnings:
            status.add("unknown word", warning)
        status.add("workers", str(self._tree.workers))
        for processor in processors:
            meters = self._meters.get(processor)
            load = 1e3 * meters[0].snapshot()["load"]["last"] if meters is not None else 0.0
            state = f"{processor.kind}, {processor.state.value}, {processor.blocks} blocks, {load:.1f} ms/s"
            status.add(processor.name, state)
        return status
