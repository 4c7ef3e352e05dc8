"""Handle standard streams that are closed, full or no longer read: one line and an exit status, no traceback."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from typing import Any


class StreamError(Exception):
    """The standard output cannot be written; the text is the reason."""


class _Output(io.FileIO):
    """The standard output. It raises StreamError, except for a closed pipe, so that OSError stands for other files."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except (BrokenPipeError, BlockingIOError):
            raise
        except OSError as problem:
            raise StreamError(f"cannot write the standard output: {problem.strerror}") from None


class _Messages(io.FileIO):
    """The standard error. Messages that cannot be written are dropped."""

    lost = False

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except (BrokenPipeError, BlockingIOError):
            raise
        except OSError:
            self.lost = True
            return len(data)


def run(name: str, main: Callable[[], int]) -> int:
    """Run the program `name`.

    Parameters
    ----------
    name : str
        The program's name, which begins the message about a stream.
    main : callable
        The program; returns its exit status, or raises SystemExit.

    Returns
    -------
    int
        The exit status; 1 if output or messages of a program that has otherwise succeeded could not be written, 141 if
        the reader of a pipe has closed it.
    """
    messages = _open_all()
    try:
        try:
            code = main()
        except SystemExit as end:
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
            code = 1 if isinstance(end.code, str) else end.code or 0
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has exited, as `head` does
        _discard(1, 2)
        return 141
    except StreamError as problem:
        print(f"{name}: {problem}", file=sys.stderr)
        _discard(1)
        return 1
    return code or int(messages.lost)


def _open_all() -> _Messages:
    """Replace Python's standard streams, which are None if the shell has closed them."""
    for number, (stream, flags) in enumerate(
        ((sys.stdin, os.O_WRONLY), (sys.stdout, os.O_RDONLY), (sys.stderr, os.O_RDONLY))
    ):
        if stream is None:  # reserve its number; reading and writing fail
            descriptor = os.open(os.devnull, flags)
            if descriptor != number:
                os.dup2(descriptor, number)
                os.close(descriptor)
            os.set_inheritable(number, True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    messages = _Messages(2, "wb", closefd=False)
    sys.stdout = _text(_Output(1, "wb", closefd=False), sys.stdout)
    sys.stderr = _text(messages, sys.stderr)
    return messages


def _text(raw: io.FileIO, like: Any) -> io.TextIOWrapper:
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=getattr(like, "encoding", "utf-8"),
        errors=getattr(like, "errors", "backslashreplace"),
        line_buffering=getattr(like, "line_buffering", False) or raw.fileno() == 2,
        write_through=getattr(like, "write_through", False),
    )


def _discard(*numbers: int) -> None:
    """Redirect descriptors to /dev/null, so that Python can flush its buffers at exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    for number in numbers:
        os.dup2(null, number)
