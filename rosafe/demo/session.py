"""One session as the user guide describes it: a master, the two nodes, and requests by rosservice."""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any

from rosafe import interface
from rosafe.component import generate
from rosafe.demo.processes import Child, ProcessGroup
from rosafe.demo.sound import DemoSound
from rosafe.transport.master import PrivateMaster
from rosafe.transport.paths import CODE_DIR

START_SECONDS = 30.0
REQUEST_SECONDS = 30.0
_RESET = "\x1b[0m"  # rospy's log lines are coloured
POLL_SECONDS = 0.02
NODES = {"bass": "bass-ros", "rosAFE": "rosAFE-ros"}
# From kind of processor to the name that it gets: those of the guide.
NAMES = {kind: representation.name for kind, representation in interface.CORE_REPRESENTATIONS.items()}


class DemoError(Exception):
    """The demonstration cannot go on; the text is the one line that the user gets."""


def acquire(sound: DemoSound) -> tuple[str, dict[str, Any]]:
    """The request that starts the sound."""
    return (
        "/bass/Acquire",
        {
            "device": sound.device,
            "sampleRate": sound.asked_rate,
            "nFramesPerChunk": sound.frames_per_chunk,
            "nChunksOnPort": 20,
        },
    )


def requests(sound: DemoSound) -> list[tuple[str, dict[str, Any]]]:
    """The guide's requests in its order, with the parameters that a user is likely to change."""
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
                "fb_highFreqHz": int(sound.highest_frequency),
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
    """The command for a request; `shlex.join` makes of it what a user types."""
    yaml = ", ".join(f"{name}: {_yaml(value)}" for name, value in arguments.items())
    return ["rosservice", "call", service, f"{{{yaml}}}"]


def _yaml(value: Any) -> str:
    text = str(value)
    if not isinstance(value, str) or re.fullmatch(r"[A-Za-z]\w*(/\w+)*", text, re.ASCII):
        return text
    return "'" + text.replace("'", "''") + "'"


def shown(command: list[str]) -> str:
    """The command as it is typed, in double quotes where that reads better than the shell's own way."""
    argument = command[-1]
    if set('"$`\\!') & set(argument):
        return shlex.join(command)
    return " ".join([*command[:-1], f'"{argument}"'])


class DemoSession:
    """A private master with both nodes on it, in an environment of their own. Everything ends with `close`.

    Parameters
    ----------
    folder : str
        For log files.
    check : callable
        Called often while waiting; may raise to end that.

    Raises
    ------
    DemoError, generate.GenerationError
        The nodes cannot start.
    """

    def __init__(self, folder: str, check: Callable[[], None]) -> None:
        self._check = check
        # Nothing of a graph that the user may be working on: this one is apart.
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
        self._ending = False  # that they end is no accident any more

    def start_nodes(self) -> None:
        """Start both nodes and wait until they serve."""
        for name, script in NODES.items():
            self.nodes[name] = self._children.start(script)
        self.wait(self._served, START_SECONDS, "the nodes do not start")

    def join(self) -> None:
        """Make this process a node of the session."""
        import rospy

        self._joined = True
        rospy.init_node("rosafe_demo", argv=["rosafe_demo"], disable_signals=True, log_level=rospy.FATAL)

    def _served(self) -> bool:
        """Whether all services of both nodes are there."""
        import rosgraph

        served = {service for service, _ in rosgraph.Master("/rosafe_demo").getSystemState()[2]}
        wanted = {f"/{component.name}/{service.name}" for component, service in interface.all_services()}
        return wanted <= served

    def wait(self, condition: Callable[[], bool], seconds: float, otherwise: str) -> None:
        """Wait for `condition`; DemoError saying `otherwise` after so many seconds, or where a node ends."""
        deadline = time.monotonic() + seconds
        while not condition():
            self.check_nodes()
            if time.monotonic() > deadline:
                raise DemoError(otherwise)
            time.sleep(POLL_SECONDS)

    def check_nodes(self) -> None:
        """DemoError where a node has ended."""
        self._check()
        for name, child in self.nodes.items():
            if child.has_ended() and not self._ending:
                code = child.process.returncode
                how = f"was killed by signal {-code}" if code < 0 else f"has ended with exit code {code}"
                lines = child.err.strip().splitlines()
                raise DemoError(f"{NODES[name]} {how}" + (f": {lines[-1]}" if lines else ""))

    def request(self, service: str, arguments: Mapping[str, Any], say: Callable[[str], None]) -> None:
        """Make one request with rosservice, telling its command line; DemoError where it is refused."""
        self.requests_together([(service, arguments)], say)

    def requests_together(self, wanted: Sequence[tuple[str, Mapping[str, Any]]], say: Callable[[str], None]) -> None:
        """Make requests that do not depend on each other at the same time."""
        calls = []
        for service, arguments in wanted:
            command = command_line(service, arguments)
            say(shown(command))
            calls.append((service, self._children.start(*command)))
        for service, call in calls:
            self.wait(call.has_ended, REQUEST_SECONDS, f"{service} does not answer")
            if call.process.returncode != 0 or "genom_success: True" not in call.out:
                raise DemoError(f"{service} was refused: {self._reason(service, call)}")

    def _reason(self, service: str, call: Child) -> str:
        """Why, in one line: what the node logged, which says more than what is on the wire."""
        _, component, request = service.split("/")
        told = re.findall(rf"{request}: (::.*)", self.nodes[component].err)
        if told:
            return str(told[-1]).removesuffix(_RESET)
        lines = (call.err.strip() or call.out.strip()).splitlines()
        return " ".join(lines) if lines else f"exit code {call.process.returncode}"

    def why_silent(self) -> str:
        """What bass said of an acquisition that failed; empty where it came to the end of its source."""
        failures = re.findall(r"\[ERROR\].*the acquisition has ended: (.*)", self.nodes["bass"].err)
        return failures[-1].removesuffix(_RESET) if failures else ""

    def kill_nodes(self, say: Callable[[str], None]) -> None:
        """Ask both nodes to end; `close` waits for it."""
        self._ending = True
        self.requests_together([(f"/{name}/kill", {}) for name in NODES], say)

    def close(self) -> None:
        """End everything, whatever state it is in."""
        self._children.close()
        if self._joined:
            import rospy

            rospy.signal_shutdown("the demonstration is over")
        self._master.close()

    def __enter__(self) -> DemoSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
