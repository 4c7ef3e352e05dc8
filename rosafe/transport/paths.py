"""Where things are: the checkout or the install space, the packages from PyPI, and where generated files may go."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

PYPI_DIR = Path("/usr/local/lib/rosafe/python")  # where scripts/install puts what Debian lacks or has broken
CODE_DIR = Path(__file__).resolve().parents[2]  # the folder that holds the `rosafe` package


def source_root() -> Path | None:
    """The checkout that this code runs from, or None where catkin has installed it."""
    return CODE_DIR if (CODE_DIR / "msg").is_dir() and (CODE_DIR / "bass" / "msg").is_dir() else None


def install_prefix() -> Path:
    """Where catkin has installed this code: it lies in lib/python3/dist-packages below."""
    return CODE_DIR.parents[2]


def program(name: str) -> str:
    """One of our commands, beside this code; its bare name, for PATH to find, where it is not there."""
    root = source_root()
    place = (root / "scripts" if root is not None else install_prefix() / "bin") / name
    return str(place) if place.is_file() else name


def put_ahead(directory: Path) -> None:
    """Make `directory` the first place that Python imports from."""
    entry = str(directory)
    if sys.path[:1] != [entry]:
        sys.path[:] = [entry, *(p for p in sys.path if p != entry)]


def prefer_pypi_packages() -> None:
    """Import what scripts/install brought from PyPI rather than Debian's package of the same name.

    Debian's alsaaudio cannot capture with Python 3.11; the one from PyPI can.
    """
    if PYPI_DIR.is_dir():
        put_ahead(PYPI_DIR)


def user_cache() -> Path:
    """The user's own place for files that can be made again."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path(os.path.expanduser("~"), ".cache")) / "rosafe"


def private_temporary() -> Path:
    """A folder below /tmp that is this user's alone and the same every time, for what can be written nowhere else.

    Raises OSError where the name is taken by somebody else, who could otherwise slip us files of theirs.
    """
    folder = Path(tempfile.gettempdir(), f"rosafe-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise PermissionError(f"{folder} is not private to this user; remove it")
    return folder


def writable(directory: Path) -> bool:
    """Whether files can be made in `directory`, which is created where it is missing.

    Tried by making one: permission bits say nothing about root or about a read-only file system.
    """
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


def foreign(path: Path) -> bool:
    """Whether anybody but root, this user and the owner of this program could have written what is at `path`."""
    try:
        found = path.stat()
    except OSError:  # it does not exist, or this user cannot read it
        return False
    others = found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX
    return bool(others) or found.st_uid not in (0, os.getuid(), CODE_DIR.stat().st_uid)
