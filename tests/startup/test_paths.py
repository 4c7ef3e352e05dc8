"""Where things may be written: the folder below /tmp is this user's alone, or it is not used."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from rosafe.transport.paths import private_temporary


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the folder belongs; nothing is there."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"rosafe-{os.getuid()}"


def test_it_is_made_private_and_found_again(folder: Path) -> None:
    before = os.umask(0)
    try:
        assert private_temporary() == folder == private_temporary()
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o701, 0o710, 0o720, 0o702, 0o740, 0o755, 0o777, 0o1777])
def test_one_that_others_may_enter_is_refused(folder: Path, mode: int) -> None:
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(PermissionError, match="is not private to this user; remove it"):
        private_temporary()
    assert folder.stat().st_mode & 0o7777 == mode, "it may be somebody's"


def _link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(folder.parent / "elsewhere")


@pytest.mark.parametrize("make", [_link, Path.touch, os.mkfifo], ids=["link", "file", "fifo"])
def test_what_is_no_folder_is_refused(folder: Path, make: Callable[[Path], None]) -> None:
    make(folder)
    with pytest.raises(OSError, match=r"not private|File exists"):
        private_temporary()


@pytest.mark.skipif(os.getuid() != 0, reason="giving a folder to somebody else takes root")
def test_somebody_elses_is_refused(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    os.chown(folder, 65534, -1)
    with pytest.raises(PermissionError, match="is not private to this user"):
        private_temporary()
