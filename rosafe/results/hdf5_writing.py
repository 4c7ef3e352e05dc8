"""Write HDF5 files such that a full disk raises OSError. With the library alone it would end the process."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any


class _File(io.RawIOBase):
    """A file object for h5py, on an empty file on the disk.

    If a write fails inside the library, as on a full disk, closing the HDF5 file later ends the process. After the
    first failure all data are therefore kept in memory and read from there. These are a few MB of the library's caches,
    because callers stop at the first error.

    Attributes
    ----------
    problem : OSError or None
        The first failure.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._at = self._end = 0
        self._kept: list[tuple[int, bytes]] = []
        self.problem: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + (self._end if whence == os.SEEK_END else 0)  # the library does not use SEEK_CUR
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        try:
            count = os.preadv(self._descriptor, [view], self._at)
        except OSError as problem:
            self.problem, count = self.problem or problem, 0
        view[count:] = bytes(len(view) - count)
        for at, data in self._kept:
            first, last = max(at, self._at), min(at + len(data), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = data[first - at : last - at]
        return len(view)

    def write(self, data: Any) -> int:
        view, at = memoryview(data).cast("B"), self._at
        self._end = max(self._end, at + len(view))
        try:
            while view and not self.problem:
                count = os.pwrite(self._descriptor, view, at)
                view, at = view[count:], at + count
        except OSError as problem:
            self.problem = problem
        if view:
            self._kept.append((at, bytes(view)))
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        assert size is not None
        self._end = size
        try:
            os.ftruncate(self._descriptor, size)
        except OSError as problem:
            self.problem = self.problem or problem
        return size

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()


class Hdf5:
    """An HDF5 file that is being written.

    All calls of the library run on a separate thread. KeyboardInterrupt cannot occur there, because Python runs signal
    handlers in the main thread only.

    Parameters
    ----------
    path : Path
        An empty file.
    **options
        For `h5py.File`.

    Raises
    ------
    OSError
        The file cannot be written.
    """

    def __init__(self, path: Path, **options: Any) -> None:
        import h5py

        self._file = _File(path)
        self._thread = ThreadPoolExecutor(1)
        self._group: Any = None

        def begin(_: None) -> None:
            self._group = h5py.File(self._file, "w", **options)

        try:
            self.call(begin)
        except BaseException:
            self.close()
            raise

    def call(self, work: Callable[..., object], *arguments: Any) -> None:
        """Run ``work(group, *arguments)``; OSError if this or an earlier write has failed."""
        self.check()
        self._thread.submit(lambda: work(self._group, *arguments)).result()
        self.check()

    def check(self) -> None:
        """Raise the OSError of the first write that has failed, if any."""
        if self._file.problem is not None:
            raise self._file.problem

    def close(self) -> None:
        """Close the file. Failures are reported only by `check`."""
        if not self._file.closed:
            self._thread.submit(self._close).result()
            self._thread.shutdown()

    def _close(self) -> None:
        if self._group is not None:
            self._group.close()
        self._file.close()
