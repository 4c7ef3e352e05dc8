"""Atomic output: a file appears only when it is complete, and has one writer at a time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

PART = ".part"  # suffix of an unfinished output
# Errors of flock on file systems without locks, such as NFS, Lustre, FUSE; EBADF: NFS does not lock folders
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF)


class OutputError(Exception):
    """The output cannot be written; the text is one line with the reason, and `errno` the error number."""

    def __init__(self, text: str, error_number: int | None = None) -> None:
        super().__init__(text)
        self.errno = error_number or errno.EIO


class AtomicOutput:
    """An unfinished output file, named after its target with the suffix ``.part``.

    The name is fixed and the file is locked. A second writer of the same target is therefore rejected, and a part that
    a killed process has left is found. On a file system without locks a second writer is not rejected.

    Parameters
    ----------
    target : path
        The path of the output; links are followed.
    replace : bool
        Whether it may replace an existing file.
    keep_leftover : bool
        Whether a part that a killed process has left is an error, unless `replace`. Otherwise it is overwritten.
    mode : int
        Permissions of a new part, of which the umask removes some.

    Attributes
    ----------
    name : Path
        The path of the part.
    descriptor : int
        The part, open for reading and writing. It is unchanged before `begin`.
    keep : bool
        Whether `close` keeps the part.

    Raises
    ------
    OutputError
        The target exists, or another process is writing it, or it cannot be written.
    """

    def __init__(self, target: str | Path, replace: bool, keep_leftover: bool = False, mode: int = 0o666) -> None:
        self.target = Path(target)
        self._path = _checked_target(self.target, replace)
        self.name = self._path.with_name(self._path.name + PART)
        self._replace = replace
        self._begun = self.keep = False
        self._mode = mode
        try:
            self.descriptor = self._open()
        except BlockingIOError:
            raise self.error(BlockingIOError(errno.EAGAIN, "another process is writing it")) from None
        except OSError as problem:
            raise self.error(problem) from None
        if keep_leftover and not replace and self._left_over():
            self.close()
            raise OutputError(
                f"{self.name} was left by an interrupted recording; rename or remove it, or replace it with --force"
            )

    def _open(self) -> int:
        """Return the locked part; BlockingIOError if another process has locked it."""
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        while True:
            with contextlib.ExitStack() as closing:
                descriptor = os.open(self.name, flags, self._mode)
                closing.callback(os.close, descriptor)
                found = os.fstat(descriptor)
                if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                    raise OSError(errno.EEXIST, f"{self.name} exists and is not a regular file with one link")
                lock_file(descriptor)
                if self._is_there(descriptor):  # otherwise its owner has just moved or removed it: try again
                    closing.pop_all()
                    return descriptor

    def _is_there(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(self.name.lstat(), os.fstat(descriptor))
        except FileNotFoundError:
            return False

    def _left_over(self) -> bool:
        return not self._begun and os.fstat(self.descriptor).st_size > 0

    def begin(self) -> int:
        """Truncate the part. Return its descriptor."""
        os.ftruncate(self.descriptor, 0)
        self._begun = True
        return self.descriptor

    def complete(self) -> None:
        """Rename the part to the target; FileExistsError if that was created meanwhile, or another OSError."""
        os.fsync(self.descriptor)  # otherwise a power cut could leave an empty file of that name
        if not self._is_there(self.descriptor):
            raise FileNotFoundError(errno.ENOENT, f"{self.name} has been removed")
        if not self._replace and os.path.lexists(self._path):
            raise FileExistsError(errno.EEXIST, "it was created meanwhile")
        os.replace(self.name, self._path)
        self.keep = True
        _sync_folder(self._path.parent)

    def close(self) -> None:
        """Unlock the part, and remove it unless it is complete, to be kept, or an unchanged leftover."""
        if not (self.keep or self._left_over()) and self._is_there(self.descriptor):
            self.name.unlink()
        os.close(self.descriptor)

    def error(self, problem: OSError) -> OutputError:
        """Return the OutputError for a failure to write."""
        return OutputError(f"cannot write {self.target}: {problem.strerror or problem}", problem.errno)


@contextmanager
def new_file(target: str | Path, replace: bool, mode: int = 0o666) -> Iterator[int]:
    """Yield the descriptor of an empty file that becomes `target` on success and is removed on failure.

    Raises OutputError as `AtomicOutput` does, and for an OSError in the body.
    """
    with _new_part(target, replace, mode) as part:
        yield part.descriptor


@contextmanager
def new_path(target: str | Path, replace: bool) -> Iterator[Path]:
    """As `new_file`, but yield the path of the empty file, which must be written in place."""
    with _new_part(target, replace) as part:
        yield part.name


@contextmanager
def _new_part(target: str | Path, replace: bool, mode: int = 0o666) -> Iterator[AtomicOutput]:
    part = AtomicOutput(target, replace, mode=mode)
    try:
        part.begin()
        yield part
        part.complete()
    except OSError as problem:
        raise part.error(problem) from problem
    finally:
        part.close()


def lock_file(descriptor: int, wait: bool = False) -> None:
    """Lock an open file or folder until it is closed; without effect on a file system without locks.

    BlockingIOError if another process has locked it, unless this function is to `wait`.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as problem:
        if problem.errno not in _NO_LOCKS:
            raise


def check_target(target: str | Path, replace: bool) -> None:
    """Raise OutputError if `new_file` would refuse an output: to be called before a long computation."""
    AtomicOutput(target, replace).close()


def write_files(contents: Mapping[Path, bytes], replace: bool) -> None:
    """Write several files, of which none appears before all have been written. Raises OutputError."""
    with contextlib.ExitStack() as parts:
        for target, data in contents.items():
            _write(parts.enter_context(new_file(target, replace)), data)


def write_whole(target: str | Path, data: bytes, mode: int | None = None) -> None:
    """Write `data` to the file `target`, which keeps its old contents on failure, also after a power cut.

    Permissions are `mode`, by default those of new files. Raises OutputError.
    """
    with new_file(target, True, 0o666 if mode is None else mode) as descriptor:
        if mode is not None:
            os.fchmod(descriptor, mode)  # also of a part that was left
        _write(descriptor, data)


def _write(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def _checked_target(target: Path, replace: bool) -> Path:
    """Return the absolute path of the output with links followed; OutputError if it exists or cannot be written."""
    try:
        path = Path(os.path.realpath(target))
    except FileNotFoundError:
        raise OutputError(f"cannot write {target}: the current directory has been deleted; change to another") from None
    except (OSError, ValueError) as problem:
        raise OutputError(f"cannot write {target}: {getattr(problem, 'strerror', None) or problem}") from None
    try:
        found = path.lstat()
    except FileNotFoundError:
        if not path.parent.is_dir():
            text = f"cannot write {target}: the folder {path.parent} does not exist"
            raise OutputError(text, errno.ENOENT) from None
        return path
    except OSError as problem:
        raise OutputError(f"cannot write {target}: {problem.strerror or problem}", problem.errno) from None
    if not stat.S_ISREG(found.st_mode):
        raise OutputError(f"{target} is not a regular file")
    if not replace:
        raise OutputError(f"{target} already exists; --force replaces it")
    return path


def sync_tree(folder: Path) -> None:
    """Write a folder and all files in it to the disk, so that they survive a power cut after a rename."""
    for parent, _, names in os.walk(folder):
        for name in names:
            _sync(Path(parent, name))
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # not supported by the file system
        _sync(folder)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
