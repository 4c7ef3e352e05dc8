"""Standard streams that are closed or full, and a current directory that has been deleted: one line, no traceback."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

import rosafe
from tests.commands.command import SMALL, environment, noise, write
from tests.harness import SCRIPTS, run_program


def shell(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run_program(["bash", "-c", f"{SCRIPTS}/{command}"], cwd=cwd, env=environment())


CLOSED, FULL = (">&-", "Bad file descriptor"), (">/dev/full", "No space left on device")


@pytest.mark.parametrize(
    ("command", "to", "why"),
    [
        ("rosafe doctor", *FULL),
        ("rosafe -h", *CLOSED),
        ("rosafe -h", *FULL),
        ("rosAFE-ros -h", *FULL),
        ("bass-ros --version", *CLOSED),
        ("genomixd -h", *FULL),
        ("eltclsh -h", *CLOSED),
    ],
)
def test_output_that_cannot_be_written(tmp_path: Path, command: str, to: str, why: str) -> None:
    done = shell(f"{command} {to}", tmp_path)
    name = command.partition(" ")[0]
    assert (done.returncode, done.stderr) == (1, f"{name}: cannot write the standard output: {why}\n")


@pytest.mark.parametrize("to", ["2>/dev/full", ">&- 2>&-", ">&-"])
def test_messages_that_cannot_be_written(tmp_path: Path, to: str) -> None:
    """The result is complete, and messages are not written into files that are opened meanwhile."""
    write(tmp_path / "in.wav", noise(3000))
    done = shell(f"rosafe process in.wav {' '.join(SMALL)} --outputs ild -o out.h5 {to}", tmp_path)
    assert done.returncode == (1 if "2>" in to else 0) and "Traceback" not in done.stderr
    assert rosafe.load(tmp_path / "out.h5")["ild"].shape[0] == 3 and not (tmp_path / "out.h5.part").exists()


def test_input_that_is_closed(tmp_path: Path) -> None:
    done = shell("rosafe setup load - <&-", tmp_path)
    assert (done.returncode, done.stderr) == (1, "rosafe setup: -: Bad file descriptor\n")


@pytest.mark.parametrize("command", ["process in.wav -o x.h5", "record x.wav --device scene:"])
def test_a_current_directory_that_has_been_deleted(tmp_path: Path, command: str) -> None:
    write(tmp_path / "in.wav", noise(3000))
    (tmp_path / "gone").mkdir()
    command = command.replace("in.wav", str(tmp_path / "in.wav"))
    done = run_program(
        ["bash", "-c", f"rmdir ../gone; exec {SCRIPTS}/rosafe {command}"], cwd=tmp_path / "gone", env=environment()
    )
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.endswith(": the current directory has been deleted; change to another\n")
    assert sorted(os.listdir(tmp_path)) == ["in.wav"]
