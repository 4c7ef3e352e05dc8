"""Debian packages: built by scripts/make-deb, checked by lintian, and used from an unpacked copy without the checkout.

tests/packaging/fresh_packages installs, upgrades and purges them on minimal machines.
"""

from __future__ import annotations

import filecmp
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe.ros1.component import generate
from rosafe.system.version import VERSION
from tests.harness import PYTHON, ROOT, Graph, MasterProcess
from tests.packaging.clone import environment, fresh_copy, run

NAMES = ("python3-rosafe", "rosafe")
DATE = "1700000000"  # seconds; the packages do not depend on the time of the build

pytestmark = pytest.mark.exploration  # a clean build takes long; test_debian_folder has the tests without one


def build(folder: Path, **variables: str) -> dict[str, Path]:
    """Build the packages of a new copy of this checkout in `folder`."""
    missing = [tool for tool in ("dpkg-buildpackage", "dh", "dh_python3") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"not installed: {missing}; run scripts/install --tests")
    with fresh_copy() as copy:
        temporary = folder.parent / "temporary 'files'"  # debhelper cannot build in such a folder
        temporary.mkdir(exist_ok=True)
        env = environment(SOURCE_DATE_EPOCH=DATE, TMPDIR=str(temporary), **variables)
        done = run(copy / "scripts" / "make-deb", folder, env=env, seconds=500)
    if "cannot download" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stdout + done.stderr
    files = {path.name.partition("_")[0]: path for path in folder.iterdir()}
    assert set(files) == set(NAMES)
    assert {str(path) for path in files.values()} <= set(done.stdout.splitlines())
    return files


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return build(tmp_path_factory.mktemp("packages"))


