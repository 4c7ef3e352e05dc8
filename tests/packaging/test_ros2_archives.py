"""Source archives of the ROS 2 packages: complete and reproducible. tests/ros2 builds a workspace of one."""

from __future__ import annotations

import subprocess
from pathlib import Path

from rosafe.system.version import VERSION
from tests.harness import ROOT
from tests.packaging.clone import environment, fresh_copy, run

NAMES = ("rosafe_msgs", "rosafe_ros2")


def archives(folder: Path) -> list[Path]:
    """Build the archives of a copy of this checkout, and return their paths."""
    with fresh_copy() as copy:
        done = run(copy / "scripts" / "make-ros2", folder, env=environment(SOURCE_DATE_EPOCH="1700000000"))
    assert (done.returncode, done.stderr) == (0, "")
    found = [folder / f"{name}-{VERSION}.tar.gz" for name in NAMES]
    assert done.stdout.splitlines() == list(map(str, found))
    return found


def test_archives_are_complete_and_reproducible(tmp_path: Path) -> None:
    first, second = archives(tmp_path / "first"), archives(tmp_path / "second")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    for name, path in zip(NAMES, first, strict=True):
        subprocess.run(["tar", "-C", tmp_path, "-xf", path], check=True)
        own = subprocess.check_output(["git", "ls-files"], cwd=ROOT / "ros2" / name, text=True).split()
        package = subprocess.check_output(["git", "ls-files", "rosafe"], cwd=ROOT, text=True).split()
        sources = {entry: ROOT / "ros2" / name / entry for entry in own if entry != "rosafe"}
        sources |= {entry: ROOT / entry for entry in ["LICENSE", *(package if "rosafe" in own else [])]}
        files = {p.relative_to(tmp_path / name).as_posix(): p for p in (tmp_path / name).rglob("*") if p.is_file()}
        assert {entry: p.read_bytes() for entry, p in files.items()} == {e: p.read_bytes() for e, p in sources.items()}
        assert not any(path.is_symlink() for path in files.values())


def test_wrong_arguments() -> None:
    done = run(ROOT / "scripts" / "make-ros2", "a", "b", env=environment())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("usage: scripts/make-ros2 [FOLDER]")
