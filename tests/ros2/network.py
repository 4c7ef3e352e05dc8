"""A network and a shared memory of their own for the ROS 2 programs of a test: nothing leaves the machine."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from tests.harness import PYTHON, SCRIPTS, Process, proc

INSTALLED = Path(os.environ.get("ROSAFE_ROS2", "/usr/local/lib/rosafe/ros2"))  # the folder given to scripts/ros2-env
_OTHER_USER = () if os.getuid() == 0 else ("--user",)
_PREPARE = (
    "mount -t tmpfs none /dev/shm && ip link set lo up && ip link set lo multicast on && "
    "ip route add 224.0.0.0/4 dev lo && echo ready && exec cat"
)


@cache
def variables() -> dict[str, str] | str:
    """Return the environment of ROS 2, or the reason why it is not there."""
    check = subprocess.run([SCRIPTS / "ros2-env", "--check", INSTALLED], capture_output=True, text=True, check=False)
    if check.returncode != 0:
        return f"ROS 2 is not installed in {INSTALLED}, or is outdated; run scripts/install --tests"
    shell = [
        "env",
        "-i",
        f"HOME={INSTALLED}",
        "PATH=/usr/sbin:/usr/bin:/sbin:/bin",
        "bash",
        "-c",
        f"{check.stdout}\nenv -0",
    ]
    found = subprocess.run(shell, capture_output=True, text=True, check=True).stdout
    env = dict(entry.split("=", 1) for entry in found.strip("\0").split("\0"))
    if options := os.environ.get("COVERAGE_PROCESS_START"):  # of scripts/test --coverage
        env |= {name: value for name, value in os.environ.items() if name.startswith("COVERAGE_")}
        env["PYTHONPATH"] = f"{Path(options).parent}:{env['PYTHONPATH']}"
    return env


class Network:
    """A network with only a loopback interface. `env` has the variables of its programs."""

    def __init__(self, env: dict[str, str], home: Path, pid: int) -> None:
        self.env = env | {"HOME": str(home), "ROS_LOG_DIR": str(home / "log")}
        self._enter = [
            "nsenter",
            *(_OTHER_USER and ("--user", "--preserve-credentials")),
            "--net",
            "--mount",
            "-t",
            str(pid),
        ]
        self._processes: list[Process] = []

    def start(self, *command: str | Path, **env: str) -> Process:
        """Start a program, which ends with the test at the latest."""
        process = Process([*self._enter, *map(str, command)], self.env | env, fork=False)
        self._processes.append(process)
        return process

    def python(self, code: str, *arguments: str, **env: str) -> Process:
        """Start a Python program with rclpy and the messages, and without the checkout."""
        return self.start(PYTHON, "-u", "-c", code, *arguments, **env)

    def node(self, *parameters: str, arguments: tuple[str, ...] = (), **env: str) -> Process:
        """Start the node with parameters as in ``device:=scene:``, and further arguments of ROS."""
        given = [word for parameter in parameters for word in ("-p", parameter)]
        return self.start(SCRIPTS / "rosafe", "ros2", "--ros-args", *given, *arguments, **env)

    @property
    def errors(self) -> str:
        """The standard error output of all programs."""
        return "".join(process.err for process in self._processes)

    def close(self) -> None:
        """End all programs."""
        for process in self._processes:
            process.close()


@contextmanager
def network(env: dict[str, str], home: Path) -> Iterator[Network]:
    """Create a network, and remove it with all its programs."""
    proc()  # nsenter finds the network there
    unshare = ["unshare", *(_OTHER_USER and ("--user", "--map-root-user")), "--net", "--mount", "sh", "-c", _PREPARE]
    with subprocess.Popen(unshare, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdin is not None and holder.stdout is not None
        assert holder.stdout.readline() == "ready\n", "expected a network namespace; see docs/ros2.md"
        created = Network(env, home, holder.pid)
        try:
            yield created
        finally:
            created.close()
            holder.stdin.close()
