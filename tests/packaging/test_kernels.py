"""The kernels are built once if possible; otherwise numpy and scipy are used, and the status gives the reason."""

from __future__ import annotations

import os
import platform
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe.dsp.kernels import build, loader
from tests.harness import PYTHON, run_together, wait_for
from tests.packaging.clone import CLANG, environment, fresh_copy, run, without_rights

SHOW = "from rosafe.dsp import kernels; print(kernels.compiled(), kernels.status(), sep='|')"
PROCESS = (  # does not import scipy.signal
    "import numpy; from rosafe.representations.haircell import InnerHairCell as Ihc; "
    "assert not Ihc(44100, ihc_method='halfwave').process(-numpy.ones((2, 1, 900))).any(); "
)

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="other processors have other libraries")


@pytest.fixture
def copy() -> Iterator[Path]:
    with fresh_copy("rosafe", "pyproject.toml") as path:
        yield path


def shown(done: subprocess.CompletedProcess[str]) -> tuple[bool, str]:
    """Return whether a process running SHOW has used kernels, and its status."""
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    compiled, status = done.stdout.strip().split("|")
    return compiled == "True", status


def show(copy: Path, before: str = "", **env: str) -> tuple[bool, str]:
    return shown(run(PYTHON, "-c", before + SHOW, env=environment(PYTHONPATH=str(copy), **env)))


def folders(copy: Path) -> list[str]:
    return sorted(path.name for path in (copy / ".generated").glob("kernels-*"))


def compiler(copy: Path, body: str, name: str = "gcc") -> str:
    """Return a PATH on which the compiler is a script."""
    folder = copy.with_name("bin")
    folder.mkdir()
    (folder / name).write_text(f"#!/bin/sh\n{body}\n")
    (folder / name).chmod(0o755)
    return f"{folder}:/usr/bin:/bin"


@pytest.mark.exploration
def test_concurrent_starts_in_a_new_tree(copy: Path) -> None:
    results = set(run_together(5, lambda index: show(copy, PROCESS)))
    assert len(results) == 1
    compiled, status = results.pop()
    assert compiled
    assert f"{copy}/.generated/" in status
    assert len(folders(copy)) == 1


def test_built_once_and_again_when_a_source_changes(copy: Path) -> None:
    _, first = show(copy)
    times = {path: path.stat().st_mtime_ns for path in (copy / ".generated").rglob("*")}
    assert show(copy)[1] == first
    assert {path: path.stat().st_mtime_ns for path in (copy / ".generated").rglob("*")} == times
    with (copy / "rosafe" / "dsp" / "kernels" / "vector.h").open("a") as header:
        header.write("/* new */\n")
    compiled, second = show(copy)
    assert compiled
    assert second != first


def test_script_builds_in_the_given_folder(copy: Path) -> None:
    script, elsewhere = copy / "rosafe" / "dsp" / "kernels" / "build.py", copy.with_name("elsewhere")
    done = run(PYTHON, script, elsewhere, env=environment())
    paths = [Path(line) for line in done.stdout.splitlines()]
    assert (done.returncode, done.stderr, len(paths)) == (0, "", 3)
    assert all(path.is_relative_to(elsewhere) and path.is_file() for path in paths)
    assert not (copy / ".generated").exists()
    assert run(PYTHON, script, "a", "b", env=environment()).returncode == 2


def test_no_compiler(copy: Path) -> None:
    empty = copy.with_name("bin")
    empty.mkdir()
    compiled, status = show(copy, PROCESS, PATH=str(empty))
    assert not compiled
    assert status == ("numpy and scipy: the kernels are not built, and there is no compiler; install gcc")
    done = run(PYTHON, copy / "rosafe" / "dsp" / "kernels" / "build.py", env=environment(PATH=str(empty)))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert show(copy)[0], "a compiler was installed"
    assert show(copy, PROCESS, PATH=str(empty))[0], "built kernels need no compiler"


def test_compiler_fails(copy: Path) -> None:
    path = compiler(copy, 'echo "In file included from x.c:1:" >&2; echo "x.c:3: error: broken" >&2; exit 1')
    compiled, status = show(copy, PATH=path)
    assert not compiled
    assert status == "numpy and scipy: gcc cannot build the kernels: x.c:3: error: broken"
    assert folders(copy) == []


def test_compiler_creates_no_library(copy: Path) -> None:
    """A library that is deleted later is built again."""
    compiled, status = show(copy, PATH=compiler(copy, "exit 0"))
    assert not compiled
    assert status.startswith("numpy and scipy: gcc cannot build the kernels: ")
    assert folders(copy) == []
    assert show(copy)[0]
    (folder,) = folders(copy)
    (copy / ".generated" / folder / "x86-64-v3.so").unlink()
    assert show(copy)[0]


@pytest.mark.parametrize("damage", ["x86-64-v2.so", build.SUMS])
def test_truncated_library_is_built_again_or_not_loaded(copy: Path, damage: str) -> None:
    """As after a power failure. Loading it would end the process with a bus error."""
    empty = copy.with_name("bin")
    empty.mkdir()
    compiled, _ = show(copy)
    (folder,) = folders(copy)
    damaged = copy / ".generated" / folder / damage
    whole = damaged.read_bytes()
    for rest in (whole[:100], bytes(len(whole))):
        damaged.write_bytes(rest)
        assert show(copy, PATH=str(empty))[0] is False
        assert show(copy)[0] is compiled


