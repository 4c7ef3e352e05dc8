"""A checkout whose path cannot be an entry of PATH: each script says so in one line, and does nothing."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from tests.harness import SCRIPTS, proc
from tests.packaging.clone import environment, run

PATHS = pytest.mark.parametrize("folder", ["my:robot", "my\nrobot", "robot\n"])
EXPECTED = "expected a path without : and line breaks, which separate folders in PATH and PYTHONPATH, got "
NAMES = sorted({path.name for path in SCRIPTS.iterdir()} - {"env.sh", "checkout.sh", "uninstall"})


def checkout(tmp_path: Path, folder: str) -> Path:
    shutil.copytree(SCRIPTS, tmp_path / folder / "scripts", symlinks=True)
    return tmp_path / folder / "scripts"


@PATHS
def test_scripts_name_the_path(tmp_path: Path, folder: str) -> None:
    scripts = checkout(tmp_path, folder)
    for name in NAMES:
        done = run(scripts / name, *(["out"] if name == "export-sources" else []), env=environment())
        assert done.returncode == 1 and done.stdout == "", (name, done)
        assert f"{name}: checkout: {EXPECTED}" in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
        assert done.stderr.endswith("; rename or move it\n") and folder.split("\n")[0] in done.stderr, done.stderr


@PATHS
@pytest.mark.parametrize("shell", ["bash", "dash", "zsh"])
def test_env_names_the_path(tmp_path: Path, folder: str, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed; run scripts/install --tests")
    if shell == "dash":
        proc()  # it has no variable with the path of the file
    line = f". {shlex.quote(str(checkout(tmp_path, folder) / 'env.sh'))} || echo refused"
    done = run(shell, "-c", line, env=environment())
    assert done.stdout == "refused\n"
    assert done.stderr.startswith(f"rosafe: checkout: {EXPECTED}{tmp_path}/") and done.stderr.count("\n") == 1, (
        done.stderr
    )
