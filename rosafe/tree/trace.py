"""Traces of the processors' states: recorded from a running tree, shown as a Chrome trace or as a summary."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any, NamedTuple

from rosafe.tree.processor import Processor
from rosafe.tree.states import FINAL_STATES, State
from rosafe.tree.workers import WORKER

MAX_EVENTS = 500_000  # in a tracer; the oldest are dropped
PROCESSORS, WORKERS = 1, 2  # the process ids that viewers show
_STATES = (State.WAIT_EXEC, State.EXEC, State.WAIT_RELEASE, State.RELEASE)


class Event(NamedTuple):
    """The transition of a processor to a state."""

    time: int  # microseconds of the monotonic clock
    name: str
    kind: str
    parent: str  # empty for the input
    state: str
    block: int | None  # number of the input's block
    worker: str = ""  # the worker that made the transition, if any


class StateInterval(NamedTuple):
    """The time that a processor spent in a state, in microseconds."""

    name: str
    state: str
    block: int | None
    begin: int
    end: int
    worker: str

    @property
    def duration(self) -> int:
        return self.end - self.begin


class Tracer:
    """An observer of a tree that records all transitions until `take`."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)

    def __call__(self, processor: Processor, state: State, block: int | None) -> None:
        """Record a transition."""
        parent = processor.parent.name if processor.parent is not None else ""
        now, thread = time.monotonic_ns() // 1000, threading.current_thread().name
        worker = thread.removeprefix("rosafe ") if thread.startswith(WORKER) else ""
        self._events.append(Event(now, processor.name, processor.kind, parent, state.value, block, worker))

    def take(self) -> list[Event]:
        """Return all events since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]


class Trace:
    """A finished trace.

    Parameters
    ----------
    events : sequence of Event
        In chronological order.
    """

    def __init__(self, events: Sequence[Event]) -> None:
        self.begin, self.end = (events[0].time, events[-1].time) if events else (0, 0)
        self.processors = _parents_first({event.name: event for event in events})
        self.intervals = list(self._intervals(events))
        workers = {interval.worker for interval in self.intervals if interval.worker}
        self.workers = sorted(workers, key=lambda name: (len(name), name))
        self._computing = [interval for interval in self.intervals if interval.state == State.EXEC.value]
        self._of: dict[tuple[str, str], list[StateInterval]] = {}
        for interval in self.intervals:
            self._of.setdefault((interval.name, interval.state), []).append(interval)

    def _intervals(self, events: Sequence[Event]) -> Iterator[StateInterval]:
        entered: dict[str, Event] = {}
        for event in events:
            before = entered.pop(event.name, None)
            if before is not None:
                yield _interval(before, event.time)
            if State(event.state) not in FINAL_STATES:
                entered[event.name] = event
        for event in entered.values():
            yield _interval(event, self.end)

    def of(self, name: str, state: State) -> list[StateInterval]:
        """Return the intervals of a processor in a state, in chronological order."""
        return self._of.get((name, state.value), [])

    def overlap(self, one: str, other: str) -> list[tuple[StateInterval, StateInterval]]:
        """Return the pairs of intervals in which both processors compute at the same time."""
        ones, others = deque(self.of(one, State.EXEC)), deque(self.of(other, State.EXEC))
        pairs = []
        while ones and others:
            if _common(ones[0], others[0]) > 0:
                pairs.append((ones[0], others[0]))
            (ones if ones[0].end <= others[0].end else others).popleft()
        return pairs

    def related_pairs(self) -> Iterator[tuple[str, str, str]]:
        """Yield all pairs of processors that may compute at the same time, with their relation."""
        for name, event in self.processors.items():
            if event.parent in self.processors:
                yield event.parent, name, "parent and child"
            for other, sibling in self.processors.items():
                if name < other and event.parent and sibling.parent == event.parent:
                    yield name, other, "siblings"

    def concurrency(self) -> dict[int, int]:
        """Return the time in microseconds by the number of processors that computed at the same time."""
        steps = [(one.begin, 1) for one in self._computing] + [(one.end, -1) for one in self._computing]
        spent: dict[int, int] = {}
        busy, last = 0, self.begin
        for moment, step in sorted(steps):
            spent[busy] = spent.get(busy, 0) + moment - last
            busy, last = busy + step, moment
        spent[busy] = spent.get(busy, 0) + self.end - last
        return spent

    # --- output ---

    def chrome(self, title: str) -> dict[str, Any]:
        """Return the trace in the event format that Perfetto (ui.perfetto.dev) and chrome://tracing show.

        There is a row for each processor, and below them a row for each worker with its computations.
        """
        rows = {name: row for row, name in enumerate(self.processors, 1)}
        workers = {name: row for row, name in enumerate(self.workers, 1 + len(rows))}
        shown = [_metadata("process_name", PROCESSORS, 0, name=title)]
        for name, row in rows.items():
            shown.append(_metadata("thread_name", PROCESSORS, row, name=f"{name} ({self.processors[name].kind})"))
            shown.append(_metadata("thread_sort_index", PROCESSORS, row, sort_index=row))
        shown += [_metadata("process_name", WORKERS, 0, name="workers")] if workers else []
        shown += [_metadata("thread_name", WORKERS, row, name=name) for name, row in workers.items()]
        for interval in self.intervals:
            shown.append(self._shown(interval, interval.state, PROCESSORS, rows[interval.name]))
            if interval.worker and interval.state == State.EXEC.value:
                shown.append(self._shown(interval, interval.name, WORKERS, workers[interval.worker]))
        return {"traceEvents": shown, "displayTimeUnit": "ms"}

    def _shown(self, interval: StateInterval, title: str, process: int, row: int) -> dict[str, Any]:
        block = {} if interval.block is None else {"block": interval.block}
        return {
            "name": " ".join([title, *map(str, block.values())]),
            "cat": interval.state,
            "ph": "X",
            "ts": interval.begin - self.begin,
            "dur": interval.duration,
            "pid": process,
            "tid": row,
            "args": block,
        }

    def summary(self) -> list[str]:
        """Return lines for the terminal.

        They show the share of the time that each processor spends in its states, the concurrency, the share of each
        worker, and the time in which related processors compute concurrently.
        """
        width = max([len("processor"), *map(len, self.processors)])
        lines = [f"{'processor':{width}} blocks exec ms  longest" + "".join(f"{s.value:>12}" for s in _STATES)]
        lines += [self._describe_processor(name, width) for name in self.processors]
        lines.append(self._describe_concurrency())
        for worker in self.workers:
            work = [interval for interval in self._computing if interval.worker == worker]
            lines.append(f"{worker:{width}} {len(work):6d} blocks, computes in {self._share(work):.1%} of the time")
        lines.append("at the same time:")
        for one, other, relation in self.related_pairs():
            both = sum(_common(a, b) for a, b in self.overlap(one, other))
            lines.append(f"{one:>{width}} and {other:{width}} {both / 1000:9.1f} ms  ({relation})")
        return lines

    def _describe_processor(self, name: str, width: int) -> str:
        work = [interval.duration / 1000 for interval in self.of(name, State.EXEC)]
        shares = [self._share(self.of(name, state)) for state in _STATES]
        figures = f"{len(work):6d} {median(work or [0.0]):7.2f} {max(work, default=0.0):8.2f}"
        return f"{name:{width}} {figures}" + "".join(f"{share:12.1%}" for share in shares)

    def _describe_concurrency(self) -> str:
        spent = self.concurrency()
        busy = sum(time for count, time in spent.items() if count > 0)
        computed = sum(count * time for count, time in spent.items())
        several = sum(time for count, time in spent.items() if count > 1)
        return (
            f"at least one processor computes in {busy / self._length:.1%} of the time; during this time, two or more "
            f"compute in {several / max(1, busy):.0%}, and {computed / max(1, busy):.2f} on average"
        )

    def _share(self, intervals: Sequence[StateInterval]) -> float:
        return sum(interval.duration for interval in intervals) / self._length

    @property
    def _length(self) -> int:
        return max(1, self.end - self.begin)


def _parents_first(processors: dict[str, Event]) -> dict[str, Event]:
    def depth(name: str) -> int:
        count = 0
        while name in processors and count < len(processors):
            count, name = count + 1, processors[name].parent
        return count

    return {name: processors[name] for name in sorted(processors, key=depth)}


def _common(a: StateInterval, b: StateInterval) -> int:
    return min(a.end, b.end) - max(a.begin, b.begin)


def _interval(event: Event, end: int) -> StateInterval:
    return StateInterval(event.name, event.state, event.block, event.time, end, event.worker)


def _metadata(key: str, process: int, row: int, **arguments: Any) -> dict[str, Any]:
    return {"name": key, "ph": "M", "pid": process, "tid": row, "args": arguments}
