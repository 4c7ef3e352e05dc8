"""Several pieces of work at once, each in a process of its own that tells how far it is."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, cast

SIGNAL_SECONDS = 0.1  # at most, until a signal is seen
REPORT_SECONDS = 0.1  # at least, between two reports of one piece of work

Progress = Callable[[int, int], None]
Work = Callable[[Progress], Any]


class Report(NamedTuple):
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


def run_together(
    works: Sequence[Work],
    jobs: int,
    failures: tuple[type[Exception], ...],
    report: Callable[[int, Report], None],
    signals: Interrupts,
) -> None:
    """Run all `works`, at most `jobs` at a time, and wait for them; whatever ends this ends those that run, too.

    Parameters
    ----------
    works : sequence of callable
        Called in a process of its own with a function that takes (done, all), to be called often: it ends the work by
        an exception once a signal has come. Returns something that can be pickled.
    jobs : int
        Processes at a time.
    failures : tuple of exception types
        What a piece of work may fail with; the text of the exception is the report's.
    report : callable
        Called with the number of a piece of work and its `Report`: now and then, and once with its last.
    signals : Interrupts
        What ends it by `Interrupted`.
    """
    waiting = deque(enumerate(works))
    running: dict[Connection, tuple[int, multiprocessing.Process]] = {}
    try:
        while waiting or running:
            signals.check()
            while waiting and len(running) < jobs:
                index, work = waiting.popleft()
                connection, process = _start(partial(_work, work, failures, signals), list(running))
                running[connection] = index, process
            for ready in wait(list(running), SIGNAL_SECONDS):
                connection = cast(Connection, ready)
                index, process = running[connection]
                told = _receive(connection, process)
                if told.failure:
                    signals.check()  # the same Ctrl-C may have ended the child sooner than us
                if told.last:
                    del running[connection]
                    process.join()
                report(index, told)
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()


def _start(work: Callable[[Connection], None], others: list[Connection]) -> tuple[Connection, multiprocessing.Process]:
    """The new process, and where its reports come."""
    context = multiprocessing.get_context("fork")  # no need to import everything again
    reader, writer = context.Pipe(duplex=False)

    def child() -> None:
        for connection in (reader, *others):  # a pipe that nobody else reads tells when the one who does is gone
            connection.close()
        work(writer)

    process = context.Process(target=child)
    process.start()
    writer.close()
    return reader, process  # type: ignore[return-value]  # a ForkProcess is a Process


def _receive(connection: Connection, process: multiprocessing.Process) -> Report:
    try:
        told = connection.recv()
        assert isinstance(told, Report)
        return told
    except EOFError:
        process.join()
        code = process.exitcode or 0
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return Report(0.0, failure=f"ended too early, with {how}")


def _work(work: Work, failures: tuple[type[Exception], ...], signals: Interrupts, writer: Connection) -> None:
    """What a process does. It ends at its next report where the one that started it is no longer there."""
    due = 0.0

    def progress(done: int, total: int) -> None:
        nonlocal due
        signals.check()
        now = time.monotonic()
        if now >= due:
            due = now + REPORT_SECONDS
            _send(writer, Report(done / total))

    try:
        last = Report(1.0, result=work(progress))
    except failures as problem:
        last = Report(0.0, failure=str(problem))
    except MemoryError:
        last = Report(0.0, failure="there is not enough memory")
    _send(writer, last)


def _send(writer: Connection, report: Report) -> None:
    try:
        writer.send(report)
    except BrokenPipeError:
        raise Interrupted(signal.SIGPIPE) from None
