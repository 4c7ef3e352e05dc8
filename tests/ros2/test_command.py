"""`rosafe ros2` and `rosafe doctor`: what is missing, the process that they become, and its modules."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from tests.commands.command import rosafe
from tests.harness import PYTHON, ROOT, SCRIPTS, Process, wait_for

from .network import Network

# Python imports it at its start, and it lists the modules at the end of the process.
LIST_MODULES = """
import json, os, sys
def end(code, end=os._exit):
    files = {name: str(getattr(module, "__file__", "")) for name, module in list(sys.modules.items())}
    files["threads"] = os.environ.get("OPENBLAS_NUM_THREADS", "")
    with open(os.environ["MODULES"], "w") as file:
        json.dump(files, file)
    end(code)
if "rosafe.ros2.node" in sys.orig_argv:
    os._exit = end
"""


def test_what_is_missing_is_one_line(tmp_path: Path) -> None:
    done = rosafe("ros2", "--ros-args", "-p", "device:=scene:")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("rosafe ros2: the Python package rclpy is not installed; ")
    assert done.stderr.count("\n") == 1
    (tmp_path / "rclpy.py").touch()
    done = rosafe("ros2", PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(
        "rosafe ros2: the Python package rosafe_msgs is not installed; build it with `colcon "
    )
    assert done.stderr.count("\n") == 1


def test_help_and_wrong_arguments() -> None:
    done = rosafe("ros2", "--help")
    assert done.returncode == 0 and "rosafe ros2 --ros-args -p device:=scene:" in done.stdout
    done = rosafe("ros2", "scene:")
    assert done.returncode == 2 and "scene:" in done.stderr


def test_doctor_reports_on_ros_2(ros2_env: dict[str, str]) -> None:
    def check(env: dict[str, str]) -> dict[str, str]:
        doctor = Process([str(SCRIPTS / "rosafe"), "doctor", "--json"], env, fork=False)
        doctor.wait()
        report = json.loads(doctor.out)
        states = {one["name"]: one for one in report["checks"]}
        assert all(one["state"] != "MISSING" for one in states.values()), states
        return dict(states["ROS 2"])

    path = {"PATH": "/usr/bin:/bin", "HOME": "/nonexistent"}
    without = check(path)
    assert (without["state"], without["detail"]) == ("note", "needed only by rosafe ros2: no rclpy in this shell")
    found = check(ros2_env | path)
    assert found["state"] == "ok" and "rmw_fastrtps_cpp" in found["detail"] and "rosafe_msgs" in found["detail"]


SIGNALS = """
import os, random, signal, threading
from rosafe.ros2 import node
node.SIGNAL_SECONDS = 0.002  # otherwise the time of each wait
for _ in range(500):
    child = os.fork()
    if not child:
        with node._signals() as received:
            signal.signal(signal.SIGALRM, signal.getsignal(signal.SIGTERM))
            signal.setitimer(signal.ITIMER_REAL, 1e-6 * random.uniform(5, 250))
            node._wait(received, threading.Event())
        os.kill(os.getpid(), signal.SIGTERM)  # another one
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
print("all have ended")
"""


def test_a_signal_at_the_start_of_the_wait_for_it(ros2: Network) -> None:
    """A handler could need a lock of the interrupted wait, or be called when the system call has not begun yet."""
    process = ros2.start(PYTHON, "-c", SIGNALS, PYTHONPATH=os.pathsep.join((str(ROOT), ros2.env["PYTHONPATH"])))
    assert process.wait() == 0 and process.out == "all have ended\n", process


def test_no_module_of_ros_1(ros2: Network, tmp_path: Path) -> None:
    """The node is a process without any module of ROS 1, though the command and this machine have them."""
    (tmp_path / "sitecustomize.py").write_text(LIST_MODULES)
    modules = tmp_path / "modules.json"
    path = os.pathsep.join((str(tmp_path), ros2.env["PYTHONPATH"]))
    node = ros2.node("device:=scene:", "representations:=[ild]", PYTHONPATH=path, MODULES=str(modules))
    wait_for(lambda: "acquiring" in node.err or not node.alive, what=lambda: node.err)
    began = time.monotonic()
    assert node.stop() == 0, node.err
    assert time.monotonic() - began < 20  # 2 s on a machine without other work
    assert "Traceback" not in node.err
    found = json.loads(modules.read_text())
    assert found["threads"] == "1"  # of small matrices, for which more threads cost more
    assert found["__main__"].endswith("/rosafe/ros2/node.py") and "rclpy" in found
    for name in (
        "rospy",
        "rosgraph",
        "genpy",
        "genmsg",
        "roslib",
        "actionlib",
        "rosAFE",
        "bass",
        "rosafe.ros1",
        "rosafe.web",
    ):
        assert name not in found
    venv = ros2.env["PATH"].split(":")[0].removesuffix("/bin")
    for name in ("std_msgs", "geometry_msgs", "diagnostic_msgs", "tf2_msgs"):
        assert Path(found[name]).is_relative_to(Path(venv).parent), found[name]


@pytest.mark.parametrize(
    ("parameter", "why"), [("devise:=scene", "did you mean device"), ("seconds:={", "Couldn't parse parameter")]
)
def test_wrong_parameters_are_one_line(ros2: Network, parameter: str, why: str) -> None:
    node = ros2.node(parameter)
    assert node.wait() == 1
    lines = [line for line in node.err.splitlines() if "[rcl]" not in line]
    assert len(lines) == 1 and lines[0].startswith("rosafe: ") and why in lines[0], node.err
