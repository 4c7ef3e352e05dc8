"""Builds the kernels with gcc, once: the libraries lie in a folder named after all that went into them.

There is one for every x86-64 processor with AVX2 and FMA, and one for those with AVX-512, so that a folder serves any
machine.

Runs as a script too, without anything but Python: ``build.py`` builds where the kernels look for it, and
``build.py FOLDER`` below FOLDER. It does nothing where they are there already.
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
LEVELS = {3: "x86-64-v3", 4: "x86-64-v4"}  # of the processor, and their names for gcc
# -O3 is slower: it unrolls what is unrolled already. Without -ffp-contract=off gcc fuses products and sums as it likes.
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Wextra")
PATIENCE = 120  # seconds for gcc, which takes about one
KEPT = 3  # folders that stay: programs of other versions may want theirs again


class BuildError(Exception):
    """There are no libraries and none can be built; one line says why."""


def digest() -> str:
    """A name for what the sources and flags give."""
    sha = hashlib.sha256(f"{LEVELS} {FLAGS}\0".encode())
    for source in sorted(HERE.glob("*.[ch]")):
        sha.update(f"{source.name}\0".encode())
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def place() -> Path:
    """Where libraries are: in ``.generated`` of a checkout, or beside this file where catkin has installed it."""
    return ROOT / ".generated" if (ROOT / "pyproject.toml").is_file() else HERE


def libraries(below: Path | None = None) -> dict[int, Path]:
    """The library for each level of `LEVELS`. They are built if they are not there.

    Parameters
    ----------
    below : Path, optional
        The folder to look and build in; `place()` by default.

    Raises
    ------
    BuildError
        Where there are none, and no gcc, no permission to write, or the wrong processor.
    """
    folder = (place() if below is None else below) / f"kernels-{digest()}"
    try:
        if _lacking(folder):
            if platform.machine() != PROCESSOR:
                raise BuildError(f"the kernels are for {PROCESSOR}, and this machine is {platform.machine()}")
            _build(folder)
    except OSError as problem:
        raise BuildError(f"the kernels cannot be built: {problem}") from problem
    return _paths(folder)


def _paths(folder: Path) -> dict[int, Path]:
    return {level: folder / f"{name}.so" for level, name in LEVELS.items()}


def _lacking(folder: Path) -> list[str]:
    """The names of the libraries that are not in `folder`, or empty."""
    return [path.name for path in _paths(folder).values() if not path.is_file() or path.stat().st_size == 0]


def _build(folder: Path) -> None:
    base = folder.parent
    gcc = shutil.which("gcc")
    if gcc is None:
        raise BuildError("the kernels are not built, and there is no gcc to build them: install gcc")
    base.mkdir(parents=True, exist_ok=True)
    with open(base / "kernels.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # given back by the kernel even if this process is killed
        for orphan in base.glob("kernels-*.new-*"):  # nobody else builds now: left by one that was killed
            shutil.rmtree(orphan)
        if _lacking(folder):
            workshop = Path(tempfile.mkdtemp(prefix=f"{folder.name}.new-", dir=base))
            try:
                _compile(gcc, workshop)
                for path in (workshop, *workshop.iterdir()):  # for other users, too, whatever this one's umask is
                    path.chmod(0o755)
                if folder.is_dir():  # something has been lost there
                    shutil.rmtree(folder)
                workshop.rename(folder)
            except BaseException:
                shutil.rmtree(workshop)
                raise
        _discard_old(base)


def _compile(gcc: str, workshop: Path) -> None:
    """All libraries at once, each by a gcc of its own."""
    sources = sorted(map(str, HERE.glob("*.c")))
    environment = {**os.environ, "LC_ALL": "C"}
    running = []
    try:
        for level, path in _paths(workshop).items():
            command = [gcc, *FLAGS, f"-march={LEVELS[level]}", "-o", str(path), *sources, "-lm"]
            running.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment))
        for process in running:
            _, said = process.communicate(timeout=PATIENCE)
            if process.returncode != 0:
                lines = said.decode(errors="replace").strip().splitlines()
                errors = [line for line in lines if "error" in line] or lines or [f"status {process.returncode}"]
                raise BuildError(f"gcc cannot build the kernels: {errors[0]}")
    except subprocess.TimeoutExpired as problem:
        raise BuildError(f"gcc took more than {PATIENCE} seconds for the kernels") from problem
    finally:
        for process in running:
            process.kill()  # one that is done already takes no notice
            process.wait()
    if missing := _lacking(workshop):
        raise BuildError(f"gcc cannot build the kernels: it says nothing, and there is no {missing[0]}")


def _discard_old(base: Path) -> None:
    for old in sorted(base.glob("kernels-*"), key=lambda folder: -folder.stat().st_mtime)[KEPT:]:
        shutil.rmtree(old)


def main(arguments: list[str]) -> int:
    """Build and print the paths; 1 where that is impossible."""
    if len(arguments) > 1 or arguments[:1] in (["-h"], ["--help"]):
        print("usage: build.py [FOLDER]", file=sys.stderr)
        return 2
    try:
        for path in libraries(Path(arguments[0]) if arguments else None).values():
            print(path)
    except BuildError as problem:
        print(f"rosafe: {problem}; numpy and scipy will serve", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
