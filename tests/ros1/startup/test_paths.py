"""The temporary folder below /tmp: it is used only if it is private to this user."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from rosafe.ros1.transport.paths import private_temporary


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of the folder, which does not exist yet."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"rosafe-{os.getuid()}"


def test_it_is_created_private_and_reused(folder: Path) -> None:
    before = os.umask(0)
    try:
        assert private_temporary() == folder == private_temporary()
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o701, 0o710, 0o720, 0o702, 0o740, 0o755, 0o777, 0o1777])
def test_a_folder_that_other_users_can_access_is_rejected(folder: Path, mode: int) -> None:
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(PermissionError, match="expected a folder that is private to this user; remove it"):
        private_temporary()
    assert folder.stat().st_mode & 0o7777 == mode, "the mode must not be changed: it may belong to another program"


def _link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(folder.parent / "elsewhere")


@pytest.mark.parametrize("make", [_link, Path.touch, os.mkfifo], ids=["link", "file", "fifo"])
def test_a_file_or_link_is_rejected(folder: Path, make: Callable[[Path], None]) -> None:
    make(folder)
    with pytest.raises(OSError, match=r"expected a folder that is private|File exists"):
        private_temporary()


@pytest.mark.skipif(os.getuid() != 0, reason="changing the owner of a folder requires root")
def test_a_folder_of_another_user_is_rejected(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    os.chown(folder, 65534, -1)
    with pytest.raises(PermissionError, match="expected a folder that is private to this user"):
        private_temporary()
