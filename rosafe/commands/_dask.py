"""Run tasks on the workers of a Dask scheduler, on one machine or several."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._workers import SIGNAL_SECONDS, Interrupts, TaskReport, Work, attempt
from rosafe.system.version import VERSION
from rosafe.tree.workers import VARIABLE

LOCAL = "local"
TASKS_IN_FLIGHT = 8  # tasks submitted to the scheduler for each thread of its workers
CONNECT_SECONDS = 10
MAX_STARTS = 3  # of a worker process that dies before it is ready


def run_on(
    address: str,
    works: Sequence[Work],
    jobs: int,
    failures: tuple[type[Exception], ...],
    report: Callable[[int, TaskReport], None],
    signals: Interrupts,
) -> None:
    """Do the same as `run_parallel` on the workers of the scheduler at `address`, or on `jobs` local ones (`local`).

    The scheduler gives the task of a worker that died to another one, a few times. Raises CommandError if the
    scheduler cannot be reached or has ended.
    """
    with ExitStack() as stack:
        dead: list[str] = []
        client = _client(address, min(jobs, len(works)), stack, dead)
        waiting = enumerate(works)
        ended: queue.SimpleQueue[int] = queue.SimpleQueue()
        running: dict[int, Any] = {}
        stack.callback(lambda: client.cancel(list(running.values())))
        left = len(works)
        while left:
            signals.check()
            if dead:
                raise CommandError(f"--dask {address}: {dead[0]}; --jobs {jobs} does the work without Dask")
            if client.status not in ("running", "connecting"):
                raise CommandError(f"the Dask scheduler at {address} has ended; continue with --resume")
            room = (
                max(TASKS_IN_FLIGHT * sum(client.nthreads().values()), TASKS_IN_FLIGHT) - len(running)
                if not ended.qsize()
                else 0
            )
            for _, (index, work) in zip(range(room), waiting, strict=False):
                running[index] = client.submit(partial(_attempt, work, failures, VERSION), pure=False)
                running[index].add_done_callback(partial(_note, ended, index))
            for index in _ended_tasks(ended):
                report(index, _task_report(running.pop(index), address))
                left -= 1


def _note(ended: queue.SimpleQueue[int], index: int, future: Any) -> None:
    ended.put(index)


def _ended_tasks(ended: queue.SimpleQueue[int]) -> Iterator[int]:
    """Yield the numbers of the ended tasks; wait at most `SIGNAL_SECONDS` for the first."""
    with contextlib.suppress(queue.Empty):
        yield ended.get(timeout=SIGNAL_SECONDS)
        while True:
            yield ended.get_nowait()


def _client(address: str, jobs: int, stack: ExitStack, dead: list[str]) -> Any:
    """Connect to the scheduler; for a local one, `dead` gets a line if its workers cannot be started."""
    from distributed import Client

    # Dask logs errors under the names of its modules and of their callers; this command prints one line per failure.
    for name in ["", *(name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if address == LOCAL:
        return stack.enter_context(Client(_local_cluster(jobs, stack, dead)))
    try:
        return stack.enter_context(Client(address, timeout=CONNECT_SECONDS, set_as_default=False))
    except (OSError, ValueError, TypeError) as problem:  # the last two: an invalid address
        why = str(problem).partition("\n")[0]
        raise CommandError(f"--dask {address}: no Dask scheduler answers ({why})") from None


def _local_cluster(jobs: int, stack: ExitStack, dead: list[str]) -> Any:
    """Start a scheduler and, without waiting for them, `jobs` worker processes on this machine."""
    from distributed import LocalCluster, Nanny
    from distributed.core import Status

    class LimitedNanny(Nanny):
        """Nanny that abandons a worker which dies `MAX_STARTS` times before it is ready.

        Dask would restart it endlessly or, in later versions, never, without an error.
        """

        starting = False
        last_exit = ""

        def _on_worker_exit_sync(self, exitcode: int) -> None:
            self.last_exit = f"signal {-exitcode}" if exitcode < 0 else f"exit code {exitcode}"
            super()._on_worker_exit_sync(exitcode)

        async def instantiate(self) -> Any:
            if self.starting:  # Dask's own restart
                return Status.starting
            self.starting = True
            try:
                for _ in range(MAX_STARTS):
                    status = await super().instantiate()
                    if status == Status.running:
                        return status
            except Exception as problem:
                why = f"{type(problem).__name__}: {problem}".partition("\n")[0]
                dead.append(f"a worker process cannot be started ({why})")
                raise
            finally:
                self.starting = False
            dead.append(f"a worker process ended {MAX_STARTS} times at its start, the last time with {self.last_exit}")
            return Status.failed

    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rosafe-dask-"))
    _import_nothing_from_the_working_directory(folder)
    # TLS with temporary keys: a Dask worker executes any code that a peer sends.
    cluster = LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        processes=True,
        worker_class=LimitedNanny,
        host="127.0.0.1",
        dashboard_address=None,
        local_directory=folder,
        security=True,
        silence_logs=logging.CRITICAL,
    )
    stack.enter_context(cluster)
    cluster.scale(jobs)
    return cluster


def _import_nothing_from_the_working_directory(folder: str) -> None:
    """Exclude the working directory, which may contain data, from the module path of child processes.

    `folder` is private to this process.
    """
    if sys.version_info >= (3, 11):
        os.environ["PYTHONSAFEPATH"] = "1"
    else:
        python = Path(folder, "python")
        python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -I "$@"\n', "utf-8")
        python.chmod(0o700)
        multiprocessing.set_executable(str(python))


def _attempt(work: Work, failures: tuple[type[Exception], ...], version: str) -> TaskReport:
    """Run a task in a worker. There is one worker process per core, so one thread computes in each."""
    if version != VERSION:
        return TaskReport(
            0.0, failure=f"worker: expected rosafe {version}, got {VERSION}; install the same version on all machines"
        )
    os.environ[VARIABLE] = "1"
    return attempt(work, failures, lambda done, total: None)


def _task_report(future: Any, address: str) -> TaskReport:
    from distributed.scheduler import KilledWorker

    if future.cancelled():
        raise CommandError(f"the Dask scheduler at {address} has ended; continue with --resume")
    problem = future.exception()
    if problem is None:
        report = future.result()
        assert isinstance(report, TaskReport)
        return report
    if isinstance(problem, KilledWorker):
        return TaskReport(0.0, failure="each worker that ran it has died; check the memory of the workers")
    text = f"{type(problem).__name__}: {problem}".partition("\n")[0]
    return TaskReport(0.0, failure=f"a worker failed ({text}); check that rosafe and its packages are installed there")
