"""Builds the kernels with gcc or clang, once: the libraries lie in a folder named after all that went into them.

On x86-64 there is one for processors with SSE4.2, one for those with AVX2 and FMA and one for those with AVX-512, so
that a folder serves any machine; on aarch64, where all have NEON, one for all.

Runs as a script too, without anything but Python: ``build.py`` builds where the kernels look for it, and
``build.py FOLDER`` below FOLDER. It does nothing where they are there already.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]

COMPILER = "ROSAFE_COMPILER"  # environment variable: the compiler to take; else the first of COMPILERS that is there
COMPILERS = ("gcc", "clang")
# levels of processors, and their names for the compiler
ISA_LEVELS = {"x86_64": {2: "x86-64-v2", 3: "x86-64-v3", 4: "x86-64-v4"}, "aarch64": {8: "armv8-a"}}
# -O3 is slower: it unrolls what is unrolled already. Without -ffp-contract=off products and sums are fused at will;
# without -fno-math-errno square roots are taken one by one.
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-Wall", "-Wextra")
COMPILE_TIMEOUT_SECONDS = 120  # seconds for the compiler, which takes about three
SUMS = "libraries.sha256"  # in each folder, for sha256sum
KEPT = 3  # folders that stay: programs of other versions may want theirs again


class BuildError(Exception):
    """There are no libraries and none can be built; one line says why."""


def digest() -> str:
    """A name for what the sources and flags give."""
    sha = hashlib.sha256(f"{ISA_LEVELS} {FLAGS} {os.environ.get(COMPILER, '')}\0".encode())
    for source in sorted(HERE.glob("*.[ch]")):
        sha.update(f"{source.name}\0".encode())
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def place() -> Path:
    """Where libraries are: in ``.generated`` of a checkout, or beside this file where catkin has installed it."""
    return ROOT / ".generated" if (ROOT / "pyproject.toml").is_file() else HERE


def libraries(below: Path | None = None) -> dict[int, Path]:
    """The library for each level of this machine's kind, ascending. They are built if they are not there.

    Parameters
    ----------
    below : Path, optional
        The folder to look and build in; `place()` by default.

    Raises
    ------
    BuildError
        If there are none, and no compiler, no permission to write, or the wrong processor; or if other users could
        have put them there.
    """
    levels = ISA_LEVELS.get(platform.machine())
    if levels is None:
        raise BuildError(f"the kernels are for {' and '.join(ISA_LEVELS)}, and this machine is {platform.machine()}")
    base = place() if below is None else below
    folder = base / f"kernels-{digest()}"
    try:
        _refuse_foreign(base, folder)
        if _missing_libraries(folder, levels):
            _build(folder, levels)
        _refuse_foreign(*_paths(folder, levels).values())
    except OSError as problem:
        raise BuildError(f"the kernels cannot be built: {problem}") from problem
    return _paths(folder, levels)


def _paths(folder: Path, levels: dict[int, str]) -> dict[int, Path]:
    return {level: folder / f"{name}.so" for level, name in levels.items()}


def _refuse_foreign(*paths: Path) -> None:
    """BuildError if anybody but root, this user and the owner of this program could have written what is there."""
    for path in filter(os.path.lexists, paths):
        found = path.stat()
        if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
            raise BuildError(
                f"{path}: expected that other users cannot write it, got mode {found.st_mode & 0o7777:o}; "
                f"chmod o-w {path}"
            )
        if found.st_uid not in (0, os.geteuid(), HERE.stat().st_uid):
            raise BuildError(
                f"{path}: expected that it belongs to root or to this user, got user {found.st_uid}; remove it"
            )


def _missing_libraries(folder: Path, levels: dict[int, str]) -> list[str]:
    """The names of the libraries that are not in `folder`, or not as they were built."""
    try:
        sums = {line[66:]: line[:64] for line in (folder / SUMS).read_text("ascii").splitlines()}
    except (FileNotFoundError, NotADirectoryError, UnicodeDecodeError):
        sums = {}
    return [p.name for p in _paths(folder, levels).values() if not p.is_file() or sums.get(p.name) != _sum(p)]


def _sum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _compiler() -> str:
    asked = os.environ.get(COMPILER)
    if asked and shutil.which(asked) is None:
        raise BuildError(f"the kernels are not built, and {COMPILER} is {asked[:40]!r}, which is no program here")
    for name in (asked,) if asked else COMPILERS:
        if shutil.which(name):
            return name
    raise BuildError("the kernels are not built, and there is no gcc to build them: install gcc")


def _build(folder: Path, levels: dict[int, str]) -> None:
    base = folder.parent
    compiler = _compiler()
    base.mkdir(mode=0o755, parents=True, exist_ok=True)
    with open(base / "kernels.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # given back by the kernel even if this process is killed
        for orphan in base.glob("kernels-*.new-*"):  # nobody else builds now: left by one that was killed
            shutil.rmtree(orphan)
        if _missing_libraries(folder, levels):
            workshop = Path(tempfile.mkdtemp(prefix=f"{folder.name}.new-", dir=base))
            try:
                built = compile_sources(compiler, levels, workshop).values()
                (workshop / SUMS).write_text("".join(f"{_sum(path)}  {path.name}\n" for path in built), "ascii")
                for path in (*workshop.iterdir(), workshop):  # for other users, too, whatever this one's umask is
                    path.chmod(0o755)
                    _sync(path)  # else a power cut could leave empty files
                if folder.is_dir():  # something has been lost there
                    shutil.rmtree(folder)
                workshop.rename(folder)
                _sync(base)
            except BaseException:
                shutil.rmtree(workshop)
                raise
        _discard_old(base)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def compile_sources(
    compiler: str, levels: dict[int, str], folder: Path, sources: Path = HERE, options: tuple[str, ...] = ()
) -> dict[int, Path]:
    """A library in `folder` for each of the `level_differences`, all at once, each by a compiler of its own.

    Raises
    ------
    BuildError
        With the first thing that the compiler has to say.
    """
    name, files = Path(compiler).name, sorted(map(str, sources.glob("*.c")))
    environment = {**os.environ, "LC_ALL": "C"}
    paths = _paths(folder, levels)
    running = []
    try:
        for level, path in paths.items():
            command = [compiler, *FLAGS, *options, f"-march={levels[level]}", "-o", str(path), *files, "-lm"]
            running.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment))
        for process in running:
            _, said = process.communicate(timeout=COMPILE_TIMEOUT_SECONDS)
            if process.returncode != 0:
                lines = said.decode(errors="replace").strip().splitlines()
                errors = [line for line in lines if "error" in line] or lines or [f"status {process.returncode}"]
                raise BuildError(f"{name} cannot build the kernels: {errors[0]}")
    except subprocess.TimeoutExpired as problem:
        raise BuildError(f"{name} took more than {COMPILE_TIMEOUT_SECONDS} seconds for the kernels") from problem
    finally:
        for process in running:
            process.kill()  # one that is done already takes no notice
            process.wait()
    for path in paths.values():
        if not path.is_file() or path.stat().st_size == 0:
            raise BuildError(f"{name} cannot build the kernels: it says nothing, and there is no {path.name}")
    return paths


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
