"""The state of the processors in /diagnostics: load, failures, slow calls, and words that were replaced."""

from __future__ import annotations

import threading
import time
import traceback
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.component.activities import TaskStatistics
from rosafe.dsp.plugin_checks import plugin_of
from rosafe.node.choice_fallbacks import ChoiceFallbacks
from rosafe.transport.log_throttle import ThrottledLog
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Failure, Tree

SLOW_SECONDS = 1.0  # a call of a stage that takes longer than this, and
SLOW_BLOCKS = 10.0  # than this many lengths of its block, is reported
SHOWN_SECONDS = 60.0  # that a slow call is shown after its end
FAILED, SLOW = "failed", "slow"  # keys in /diagnostics, before the name of the processor
NEXT_STEP = "correct it, restart rosAFE if it is a plugin, and request it again"
LOG_SECONDS = 60.0  # between two lines about one processor


class SlowCalls:
    """Finds calls of stages that take too long, also those that never return. Safe from any thread."""

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._lock = threading.Lock()
        self._computing: dict[Processor, tuple[int, float]] = {}  # block, and when it was first seen at that block
        self._found: dict[Processor, tuple[int, float, str]] = {}  # block, when it was seen last, the line
        self._log = ThrottledLog(rospy.logwarn, LOG_SECONDS)

    def look(self) -> None:
        """Look at all processors. Called about once a second."""
        now = time.monotonic()
        processors = self._tree.processors
        with self._lock:
            before, self._computing = self._computing, {}
            for processor in processors:
                if processor.state is State.EXEC:
                    block = processor.blocks
                    since = before.get(processor, (block, now))
                    self._computing[processor] = since if since[0] == block else (block, now)
            running = [(one, block, now - since) for one, (block, since) in self._computing.items()]
            self._found = {p: found for p, found in self._found.items() if now - found[1] < SHOWN_SECONDS}
        for processor, block, seconds in running:
            if _is_slow(processor, seconds):
                self._report(processor, block, f"one call has been running for {seconds:.1f} s")
                self._tree.skip(processor, block)

    def executed(self, processor: Processor, seconds: float) -> None:
        """A call took so many seconds."""
        if seconds > SLOW_SECONDS and _is_slow(processor, seconds):
            self._report(processor, processor.blocks - 1, f"one call took {seconds:.1f} s")

    def _report(self, processor: Processor, block: int, what: str) -> None:
        length = _block_seconds(processor)
        line = f"{_named(processor)} is slow: {what} for a block of {length:.3g} s; make it faster or remove it"
        with self._lock:
            known = self._found.get(processor)
            self._found[processor] = (block, time.monotonic(), line)
        if known is None or known[0] != block:
            self._log(line, processor.name)

    def forget(self, processor: Processor) -> None:
        """The processor has ended."""
        with self._lock:
            self._computing.pop(processor, None)
            self._found.pop(processor, None)

    @property
    def lines(self) -> dict[str, str]:
        """A line for each processor that is slow, or was a short time ago, by its name."""
        with self._lock:
            return {processor.name: line for processor, (_, _, line) in self._found.items()}


def _block_seconds(processor: Processor) -> float:
    taken = processor.current_block
    return taken.parts[0].shape[-1] / taken.signal.rate if taken is not None else 0.0


def _is_slow(processor: Processor, seconds: float) -> bool:
    return seconds > max(SLOW_SECONDS, SLOW_BLOCKS * _block_seconds(processor))


def _named(processor: Processor) -> str:
    return f"{processor.name} ({plugin_of(processor.stage) or processor.kind})"


class ProcessorHealth:
    """What `/diagnostics` says of the processors, with their loads."""

    def __init__(self, tree: Tree, words: ChoiceFallbacks) -> None:
        self._tree, self._words = tree, words
        self._slow = SlowCalls(tree)
        self._loads: dict[Processor, TaskStatistics] = {}

    def added(self, processor: Processor) -> None:
        """The processor is about to start."""
        self._loads[processor] = TaskStatistics(processor.name)

    def executed(self, processor: Processor, seconds: float) -> None:
        """A block was computed."""
        meter = self._loads.get(processor)  # None if it has ended
        if meter is not None:
            meter.cycle(seconds)
            self._slow.executed(processor, seconds)

    def ended(self, processor: Processor) -> None:
        """The processor has ended; the log gets the reason of a failure, with its traceback."""
        self._loads.pop(processor, None)
        self._slow.forget(processor)
        if processor.error is not None:
            failure = next((f for f in self._tree.failures if f.name == processor.name), Failure.of(processor))
            trace = "".join(traceback.format_exception(processor.error.__cause__ or processor.error))
            rospy.logerr(f"{failure}; {NEXT_STEP}\n{trace}")

    def report(self, status: Any) -> Any:
        """Fill in a status of /diagnostics."""
        self._slow.look()
        processors, doubts, slow = self._tree.processors, self._words.lines, self._slow.lines
        failures = {failure.name: f"{failure}; {NEXT_STEP}" for failure in self._tree.failures}
        for level, lines, more in (
            (DiagnosticStatus.ERROR, [*failures.values()], "failed processors"),
            (DiagnosticStatus.WARN, [*slow.values()], "slow processors"),
            (DiagnosticStatus.WARN, doubts, "unknown words"),
            (DiagnosticStatus.OK, [f"{len(processors)} processors"], ""),
        ):
            if lines:
                rest = f" (and {len(lines) - 1} more {more})" if len(lines) > 1 else ""
                status.summary(level, f"{lines[0]}{rest}")
                break
        for what, named in ((FAILED, failures), (SLOW, slow)):
            for name, line in named.items():
                status.add(f"{what} {name}", line)
        for doubt in doubts:
            status.add("unknown word", doubt)
        status.add("workers", str(self._tree.workers))
        for processor in processors:
            meter = self._loads.get(processor)
            load = 1e3 * meter.snapshot()["load"]["last"] if meter is not None else 0.0
            told = f"{processor.kind}, {processor.state.value}, {processor.blocks} blocks, {load:.1f} ms/s"
            status.add(processor.name, told)
        return status
