"""File systems without locks, such as NFS and Lustre: everything can be written and read."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
from pathlib import Path

import pytest

from rosafe.system import output
from tests.commands.command import noise, write
from tests.harness import PYTHON, ROOT
from tests.localization.test_head import write_sofa

_SHIM = """
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdlib.h>
#include <sys/file.h>
int flock(int file, int operation) { errno = atoi(getenv("FLOCK_ERROR")); return -1; }
"""
_PROGRAM = """
import fcntl, os, sys, tempfile
from pathlib import Path

with tempfile.TemporaryFile() as file:
    try: fcntl.flock(file, fcntl.LOCK_EX)
    except OSError as problem: assert problem.errno == int(os.environ["FLOCK_ERROR"])
    else: raise AssertionError("the locks work")

import rosafe
from rosafe.commands.__main__ import main
from rosafe.dsp.kernels import build
from rosafe.localization import training
from rosafe.ros1.afe.saved_tree import TreeStateFile
from rosafe.setups import Setup
from rosafe.ros1.transport.registration import _user_lock

for extension in (".npz", ".h5", ".mat", ".csv"):
    command = ["process", "in.wav", "-o", f"out{extension}", "--outputs", "ild"]
    assert main(command) == 0, extension
    assert main([*command, "--force"]) == 0, extension
assert rosafe.load("out.h5")["ild"].shape[0] == rosafe.load("out.npz")["ild"].shape[0] == 31
for recording in ("a.wav", "a.bag"):
    assert main(["record", recording, "--device", "scene:", "--rate", "8000", "--seconds", "0.2"]) == 0
training.SOUND_SECONDS = 20.0
assert main(["head", "learn", "a.sofa", "-o", "a.head", "--rate", "8000", "--set", "fb_nChannels=3"]) == 0
assert rosafe.Localizer(8000, "a.head").model.channels == 3
TreeStateFile(Path("setup.yaml"), Setup, print).save()
with _user_lock():
    assert build.libraries(Path("kernels"))
print(*sorted(os.listdir()))
"""


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF])
def test_outputs_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    for replace in (False, True):
        output.write_files({tmp_path / "a": b"whole"}, replace)
    with pytest.raises(output.OutputError, match="already exists"):
        output.check_target(tmp_path / "a", False)
    assert (tmp_path / "a").read_text() == "whole" and len(list(tmp_path.iterdir())) == 1


def test_commands_without_locks(tmp_path: Path) -> None:
    (tmp_path / "shim.c").write_text(_SHIM)
    shim, folder = tmp_path / "shim.so", tmp_path / "folder"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", shim, tmp_path / "shim.c"], check=True, timeout=60)
    folder.mkdir()
    write(folder / "in.wav", noise(4000))
    write_sofa(folder / "a.sofa")
    done = subprocess.run(
        [PYTHON, "-c", _PROGRAM],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "LD_PRELOAD": str(shim), "FLOCK_ERROR": str(errno.ENOLCK)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    results = "out.csv out.h5 out.mat out.npz"
    expected = f"a.bag a.head a.sofa a.truth.csv a.wav in.wav kernels {results} setup.yaml"
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, [expected]), done
