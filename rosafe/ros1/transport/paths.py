"""Folders: the checkout or the install space, packages from PyPI, and places for generated files."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

CODE_DIR = Path(__file__).resolve().parents[3]  # the folder that holds the `rosafe` package
SYSTEM_PREFIX = Path("/usr")  # of Debian packages: its folders are on all paths already


def source_root() -> Path | None:
    """Return the checkout that this code runs from, or None if catkin or a Debian package has installed it."""
    return CODE_DIR if (CODE_DIR / "package.xml").is_file() and (CODE_DIR / "bass" / "msg").is_dir() else None


def install_prefix() -> Path:
    """Return the install prefix of catkin or dpkg; this code is in lib/python3/dist-packages below it."""
    return CODE_DIR.parents[2]


def _pypi_dir() -> Path:
    """Return the folder of the packages from PyPI: part of the Debian package, or created by scripts/install."""
    if source_root() is None and len(CODE_DIR.parents) > 2:
        own = install_prefix() / "lib" / "rosafe" / "python"
        if own.is_dir():
            return own
    return Path("/usr/local/lib/rosafe/python")


PYPI_DIR = _pypi_dir()  # packages from PyPI that are necessary because Debian's are missing or broken


def program(name: str) -> str:
    """Return the path of a command that was installed with this code; its bare name, for PATH, if it is missing."""
    root = source_root()
    path = (root / "scripts" if root is not None else install_prefix() / "bin") / name
    return str(path) if path.is_file() else name


def put_ahead(directory: Path) -> None:
    """Make `directory` the first entry of Python's import path."""
    entry = str(directory)
    if sys.path[:1] != [entry]:
        sys.path[:] = [entry, *(p for p in sys.path if p != entry)]


def prefer_pypi_packages() -> None:
    """Prefer the packages in `PYPI_DIR` to Debian's packages of the same name.

    Debian's alsaaudio cannot capture with Python 3.11; the one from PyPI can.
    """
    if PYPI_DIR.is_dir():
        put_ahead(PYPI_DIR)


def private_temporary() -> Path:
    """Return a private folder of this user in /tmp, always the same one, for files without another writable place.

    Raises OSError if another user has created a folder of this name and could therefore place files in it.
    """
    folder = Path(tempfile.gettempdir(), f"rosafe-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise PermissionError(f"{folder}: expected a folder that is private to this user; remove it")
    return folder


def writable(directory: Path) -> bool:
    """Return whether files can be created in `directory`, which is created if it is missing.

    The function creates a file, because permission bits are not conclusive for root or a read-only file system.
    """
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False
