"""A catkin workspace with both packages: built, installed, and used from the install space only.

Usually with a few requests and messages: catkin starts several processes for each. `scripts/test --long` has all.
"""

from __future__ import annotations

import filecmp
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe import __version__
from rosafe.ros1.component import generate
from tests.harness import PYTHON, ROOT, Graph, MasterProcess
from tests.packaging.clone import definitions, environment, fresh_copy, keep_few_definitions, run

NEEDED = ("catkin_make", "cmake", "make", "cc")
ALL = pytest.param("all", marks=pytest.mark.exploration)


@pytest.fixture(scope="module", params=["few", ALL])
def workspace(request: pytest.FixtureRequest) -> Iterator[Path]:
    """A workspace after ``catkin_make install``, whose sources have been moved away."""
    missing = [tool for tool in NEEDED if shutil.which(tool) is None]
    if missing or not Path("/usr/share/message_generation").exists():
        pytest.skip(f"no catkin here ({missing or 'message_generation'}); run scripts/install --tests")
    with fresh_copy() as copy:
        if request.param == "few":
            keep_few_definitions(copy)
            list_definitions(copy)
            list_definitions(copy / "bass")
        folder = copy.with_name("workspace")
        sources = folder / "src"
        sources.mkdir(parents=True)
        (sources / "rosAFE").symlink_to(copy)
        (sources / "bass").symlink_to(copy / "bass")
        done = run(
            # replaces the default -j2 -l2, with which make runs single jobs while the load of the machine is above 2
            *("catkin_make", "-j2", "-C", folder, "install", f"-DPYTHON_EXECUTABLE={PYTHON}"),
            env=environment(HOME=str(folder), ROS_LANG_DISABLE="genlisp:gencpp"),
            cwd=folder,
            seconds=550,
        )
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
        assert "CMake Warning" not in done.stderr.replace("CMake Deprecation Warning", ""), done.stderr
        copy.rename(copy.with_name("gone"))
        yield folder


def names(package: Path) -> set[str]:
    """Return the names of messages, services and actions in the folder of a ROS package."""
    return {path.name for path in definitions(package)}


def list_definitions(package: Path) -> None:
    """Remove the names of deleted files from the lists in CMakeLists.txt, each of which was listed once."""
    cmake = package / "CMakeLists.txt"
    removed = names(ROOT / package.name if package.name == "bass" else ROOT) - names(package)
    lines = cmake.read_text("utf-8").splitlines(keepends=True)
    kept = [line for line in lines if line.strip() not in removed]
    assert removed and len(lines) - len(kept) == len(removed)
    cmake.write_text("".join(kept), "utf-8")


PARTS_OF_ACTIONS = ("Action", "Goal", "ActionGoal", "Result", "ActionResult", "Feedback", "ActionFeedback")


def generated_from(name: str) -> set[tuple[str, str]]:
    """Return the kind and name of the generated messages and services of a definition."""
    stem, _, kind = name.partition(".")
    return {("msg", stem + part) for part in PARTS_OF_ACTIONS} if kind == "action" else {(kind, stem)}


def sourced(workspace: Path, commands: str, shell: str = "bash", **env: str) -> subprocess.CompletedProcess[str]:
    """Run commands in a new shell after sourcing the setup file of the install space."""
    return run(
        shell, "-c", f". {workspace}/install/setup.{shell.replace('dash', 'sh')} && {commands}", env=environment(**env)
    )


