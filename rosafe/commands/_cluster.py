"""Many pieces of work on the workers of a Dask scheduler, on this machine or on many."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from rosafe.commands import Failure
from rosafe.commands._workers import SIGNAL_SECONDS, Interrupts, Report, Work, attempt
from rosafe.tree.workers import VARIABLE
from rosafe.version import VERSION

LOCAL = "local"
AHEAD = 8  # pieces of work that are with the scheduler, for each thread of its workers
CONNECT_SECONDS = 10


def run_on(
    address: str,
    works: Sequence[Work],
    jobs: int,
    failures: tuple[type[Exception], ...],
    report: Callable[[int, Report], None],
    signals: Interrupts,
) -> None:
    """As `run_together`, on the workers of the scheduler at `address`, or on `jobs` of one's own where that is `local`.

    What a worker that dies was at, others do again, a few times: that is the scheduler's doing. Raises Failure where
    there is no scheduler, or no longer.
    """
    with ExitStack() as stack:
        client = _client(address, min(jobs, len(works)), stack)
        waiting = enumerate(works)
        ended: queue.SimpleQueue[int] = queue.SimpleQueue()
        running: dict[int, Any] = {}
        stack.callback(lambda: client.cancel(list(running.values())))
        left = len(works)
        while left:
            signals.check()
            if client.status not in ("running", "connecting"):
                raise Failure(f"the Dask scheduler at {address} is gone; --resume goes on where this ended")
            room = max(AHEAD * sum(client.nthreads().values()), AHEAD) - len(running) if not ended.qsize() else 0
            for _, (index, work) in zip(range(room), waiting, strict=False):
                running[index] = client.submit(partial(_attempt, work, failures, VERSION), pure=False)
                running[index].add_done_callback(partial(_note, ended, index))
            for index in _taken(ended):
                report(index, _outcome(running.pop(index), address))
                left -= 1


def _note(ended: queue.SimpleQueue[int], index: int, future: Any) -> None:
    ended.put(index)


def _taken(ended: queue.SimpleQueue[int]) -> Iterator[int]:
    """All that have ended; waits a moment for the first."""
    with contextlib.suppress(queue.Empty):
        yield ended.get(timeout=SIGNAL_SECONDS)
        while True:
            yield ended.get_nowait()


def _client(address: str, jobs: int, stack: ExitStack) -> Any:
    from distributed import Client, LocalCluster

    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is told in one line each
    if address == LOCAL:  # TLS with keys of its own: a Dask worker does what anybody asks it who can connect
        cluster: Any = stack.enter_context(
            LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                local_directory=stack.enter_context(tempfile.TemporaryDirectory(prefix="rosafe-dask-")),
                security=True,
                silence_logs=logging.CRITICAL,
            )
        )
        return stack.enter_context(Client(cluster))
    try:
        return stack.enter_context(Client(address, timeout=CONNECT_SECONDS, set_as_default=False))
    except (OSError, ValueError, TypeError) as problem:  # the two latter: an address that is none
        why = str(problem).partition("\n")[0]
        raise Failure(f"--dask {address}: no Dask scheduler answers there ({why})") from None


def _attempt(work: Work, failures: tuple[type[Exception], ...], version: str) -> Report:
    """What a worker does. Its processes are as many as there are cores to use; in each, one thread computes."""
    if version != VERSION:
        return Report(0.0, failure=f"the worker has rosafe {VERSION}, not {version}: install the same on all machines")
    os.environ[VARIABLE] = "1"
    return attempt(work, failures, lambda done, total: None)


def _outcome(future: Any, address: str) -> Report:
    from distributed.scheduler import KilledWorker

    if future.cancelled():
        raise Failure(f"the Dask scheduler at {address} is gone; --resume goes on where this ended")
    problem = future.exception()
    if problem is None:
        told = future.result()
        assert isinstance(told, Report)
        return told
    if isinstance(problem, KilledWorker):
        return Report(0.0, failure="each worker that tried it has died: is there not enough memory?")
    text = f"{type(problem).__name__}: {problem}".partition("\n")[0]
    return Report(0.0, failure=f"a worker could not do it ({text}); are rosafe and its packages installed there?")
