"""Files and folders that the product writes: complete or not there, never two writers in one."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import glob
import os
import shlex
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PART = ".part"  # what the name of an unfinished output ends with
_AT_FDCWD, _RENAME_NOREPLACE, _RENAME_EXCHANGE = -100, 1, 2  # of renameat2


class OutputError(Exception):
    """The output cannot be written; the text is one line that says why."""


class AtomicOutput:
    """An output on its way, in a file beside its place whose name ends with ``.part``.

    That name is always the same, and the file is locked: two writers for one place notice each other, and what a killed
    process has left is found.

    Parameters
    ----------
    target : path
        Where the output goes, links followed: to a new file, or in the place of one.
    replace : bool
        Whether it may take the place of a file that is there, now or at the end.
    precious : bool
        Whether what a killed process has left under the name of the part is kept, unless `replace`. Else it is used up.

    Attributes
    ----------
    name : Path
        Of the part.
    descriptor : int
        Of the part, open for reading and writing. Nothing has been changed in it before `begin`.
    keep : bool
        Whether `close` leaves it where it is.

    Raises
    ------
    OutputError
        The place is taken, or another process writes to it (the text says which), or nothing can be written there.
    """

    def __init__(self, target: str | Path, replace: bool, precious: bool = False) -> None:
        self.target = Path(target)
        self._path = _place(self.target, replace)
        self.name = self._path.with_name(self._path.name + PART)
        self._replace = replace
        self._begun = self.keep = False
        try:
            self.descriptor = _locked(self.name, self._open)
        except OSError as problem:
            raise self.error(problem) from None
        if precious and not replace and self._left_over():
            self.close()
            raise OutputError(
                f"{self.name} is what an interrupted recording has left: rename or remove it; --force replaces it"
            )

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(self.name, flags, 0o666)
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
            os.close(descriptor)
            raise OSError(errno.EEXIST, f"{self.name} is there, and no file of its own")
        return descriptor

    def _left_over(self) -> bool:
        return not self._begun and os.fstat(self.descriptor).st_size > 0

    def begin(self) -> int:
        """Empty it of what somebody else has left; returns the descriptor."""
        os.ftruncate(self.descriptor, 0)
        self._begun = True
        return self.descriptor

    def complete(self) -> None:
        """Let it take its place; OSError where it cannot, FileExistsError where that is taken now."""
        os.fsync(self.descriptor)  # else a power cut could leave an empty file of that name
        if not _is_at(self.name, self.descriptor):
            raise FileNotFoundError(errno.ENOENT, f"{self.name} is not there any more")
        if self._replace:
            self.name.rename(self._path)
        else:
            _renameat2(self.name, self._path, _RENAME_NOREPLACE)
        self.keep = True
        _sync_folder(self._path.parent)

    def close(self) -> None:
        """Unlock it; what is not complete goes, unless it is to be kept or is still what somebody else has left."""
        if not (self.keep or self._left_over()) and _is_at(self.name, self.descriptor):
            self.name.unlink()
        os.close(self.descriptor)

    def error(self, problem: OSError) -> OutputError:
        """What to say of a failure to write."""
        return OutputError(f"cannot write {self.target}: {problem.strerror or problem}")


@contextmanager
def new_file(target: str | Path, replace: bool) -> Iterator[int]:
    """A descriptor of an empty file that takes the place `target` if all goes well, and else is gone.

    Raises OutputError as `Part` does, and for an OSError from within.
    """
    with _new_part(target, replace) as part:
        yield part.descriptor


@contextmanager
def new_path(target: str | Path, replace: bool) -> Iterator[Path]:
    """As `new_file`, for those who open files by name: the name of the empty file, which must be written in place."""
    with _new_part(target, replace) as part:
        yield part.name


@contextmanager
def _new_part(target: str | Path, replace: bool) -> Iterator[AtomicOutput]:
    part = AtomicOutput(target, replace)
    try:
        part.begin()
        yield part
        part.complete()
    except OSError as problem:
        raise part.error(problem) from problem
    finally:
        part.close()


@contextmanager
def new_folder(target: str | Path, replace: bool, sign: str) -> Iterator[Path]:
    """An empty folder that takes the place `target`, links followed, if all goes well, and else is gone.

    As with `Part`, its name until then ends with ``.part``, it is locked, and what a killed process left is used up.

    Parameters
    ----------
    target : path
        Where the folder goes.
    replace : bool
        Whether it may take the place of a folder that is there, if that holds a file of the name `sign`.
    sign : str
        What tells such a folder from one that somebody keeps other things in.

    Raises
    ------
    OutputError
        The place is taken, or another process writes to it, or nothing can be written there; an OSError from within.
    """
    path = _real(target)
    try:
        if os.path.lexists(path):
            _check_replaceable(Path(target), path, replace, sign)
        elif not path.parent.is_dir():
            raise OutputError(f"cannot write {target}: there is no folder {path.parent}")
        part = path.with_name(path.name + PART)
        descriptor = _locked(part, lambda: _open_folder(part))
        try:
            for left in part.iterdir():
                _remove(left)
            yield part
            sync_tree(part)
            if not _is_at(part, descriptor):
                raise FileNotFoundError(errno.ENOENT, f"{part} is not there any more")
            if os.path.lexists(path):
                _check_replaceable(Path(target), path, replace, sign)
                _exchange(part, path)
            else:
                _renameat2(part, path, _RENAME_NOREPLACE)
            _sync_folder(path.parent)
        finally:
            if _is_at(part, descriptor):
                shutil.rmtree(part, ignore_errors=True)
            os.close(descriptor)
    except OSError as problem:
        raise OutputError(f"cannot write {target}: {problem.strerror or problem}") from problem


def _check_replaceable(target: Path, path: Path, replace: bool, sign: str) -> None:
    if not path.is_dir():
        raise OutputError(f"{target} is there already, and no folder")
    if not replace:
        raise OutputError(f"{target} is there already; --force replaces it")
    if any(path.iterdir()) and not (path / sign).exists():
        raise OutputError(f"{target} is a folder with other things in it, which stay")


def _open_folder(part: Path) -> int:
    while True:
        part.mkdir(exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # another process has just removed or moved it
            return os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)


def _exchange(part: Path, path: Path) -> None:
    """Put a folder in the place of another, which is removed.

    The old one has the name of the part meanwhile. It is locked, so that no other writer takes it for its own part.
    """
    old = _locked(path, lambda: os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW))
    try:
        try:
            _renameat2(part, path, _RENAME_EXCHANGE)
        except FileExistsError:  # a file system that cannot
            shutil.rmtree(path)
            part.rename(path)
        else:
            shutil.rmtree(part, ignore_errors=True)
    finally:
        os.close(old)


def _locked(name: Path, opened: Callable[[], int]) -> int:
    """The descriptor of the file or folder `name` that `opened` returns, locked; BlockingIOError if another has it."""
    while True:
        descriptor = opened()
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(name, descriptor):
                return descriptor
        except BlockingIOError:
            who = _holder(descriptor)
            os.close(descriptor)
            raise BlockingIOError(errno.EAGAIN, f"{who} is writing it") from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # the process that had it has just finished, and moved or removed it


def _is_at(name: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(name.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def write_whole(target: str | Path, data: bytes) -> None:
    """Put a file with `data` in the place `target`, or leave what is there: after a power cut too. OutputError."""
    with new_file(target, replace=True) as descriptor:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(descriptor, rest) :]


def _place(target: Path, replace: bool) -> Path:
    """Where the output goes, links followed; OutputError where that is taken or cannot be."""
    path = _real(target)
    try:
        found = path.lstat()
    except FileNotFoundError:
        if not path.parent.is_dir():
            raise OutputError(f"cannot write {target}: there is no folder {path.parent}") from None
        return path
    except OSError as problem:
        raise OutputError(f"cannot write {target}: {problem.strerror or problem}") from None
    if not stat.S_ISREG(found.st_mode):
        raise OutputError(f"{target} is not a regular file")
    if not replace:
        raise OutputError(f"{target} is there already; --force replaces it")
    return path


def _real(target: str | Path) -> Path:
    """The absolute path of the output, links followed; OutputError if there is none."""
    try:
        return Path(os.path.realpath(target))
    except FileNotFoundError:
        raise OutputError(f"cannot write {target}: the current directory has been deleted; change to another") from None
    except (OSError, ValueError) as problem:
        raise OutputError(f"cannot write {target}: {getattr(problem, 'strerror', None) or problem}") from None


def _renameat2(name: Path, path: Path, flag: int) -> None:
    """Rename to nothing, or exchange the two; FileExistsError where `path` is there, or the file system cannot."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(_AT_FDCWD, os.fsencode(name), _AT_FDCWD, os.fsencode(path), flag) == 0:
        return
    problem = ctypes.get_errno()
    if problem in (errno.EINVAL, errno.ENOSYS) and not os.path.lexists(path):  # a file system that cannot, such as NFS
        name.rename(path)
        return
    if problem in (errno.EINVAL, errno.ENOSYS, errno.EEXIST):
        raise FileExistsError(errno.EEXIST, "it has come into being meanwhile")
    raise OSError(problem, os.strerror(problem))


def sync_tree(folder: Path) -> None:
    """Have the folder and everything in it on the disk, so that they survive a power cut once they are renamed."""
    for parent, _, names in os.walk(folder):
        for name in names:
            _sync(Path(parent, name))
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # a file system that cannot
        _sync(folder)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    """Which process has the file locked, for people; of those of other users nothing is known."""
    wanted = os.fstat(descriptor)
    # This process comes last: forked from the one that writes, it has inherited the locked descriptor.
    own = f"/proc/{os.getpid()}/"
    for opened in map(Path, sorted(glob.iglob("/proc/[0-9]*/fd/*"), key=lambda name: name.startswith(own))):
        with contextlib.suppress(OSError):  # closed by now, or somebody else's
            process = opened.parents[1]
            if os.path.samestat(opened.stat(), wanted) and "FLOCK" in (process / "fdinfo" / opened.name).read_text():
                words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")[:-1]
                command = shlex.join(words)[:200]
                return f"process {process.name} ({command if command.isprintable() else 'unknown'})"
    return "another process"