@pytest.fixture(scope="module")
def root(packages: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the content of both packages, which is read-only."""
    folder = tmp_path_factory.mktemp("root")
    for path in packages.values():
        assert run("dpkg-deb", "-x", path, folder, env=environment()).returncode == 0
    folders = [path for path in (folder, *folder.rglob("*")) if path.is_dir() and not path.is_symlink()]
    for path in folders:
        path.chmod(0o555)
    yield folder
    for path in folders:
        path.chmod(0o755)


def content(folder: Path) -> list[Path]:
    """Return all paths, without those of compiled modules: root may write them, and dpkg does when it installs."""
    return sorted(path for path in folder.rglob("*") if "__pycache__" not in path.parts)


def field(package: Path, name: str) -> str:
    done = run("dpkg-deb", "-f", package, name, env=environment())
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def assert_same_messages(python: Path, share: Path, package: str) -> None:
    """Compare the messages of a package in these folders with those of the checkout."""
    generation = Path(generate.environment()["ROS_PACKAGE_PATH"].split(":")[0]).parent
    for kind in ("msg", "srv"):
        for own, installed in (
            (generation / "python" / package / kind, python / package / kind),
            (generation / "share" / package / kind, share / package / kind),
        ):
            names = sorted(path.name for path in own.iterdir() if path.is_file())
            assert names and names == sorted(path.name for path in installed.iterdir())
            assert filecmp.cmpfiles(own, installed, names, shallow=False) == (names, [], [])


def test_versions(packages: dict[str, Path]) -> None:
    for path in packages.values():
        assert re.fullmatch(re.escape(VERSION) + r"~[a-z]+[0-9.]*", field(path, "Version"))
    assert f"python3-rosafe (= {field(packages['rosafe'], 'Version')})" in field(packages["rosafe"], "Depends")


def test_maintainer_scripts_remove_what_programs_create(packages: dict[str, Path], tmp_path: Path) -> None:
    for name, path in packages.items():
        assert run("dpkg-deb", "-e", path, tmp_path / name, env=environment()).returncode == 0
        assert f"py3clean -p {name}" in (tmp_path / name / "prerm").read_text("utf-8")
    assert "/var/lib/private/rosafe" in (tmp_path / "rosafe" / "postrm").read_text("utf-8")


def test_lintian_finds_nothing(packages: dict[str, Path]) -> None:
    if shutil.which("lintian") is None:
        pytest.skip("lintian is not installed; run scripts/install --tests")
    done = run("lintian", "--fail-on", "error,warning", *packages.values(), env=environment(LC_ALL="C.UTF-8"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_files(root: Path) -> None:
    """No file depends on the checkout or its place, and all links end in the packages or in the packages of ROS."""
    assert [path.name for path in root.iterdir()] == ["usr"]
    programs = {path.name for path in (root / "usr" / "bin").iterdir()}
    assert programs == {"bass-ros", "eltclsh", "elwish", "genomixd", "rosAFE-ros", "rosafe"}
    assert {path.name for path in (root / "usr/share/man/man1").iterdir()} == {f"{name}.1.gz" for name in programs}
    for path in root.rglob("*"):
        assert path.name not in ("__pycache__", ".generated", "kernels.lock")
        if path.is_symlink():
            target = Path(os.path.normpath(path.parent / path.readlink()))
            assert target.is_relative_to(root / "usr")
            assert target.exists() or Path("/", target.relative_to(root)).exists(), path
    units = [path for kind in ("system", "user") for path in (root / "usr" / "lib" / "systemd" / kind).iterdir()]
    assert len(units) == len(list((ROOT / "systemd" / "system").iterdir())) * 2
    for unit in units:
        text = unit.read_text("utf-8")
        assert "/opt" not in text
        for program in re.findall(r"^ExecStart=/(\S+)", text, re.MULTILINE):
            assert (root / program).exists() or program == "usr/bin/roscore"
        for document in re.findall(r"^Documentation=file:/(\S+)", text, re.MULTILINE):
            assert (root / document).is_file()


@pytest.mark.parametrize("package", ["rosAFE", "bass"])
def test_messages_equal_those_of_the_checkout(root: Path, package: str) -> None:
    assert_same_messages(root / "usr/lib/python3/dist-packages", root / "usr/share", package)


def test_doctor_finds_the_prebuilt_parts(root: Path, tmp_path: Path) -> None:
    done = run(root / "usr/bin/rosafe", "doctor", env=environment(HOME=str(tmp_path), PATH="/usr/bin"))
    lines = {line[8:].split("  ")[0].strip(): line for line in done.stdout.splitlines()}
    assert done.returncode == 0, done
    assert str(root / "usr/lib/python3/dist-packages/rosafe/dsp/kernels") in lines["kernels"]
    assert lines["messages"].endswith(f"up to date, in {root}/usr/lib/python3/dist-packages")
    assert str(root / "usr/lib/rosafe/python/alsaaudio") in lines["alsaaudio"]


def test_nodes_run_from_the_packages(root: Path, private_graph: tuple[Graph, MasterProcess], tmp_path: Path) -> None:
    """They write nothing into their packages or into the home folder."""
    graph, _ = private_graph
    home = tmp_path / "home"  # not the folder of the test's master
    home.mkdir()
    ros = {
        "ROS_MASTER_URI": graph.uri,
        "ROS_IP": "127.0.0.1",
        "HOME": str(home),
        "ROS_LOG_DIR": str(home / "log"),
    }
    plain = ["env", "-i", *(f"{name}={value}" for name, value in {**environment(), **ros}.items())]
    before = content(root)
    with (
        graph.start(*plain, str(root / "usr/bin/bass-ros")) as bass,
        graph.start(*plain, str(root / "usr/lib/rosAFE/rosAFE-ros")) as rosafe,
    ):
        for name, node in (("bass", bass), ("rosAFE", rosafe)):
            graph.wait_until_up(node, name)
        exports = run(
            *(PYTHON, "-P", "-m", "rosafe.ros1.component.generate", "--shell"),
            env=environment(PYTHONPATH=str(root / "usr/lib/python3/dist-packages"), **ros),
        ).stdout
        request = "rosservice call /bass/Acquire \"{device: 'scene:'}\" && rosafe request ild"
        done = run("sh", "-c", f"{exports}\n{request} && rosmsg show rosAFE/rosAFE_dataObjSt", env=environment(**ros))
        assert done.returncode == 0, done
        assert "genom_success: True" in done.stdout and "float64[] data" in done.stdout
        assert bass.stop() == 0 and rosafe.stop() == 0
    assert content(root) == before
    assert {path.name for path in home.iterdir()} <= {"log"}


def test_two_builds_are_equal(packages: dict[str, Path], tmp_path: Path) -> None:
    """The help of `rosafe process`, and so its manual page, would list the parameters of plugins."""
    plugins = str(ROOT / "tests" / "plugins" / "plugins_with_hooks")
    for name, path in build(tmp_path, TZ="Asia/Tokyo", LC_ALL="C", ROSAFE_PLUGINS=plugins).items():
        assert filecmp.cmp(path, packages[name], shallow=False), name
