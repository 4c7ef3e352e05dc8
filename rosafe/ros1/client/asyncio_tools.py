"""Helpers for tasks and events of asyncio, and the set-up of the event loop of a server."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from rosafe.ros1.component import startup

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


def set_up_server(threads: int) -> asyncio.Event:
    """Return an event that the ending signals set; blocking calls of the running loop get `threads` threads."""
    loop = asyncio.get_running_loop()
    end = asyncio.Event()
    for number in startup.ending_signals():
        loop.add_signal_handler(number, end.set)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    loop.set_default_executor(ThreadPoolExecutor(threads, "rospy"))
    return end
