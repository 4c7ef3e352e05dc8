"""The files derived from the interface table are up to date, and one command updates them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from rosafe.interface import BASS, files, rosafe
from rosafe.representations import registry
from tests.harness import PYTHON, ROOT


def test_the_files_are_up_to_date() -> None:
    run = subprocess.run([PYTHON, "-m", "rosafe.interface", "--check"], cwd=ROOT, capture_output=True, text=True)
    assert (run.stdout, run.stderr, run.returncode) == ("", "", 0), "run: python3 -m rosafe.interface"


def test_files_follow_the_table(tmp_path: Path) -> None:
    """The files of a removed representation are deleted, and written again if it returns; others are not changed."""
    component = rosafe.derive({kind: stage.REPRESENTATION for kind, stage in registry.builtin_stages().items()})
    less = rosafe.derive({kind: r for kind, r in rosafe.KINDS.items() if kind not in ("ild", *children("ild"))})
    for folder in (tmp_path, tmp_path / "bass"):
        for kind in ("msg", "srv", "action"):
            (folder / kind).mkdir(parents=True)
        lists = "\n".join(f"add_{kind}_files(FILES\n)" for kind in ("message", "service", "action"))
        (folder / "CMakeLists.txt").write_text(f"before\n{lists}\nbehind\n")
    files.write(files.all_files(tmp_path, (component, BASS)))
    whole = {path: path.read_text() for path in tmp_path.rglob("*.*")}
    assert not files.stale(files.all_files(tmp_path, (component, BASS)))
    assert "  IldProc.srv\n" in whole[tmp_path / "CMakeLists.txt"]

    files.write(files.all_files(tmp_path, (less, BASS)))
    left = {path: path.read_text() for path in tmp_path.rglob("*.*")}
    gone = {path.relative_to(tmp_path).as_posix() for path in whole.keys() - left.keys()}
    assert {"srv/IldProc.srv", "action/IldProc.action"} <= gone
    assert "IldProc" not in left[tmp_path / "CMakeLists.txt"]
    assert left[tmp_path / "CMakeLists.txt"].startswith("before\n")
    assert left[tmp_path / "CMakeLists.txt"].endswith("behind\n")

    files.write(files.all_files(tmp_path, (component, BASS)))
    assert {path: path.read_text() for path in tmp_path.rglob("*.*")} == whole


def children(kind: str) -> set[str]:
    """Return all descendants of `kind`."""
    own = {child for child, representation in rosafe.KINDS.items() if representation.parent == kind}
    return own.union(*map(children, own))
