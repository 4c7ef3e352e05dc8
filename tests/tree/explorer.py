"""A deterministic scheduler for threads: one runs at a time, and every possible switch between threads is a decision.

`explore` runs a scenario under many schedules. The code under test is the real one; only locks, conditions and threads
are replaced. A few deviations from a simple schedule find nearly all faults that depend on the order of events. All
schedules with a limited number of delays are run (Emmi, Qadeer and Rakamaric, POPL 2011), and some schedules with
random priorities (Burckhardt et al., ASPLOS 2010).
"""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace, TracebackType
from typing import Any

HANG_SECONDS = 30.0  # if no thread runs for this time, the scheduler itself has failed
MAX_PASSES = 10  # successive timeouts without progress: there will be none


class Abandoned(BaseException):
    """Raised in the threads of a run that cannot continue."""


class Task:
    """A thread that the scheduler controls."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.ready: Callable[[], bool] = lambda: True
        self.in_time: Callable[[], bool] | None = None  # ready after a timeout if this holds
        self.finished = False
        self.go = threading.Lock()  # released to let the thread run
        self.go.acquire()


class Delays:
    """Run a thread until it blocks, then the next one; at the decisions `at`, run the one after that."""

    def __init__(self, at: tuple[int, ...]) -> None:
        self.at = at
        self.decisions = 0

    def choose(self, able: list[Task]) -> Task:
        self.decisions += 1
        return able[self.decisions - 1 in self.at]

    def __repr__(self) -> str:
        return f"delays at {self.at}"


class Priorities:
    """Give threads random priorities; at some random decisions, the running thread gets the lowest one."""

    FALLS = 3
    MAX_FALL = 150  # number of the last decision at which a priority may fall

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._random = random.Random(seed)
        self._falls = [self._random.randrange(self.MAX_FALL) for _ in range(self.FALLS)]
        self._priorities: dict[Task, float] = {}
        self._decisions = 0

    def choose(self, able: list[Task]) -> Task:
        for task in able:
            self._priorities.setdefault(task, self._random.random())
        chosen = max(able, key=self._priorities.__getitem__)
        if self._decisions in self._falls:
            self._priorities[chosen] = -self._decisions
            chosen = max(able, key=self._priorities.__getitem__)
        self._decisions += 1
        return chosen

    def __repr__(self) -> str:
        return f"seed {self.seed}"


class Scheduler:
    """Lets one thread run at a time; `strategy` chooses one if several are ready.

    Timeouts expire only if no thread can run otherwise.
    """

    def __init__(self, strategy: Delays | Priorities) -> None:
        self.trace: list[str] = []
        self.deadlock = ""
        self.tasks = [Task("main")]
        self._current = self.tasks[0]
        self._strategy = strategy
        self._passes = 0
        self.threading = SimpleNamespace(
            Lock=lambda: Lock(self),
            RLock=lambda: Lock(self),
            Condition=lambda lock: Condition(self, lock),
            Thread=lambda target, name="", daemon=False: Thread(self, target, name),
            current_thread=threading.current_thread,
        )

    def until(self, ready: Callable[[], bool], in_time: Callable[[], bool] | None = None) -> None:
        """Let other threads run until `ready()` holds and this thread is chosen.

        Or until `in_time()` holds after a timeout.
        """
        me = self._current
        me.ready, me.in_time = ready, in_time
        self._switch(me)

    def _switch(self, me: Task) -> None:
        start = self.tasks.index(me)
        in_turn = self.tasks[start:] + self.tasks[:start]
        able = [task for task in in_turn if not task.finished and task.ready()]
        if able:
            self._passes = 0
        elif self._passes < MAX_PASSES:
            self._passes += 1
            able = [task for task in in_turn if not task.finished and task.in_time is not None and task.in_time()]
        if not able:
            waiting = [task.name for task in self.tasks if not task.finished]
            if waiting and not self.deadlock:
                self.deadlock = ", ".join(waiting)
            self._abandon()
        else:
            chosen = able[0] if len(able) == 1 else self._strategy.choose(able)
            self._current = chosen
            if chosen is me:
                return
            self.trace.append(chosen.name)
            chosen.go.release()
        if not me.finished:
            if not me.go.acquire(timeout=HANG_SECONDS):
                raise RuntimeError(f"{me.name} was never scheduled")
            if self.deadlock:
                raise Abandoned

    def _abandon(self) -> None:
        for task in self.tasks:
            if task.go.locked():
                task.go.release()

    def finish(self, task: Task) -> None:
        """Mark `task` as finished."""
        task.finished = True
        if not self.deadlock:
            self._switch(task)


class Lock:
    """`threading.RLock`, also used for `threading.Lock`, which no thread acquires twice."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self.owner: Task | None = None
        self.depth = 0

    def acquire(self) -> None:
        scheduler = self._scheduler
        if scheduler.deadlock:
            raise Abandoned
        me = scheduler._current
        if self.owner is not me:
            scheduler.until(lambda: self.owner is None)
            self.owner = me
        self.depth += 1

    def release(self) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.owner = None

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.release()


