"""Functions for child processes that tests fork from a process with one thread.

A process that runs tests has threads (of xdist, rospy, numerical libraries). A fork of it has their locks without them,
so that it may hang or fail for no reason of its own.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

import h5py  # noqa: F401  # the writer imports it in each child otherwise

from rosafe.processing.files import process_file
from rosafe.system.output import OutputError, new_file
from tests.commands.command import SMALL_PARAMETERS

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload([__name__])


def queue() -> SimpleQueue[str]:
    """Return a queue for the answer of a child process."""
    return _CONTEXT.SimpleQueue()


def start(target: Callable[..., None], *arguments: Any) -> ForkServerProcess:
    """Start a function of this module in a child process."""
    process = _CONTEXT.Process(target=target, args=arguments)
    process.start()
    return process


def process(
    source: Path, target: Path, replace: bool = False, progress: Callable[[int, int], None] = lambda done, frames: None
) -> str:
    """Process a file; return "done" or the text of the OutputError."""
    try:
        process_file(source, target, SMALL_PARAMETERS, 500, ["ild"], replace, progress)
    except OutputError as problem:
        return str(problem)
    return "done"


def answer_of_process(answer: SimpleQueue[str], source: Path, target: Path, replace: bool) -> None:
    """Put the result of `process` into a queue."""
    answer.put(process(source, target, replace))


def write_again_and_again(path: Path, letter: str, rounds: int) -> None:
    """Replace a file by many copies of a letter, unless another process is writing it."""
    for _ in range(rounds):
        try:
            with new_file(path, replace=True) as descriptor:
                for _ in range(10):
                    os.write(descriptor, letter.encode() * 1000)
        except OutputError as problem:
            assert "is writing it" in str(problem), problem
