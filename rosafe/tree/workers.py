"""Who runs what when: threads, as many as there are cores to use, that take up whatever task is ready.

A worker that has finished a task goes on with the deepest one that is ready, mostly what it has just made ready: the
block is still in its cache. Of several it takes one that it did the last time, whose state and memory are there. It
wakes another worker only where something is left over and one is idle, and both together are worth it. On one core no
thread is ever switched so; on several, siblings and successive blocks are worked on at the same time.

Only those who compute count. A worker that somebody else holds up (a listener that does not return, a source that does
not answer), or whose processor was removed, loses its seat to another one after `BLOCKED_TIMEOUT_SECONDS` seconds.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import os
import threading
import time
from collections.abc import Callable
from typing import Protocol

VARIABLE = "ROSAFE_WORKERS"
MAX_WORKERS = 1024
BLOCKED_TIMEOUT_SECONDS = 0.05  # seconds
WAKE_THRESHOLD_SECONDS = (
    2.5e-4  # seconds: a call takes some ten microseconds of two workers, which then want the interpreter in turn
)
WORKER = "rosafe worker"  # what the names of their threads begin with


def workers_to_use(wanted: int | str | None = None) -> int:
    """How many workers there should be: `wanted`, else what ROSAFE_WORKERS says, else one for each core to use."""
    text = os.environ.get(VARIABLE, "").strip()
    name, given = ("workers", str(wanted)) if wanted is not None else (VARIABLE, text)
    if not given:
        return len(os.sched_getaffinity(0))
    if not (given.isascii() and given.isdigit()) or not 1 <= int(given[:20]) <= MAX_WORKERS:
        raise ValueError(f"{name}: {given[:80]!r} is not a whole number from 1 to {MAX_WORKERS}")
    return int(given)


class Task(Protocol):
    """What workers do. One works on it at a time; `begin` and `rest` are called with the lock held.

    It may be pushed more often than there is something to do.
    """

    depth: int
    estimated_seconds: float  # seconds that it takes, or more than that
    blocked_since: float  # time.monotonic() at which somebody else began to hold it up; 0 where nobody does

    @property
    def removed(self) -> bool:
        """Whether nobody wants the result of what is being done any more."""

    def begin_work(self) -> bool:
        """Somebody works on it from now on; False where there is nothing to do."""

    def work(self) -> None:
        """Do it. Raises nothing."""

    def end_work(self) -> None:
        """Nobody works on it any more; it may be ready again."""


class _Worker:
    """What one of the threads is at."""

    def __init__(self) -> None:
        self.task: Task | None = None
        self.has_slot = False  # counts as one of those who compute


class Workers:
    """The threads of one tree. There are none before the first member comes and after the last one has gone.

    Parameters
    ----------
    lock : threading.RLock
        The tree's lock. All but `join` is called with it held.
    count : int
        How many may compute at the same time.
    """

    def __init__(self, lock: threading.RLock, count: int) -> None:
        self.lock = lock
        self.count = count
        self._clients = 0
        self._ready: list[tuple[int, int, Task]] = []  # a heap: the deepest first, of these the one that came last
        self._sequence = itertools.count(0, -1)
        self._free_slots = count  # seats that nobody has
        self._idle = 0  # threads that wait for a task, or are about to begin, and
        self._woken = 0  # those of them that are called already
        self._last: dict[int, _Worker] = {}  # who did a task the last time, by its id
        self._task_available = threading.Condition(lock)
        self._watch = threading.Condition(lock)
        self._workers: list[_Worker] = []
        self._threads: dict[str, threading.Thread] = {}

    def add_client(self) -> None:
        """One member more. RuntimeError where the system has no thread left for the first one."""
        self._clients += 1
        try:
            if not self._threads:
                self._start("rosafe watch", self._monitor_blocked)
            if not self._workers:
                self._start_worker()
        except RuntimeError:
            self.remove_client()
            raise

    def remove_client(self) -> None:
        """One member less."""
        self._clients -= 1
        if self._clients == 0:
            self._ready, self._last = [], {}
            self._task_available.notify_all()
            self._watch.notify_all()

    def join(self) -> None:
        """Wait until all threads have ended, as they do when there are no members."""
        with self.lock:
            threads = list(self._threads.values())
        for thread in threads:
            thread.join()

    # --- tasks ---

    def push(self, task: Task) -> None:
        """`task` is ready. Who is no worker calls `wake` after that."""
        heapq.heappush(self._ready, (-task.depth, next(self._sequence), task))

    def wake(self) -> None:
        """Call an idle worker, or start one, for each task that waits, as far as there are seats."""
        for _ in range(min(len(self._ready), self._free_slots) - self._woken):
            if self._idle > self._woken:
                self._woken += 1
                self._task_available.notify()
                continue
            try:
                self._start_worker()
            except RuntimeError:  # the system has none left: those that there are must do
                return

    def _should_wake_another(self, own: Task) -> bool:
        """Whether what waits would wait too long for a worker that takes up `own` now, or keep it busy for too long."""
        seconds = own.estimated_seconds
        for _, _, task in self._ready:
            if seconds > WAKE_THRESHOLD_SECONDS:
                break
            seconds += task.estimated_seconds
        return seconds > WAKE_THRESHOLD_SECONDS

    def _pop_task(self, me: _Worker) -> Task:
        """The deepest one; of several that of `me`."""
        ready, last = self._ready, self._last
        depth, _, task = ready[0]
        if len(ready) > 1 and last.get(id(task)) is not me:
            for place, (other, _, mine) in enumerate(ready):
                if other == depth and last.get(id(mine)) is me:
                    del ready[place]
                    heapq.heapify(ready)
                    return mine
        heapq.heappop(ready)
        last[id(task)] = me
        return task

    # --- threads ---

    def _start_worker(self) -> None:
        names = (f"{WORKER} {number}" for number in itertools.count(1))
        name = next(name for name in names if name not in self._threads)
        worker = _Worker()
        self._start(name, functools.partial(self._run, name, worker))
        self._workers.append(worker)
        self._idle += 1
        self._woken += 1

    def _start(self, name: str, run: Callable[[], None]) -> None:
        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads[name] = thread

    def _run(self, name: str, me: _Worker) -> None:
        acquire, release = self.lock.acquire, self.lock.release
        with self.lock:
            self._idle -= 1
            self._woken -= 1
            while (task := self._wait_for_task(me)) is not None:
                release()
                try:
                    task.work()
                finally:
                    acquire()
                    task.end_work()
            self._workers.remove(me)
            del self._threads[name]

    def _wait_for_task(self, me: _Worker) -> Task | None:
        """A task that has begun, and a seat for it, as soon as there are both; None where the thread is to end."""
        while self._clients:
            if me.has_slot or self._free_slots:
                while self._ready:
                    task = self._pop_task(me) if self.count > 1 else heapq.heappop(self._ready)[2]
                    if not task.begin_work():
                        continue
                    me.task = task
                    if not me.has_slot:
                        me.has_slot = True
                        self._free_slots -= 1
                    if self._ready and self._free_slots and self._should_wake_another(task):
                        self.wake()
                    return task
            self._release_slot(me)
            if self._idle >= self.count:  # others have come in the place of those that were held up
                break
            self._idle += 1
            self._task_available.wait()
            self._idle -= 1
            self._woken = max(0, self._woken - 1)
        self._release_slot(me)
        return None

    def _release_slot(self, me: _Worker) -> None:
        """Give the seat back, if there still is one."""
        self._free_slots += me.has_slot
        me.task, me.has_slot = None, False

    def _monitor_blocked(self) -> None:
        """Give the seats of those that are held up to others."""
        with self.lock:
            while self._clients:
                self._watch.wait(BLOCKED_TIMEOUT_SECONDS)
                for worker in self._workers:
                    if worker.has_slot and worker.task is not None and _is_blocked(worker.task):
                        worker.has_slot = False
                        self._free_slots += 1
                self.wake()
            del self._threads["rosafe watch"]


def _is_blocked(task: Task) -> bool:
    return task.removed or 0 < task.blocked_since < time.monotonic() - BLOCKED_TIMEOUT_SECONDS
