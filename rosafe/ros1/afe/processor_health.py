"""The state of the processors in /diagnostics: load, failures, slow calls, and choices that were replaced."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.declarations.parameter import Parameter
from rosafe.dsp.plugin_checks import plugin_of
from rosafe.interface.remarks import advice
from rosafe.ros1.component.activities import TaskStatistics
from rosafe.ros1.transport import master
from rosafe.ros1.transport.log_throttle import ThrottledLog
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Failure, Tree

SLOW_SECONDS = 1.0  # a call of a stage is slow if it takes longer than this,
SLOW_BLOCKS = 10.0  # and longer than this many lengths of its block
SHOWN_SECONDS = 60.0  # for which a slow call is reported after its end
FAILED, SLOW = "failed", "slow"  # keys in /diagnostics, before the name of the processor
NEXT_STEP = "correct it, restart rosAFE if it is a plugin, and request it again"
STRICT_CHOICES_PARAM = "~strict_words"  # ROS parameter, read for each unknown choice
LOG_SECONDS = 60.0  # between two lines about one processor


class SlowCalls:
    """Detects calls of stages that take too long, including those that never return. Safe from any thread."""

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._lock = threading.Lock()
        self._computing: dict[Processor, tuple[int, float]] = {}  # block, and when it was first seen
        self._found: dict[Processor, tuple[int, float, str]] = {}  # block, when it was last seen, the line
        self._log = ThrottledLog(rospy.logwarn, LOG_SECONDS)

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


class ChoiceFallbacks:
    """Unknown choices in requests: replaced as in the original, with a warning, or rejected in strict mode.

    Parameters
    ----------
    strict : bool
        Reject unknown choices, whatever the value of the ROS parameter.
    """

    def __init__(self, strict: bool) -> None:
        self._strict = strict
        self._warnings: dict[Processor, dict[str, str]] = {}  # by the name of the parameter
        self._advised: set[Processor] = set()
        self._lock = threading.Lock()

    def resolving(self, warnings: dict[str, str]) -> Callable[[Parameter, Any], Any]:
        """Return a function that replaces unknown choices, except in strict mode, and adds a warning to `warnings`."""

        def resolve(parameter: Parameter, value: Any) -> Any:
            warnings[parameter.name] = warning = parameter.substitution_warning(value)
            return value if warning and self._is_strict() else parameter.resolve_choice(value)

        return resolve

    def _is_strict(self) -> bool:
        try:
            return self._strict or bool(rospy.get_param_cached(STRICT_CHOICES_PARAM, False) == 1)  # true, or 1
        except master.FAILURES:
            return False

    def note(self, processor: Processor, warnings: dict[str, str]) -> str:
        """Log and store the `warnings` about parameters of a processor, and return them as one line."""
        with self._lock:
            stored = {**self._warnings.pop(processor, {}), **warnings}
            if any(stored.values()):
                self._warnings[processor] = {name: warning for name, warning in stored.items() if warning}
        lines = [f"{processor.name}: {warning}" for warning in warnings.values() if warning]
        for line in [*lines, *self._advice(processor)]:
            rospy.logwarn(line)
        return "; ".join(lines)

    def _advice(self, processor: Processor) -> list[str]:
        """Return the declared warning about valid but unsuitable values, once for each processor."""
        if processor in self._advised:
            return []
        with self._lock:
            self._advised.add(processor)
        values: dict[str, Any] = {}
        ancestor: Processor | None = processor
        while ancestor is not None:
            values |= ancestor.stage.parameters
            ancestor = ancestor.parent
        text = advice(processor.kind, values)
        return [f"{processor.name}: {text}"] if text else []

    def forget(self, processor: Processor) -> None:
        """Remove the warnings of a processor that has ended."""
        with self._lock:
            self._warnings.pop(processor, None)
            self._advised.discard(processor)

    @property
    def lines(self) -> list[str]:
        """The warnings about the current parameters of all processors."""
        with self._lock:
            return [f"{p.name}: {warning}" for p, warnings in self._warnings.items() for warning in warnings.values()]


class ProcessorHealth:
    """The part of `/diagnostics` about processors, with their loads."""

    def __init__(self, tree: Tree, choices: ChoiceFallbacks) -> None:
        self._tree, self._choices = tree, choices
        self._slow = SlowCalls(tree)
        self._meters: dict[Processor, tuple[TaskStatistics, TaskStatistics]] = {}  # its own, and that of its task

    def added(self, processor: Processor, task: TaskStatistics) -> None:
        """Register a processor that is about to start; its computing time is added to that of `task`."""
        self._meters[processor] = TaskStatistics(processor.name), task

    def executed(self, processor: Processor, seconds: float) -> None:
        """Register the computation of a block, which took `seconds`."""
        meters = self._meters.get(processor)  # None if it has ended
        if meters is not None:
            meters[0].cycle(seconds)
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
            rospy.logerr(f"{failure}; {NEXT_STEP}\n{trace}")

    def report(self, status: Any) -> Any:
        """Fill in a status of /diagnostics."""
        self._slow.poll()
        processors, warnings, slow = self._tree.processors, self._choices.lines, self._slow.lines
        failures = {failure.name: f"{failure}; {NEXT_STEP}" for failure in self._tree.failures}
        for level, lines, more in (
            (DiagnosticStatus.ERROR, [*failures.values()], "failed processors"),
            (DiagnosticStatus.WARN, [*slow.values()], "slow processors"),
            (DiagnosticStatus.WARN, warnings, "unknown words"),
            (DiagnosticStatus.OK, [f"{len(processors)} processors"], ""),
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