def printed(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.exploration
@pytest.mark.parametrize("package", ["rosAFE", "bass"])
def test_messages_equal_those_of_our_generator(workspace: Path, package: str) -> None:
    """Byte for byte, including the messages of actions."""
    generation = Path(generate.environment()["ROS_PACKAGE_PATH"].split(":")[0]).parent
    folder = "bass" if package == "bass" else "."
    removed = names(ROOT / folder) - names(workspace.with_name("gone") / folder)
    deleted = {made for name in removed for made in generated_from(name)}
    for kind in ("msg", "srv"):
        for own, catkin in (
            (generation / "python" / package / kind, workspace / "install/lib/python3/dist-packages" / package / kind),
            (generation / "share" / package / kind, workspace / "install/share" / package / kind),
        ):
            files = [p for p in own.iterdir() if p.is_file()]
            expected = {p.name for p in files if (kind, p.stem.removeprefix("_")) not in deleted}
            assert {p.name for p in catkin.iterdir() if p.is_file()} == expected
            same = sorted(expected - ({"__init__.py"} if deleted else set()))  # __init__.py imports the others
            assert same and filecmp.cmpfiles(own, catkin, same, shallow=False) == (same, [], [])


def test_python(workspace: Path) -> None:
    code = "import rosafe, rosafe.processing, rosAFE.msg, bass.srv; print(rosafe.__file__, rosAFE.msg.__file__)"
    found = printed(sourced(workspace, f"{PYTHON} -c '{code}'")).split()
    packages = workspace / "install" / "lib" / "python3" / "dist-packages"
    assert found == [str(packages / "rosafe/__init__.py"), str(packages / "rosAFE/msg/__init__.py")]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the kernels are for x86-64")
def test_kernels(workspace: Path) -> None:
    """They are built with the workspace, and used without a compiler."""
    show = f"PATH=/nonexistent {PYTHON} -c 'from rosafe.dsp import kernels; print(kernels.status())'"
    status = printed(sourced(workspace, show))
    assert status.startswith("compiled for x86-64-v")
    assert f"{workspace}/install/lib/python3/dist-packages/rosafe/dsp/kernels/" in status


@pytest.mark.parametrize("program", ["rosAFE-ros", "bass-ros"])
def test_executables(workspace: Path, program: str) -> None:
    package = program.removesuffix("-ros")
    where, version = str(workspace / "install" / "bin" / program), f"{package} {__version__}\n"
    commands = f"command -v {program}; {program} --version; rosrun {package} {program} --version"
    assert printed(sourced(workspace, commands)) == f"{where}\n{version}{version}"
    assert printed(sourced(workspace, f"command -v {program}", "dash")).strip() == where
    unsourced = run(workspace / "install" / "bin" / program, "--version", env=environment())
    assert printed(unsourced) == version


def test_ros_tools(workspace: Path) -> None:
    assert "float64[] data" in printed(sourced(workspace, "rosmsg show rosAFE/rosAFE_signalOneD"))
    assert "string device" in printed(sourced(workspace, "rossrv show bass/Acquire"))
    assert printed(sourced(workspace, "rospack find rosAFE")).strip() == str(workspace / "install" / "share" / "rosAFE")


def test_tcl_package(workspace: Path) -> None:
    script = workspace / "require.tcl"
    script.write_text("puts [package require genomix]\nputs [package ifneeded genomix [package require genomix]]\n")
    shown = printed(sourced(workspace, f"tclsh {script}"))
    assert str(workspace / "install" / "lib" / "tcltk" / "genomix") in shown


def test_python_client(workspace: Path) -> None:
    shown = printed(sourced(workspace, f"{PYTHON} -c 'import genomix; print(genomix.__file__)'"))
    assert shown.startswith(f"{workspace}/install/lib/python3/dist-packages/genomix/")


def test_environment_for_children(workspace: Path) -> None:
    install = workspace / "install"
    python = install / "lib" / "python3" / "dist-packages"
    command = [PYTHON, "-m", "rosafe.ros1.component.generate", "--shell"]
    exports = dict(
        line.removeprefix("export ").split("=", 1)
        for line in printed(run(*command, env=environment(PYTHONPATH=str(python)), cwd=Path("/"))).splitlines()
    )
    assert exports["PATH"].split(":")[0] == str(install / "bin")
    assert exports["PYTHONPATH"].split(":")[0] == str(python)
    assert exports["ROS_PACKAGE_PATH"] == str(install / "share")
    assert exports["TCLLIBPATH"] == str(install / "lib" / "tcltk")
    assert exports["OCTAVE_PATH"] == exports["MATLABPATH"] == str(install / "lib" / "matlab")


def test_second_setup_has_no_effect(workspace: Path) -> None:
    again = f". {workspace}/install/setup.bash && echo $TCLLIBPATH"
    assert printed(sourced(workspace, again)).strip() == str(workspace / "install" / "lib" / "tcltk")


@pytest.mark.parametrize("workspace", [ALL], indirect=True)  # a node imports the messages of all requests
def test_both_nodes_run_from_the_install_space(
    workspace: Path, private_graph: tuple[Graph, MasterProcess], tmp_path: Path
) -> None:
    graph, _ = private_graph
    setup = f". {workspace}/install/setup.sh"
    ros = {"ROS_MASTER_URI": graph.uri, "ROS_IP": "127.0.0.1", "HOME": str(tmp_path)}
    plain = [f"{name}={value}" for name, value in {**environment(), **ros}.items()]
    with (
        graph.start("env", "-i", *plain, "sh", "-c", f"{setup} && exec bass-ros") as bass,
        graph.start("env", "-i", *plain, "sh", "-c", f"{setup} && exec rosAFE-ros") as rosafe,
    ):
        for name, node in (("bass", bass), ("rosAFE", rosafe)):
            graph.wait_until_up(node, name)
        called = printed(sourced(workspace, "rosservice call /bass/Acquire \"{device: 'scene:'}\"", **ros))
        assert "genom_success: True" in called
        published = printed(sourced(workspace, "rostopic echo -n1 /bass/Audio/sampleRate", **ros))
        assert published.startswith("44100")
        assert bass.stop() == 0 and rosafe.stop() == 0
    installed = workspace / "install" / "lib" / "python3" / "dist-packages"
    assert not any(installed.rglob(".generated")) and not (tmp_path / ".cache").exists()
    assert os.access(installed / "rosafe" / "__init__.py", os.R_OK)
