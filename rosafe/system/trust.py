"""The user's folder for files that can be computed again, and whether other users could have written a file in it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_PROGRAM = Path(__file__).resolve()


def user_cache() -> Path | None:
    """Return the folder `rosafe` in `$XDG_CACHE_HOME` (default `~/.cache`); None if this user has no home."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base, "rosafe") if os.path.isabs(base) else None


def foreign(path: Path) -> str:
    """Return why users other than root, this user and the owner of this program could have written `path`.

    Empty if they could not, or if it does not exist. A symbolic link and its target must both belong to these users.
    """
    try:
        found, owners = path.stat(), {path.lstat().st_uid, path.stat().st_uid}
    except OSError:  # it does not exist, or this user cannot read it
        return ""
    if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
        return (
            f"{path}: expected that other users cannot write it, got mode {found.st_mode & 0o7777:o}; chmod o-w {path}"
        )
    others = owners - {0, os.geteuid(), _PROGRAM.stat().st_uid}
    if others:
        return f"{path}: expected that it belongs to root or to this user, got user {min(others)}; remove it"
    return ""
