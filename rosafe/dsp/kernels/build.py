"""Builds the kernels with one call of gcc, once: the library lies in a folder named after all that went into it.

Runs as a script too, without anything but Python: ``build.py`` builds where the kernels look for it, and
``build.py FOLDER`` below FOLDER. It does nothing where the library is there already.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]

PROCESSOR = "x86_64"
# -O3 is slower: it unrolls what is unrolled already. Without -ffp-contract=off gcc fuses products and sums as it likes.
FLAGS = ("-std=gnu11", "-O2", "-march=x86-64-v3", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Wextra")
LIBRARY = "kernels.so"
PATIENCE = 120  # seconds for gcc, which takes about one
KEPT = 3  # libraries that stay: programs of other versions may want theirs again


class BuildError(Exception):
    """There is no library and none can be built; one line says why."""


def digest() -> str:
    """A name for what the sources, flags and processor of this machine give."""
    sha = hashlib.sha256(f"{platform.machine()} {' '.join(FLAGS)}\0".encode())
    for source in sorted(HERE.glob("*.[ch]")):
        sha.update(f"{source.name}\0".encode())
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def place() -> Path:
    """Where libraries are: in ``.generated`` of a checkout, or beside this file where catkin has installed it."""
    return ROOT / ".generated" if (ROOT / "pyproject.toml").is_file() else HERE


def library(below: Path | None = None) -> Path:
    """The path of the library, which is built if it is not there.

    Parameters
    ----------
    below : Path, optional
        The folder to look and build in; `place()` by default.

    Raises
    ------
    BuildError
        Where there is no library, and no gcc, no permission to write, or the wrong processor.
    """
    base = place() if below is None else below
    wanted = base / f"kernels-{digest()}" / LIBRARY
    if wanted.is_file():
        return wanted
    if platform.machine() != PROCESSOR:
        raise BuildError(f"the kernels are for {PROCESSOR}, and this machine is {platform.machine()}")
    try:
        return _build(wanted)
    except OSError as problem:
        raise BuildError(f"the kernels cannot be built: {problem}") from problem


def _build(wanted: Path) -> Path:
    base = wanted.parents[1]
    gcc = shutil.which("gcc")
    if gcc is None:
        raise BuildError("the kernels are not built, and there is no gcc to build them; run scripts/install")
    base.mkdir(parents=True, exist_ok=True)
    with open(base / "kernels.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # given back by the kernel even if this process is killed
        for orphan in base.glob("kernels-*.new-*"):  # nobody else builds now: left by one that was killed
            shutil.rmtree(orphan)
        if not wanted.is_file():
            workshop = Path(tempfile.mkdtemp(prefix=f"{wanted.parent.name}.new-", dir=base))
            try:
                _compile(gcc, workshop / LIBRARY)
                workshop.chmod(0o755)
                workshop.rename(wanted.parent)
            except BaseException:
                shutil.rmtree(workshop)
                raise
        _discard_old(base)
    return wanted


def _compile(gcc: str, library: Path) -> None:
    command = [gcc, *FLAGS, "-o", str(library), *sorted(map(str, HERE.glob("*.c")))]
    environment = {**os.environ, "LC_ALL": "C"}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment, check=False)
    except subprocess.TimeoutExpired as problem:
        raise BuildError(f"gcc took more than {PATIENCE} seconds for the kernels") from problem
    if done.returncode != 0:
        said = done.stderr.strip().splitlines()
        errors = [line for line in said if "error" in line] or said or [f"exit status {done.returncode}"]
        raise BuildError(f"gcc cannot build the kernels: {errors[0]}")


def _discard_old(base: Path) -> None:
    for old in sorted(base.glob("kernels-*"), key=lambda folder: -folder.stat().st_mtime)[KEPT:]:
        shutil.rmtree(old)


def main(arguments: list[str]) -> int:
    """Build and print the path; 1 where that is impossible."""
    if len(arguments) > 1 or arguments[:1] in (["-h"], ["--help"]):
        print("usage: build.py [FOLDER]", file=sys.stderr)
        return 2
    try:
        print(library(Path(arguments[0]) if arguments else None))
    except BuildError as problem:
        print(f"rosafe: {problem}; numpy and scipy will serve", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
