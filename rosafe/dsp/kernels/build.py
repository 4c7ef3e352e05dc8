"""Builds the kernels with gcc or clang, once, in a folder whose name contains a hash of sources and flags.

On x86-64 there are libraries for SSE4.2, for AVX2 with FMA, and for AVX-512, so that a folder can be used on any
machine; on aarch64 there is one, for NEON.

It is also a script that requires only Python: ``build.py`` builds in the default folder, ``build.py FOLDER`` below
FOLDER. It does nothing if the libraries exist already.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from rosafe.system.output import lock_file
from rosafe.system.trust import foreign

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]

COMPILER = "ROSAFE_COMPILER"  # environment variable: the compiler; by default the first available one of COMPILERS
COMPILERS = ("gcc", "clang")
# levels of instruction sets, and their names for the compiler
ISA_LEVELS = {"x86_64": {2: "x86-64-v2", 3: "x86-64-v3", 4: "x86-64-v4"}, "aarch64": {8: "armv8-a"}}
# -O3 is slower: it unrolls loops that are unrolled already. Without -ffp-contract=off the compiler may fuse products
# and sums; without -fno-math-errno square roots are not vectorised.
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-Wall", "-Wextra")
COMPILE_TIMEOUT_SECONDS = 600  # the compiler takes about 3 s, but minutes if thirty other programs compute
SUMS = "libraries.sha256"  # in each folder, for sha256sum
MAX_FOLDERS = 3  # programs of other versions may use the other folders


class BuildError(Exception):
    """The libraries do not exist and cannot be built; one line with the reason."""


def digest() -> str:
    """Return a hash of the sources and flags."""
    sha = hashlib.sha256(f"{ISA_LEVELS} {FLAGS} {os.environ.get(COMPILER, '')}\0".encode())
    for source in sorted(HERE.glob("*.[ch]")):
        sha.update(f"{source.name}\0".encode())
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def place() -> Path:
    """Return the folder of the libraries: ``.generated`` of a checkout, or the folder of this file if installed."""
    return ROOT / ".generated" if (ROOT / "pyproject.toml").is_file() else HERE


def libraries(below: Path | None = None) -> dict[int, Path]:
    """Return the library for each level of this architecture, ascending. Build them if they do not exist.

    Parameters
    ----------
    below : Path, optional
        The folder to search and build in; `place()` by default.

    Raises
    ------
    BuildError
        If they do not exist and there is no compiler, no write permission or the wrong processor; or if other users
        could have written them.
    """
    levels = ISA_LEVELS.get(platform.machine())
    if levels is None:
        raise BuildError(f"the kernels are for {' and '.join(ISA_LEVELS)}, but this machine is {platform.machine()}")
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
    """Raise BuildError if other users could have written a path."""
    for path in paths:
        if why := foreign(path):
            raise BuildError(why)


def _missing_libraries(folder: Path, levels: dict[int, str]) -> list[str]:
    """Return the names of the libraries that are missing in `folder` or have changed since they were built."""
    try:
        sums = {line[66:]: line[:64] for line in (folder / SUMS).read_text("ascii").splitlines()}
    except (FileNotFoundError, NotADirectoryError, UnicodeDecodeError):
        sums = {}
    return [p.name for p in _paths(folder, levels).values() if not p.is_file() or sums.get(p.name) != _sum(p)]


def _sum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _compiler() -> str:
    chosen = os.environ.get(COMPILER)
    for name in (chosen,) if chosen else COMPILERS:
        if shutil.which(name):
            return name
    if chosen:
        raise BuildError(f"the kernels are not built; {COMPILER}: expected a program, got {chosen[:40]!r}")
    raise BuildError("the kernels are not built, and there is no compiler; install gcc")


def _build(folder: Path, levels: dict[int, str]) -> None:
    base = folder.parent
    compiler = _compiler()
    base.mkdir(mode=0o755, parents=True, exist_ok=True)
    with open(base / "kernels.lock", "w") as lock:
        lock_file(lock.fileno(), wait=True)  # released by the system even if this process is killed
        for orphan in base.glob("kernels-*.new-*"):  # left by a process that was killed
            shutil.rmtree(orphan)
        if _missing_libraries(folder, levels):
            temporary = Path(tempfile.mkdtemp(prefix=f"{folder.name}.new-", dir=base))
            try:
                built = compile_sources(compiler, levels, temporary).values()
                (temporary / SUMS).write_text("".join(f"{_sum(path)}  {path.name}\n" for path in built), "ascii")
                for path in (*temporary.iterdir(), temporary):  # readable by other users, independent of the umask
                    path.chmod(0o755)
                    _sync(path)  # otherwise a power failure could leave empty files
                if folder.is_dir():  # incomplete
                    shutil.rmtree(folder)
                temporary.rename(folder)
                _sync(base)
            except BaseException:
                shutil.rmtree(temporary)
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
    """Compile a library in `folder` for each of the `levels`, concurrently.

    Raises
    ------
    BuildError
        With the first error of the compiler.
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
            _, output = process.communicate(timeout=COMPILE_TIMEOUT_SECONDS)
            if process.returncode != 0:
                lines = output.decode(errors="replace").strip().splitlines()
                errors = [line for line in lines if "error" in line] or lines or [f"status {process.returncode}"]
                raise BuildError(f"{name} cannot build the kernels: {errors[0]}")
    except subprocess.TimeoutExpired as problem:
        raise BuildError(f"{name} took more than {COMPILE_TIMEOUT_SECONDS} seconds for the kernels") from problem
    finally:
        for process in running:
            process.kill()  # no effect if it has ended
            process.wait()
    for path in paths.values():
        if not path.is_file() or path.stat().st_size == 0:
            raise BuildError(f"{name} cannot build the kernels: it reports no error, but {path.name} is missing")
    return paths


def _discard_old(base: Path) -> None:
    for old in sorted(base.glob("kernels-*"), key=lambda folder: -folder.stat().st_mtime)[MAX_FOLDERS:]:
        shutil.rmtree(old)


def main(arguments: list[str]) -> int:
    """Build and print the paths; return 1 if that fails."""
    if len(arguments) > 1 or arguments[:1] in (["-h"], ["--help"]):
        print("usage: build.py [FOLDER]", file=sys.stderr)
        return 2
    try:
        for path in libraries(Path(arguments[0]) if arguments else None).values():
            print(path)
    except BuildError as problem:
        print(f"rosafe: {problem}; numpy and scipy will be used", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
