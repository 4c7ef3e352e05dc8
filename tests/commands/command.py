"""Shared by the tests of the command: running it, writing sound files, checking its results and errors."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import scipy.io
import soundfile

from rosafe.results.readers import READERS, load
from tests import fork_server
from tests.harness import PYTHON, SCRIPTS, Process, can_fork, run_program

ROSAFE = SCRIPTS / "rosafe"
SMALL = ("--set", "fb_cfHz=200,800,2000")  # a cheap chain, also at low sample rates
SMALL_PARAMETERS = {"fb_cfHz": [200.0, 800.0, 2000.0]}


def environment(**changes: str) -> dict[str, str]:
    """Return the environment of a shell without ROS and Python variables."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "PYTHON"))}
    return {**env, "PATH": "/usr/local/bin:/usr/bin:/bin", **changes}


def rosafe(
    *arguments: str | Path, cwd: Path | None = None, timeout: float = 120.0, program: Path = ROSAFE, **env: str
) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends."""
    command = [str(program), *map(str, arguments)]
    if can_fork(command, environment(**env)):
        return fork_server.shared().run(command, environment(**env), cwd, "", timeout)
    return run_program(command, cwd=cwd, env=environment(**env), stdin=subprocess.DEVNULL)


def rosafe_alone(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command with the standard library only, without Debian's packages."""
    return rosafe("-S", ROSAFE, *arguments, program=Path(PYTHON))


def start(*arguments: str | Path, cwd: Path) -> Process:
    """Start the command in a new process, which has its command line; use the result in a `with` statement."""
    return Process([str(ROSAFE), *map(str, arguments)], environment(), cwd, fork=False)


def noise(frames: int, seed: int = 1) -> np.ndarray:
    """Return binaural noise, (2, frames), within ±1 and exact in 16 bits."""
    return np.random.default_rng(seed).integers(-(2**15), 2**15, (2, frames)) / 2.0**15


def as_int32(signal: np.ndarray) -> np.ndarray:
    """Return the int32 samples of integer files."""
    return (signal * 2.0**31).astype(np.int64).astype(np.int32)


def write(path: Path, signal: np.ndarray, rate: int = 16000, subtype: str = "PCM_16") -> Path:
    """Write a sound file whose format follows from the name."""
    soundfile.write(path, signal.T, rate, subtype=subtype)
    return path


def refused(done: subprocess.CompletedProcess[str], *words: str, code: int = 1) -> None:
    """Assert that the command failed with this code and one line on stderr that contains the words."""
    assert done.returncode == code, done
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.endswith("\n"), done.stderr
    assert done.stderr.startswith("rosafe"), done.stderr
    for word in words:
        assert word in done.stderr, done.stderr


def ild_in(path: Path) -> np.ndarray:
    """Return the ILD of a result of any format."""
    if path.suffix in READERS:
        return np.asarray(load(path)["ild"])
    if path.suffix == ".mat":
        return np.asarray(scipy.io.loadmat(path)["ild"])
    return np.loadtxt(path, delimiter=",", skiprows=2, ndmin=2)[:, 1:].T