@pytest.mark.skipif(os.getuid() != 0, reason="only root can change the owner of files")
def test_library_writable_by_other_users_is_not_loaded(copy: Path) -> None:
    env = environment(PYTHONPATH=str(copy))
    old = os.umask(0)
    try:
        assert shown(run(PYTHON, "-c", SHOW, env=env))[0]
    finally:
        os.umask(old)
    base = copy / ".generated"
    (name,) = folders(copy)
    for path in (base, *(base / name).rglob("*"), base / name):
        if path != base / "kernels.lock":
            assert not path.stat().st_mode & 0o022, path
    for path in (base, base / name, base / name / "x86-64-v2.so"):
        path.chmod(0o777)
        why = f"numpy and scipy: {path}: expected that other users cannot write it, got mode 777; chmod o-w {path}"
        assert show(copy) == (False, why)
        path.chmod(0o755)
        os.chown(path, 12345, 12345)
        compiled, status = show(copy)
        assert not compiled and f"{path}: expected that it belongs to root or to this user, got user 12345" in status
        os.chown(path, 0, 0)
    base.chmod(0o1777)
    assert show(copy)[0]
    link = copy.with_name("moved")
    base.rename(link)
    base.symlink_to(link)
    assert show(copy)[0]


def test_killed_build(copy: Path) -> None:
    path = compiler(copy, "exec sleep 60")
    env = environment(PYTHONPATH=str(copy), PATH=path)
    with subprocess.Popen([PYTHON, "-c", SHOW], env=env, cwd="/", start_new_session=True) as killed:
        wait_for(lambda: folders(copy), what="start of the build")
        os.killpg(killed.pid, signal.SIGKILL)
    assert len(folders(copy)) == 1
    assert show(copy)[0]
    (folder,) = folders(copy)
    assert ".new-" not in folder


def test_read_only_tree(copy: Path) -> None:
    """No kernels are built in it. Kernels built before are used, by any user with any home folder."""
    command = without_rights("env", f"PYTHONPATH={copy}", PYTHON, "-c", SHOW)
    copy.chmod(0o555)
    try:
        compiled, status = shown(run(*command, env=environment()))
        assert not compiled
        assert status.startswith("numpy and scipy: the kernels cannot be built: ")
        assert not (copy / ".generated").exists()
    finally:
        copy.chmod(0o755)
    builder = copy / "rosafe" / "dsp" / "kernels" / "build.py"
    assert run("sh", "-c", 'umask 077; exec "$@"', "-", PYTHON, builder, env=environment()).returncode == 0
    (copy / ".generated").chmod(0o555)
    try:
        assert shown(run(*command, env=environment()))[0]
    finally:
        (copy / ".generated").chmod(0o755)


def test_environment_variable(copy: Path) -> None:
    assert show(copy, ROSAFE_KERNELS="0") == (False, "numpy and scipy, because ROSAFE_KERNELS is 0")
    assert not (copy / ".generated").exists()
    for level in (2, 3):
        compiled, status = show(copy, ROSAFE_KERNELS=str(level))
        assert compiled
        assert status.startswith(f"compiled for x86-64-v{level} by gcc ")
        assert status.endswith(f"x86-64-v{level}.so")
    compiled, status = show(copy, ROSAFE_KERNELS="off")
    assert compiled
    assert "(ROSAFE_KERNELS: expected 0, 2, 3 or 4, got 'off'; it is ignored)" in status


def test_selected_compiler(copy: Path) -> None:
    """It has a separate folder: the libraries of the other compiler remain."""
    if shutil.which("clang") is None:
        pytest.skip("clang is not installed; run scripts/install --tests")
    path = compiler(copy, f'exec "{CLANG}" "$@" -O0', "clang")  # in a third of the time
    assert "by clang " in show(copy, PATH=path, ROSAFE_COMPILER="clang")[1]
    assert "by gcc " in show(copy)[1]
    assert len(folders(copy)) == 2
    compiled, status = show(copy, ROSAFE_COMPILER="clong")
    assert not compiled
    assert status.endswith("the kernels are not built; ROSAFE_COMPILER: expected a program, got 'clong'")


def test_clang_without_gcc(copy: Path) -> None:
    path = compiler(copy, 'echo "clang: error: found" >&2; exit 1', "clang")
    assert show(copy, PATH=path.partition(":")[0])[1].endswith("clang cannot build the kernels: clang: error: found")


def test_other_machines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    with pytest.raises(build.BuildError, match="for x86_64 and aarch64, but this machine is riscv64"):
        build.libraries(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("level", [0, 2, 3, 4])
def test_only_levels_of_the_processor_are_loaded(monkeypatch: pytest.MonkeyPatch, level: int) -> None:
    """Libraries for other processors are not opened, except the one that reports the level of the processor."""
    opened = []

    class Library:
        def rosafe_processor_level(self) -> int:
            return level

        def rosafe_compiler(self) -> bytes:
            return b"gcc 12.2.0"

    def load(path: Path) -> Library:
        opened.append(path.name)
        return Library()

    monkeypatch.setattr(loader, "load", load)
    monkeypatch.delenv(loader.KERNELS_VARIABLE, raising=False)
    loaded, status = loader.loaded.__wrapped__()
    assert (loaded is not None) == status.compiled == (level > 0)
    assert ("x86-64-v4.so" in opened) == (level == 4)
    assert ("x86-64-v3.so" in opened) == (level == 3)
    assert level or "SSE4.2" in status.detail
