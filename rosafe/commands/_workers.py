"""Run tasks in several processes, which report their progress."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, cast

SIGNAL_SECONDS = 0.1  # maximum time until a signal is noticed
REPORT_SECONDS = 0.1  # minimum time between two reports of one task

Progress = Callable[[int, int], None]
Work = Callable[[Progress], Any]


class TaskReport(NamedTuple):
    """Progress of a task: the finished fraction or, at its end, its result or the reason of its failure."""

    part: float
    result: Any = None
    failure: str = ""

    @property
    def last(self) -> bool:
        return self.result is not None or bool(self.failure)


class Interrupted(SystemExit):
    """A signal requested the end. The exit code is the one that shells use for this signal."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)


class Interrupts:
    """Record of the first SIGINT, SIGTERM or SIGHUP in this process and in processes forked from it.

    `check` raises it. An exception raised by the handler itself could interrupt any statement: in Thread.join it makes
    Python 3.11 assume that the thread has ended.
    """

    def __init__(self) -> None:
        self._received = 0
        signal.signal(signal.SIGINT, self._note)
        signal.signal(signal.SIGTERM, self._note)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
            signal.signal(signal.SIGHUP, self._note)

    def _note(self, number: int, frame: object) -> None:
        self._received = self._received or number

    def check(self) -> None:
        """Raise `Interrupted` if a signal was received."""
        if self._received:
            raise Interrupted(self._received)


def run_parallel(
    works: Sequence[Work],
    jobs: int,
    failures: tuple[type[Exception], ...],
    report: Callable[[int, TaskReport], None],
    signals: Interrupts,
) -> None:
    """Run all `works` in at most `jobs` processes and wait for them. An exception here ends these processes.

    Parameters
    ----------
    works : sequence of callable
        The tasks. Each is called in another process with a function (done, total), which the task has to call often:
        the function raises an exception after a signal. The result of a task has to be picklable.
    jobs : int
        Number of processes. Each runs one task at a time; if it dies, only this task fails.
    failures : tuple of exception types
        Exceptions that mark a task as failed; the text of the exception goes into the report.
    report : callable
        Called with the number of a task and its `TaskReport`: repeatedly, and once with the last report.
    signals : Interrupts
        Raises `Interrupted` after a signal.
    """
    waiting = iter(range(len(works)))
    left = len(works)
    idle: list[Connection] = []
    busy: dict[Connection, int] = {}  # the task of each
    processes: dict[Connection, multiprocessing.Process] = {}
    try:
        while left:
            signals.check()
            for _ in range(min(jobs, len(works)) - len(processes)):
                connection, process = _start(partial(_serve, works, failures, signals), list(processes))
                processes[connection] = process
                idle.append(connection)
            while idle and (index := next(waiting, None)) is not None:
                connection = idle.pop()
                busy[connection] = index
                with contextlib.suppress(BrokenPipeError):  # the process has died; reading from the pipe reports this
                    connection.send(index)
            for ready in wait(list(busy), SIGNAL_SECONDS):
                connection = cast(Connection, ready)
                index = busy[connection]
                task = _receive(connection, processes[connection])
                if task.failure:
                    signals.check()  # the same Ctrl-C may have ended the child first
                if task.last:
                    left -= 1
                    del busy[connection]
                    if processes[connection].exitcode is None:
                        idle.append(connection)
                    else:
                        del processes[connection]
                report(index, task)
    finally:
        for connection in processes:
            connection.close()  # ends idle processes
        for process in processes.values():
            process.terminate()
        for process in processes.values():
            process.join()


def _start(serve: Callable[[Connection], None], others: list[Connection]) -> tuple[Connection, multiprocessing.Process]:
    """Start a process; return the connection to it and the process."""
    context = multiprocessing.get_context("fork")  # no need to import everything again
    parent_end, child_end = context.Pipe()

    def child() -> None:
        for connection in (parent_end, *others):  # otherwise the end of the parent would not close the pipe
            connection.close()
        serve(child_end)

    process = context.Process(target=child)
    process.start()
    child_end.close()
    return parent_end, process  # type: ignore[return-value]  # a ForkProcess is a Process


def _receive(connection: Connection, process: multiprocessing.Process) -> TaskReport:
    try:
        report = connection.recv()
        assert isinstance(report, TaskReport)
        return report
    except (EOFError, ConnectionResetError):
        process.join()
        code = process.exitcode or 0
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        return TaskReport(0.0, failure=f"the process ended too early, with {reason}")


def _serve(
    works: Sequence[Work], failures: tuple[type[Exception], ...], signals: Interrupts, connection: Connection
) -> None:
    """Run tasks in a process until its parent closes the pipe or ends."""
    while True:
        try:
            index = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        _send(connection, attempt(works[index], failures, partial(_send_progress, connection, signals, [0.0])))


def attempt(work: Work, failures: tuple[type[Exception], ...], progress: Progress) -> TaskReport:
    """Run one task and return its last report."""
    try:
        return TaskReport(1.0, result=work(progress))
    except failures as problem:
        return TaskReport(0.0, failure=str(problem) or type(problem).__name__)
    except MemoryError:
        return TaskReport(0.0, failure="out of memory")


def _send_progress(connection: Connection, signals: Interrupts, due: list[float], done: int, total: int) -> None:
    signals.check()
    now = time.monotonic()
    if now >= due[0]:
        due[0] = now + REPORT_SECONDS
        _send(connection, TaskReport(done / total))


def _send(writer: Connection, report: TaskReport) -> None:
    try:
        writer.send(report)
    except BrokenPipeError:
        raise Interrupted(signal.SIGPIPE) from None
