"""A session as described in the user guide: a master, the two nodes, and requests by rosservice."""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rosafe import interface
from rosafe.demo.processes import Child, ProcessGroup
from rosafe.demo.sound import DemoSound
from rosafe.ros1.component import generate
from rosafe.ros1.transport.master import PrivateMaster
from rosafe.ros1.transport.paths import CODE_DIR

START_SECONDS = 30.0
REQUEST_SECONDS = 30.0
_RESET = "\x1b[0m"  # end of the colour of a log line of rospy
POLL_SECONDS = 0.02
NODES = {"bass": "bass-ros", "rosAFE": "rosAFE-ros"}
# Name of the processor by kind, as in the user guide.
NAMES = {kind: representation.name for kind, representation in interface.CORE_REPRESENTATIONS.items()}


class DemoError(Exception):
    """The demonstration cannot continue; the text is one line for the user."""


def acquire(sound: DemoSound) -> tuple[str, dict[str, Any]]:
    """Return the request that starts the capture."""
    return (
        "/bass/Acquire",
        {
            "device": sound.device,
            "sampleRate": sound.requested_rate,
            "nFramesPerChunk": sound.frames_per_chunk,
            "nChunksOnPort": 20,
        },
    )


def requests(sound: DemoSound) -> list[tuple[str, dict[str, Any]]]:
    """Return the requests of the user guide, with the parameters that a user is likely to change."""
    return [
        ("/rosAFE/connect_port", {"local": "Audio", "remote": "bass/Audio"}),
        acquire(sound),
        (
            "/rosAFE/InputProc",
            {
                "name": NAMES["input"],
                "nFramesPerBlock": sound.frames_per_block,
                "bufferSize_s_port": 1,
                "bufferSize_s_getSignal": 1,
            },
        ),
        ("/rosAFE/PreProc", {"name": NAMES["preProc"], "upperDepName": NAMES["input"]}),
        (
            "/rosAFE/GammatoneProc",
            {
                "name": NAMES["gammatone"],
                "upperDepName": NAMES["preProc"],
                "fb_lowFreqHz": 80,
                "fb_highFreqHz": int(sound.max_frequency),
                "fb_nERBs": 1,
            },
        ),
        ("/rosAFE/IhcProc", {"name": NAMES["ihc"], "upperDepName": NAMES["gammatone"], "ihc_method": "dau"}),
        *(
            (
                f"/rosAFE/{interface.KINDS[kind].request}",
                {
                    "name": NAMES[kind],
                    "upperDepName": NAMES["ihc"],
                    f"{prefix}_wSizeSec": 0.02,
                    f"{prefix}_hSizeSec": 0.01,
                },
            )
            for kind, prefix in (("ild", "ild"), ("ratemap", "rm"), ("crossCorrelation", "cc"))
        ),
    ]


def command_line(service: str, arguments: Mapping[str, Any]) -> list[str]:
    """Return the command for a request as a list of arguments."""
    yaml = ", ".join(f"{name}: {_yaml(value)}" for name, value in arguments.items())
    return ["rosservice", "call", service, f"{{{yaml}}}"]


def _yaml(value: Any) -> str:
    text = str(value)
    if not isinstance(value, str) or re.fullmatch(r"[A-Za-z]\w*(/\w+)*", text, re.ASCII):
        return text
    return "'" + text.replace("'", "''") + "'"


def shell_command(command: list[str]) -> str:
    """Return the command as typed in a shell, with double quotes if the argument allows them."""
    argument = command[-1]
    if set('"$`\\!') & set(argument):
        return shlex.join(command)
    return " ".join([*command[:-1], f'"{argument}"'])


