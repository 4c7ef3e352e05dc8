"""The ROS 2 packages: built by colcon, manifests, linters, and the launch file."""

from __future__ import annotations

import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.harness import ROOT, wait_for
from tests.packaging.test_ros2_archives import archives

from .network import Network

PACKAGES = ROOT / "ros2"
OWN = PACKAGES / "rosafe_ros2"
LAUNCH = OWN / "launch" / "rosafe.launch.py"


def run(env: dict[str, str], *command: str | Path, cwd: Path) -> str:
    """Run a program of ROS 2 and return its output; AssertionError if it fails."""
    done = subprocess.run(list(map(str, command)), env=env, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


def build(env: dict[str, str], folder: Path, packages: Path, *options: str) -> Path:
    """Build packages in a workspace, and return its folder of installed files."""
    out = run(env | {"HOME": str(folder)}, "colcon", "build", "--base-paths", packages, *options, cwd=folder)
    assert "failed" not in out
    return folder / "install"


def sourced(env: dict[str, str], install: Path) -> dict[str, str]:
    """Return the variables after the setup file of a workspace."""
    found = run(env, "bash", "-c", f". {install}/setup.sh && env -0", cwd=install)
    return dict(entry.split("=", 1) for entry in found.strip("\0").split("\0"))


def test_the_node_of_a_workspace(ros2: Network, tmp_path: Path) -> None:
    """Built of the source archive, it runs without the checkout; its files are those of the checkout."""
    _, archive = archives(tmp_path)
    subprocess.run(["tar", "-C", tmp_path, "-xf", archive], check=True)
    install = build(ros2.env, tmp_path, tmp_path / "rosafe_ros2")
    prefix = install / "rosafe_ros2"
    assert (prefix / "share/ament_index/resource_index/packages/rosafe_ros2").is_file()
    assert (prefix / "share/rosafe_ros2/launch/rosafe.launch.py").read_bytes() == LAUNCH.read_bytes()
    (package,) = prefix.glob("lib/python3*/site-packages/rosafe")
    for path in subprocess.check_output(["git", "ls-files", "rosafe"], cwd=ROOT, text=True).split():
        assert (package.parent / path).read_bytes() == (ROOT / path).read_bytes()
    node = ros2.start(
        *(prefix / "lib/rosafe_ros2/rosafe", "--ros-args", "-p", "device:=scene:", "-p", "representations:=[ild]"),
        **{**sourced(ros2.env, install), "ROSAFE_KERNELS": "0"},
    )
    wait_for(lambda: "acquiring" in node.err or not node.alive, what=lambda: node.err)
    assert node.stop() == 0 and "Traceback" not in node.err


@pytest.mark.exploration
def test_both_packages_in_an_empty_workspace(ros2_env: dict[str, str], tmp_path: Path) -> None:
    """With links, and without the messages that the environment has."""
    env = {
        name: ":".join(entry for entry in value.split(":") if "/packages/rosafe_msgs-" not in entry)
        for name, value in ros2_env.items()
    }
    install = build(env, tmp_path, PACKAGES, "--symlink-install")
    show = "import rosafe.ros2.node as node, rosafe_msgs.msg as msg; print(node.__file__, msg.__file__)"
    node, messages = run(sourced(env, install), "/usr/bin/python3", "-c", show, cwd=tmp_path).split()
    assert Path(node).resolve() == ROOT / "rosafe" / "ros2" / "node.py"
    assert Path(messages).is_relative_to(install / "rosafe_msgs")


def test_manifests_are_complete(ros2_env: dict[str, str], tmp_path: Path) -> None:
    check = (
        "import sys; from catkin_pkg.package import parse_package; warnings = [];"
        "package = parse_package(sys.argv[1], warnings=warnings); package.validate(); print(warnings)"
    )
    for name in ("rosafe_msgs", "rosafe_ros2"):
        assert run(ros2_env, "python3", "-c", check, PACKAGES / name, cwd=tmp_path) == "[]\n"
        assert ElementTree.parse(PACKAGES / name / "package.xml").getroot().get("format") == "3"
    depends = {element.text for element in ElementTree.parse(OWN / "package.xml").iter("exec_depend")}
    sources = "".join(path.read_text("utf-8") for path in [*(ROOT / "rosafe/ros2").glob("*.py"), LAUNCH])
    imported = {
        line.split()[1].partition(".")[0] for line in sources.splitlines() if line.startswith(("from ", "import "))
    }
    ros = {
        name
        for name in imported
        if name.endswith(("_msgs", "_interfaces", "_srvs")) or name.startswith(("rclpy", "launch"))
    }
    assert ros - {"audio_common_msgs"} == depends - {name for name in depends if str(name).startswith("python3-")}


@pytest.mark.parametrize("linter", ["flake8", "pep257", "lint_cmake"])
def test_linters_of_ament(ros2_env: dict[str, str], tmp_path: Path, linter: str) -> None:
    files = {"lint_cmake": [PACKAGES / "rosafe_msgs"]}.get(linter, [OWN / "setup.py", LAUNCH])
    out = run(ros2_env, f"ament_{linter}", *files, cwd=tmp_path)
    assert "No problems found" in out


def launch(monkeypatch: pytest.MonkeyPatch, **given: str) -> tuple[dict[str, str], Any]:
    """Return the arguments of the launch file and the node that it starts, with stand-ins for the package launch."""

    def record(*values: Any, **named: Any) -> SimpleNamespace:
        return SimpleNamespace(values=values, **named)

    modules: dict[str, dict[str, Callable[..., Any]]] = {
        "launch": {"LaunchDescription": record},
        "launch.actions": {"DeclareLaunchArgument": record, "OpaqueFunction": record},
        "launch.substitutions": {"LaunchConfiguration": record},
        "launch_ros": {},
        "launch_ros.actions": {"Node": record},
        # the value has to be a substitution: launch_ros converts no other text to another type
        "launch_ros.parameter_descriptions": {"ParameterValue": lambda value, value_type: (*value.values, value_type)},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    (items,) = runpy.run_path(str(LAUNCH))["generate_launch_description"]().values
    arguments = {one.values[0]: one.default_value for one in items if hasattr(one, "default_value")}
    (function,) = (one.function for one in items if hasattr(one, "function"))
    (node,) = function(SimpleNamespace(launch_configurations={**arguments, **given}))
    return arguments, node


def test_launch_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments that are not given have the defaults of the node; texts are not read as YAML."""
    arguments, node = launch(monkeypatch, device="scene:", localize="true", namespace="robot1")
    assert set(arguments.values()) == {""}
    assert (node.package, node.executable, node.namespace) == ("rosafe_ros2", "rosafe", "robot1")
    assert node.parameters == [{"device": ("device", str), "localize": ("localize", bool)}]
    assert launch(monkeypatch)[1].parameters == [{}]
