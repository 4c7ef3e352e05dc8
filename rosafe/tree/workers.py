"""Task scheduler: a pool of threads, one per available core, that run tasks as they become ready.

A worker that has finished a task continues with the deepest ready task, usually the one it has just made ready: the
block is still in its cache. Among several it prefers one that it ran before, whose state is in its cache too. It wakes
another worker only if a task remains, a worker is idle, and the tasks are long enough. With one core there is therefore
no switching between threads; with several, siblings and successive blocks are processed concurrently. The idle
worker that worked last is woken, as its cache is the warmest.

The thread that receives sound in real time runs short tasks itself if all workers are idle (`run_short_tasks`), because
waking another thread delays them, and takes processor time.

Only computing workers count towards the limit. A worker that is blocked by other code (a listener that does not return,
a source that does not respond), or whose processor was removed, loses its slot to another worker after
`BLOCKED_TIMEOUT_SECONDS`.
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
BLOCKED_TIMEOUT_SECONDS = 0.05
WAKE_THRESHOLD_SECONDS = 1e-3  # of waiting work: below, two workers lose more by competing for the GIL than they gain
REAL_TIME_THRESHOLD_SECONDS = 0.02  # the same for sound in real time: two cores need more time in total, and a tree
# that keeps up delivers results later than with two workers by less than this
BUSY_THRESHOLD_SECONDS = 2.5e-4  # the same for a busy pool, whose tree may not keep up: its workers were not all idle
BUSY_SECONDS = 0.1  # within this time
POLL_SECONDS = 1e-3  # of `wait_idle`
SHORT_TASK_SECONDS = 1e-3  # estimated; the thread that receives sound leaves longer tasks to the workers,
SHORT_RUN_SECONDS = 5e-3  # and the remaining ones after this time;
REFUSED_RUNS = 32  # it then leaves the tasks of this many messages to the workers
WORKER = "rosafe worker"  # prefix of the threads' names


def workers_to_use(count: int | str | None = None) -> int:
    """Return the number of workers: `count`, or the value of ROSAFE_WORKERS, or the number of available cores."""
    text = os.environ.get(VARIABLE, "").strip()
    name, value = ("workers", str(count)) if count is not None else (VARIABLE, text)
    if not value:
        return len(os.sched_getaffinity(0))
    if not (value.isascii() and value.isdigit()) or not 1 <= int(value[:20]) <= MAX_WORKERS:
        raise ValueError(f"{name}: expected a whole number from 1 to {MAX_WORKERS}, got {value[:80]!r}")
    return int(value)


class Task(Protocol):
    """A task of the workers. One worker runs it at a time; `begin_work` and `end_work` are called with the lock held.

    It may be pushed even if there is nothing to do.
    """

    depth: int
    estimated_seconds: float  # an upper estimate of its duration
    blocked_since: float  # time.monotonic() since which other code blocks it; 0 if none does

    @property
    def trusted(self) -> bool:
        """Return whether it contains only code of this package, which returns."""

    @property
    def removed(self) -> bool:
        """Return whether the result of the current work is no longer needed."""

    def begin_work(self) -> bool:
        """Begin to work on it. Return False if there is nothing to do."""

    def work(self) -> None:
        """Run the task. Raises nothing."""

    def end_work(self) -> None:
        """End the work on it; it may be ready again."""

    def check_source(self) -> None:
        """Read if its source, if it has one, has a block; in real time called regularly, without the lock."""


class _Worker:
    """The task of one thread, and whether it occupies a slot."""

    def __init__(self, lock: threading.RLock) -> None:
        self.task: Task | None = None
        self.has_slot = False  # counts towards the limit
        self.refusals = 0  # calls of `run_short_tasks` in which it will run none
        self.woken = threading.Condition(lock)


class Workers:
    """The threads of one tree. They exist while there is at least one client (a processor).

    Parameters
    ----------
    lock : threading.RLock
        The tree's lock. All but `join` is called with it held.
    count : int
        The number of workers that may compute at the same time.
    real_time : bool
        Whether blocks arrive in real time. As long as the tree keeps up, another worker is then woken for long tasks
        only.
    """

    def __init__(self, lock: threading.RLock, count: int, real_time: bool = False) -> None:
        self.lock = lock
        self.count = count
        self.real_time = real_time
        self._clients: list[Task] = []
        self._ready: list[tuple[int, int, Task]] = []  # a heap: the deepest first, of these the newest
        self._sequence = itertools.count(0, -1)
        self._free_slots = count  # slots that no worker occupies
        self._idle: list[_Worker] = []  # those that wait for a task; the last one worked last
        self._woken = 0  # those that were notified, or are about to start, and have not taken a task yet
        self._busy_since = time.monotonic()  # when all workers were idle last
        self._last: dict[int, _Worker] = {}  # the worker that ran a task last, by its id
        self._watch = threading.Condition(lock)
        self._caller = _Worker(lock)  # the thread in `run_short_tasks`
        self._workers: list[_Worker] = []
        self._threads: dict[str, threading.Thread] = {}

    def add_client(self, client: Task) -> None:
        """Add a client. Raises RuntimeError if the system cannot start the first thread."""
        self._clients.append(client)
        try:
            if not self._threads:
                self._start("rosafe watch", self._monitor_blocked)
            if not self._workers:
                self._start_worker()
        except RuntimeError:
            self.remove_client(client)
            raise

    def remove_client(self, client: Task) -> None:
        """Remove a client, if it was added; the threads end with the last one."""
        if client in self._clients:
            self._clients.remove(client)
        if not self._clients:
            self._ready, self._last = [], {}
            while self._idle:
                self._notify_idle()
            self._watch.notify_all()

    def join(self) -> None:
        """Wait until all threads have ended, after the last client was removed."""
        with self.lock:
            threads = list(self._threads.values())
        for thread in threads:
            thread.join()

    # --- tasks ---

    def wait_idle(self, timeout: float) -> bool:
        """Wait until no task is ready and no worker computes. Return False after `timeout` seconds."""
        end = time.monotonic() + timeout
        while True:
            with self.lock:
                if not self._ready and not self._woken and self._free_slots == self.count:
                    return True
            if time.monotonic() > end:
                return False
            time.sleep(POLL_SECONDS)

    def push(self, task: Task) -> None:
        """Add a ready task. A caller that is not a worker calls `wake` afterwards."""
        heapq.heappush(self._ready, (-task.depth, next(self._sequence), task))

    def wake(self, limit: int = MAX_WORKERS) -> None:
        """Notify an idle worker, or start one, for each waiting task, within the free slots and `limit`."""
        for _ in range(min(len(self._ready), self._free_slots, limit) - self._woken):
            if self._idle:
                self._notify_idle()
                continue
            try:
                self._start_worker()
            except RuntimeError:  # no thread can be started: the existing ones continue
                return

    def run_short_tasks(self) -> None:
        """Run ready tasks on the calling thread, without the lock, while they are short, and wake workers for the rest.

        Without `real_time`, or if a worker computes, the tasks are left to the workers.
        """
        me = self._caller
        me.refusals = max(0, me.refusals - 1)
        idle = self._free_slots == self.count and not self._woken and me.task is None
        if self.real_time and idle and not me.refusals:
            me.has_slot, self._free_slots = True, self._free_slots - 1
            end = time.monotonic() + SHORT_RUN_SECONDS
            while me.has_slot and self._ready:
                task = self._ready[0][2]
                if not task.trusted or task.estimated_seconds > SHORT_TASK_SECONDS:
                    break
                heapq.heappop(self._ready)
                if task.begin_work():
                    me.task = task
                    self._work(task)
                    if time.monotonic() > end:
                        break
            self._release_slot(me)
            if self._ready:  # handing tasks over costs more than leaving all to the workers
                me.refusals = REFUSED_RUNS
        self._wake_if_needed()

    def _wake_if_needed(self) -> None:
        """Wake workers for the ready tasks; in real time one, or another one only if the tasks take long."""
        computing = next((worker.task for worker in self._workers if worker.has_slot and worker.task), None)
        if not self.real_time or (computing is not None and self._should_wake_another(computing)):
            self.wake()
        elif computing is None and not self._woken:
            self.wake(1)

    def _work(self, task: Task) -> None:
        """Run a task without the lock."""
        self.lock.release()
        try:
            task.work()
        finally:
            self.lock.acquire()
            task.end_work()

    def _notify_idle(self) -> None:
        self._woken += 1
        self._idle.pop().woken.notify()

    def _should_wake_another(self, own: Task) -> bool:
        """Return whether the waiting tasks, and `own` before them, take one worker longer than the threshold."""
        threshold = REAL_TIME_THRESHOLD_SECONDS if self.real_time else WAKE_THRESHOLD_SECONDS
        if time.monotonic() - self._busy_since > BUSY_SECONDS:
            threshold = min(BUSY_THRESHOLD_SECONDS, threshold)
        seconds = own.estimated_seconds
        for _, _, task in self._ready:
            if seconds > threshold:
                break
            seconds += task.estimated_seconds
        return seconds > threshold

    def _pop_task(self, me: _Worker) -> Task:
        """Return the deepest task, preferably one that `me` ran last."""
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
        worker = _Worker(self.lock)
        self._start(name, functools.partial(self._run, name, worker))
        self._workers.append(worker)
        self._woken += 1

    def _start(self, name: str, run: Callable[[], None]) -> None:
        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads[name] = thread

    def _run(self, name: str, me: _Worker) -> None:
        with self.lock:
            self._woken -= 1
            while (task := self._wait_for_task(me)) is not None:
                self._work(task)
                del task  # a waiting thread would keep it: a processor, which may be removed
            self._workers.remove(me)
            del self._threads[name]

    def _wait_for_task(self, me: _Worker) -> Task | None:
        """Wait for a task and a slot, and begin the task. Return None if the thread has to end."""
        while self._clients:
            if me.has_slot or self._free_slots:
                while self._ready:
                    task = self._pop_task(me) if len(self._workers) > 1 else heapq.heappop(self._ready)[2]
                    if not task.begin_work():
                        del task  # see `_run`
                        continue
                    me.task = task
                    if not me.has_slot:
                        me.has_slot = True
                        self._free_slots -= 1
                    if self._ready and self._free_slots and self._should_wake_another(task):
                        self.wake()
                    return task
            self._release_slot(me)
            if len(self._idle) + self._woken >= self.count:  # others have replaced those that were blocked
                break
            self._idle.append(me)
            me.woken.wait()
            if len(self._idle) + self._woken == len(self._workers):
                self._busy_since = time.monotonic()
            self._woken -= 1
        self._release_slot(me)
        return None

    def _release_slot(self, me: _Worker) -> None:
        """Return the slot, if the worker still has one."""
        self._free_slots += me.has_slot
        me.task, me.has_slot = None, False

    def _monitor_blocked(self) -> None:
        """Give the slots of blocked workers to others."""
        with self.lock:
            while self._clients:
                self._watch.wait(BLOCKED_TIMEOUT_SECONDS)
                for worker in (self._caller, *self._workers):
                    if worker.has_slot and worker.task is not None and _is_blocked(worker.task):
                        worker.has_slot = False
                        self._free_slots += 1
                self.wake()
                if self.real_time:
                    self._check_sources()
            del self._threads["rosafe watch"]

    def _check_sources(self) -> None:
        clients = list(self._clients)
        self.lock.release()
        try:
            for client in clients:
                client.check_source()
        finally:
            self.lock.acquire()


def _is_blocked(task: Task) -> bool:
    return task.removed or 0 < task.blocked_since < time.monotonic() - BLOCKED_TIMEOUT_SECONDS