class DemoSession:
    """A private master with both nodes in their own environment. `close` ends all of them.

    Parameters
    ----------
    folder : str
        Folder for log files.
    check : callable
        Called repeatedly while waiting; may raise an exception to end the wait.

    Raises
    ------
    DemoError, generate.GenerationError
        The nodes cannot start.
    """

    def __init__(self, folder: str, check: Callable[[], None]) -> None:
        self._check = check
        # The session must not connect to another graph of the user.
        for name in [name for name in os.environ if name.startswith("ROS_")]:
            del os.environ[name]
        os.environ.update(ROS_IP="127.0.0.1", ROS_LOG_DIR=folder, ROS_HOME=folder, **generate.environment())
        os.environ["PATH"] = f"{CODE_DIR / 'scripts'}:/usr/local/bin:/usr/bin:/bin:{os.environ.get('PATH', '')}"
        generate.ensure_messages()
        self._master = PrivateMaster()
        self.uri = os.environ["ROS_MASTER_URI"] = self._master.uri
        self._children = ProcessGroup(os.environ)
        self.nodes: dict[str, Child] = {}
        self._joined = False
        self._ending = False  # the nodes are expected to end

    def start_nodes(self) -> None:
        """Start both nodes and wait until their services are registered."""
        for name, script in NODES.items():
            self.nodes[name] = self._children.start(script)
        self.wait(self._has_all_services, START_SECONDS, "the nodes do not start")

    def join(self) -> None:
        """Make this process a node of the session."""
        import rospy

        self._joined = True
        rospy.init_node("rosafe_demo", argv=["rosafe_demo"], disable_signals=True, log_level=rospy.FATAL)

    def _has_all_services(self) -> bool:
        """Return whether all services of both nodes are registered."""
        import rosgraph

        registered = {service for service, _ in rosgraph.Master("/rosafe_demo").getSystemState()[2]}
        expected = {f"/{component.name}/{service.name}" for component, service in interface.all_services()}
        return expected <= registered

    def wait(self, condition: Callable[[], bool], seconds: float, error: str) -> None:
        """Wait for `condition`; raise DemoError(`error`) after `seconds`, or another DemoError if a node ends."""
        deadline = time.monotonic() + seconds
        while not condition():
            self.check_nodes()
            if time.monotonic() > deadline:
                raise DemoError(error)
            time.sleep(POLL_SECONDS)

    def check_nodes(self) -> None:
        """Raise DemoError if a node has ended."""
        self._check()
        for name, child in self.nodes.items():
            if child.has_ended() and not self._ending:
                code = child.process.returncode
                how = f"was killed by signal {-code}" if code < 0 else f"has ended with exit code {code}"
                lines = child.err.strip().splitlines()
                raise DemoError(f"{NODES[name]} {how}" + (f": {lines[-1]}" if lines else ""))

    def request(self, service: str, arguments: Mapping[str, Any], show: Callable[[str], None]) -> None:
        """Send a request with rosservice and print its command; raise DemoError if it is rejected."""
        self.request_parallel([(service, arguments)], show)

    def request_parallel(self, steps: Sequence[tuple[str, Mapping[str, Any]]], show: Callable[[str], None]) -> None:
        """Send requests that are independent of each other at the same time."""
        calls = []
        for service, arguments in steps:
            command = command_line(service, arguments)
            show(shell_command(command))
            calls.append((service, self._children.start(*command)))
        for service, call in calls:
            self.wait(call.has_ended, REQUEST_SECONDS, f"{service} does not answer")
            if call.process.returncode != 0 or "genom_success: True" not in call.out:
                raise DemoError(f"{service} failed: {self._reason(service, call)}")

    def _reason(self, service: str, call: Child) -> str:
        """Return why a request failed in one line: the log of the node, which has more details than the answer."""
        _, component, request = service.split("/")
        logged = re.findall(rf"{request}: (::.*)", self.nodes[component].err)
        if logged:
            return str(logged[-1]).removesuffix(_RESET)
        lines = (call.err.strip() or call.out.strip()).splitlines()
        return " ".join(lines) if lines else f"exit code {call.process.returncode}"

    def capture_error(self) -> str:
        """Return why the capture has failed; empty if it has reached the end of its source."""
        failures = re.findall(r"\[ERROR\].*the acquisition has ended: (.*)", self.nodes["bass"].err)
        return failures[-1].removesuffix(_RESET) if failures else ""

    def kill_nodes(self, show: Callable[[str], None]) -> None:
        """Ask both nodes to end; `close` waits for them."""
        self._ending = True
        self.request_parallel([(f"/{name}/kill", {}) for name in NODES], show)

    def close(self) -> None:
        """End the nodes, the requests and the master."""
        self._children.close()
        if self._joined:
            import rospy

            rospy.signal_shutdown("the demonstration is over")
        self._master.close()
