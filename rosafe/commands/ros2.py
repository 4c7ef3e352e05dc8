"""Run the node of ROS 2: sound, representations and tracked sources in one process.

The process becomes that of `ros2 run rosafe_ros2 rosafe`, without a workspace: in any shell in which Python finds rclpy
and rosafe_msgs. docs/ros2.md describes the parameters, topics and services of the node.

examples:
  rosafe ros2 --ros-args -p device:=scene: -p localize:=true
  rosafe ros2 --ros-args -p device:=plughw:1,0 -p representations:='[ild, ratemap]' -r __ns:=/robot1"""

from __future__ import annotations

import argparse
import importlib.util
import os
import site
import sys
from pathlib import Path

from rosafe.commands import CommandError
from rosafe.ros1.transport.paths import PYPI_DIR
from rosafe.system import missing

_NODE = "rosafe.ros2.node"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="ARGUMENT",
        help="arguments of ROS 2: -p NAME:=VALUE sets a parameter, -r NAME:=NAME renames",
    )


def run(options: argparse.Namespace) -> int:
    """Become the node."""
    for module in missing.ROS2:
        if importlib.util.find_spec(module) is None:
            raise CommandError(missing.advice(module))
    folder = str(Path(__file__).parents[2])
    environ = {**os.environ, "PYTHONSAFEPATH": "1"}  # without the working directory
    own = [] if folder in site.getsitepackages() else [folder]  # there, messages of ROS 1 could come before the others
    environ["PYTHONPATH"] = os.pathsep.join(filter(None, (*own, environ.get("PYTHONPATH"), str(PYPI_DIR))))
    sys.stdout.flush()
    # A new program, since this one has imported modules of ROS 1
    os.execve(sys.executable, [sys.executable, "-m", _NODE, "--ros-args", *options.ros_args], environ)  # noqa: S606
