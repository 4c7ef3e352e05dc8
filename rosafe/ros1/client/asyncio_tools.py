"""Helpers for tasks and events of asyncio, ending signals, and the set-up of the event loop of a server."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from rosafe.ros1.component import startup

SIGNAL_SECONDS = 0.1  # from a signal until the event loop looks for it
T = TypeVar("T")


def run_shared(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
    """Start a task that several callers can await with `asyncio.shield`; without a caller its error is ignored."""
    task = asyncio.create_task(work)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    return task


async def wait_any(*events: asyncio.Event, timeout: float | None = None) -> None:
    """Wait until one of the events is set, or for `timeout` seconds."""
    waits = [asyncio.create_task(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waits:
            task.cancel()


def note_signals() -> tuple[list[int], dict[int, Any]]:
    """Return a list that gets the numbers of the ending signals, and the handlers before.

    The handlers of `loop.add_signal_handler` end with the loop: another signal then would kill the process.
    """
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in startup.ending_signals()
    }
    return received, before


async def until_signal(work: Coroutine[Any, Any, None]) -> int:
    """Run `work`, which the first ending signal cancels; return the number of the signal, or 0.

    Further signals have no effect: they must not interrupt the clean-up, here or after the end of the loop.
    """
    received, before = note_signals()
    task = asyncio.ensure_future(work)
    try:
        while not (received or task.done()):
            await asyncio.wait({task}, timeout=SIGNAL_SECONDS)
        if received:
            task.cancel()
        await task
    except BaseException:  # a library may have converted the cancellation to another exception
        if not received:
            raise
    finally:
        if received:
            startup.ignore_signals()
        else:
            for number, handler in before.items():
                signal.signal(number, handler)
    return received[0] if received else 0


def set_up_server(threads: int) -> asyncio.Event:
    """Return an event that the ending signals set; blocking calls of the running loop get `threads` threads."""
    loop = asyncio.get_running_loop()
    end = asyncio.Event()
    received, _ = note_signals()

    def look() -> None:
        if received:
            startup.ignore_signals()
            end.set()
        else:
            loop.call_later(SIGNAL_SECONDS, look)

    look()
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    loop.set_default_executor(ThreadPoolExecutor(threads, "rospy"))
    return end
