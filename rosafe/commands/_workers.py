"""Many pieces of work in a few processes, which tell how far they are."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, cast

SIGNAL_SECONDS = 0.1  # at most, until a signal is seen
REPORT_SECONDS = 0.1  # at least, between two reports of one piece of work

Progress = Callable[[int, int], None]
Work = Callable[[Progress], Any]


class TaskReport(NamedTuple):
    """How a piece of work stands: the part that is done, or (at its end) its result, or why it failed."""

    part: float
    result: Any = None
    failure: str = ""

    @property
    def last(self) -> bool:
        return self.result is not None or bool(self.failure)


class Interrupted(SystemExit):
    """A signal asks for the end; the exit code is the one that shells give it."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)


class Interrupts:
    """Notes the first SIGINT, SIGTERM or SIGHUP, here and in processes that are forked from here.

    It is raised by those who ask. An exception out of the handler itself could come anywhere: in Thread.join, it makes
    Python 3.11 believe that the thread has ended.
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
        """Raise `Interrupted` if there was a signal."""
        if self._received:
            raise Interrupted(self._received)


def run_parallel(
    works: Sequence[Work],
    jobs: int,
    failures: tuple[type[Exception], ...],
    report: Callable[[int, TaskReport], None],
    signals: Interrupts,
) -> None:
    """Run all `works` in at most `jobs` processes, and wait for them; whatever ends this ends those that run, too.

    Parameters
    ----------
    works : sequence of callable
        Called in another process with a function that takes (done, all), to be called often: it ends the work by
        an exception once a signal has come. Returns something that can be pickled.
    jobs : int
        Processes. Each does one piece of work after the other; one that dies fails with that alone.
    failures : tuple of exception types
        What a piece of work may fail with; the text of the exception is the report's.
    report : callable
        Called with the number of a piece of work and its `TaskReport`: now and then, and once with its last.
    signals : Interrupts
        What ends it by `Interrupted`.
    """
    waiting = iter(range(len(works)))
    left = len(works)
    idle: list[Connection] = []
    busy: dict[Connection, int] = {}  # and the work that each is at
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
                with contextlib.suppress(BrokenPipeError):  # it has died; its end of the pipe tells
                    connection.send(index)
            for ready in wait(list(busy), SIGNAL_SECONDS):
                connection = cast(Connection, ready)
                index = busy[connection]
                told = _receive(connection, processes[connection])
                if told.failure:
                    signals.check()  # the same Ctrl-C may have ended the child sooner than us
                if told.last:
                    left -= 1
                    del busy[connection]
                    if processes[connection].exitcode is None:
                        idle.append(connection)
                    else:
                        del processes[connection]
                report(index, told)
    finally:
        for connection in processes:
            connection.close()  # who waits for work ends
        for process in processes.values():
            process.terminate()
        for process in processes.values():
            process.join()


def _start(serve: Callable[[Connection], None], others: list[Connection]) -> tuple[Connection, multiprocessing.Process]:
    """A new process, and the pipe to it."""
    context = multiprocessing.get_context("fork")  # no need to import everything again
    ours, its = context.Pipe()

    def child() -> None:
        for connection in (ours, *others):  # a pipe that nobody else has tells when the one at its other end is gone
            connection.close()
        serve(its)

    process = context.Process(target=child)
    process.start()
    its.close()
    return ours, process  # type: ignore[return-value]  # a ForkProcess is a Process


def _receive(connection: Connection, process: multiprocessing.Process) -> TaskReport:
    try:
        told = connection.recv()
        assert isinstance(told, TaskReport)
        return told
    except (EOFError, ConnectionResetError):
        process.join()
        code = process.exitcode or 0
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return TaskReport(0.0, failure=f"ended too early, with {how}")


def _serve(
    works: Sequence[Work], failures: tuple[type[Exception], ...], signals: Interrupts, connection: Connection
) -> None:
    """What a process does, until the one that started it closes the pipe or is no longer there."""
    while True:
        try:
            index = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        _send(connection, attempt(works[index], failures, partial(_tell, connection, signals, [0.0])))


def attempt(work: Work, failures: tuple[type[Exception], ...], progress: Progress) -> TaskReport:
    """Do one piece of work; its last report."""
    try:
        return TaskReport(1.0, result=work(progress))
    except failures as problem:
        return TaskReport(0.0, failure=str(problem) or type(problem).__name__)
    except MemoryError:
        return TaskReport(0.0, failure="there is not enough memory")


def _tell(connection: Connection, signals: Interrupts, due: list[float], done: int, total: int) -> None:
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