class Condition(Lock):
    """`threading.Condition` on a shared lock."""

    def __init__(self, scheduler: Scheduler, lock: Lock) -> None:
        super().__init__(scheduler)
        self._lock = lock
        self._waiting: list[Task] = []

    def acquire(self) -> None:
        self._lock.acquire()

    def release(self) -> None:
        self._lock.release()

    def wait(self, timeout: float | None = None) -> None:
        lock, me = self._lock, self._scheduler._current
        depth, lock.owner, lock.depth = lock.depth, None, 0
        self._waiting.append(me)
        self._scheduler.until(
            lambda: me not in self._waiting and lock.owner is None,
            None if timeout is None else lambda: lock.owner is None,
        )
        if me in self._waiting:
            self._waiting.remove(me)
        lock.owner, lock.depth = me, depth

    def wait_for(self, predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        assert timeout is None
        while not predicate():
            self.wait()
        return True

    def notify(self, count: int = 1) -> None:
        assert self._lock.owner is self._scheduler._current
        del self._waiting[:count]

    def notify_all(self) -> None:
        self.notify(len(self._waiting))


class Thread:
    """`threading.Thread`."""

    def __init__(self, scheduler: Scheduler, target: Callable[[], None], name: str) -> None:
        self.ident: int | None = None
        self._scheduler = scheduler
        self._target = target
        self._task = Task(name)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._scheduler.tasks.append(self._task)
        self._thread.start()
        self.ident = self._thread.ident

    def _run(self) -> None:
        self._task.go.acquire()
        try:
            if not self._scheduler.deadlock:
                self._target()
        except Abandoned:
            pass
        finally:
            self._scheduler.finish(self._task)

    def join(self, timeout: float | None = None) -> None:
        self._scheduler.until(lambda: self._task.finished)

    def is_alive(self) -> bool:
        return not self._task.finished


def delay_bounded(bound: int) -> Iterator[Delays]:
    """Yield all strategies with up to `bound` delays. Each must be run before the next one is requested."""
    unexplored: list[tuple[int, ...]] = [()]
    while unexplored:
        strategy = Delays(unexplored.pop())
        yield strategy
        if len(strategy.at) < bound:
            first = strategy.at[-1] + 1 if strategy.at else 0
            unexplored += [(*strategy.at, at) for at in range(first, strategy.decisions)]


def explore(
    scenario: Callable[[Scheduler], Callable[[], None]], use: Callable[[Any], None], delays: int, walks: int
) -> int:
    """Run `scenario(scheduler)`, and the check that it returns, with all delays and with `walks` random priorities.

    `use` replaces the module `threading` in the code under test. Return the number of schedules.
    """
    count = 0
    with _one_processor():
        for strategy in delay_bounded(delays):
            _run(scenario, use, strategy)
            count += 1
        for seed in range(walks):
            _run(scenario, use, Priorities(seed))
            count += 1
    return count


def _run(
    scenario: Callable[[Scheduler], Callable[[], None]], use: Callable[[Any], None], strategy: Delays | Priorities
) -> None:
    scheduler = Scheduler(strategy)
    use(scheduler.threading)
    try:
        check = scenario(scheduler)
        scheduler.until(lambda: all(task.finished for task in scheduler.tasks[1:]))
    except Abandoned:
        raise AssertionError(f"deadlock of {scheduler.deadlock}; {strategy}: {' '.join(scheduler.trace)}") from None
    try:
        check()
    except AssertionError as problem:
        raise AssertionError(f"{problem}; {strategy}: {' '.join(scheduler.trace)}") from problem


@contextmanager
def _one_processor() -> Iterator[None]:
    """Run all threads on one CPU; switching between threads takes twice as long across CPUs."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)
