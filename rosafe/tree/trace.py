"""What the processors did and when: collected from a running tree, shown as a Chrome trace and in numbers."""

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

MAX_EVENTS = 500_000  # that wait to be taken; the oldest are forgotten
PROCESSORS, WORKERS = 1, 2  # what viewers take for processes


class Event(NamedTuple):
    """A processor enters a state."""

    time: int  # microseconds of the monotonic clock
    name: str
    kind: str
    parent: str  # empty for the input
    state: str
    block: int | None  # the input's number of the block at hand
    worker: str = ""  # who brought it there, where that was one


class StateInterval(NamedTuple):
    """A processor is in a state. Times in microseconds."""

    name: str
    state: str
    block: int | None
    begin: int
    end: int
    worker: str


class Tracer:
    """An observer of a tree that keeps what it hears until `take`."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)

    def __call__(self, processor: Processor, state: State, block: int | None) -> None:
        """Note one step."""
        parent = processor.parent.name if processor.parent is not None else ""
        now, thread = time.monotonic_ns() // 1000, threading.current_thread().name
        worker = thread.removeprefix("rosafe ") if thread.startswith(WORKER) else ""
        self._events.append(Event(now, processor.name, processor.kind, parent, state.value, block, worker))

    def take(self) -> list[Event]:
        """All events since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]


class Trace:
    """A finished trace.

    Parameters
    ----------
    events : sequence of Event
        In the order of time.
    """

    def __init__(self, events: Sequence[Event]) -> None:
        self.begin, self.end = (events[0].time, events[-1].time) if events else (0, 0)
        self.processors = _parents_first({event.name: event for event in events})
        self.spans = list(self._spans(events))
        self.workers = sorted({span.worker for span in self.spans if span.worker}, key=lambda name: (len(name), name))
        self._of: dict[tuple[str, str], list[StateInterval]] = {}
        for span in self.spans:
            self._of.setdefault((span.name, span.state), []).append(span)

    def _spans(self, events: Sequence[Event]) -> Iterator[StateInterval]:
        entered: dict[str, Event] = {}
        for event in events:
            before = entered.pop(event.name, None)
            if before is not None:
                yield _span(before, event.time)
            if State(event.state) not in FINAL_STATES:
                entered[event.name] = event
        for event in entered.values():
            yield _span(event, self.end)

    def of(self, name: str, state: State) -> list[StateInterval]:
        """When a processor was in a state, in the order of time."""
        return self._of.get((name, state.value), [])

    def overlap(self, one: str, other: str) -> list[tuple[StateInterval, StateInterval]]:
        """The pairs of spans in which both processors compute at the same time."""
        ones, others = deque(self.of(one, State.EXEC)), deque(self.of(other, State.EXEC))
        pairs = []
        while ones and others:
            if _common(ones[0], others[0]) > 0:
                pairs.append((ones[0], others[0]))
            (ones if ones[0].end <= others[0].end else others).popleft()
        return pairs

    def related_pairs(self) -> Iterator[tuple[str, str, str]]:
        """All pairs that may work at the same time, and what they are to each other."""
        for name, event in self.processors.items():
            if event.parent in self.processors:
                yield event.parent, name, "parent and child"
            for other, sibling in self.processors.items():
                if name < other and event.parent and sibling.parent == event.parent:
                    yield name, other, "siblings"

    def concurrency(self) -> dict[int, int]:
        """For how many microseconds so many processors computed at the same time."""
        work = [span for span in self.spans if span.state == State.EXEC.value]
        steps = [(span.begin, 1) for span in work] + [(span.end, -1) for span in work]
        spent: dict[int, int] = {}
        busy, last = 0, self.begin
        for moment, step in sorted(steps):
            spent[busy] = spent.get(busy, 0) + moment - last
            busy, last = busy + step, moment
        spent[busy] = spent.get(busy, 0) + self.end - last
        return spent

    # --- for people and viewers ---

    def chrome(self, title: str) -> dict[str, Any]:
        """The trace event format that Perfetto (ui.perfetto.dev) and chrome://tracing show.

        There is a row for each processor, and below them one for each worker with what it computed.
        """
        rows = {name: row for row, name in enumerate(self.processors, 1)}
        workers = {name: row for row, name in enumerate(self.workers, 1 + len(rows))}
        shown = [_metadata("process_name", PROCESSORS, 0, name=title)]
        for name, row in rows.items():
            shown.append(_metadata("thread_name", PROCESSORS, row, name=f"{name} ({self.processors[name].kind})"))
            shown.append(_metadata("thread_sort_index", PROCESSORS, row, sort_index=row))
        shown += [_metadata("process_name", WORKERS, 0, name="workers")] if workers else []
        shown += [_metadata("thread_name", WORKERS, row, name=name) for name, row in workers.items()]
        for span in self.spans:
            shown.append(self._shown(span, span.state, PROCESSORS, rows[span.name]))
            if span.worker and span.state == State.EXEC.value:
                shown.append(self._shown(span, span.name, WORKERS, workers[span.worker]))
        return {"traceEvents": shown, "displayTimeUnit": "ms"}

    def _shown(self, span: StateInterval, what: str, process: int, row: int) -> dict[str, Any]:
        block = {} if span.block is None else {"block": span.block}
        return {
            "name": " ".join([what, *map(str, block.values())]),
            "cat": span.state,
            "ph": "X",
            "ts": span.begin - self.begin,
            "dur": span.end - span.begin,
            "pid": process,
            "tid": row,
            "args": block,
        }

    def summary(self) -> list[str]:
        """Lines: each processor's share of the time in its states, and who works at the same time as whom."""
        states = (State.WAIT_EXEC, State.EXEC, State.WAIT_RELEASE, State.RELEASE)
        width = max([len("processor"), *map(len, self.processors)])
        lines = [f"{'processor':{width}} blocks exec ms  longest" + "".join(f"{s.value:>12}" for s in states)]
        for name in self.processors:
            work = [(span.end - span.begin) / 1000 for span in self.of(name, State.EXEC)]
            shares = [sum(s.end - s.begin for s in self.of(name, state)) / self._length for state in states]
            lines.append(
                f"{name:{width}} {len(work):6d} {median(work or [0.0]):7.2f} {max(work, default=0.0):8.2f}"
                + "".join(f"{share:12.1%}" for share in shares)
            )
        spent = self.concurrency()
        busy = self.end - self.begin - spent.get(0, 0)
        computed = sum(count * time for count, time in spent.items())
        several = sum(time for count, time in spent.items() if count > 1)
        lines.append(
            f"somebody computes in {busy / self._length:.1%} of the time; of that, two or more at once in "
            f"{several / max(1, busy):.0%}, {computed / max(1, busy):.2f} on average"
        )
        for worker in self.workers:
            did = [span for span in self.spans if span.worker == worker and span.state == State.EXEC.value]
            share = sum(span.end - span.begin for span in did) / self._length
            lines.append(f"{worker:{width}} {len(did):6d} blocks, computes in {share:.1%} of the time")
        lines.append("at the same time:")
        for one, other, what in self.related_pairs():
            both = sum(_common(a, b) for a, b in self.overlap(one, other))
            lines.append(f"{one:>{width}} and {other:{width}} {both / 1000:9.1f} ms  ({what})")
        return lines

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


def _span(event: Event, end: int) -> StateInterval:
    return StateInterval(event.name, event.state, event.block, event.time, end, event.worker)


def _metadata(what: str, process: int, row: int, **arguments: Any) -> dict[str, Any]:
    return {"name": what, "ph": "M", "pid": process, "tid": row, "args": arguments}
