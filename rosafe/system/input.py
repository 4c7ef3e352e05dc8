"""Read input files. Only regular files are accepted, because a FIFO, socket or device can block or never end."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader

_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFDIR: "a directory",
}


def open_descriptor(path: str | os.PathLike[str]) -> int:
    """Open a regular file for reading and return its descriptor.

    This never blocks, even if the file is replaced by a FIFO in the meantime.

    Raises
    ------
    OSError
        The file does not exist, cannot be opened, or is not a regular file; `strerror` is the reason.
    ValueError
        The name is not valid for a file.
    """
    _check(os.stat(path), path)  # before it is opened, because opening a device can have effects
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        _check(os.fstat(descriptor), path)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file as a binary stream. Raises the errors of `open_descriptor`."""
    return os.fdopen(open_descriptor(path), "rb")


def read_regular(path: str | os.PathLike[str], limit: int) -> bytes:
    """Return the first `limit` bytes of a regular file, or fewer. Raises the errors of `open_descriptor`."""
    with open_regular(path) as file:
        data: bytes | None = file.read(limit)
    if data is None:  # some files of /proc and /sys only claim to be regular
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN), str(path))
    return data


def _check(status: os.stat_result, path: str | os.PathLike[str]) -> None:
    """Raise OSError unless `status` is that of a regular file."""
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        number = errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL
        reason = f"expected a regular file, got {_KINDS.get(kind, 'another kind of file')}"
        raise OSError(number, reason, os.fspath(path))
