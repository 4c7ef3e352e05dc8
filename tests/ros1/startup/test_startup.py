"""Start and end of both nodes: options, names, signals, background, a missing or silent master, takeover."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
import rospy
from diagnostic_msgs.msg import DiagnosticArray

from rosafe import __version__
from rosafe.ros1.transport import systemd
from tests.harness import SCRIPTS, Graph, MasterProcess, Process, free_port, wait_for
from tests.packaging.clone import fresh_copy, without_rights

PROGRAMS = pytest.mark.parametrize("program", ["rosAFE-ros", "bass-ros"])
FORKS = pytest.mark.forks  # the start of the process does not matter


@contextmanager
def silent_port() -> Iterator[int]:
    """A port that accepts connections and never answers."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(8)
        yield listener.getsockname()[1]


@contextmanager
def web_server() -> Iterator[int]:
    """A port at which a web server answers instead of a ROS master."""
    server = HTTPServer(("127.0.0.1", 0), type("Quiet", (BaseHTTPRequestHandler,), {"log_message": lambda *a: None}))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


# --- the command line -------------------------------------------------------------------------------------------


@PROGRAMS
def test_help_and_version(graph: Graph, program: str) -> None:
    text = graph.run(program, "-h").stdout
    assert f"{program} -b -i left" in text
    for option in ("--background", "--instance", "--name", "--version", "__ip"):
        assert option in text
    assert graph.run(program, "--version").stdout == f"{program.removesuffix('-ros')} {__version__}\n"


@FORKS
@pytest.mark.parametrize(
    ("program", "argument"),
    [("rosAFE-ros", "--frobnicate"), ("bass-ros", "-i"), ("rosAFE-ros", "stray"), ("bass-ros", "--back")],
)
def test_wrong_option(graph: Graph, program: str, argument: str) -> None:
    done = graph.run(program, argument, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{program}: ") and done.stderr.count("\n") == 1
    assert f"{program} -h" in done.stderr


@FORKS
@pytest.mark.parametrize("name", ["", "1left", "left ear", "a/b", "/left", "höhe", "a-b", "~x", "x" * 300 + "!"])
def test_wrong_instance_name(graph: Graph, name: str) -> None:
    arguments = [f"__name:={name}"] if name == "a-b" else ["-i", name]
    done = graph.run("bass-ros", *arguments, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "instance name: expected" in done.stderr and done.stderr.count("\n") == 1


# --- workers ---------------------------------------------------------------------------------------------------


def test_number_of_workers(graph: Graph) -> None:
    """The node's own parameter has priority over the environment; without it, see tests/tree/test_workers.py."""
    graph.client()
    rospy.set_param("/few/workers", 3)
    with (
        graph.node("rosAFE-ros", "-i", "few", ROSAFE_WORKERS="2"),
        graph.collect("/diagnostics", DiagnosticArray) as messages,
    ):
        wait_for(lambda: ("few", "3") in reported_workers(messages), what=lambda: str(messages))
    rospy.delete_param("/few/workers")


def reported_workers(messages: list[Any]) -> set[tuple[str, str]]:
    """Return instance and number of workers in all messages."""
    return {
        (status.name.split(":")[0].strip("/ "), value.value)
        for message in messages
        for status in message.status
        for value in status.values
        if value.key == "workers"
    }


@FORKS
@pytest.mark.parametrize("number", [0, True, [1, 2]])
def test_wrong_number_of_workers(graph: Graph, number: Any) -> None:
    graph.client()
    rospy.set_param("/wrong/workers", number)
    done = graph.run("rosAFE-ros", "-i", "wrong", check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "/wrong/workers: workers: " in done.stderr and "from 1 to 1024" in done.stderr
    assert done.stderr.count("\n") == 1


# --- no master --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masterless(graph: Graph) -> Iterator[dict[str, Process]]:
    """Nodes without a master, for different reasons; started together, because each waits for a while."""
    with silent_port() as silent, web_server() as web, ExitStack() as stack:

        def start(program: str, port: int, *options: str) -> Process:
            uri = f"http://127.0.0.1:{port}"
            return stack.enter_context(graph.start(program, *options, ROS_MASTER_URI=uri))

        yield {
            "rosAFE": start("rosAFE-ros", free_port()),
            "bass": start("bass-ros", free_port()),
            "background": start("bass-ros", free_port(), "-b"),
            "silent": start("bass-ros", silent),
            "web": start("bass-ros", web),
        }


def error_line(node: Process) -> str:
    """Return the single line of a node that cannot start."""
    assert node.wait() == 1
    assert node.out == ""
    assert re.fullmatch(r"(rosAFE|bass)-ros: .*\n", node.err), node
    return node.err


@FORKS
@pytest.mark.parametrize("which", ["rosAFE", "bass", "background"])
def test_no_master(masterless: dict[str, Process], which: str) -> None:
    assert re.search(r"no ROS master at http://127\.0\.0\.1:\d+ .*start roscore first", error_line(masterless[which]))


@FORKS
def test_silent_master(masterless: dict[str, Process]) -> None:
    assert "no answer" in error_line(masterless["silent"])


@FORKS
def test_a_web_server_at_the_masters_port(masterless: dict[str, Process]) -> None:
    assert "not a ROS master" in error_line(masterless["web"])


@FORKS
@pytest.mark.parametrize(
    "uri", ["nonsense", "http://127.0.0.1", "http://127.0.0.1:99999", "ftp://127.0.0.1:1", "http://[::1"]
)
def test_invalid_master_address(graph: Graph, uri: str) -> None:
    with graph.start("bass-ros", ROS_MASTER_URI=uri) as node:
        assert "ROS_MASTER_URI" in error_line(node)


@FORKS
def test_waiting_for_a_master(private_graph: tuple[Graph, MasterProcess]) -> None:
    """Nodes with --wait wait longer than the default and then start; without it they do not."""
    graph, master = private_graph
    master.kill()
    with (
        graph.start("rosAFE-ros", "--wait") as afe,
        graph.start("bass-ros", "--wait", "-b") as bass,
        graph.start("bass-ros", "-i", "hasty") as hasty,
        graph.start("bass-ros", "-i", "stopped", "--wait") as stopped,
    ):
        assert "start roscore first" in error_line(hasty), "the nodes with --wait have waited for the same time"
        line = f"waiting for a ROS master at {graph.uri}"
        for node in (afe, bass, stopped):
            wait_for(lambda: line in node.err, what=lambda: str(node))  # noqa: B023
            assert node.alive and node.err.count("\n") == 1, node
        assert stopped.stop(signal.SIGTERM) == 0
        master.start(graph.env)
        wait_for(lambda: {"/rosAFE/Stop", "/bass/Stop"} <= graph.services(), what=lambda: f"{afe} {bass}")
        assert bass.wait() == 0, "the command returns when the node has started"
        assert "Traceback" not in afe.err + bass.err
        done = graph.run("rosservice", "call", "/bass/kill")
        assert "genom_success: True" in done.stdout


@FORKS
def test_waiting_for_a_silent_master_can_be_interrupted(graph: Graph) -> None:
    with silent_port() as port, graph.start("bass-ros", "--wait", ROS_MASTER_URI=f"http://127.0.0.1:{port}") as node:
        wait_for(lambda: "waiting" in node.err, what=lambda: str(node))
        assert node.stop(signal.SIGINT) == 0
        assert node.err.count("\n") == 1, node


# --- systemd ----------------------------------------------------------------------------------------------------


@contextmanager
def notified(address: str) -> Iterator[list[str]]:
    """Receive the datagrams of a service."""
    messages: list[str] = []

    def receive() -> None:
        while (data := receiver.recv(4096)) != b"end":
            messages.append(data.decode())

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(address)
        thread = threading.Thread(target=receive)
        thread.start()
        try:
            yield messages
        finally:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(b"end", address)
            thread.join()


def test_services_wait_for_a_master_and_notify_the_watchdog(
    private_graph: tuple[Graph, MasterProcess], tmp_path: Path
) -> None:
    """The commands of the units in systemd/. The watchdog is notified also when the master is lost."""
    graph, master = private_graph
    master.kill()

    def wait_until_sent(text: str, times: int) -> None:
        """Wait until each service has sent a text the given number of times."""
        wait_for(
            lambda: all(messages.count(text) >= times for _, messages in services),
            what=lambda: f"{times} times {text} of {services}",
        )

    with ExitStack() as stack:
        services = []
        for number, command in enumerate((("bass-ros",), ("rosafe", "localize"))):
            address = str(tmp_path / f"notify{number}")
            messages = stack.enter_context(notified(address))
            process = stack.enter_context(graph.start(*command, "--wait", NOTIFY_SOCKET=address))
            services.append((process, messages))
        wait_until_sent(f"STATUS=waiting for a ROS master at {graph.uri}\nEXTEND_TIMEOUT_USEC=30000000", 2)
        master.start(graph.env)
        wait_until_sent("READY=1", 1)
        wait_until_sent("WATCHDOG=1", 3)
        master.kill()
        for process, _ in services:
            wait_for(lambda: "no answer from the ROS master" in process.err)  # noqa: B023
        wait_until_sent("WATCHDOG=1", 3 + max(messages.count("WATCHDOG=1") for _, messages in services))
        for process, messages in services:
            assert process.stop(signal.SIGTERM) == 0
            assert [one for one in messages if one != "WATCHDOG=1"][-2:] == ["READY=1", "STOPPING=1"]


@FORKS
@pytest.mark.parametrize("abstract", [True, False])
def test_abstract_and_missing_notification_addresses(graph: Graph, abstract: bool) -> None:
    name = f"rosafe-test-{os.getpid()}"
    with notified(f"\0{name}") as messages:
        given = f"@{name}" if abstract else "/nowhere/at/all"
        with graph.node("bass-ros", "-i", "notifying", NOTIFY_SOCKET=given) as process:
            assert process.stop(signal.SIGTERM) == 0 and process.complaints == ""
    assert {"READY=1", "STOPPING=1"} <= set(messages) if abstract else not messages


def test_the_interval_of_the_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    for pid in ("", str(os.getpid()), "1"):
        monkeypatch.setenv("WATCHDOG_PID", pid)
        for text, seconds in {"3000000": 3.0, "": None, "0": None, "-5": None, "2e6": None, "²": None}.items():
            monkeypatch.setenv("WATCHDOG_USEC", text)
            assert systemd.watchdog_seconds() == (None if pid == "1" else seconds)


# --- an unreachable address --------------------------------------------------------------------------------------


@FORKS
@pytest.mark.parametrize(
    ("program", "ip", "hostname", "remapping", "why"),
    [
        ("rosAFE-ros", "203.0.113.7", "", "", "ROS_IP is 203.0.113.7, which is not an address of this machine"),
        ("bass-ros", "127.0.0.1", "unknown.invalid", "", "ROS_HOSTNAME is unknown.invalid, neither an address nor"),
        ("bass-ros", "127.0.0.1", "", "__ip:=203.0.113.8", "ROS_IP is 203.0.113.8, which is not an address of this"),
        ("bass-ros", "127.3.2.1", "", "", ""),
        ("rosAFE-ros", "203.0.113.7", "localhost", "", ""),
    ],
)
def test_an_unreachable_address_is_reported(
    graph: Graph, program: str, ip: str, hostname: str, remapping: str, why: str
) -> None:
    """In one line; the node starts nevertheless."""
    name = f"at_{program.partition('-')[0]}"
    with graph.node(program, "-i", name, *filter(None, [remapping]), ROS_IP=ip, ROS_HOSTNAME=hostname) as node:
        if why:
            assert node.err.startswith(f"{program}: warning: {why}") and "set it to 127.0.0.1" in node.err
            assert node.complaints.count("\n") == 1
        else:
            assert node.complaints == ""
        wait_for(lambda: node.err.endswith(f"{program}: ready as /{name} at {graph.uri}\n"), what=lambda: str(node))


@FORKS
@pytest.mark.parametrize(
    ("command", "ip", "ipv6"),
    [
        ("rosAFE-ros", "::1", ""),
        ("bass-ros -b", "::1", "on"),
        ("bass-ros __ip:=fe80::1%lo", "", ""),
        ("rosafe localize", "fd00::1", ""),
        ("genomixd -p 0", "[::1]", ""),
        ("rosafe live --port 0", "::ffff:127.0.0.1", ""),
        ("rosafe record", "::1", ""),
        ("rosafe up", "::1", ""),
    ],
)
def test_ipv6_addresses_are_refused(graph: Graph, command: str, ip: str, ipv6: str) -> None:
    """rospy would register a URI that no client can parse."""
    done = graph.run(*command.split(), check=False, ROS_IP=ip, ROS_IPV6=ipv6)
    assert done.returncode == 1 and "expected an IPv4 address or a name" in done.stderr, done
    assert done.stderr.count("\n") == 1 and "set it to an IPv4 address, or set ROS_IPV6=on" in done.stderr


def test_without_an_address_nodes_work_with_ipv6(graph: Graph) -> None:
    with graph.node("bass-ros", "-i", "sixth", ROS_IP="", ROS_IPV6="on"):
        assert graph.call("/sixth/getAcquisition").genom_success


# --- up and down ------------------------------------------------------------------------------------------------


@FORKS
@pytest.mark.parametrize(
    ("program", "number"),
    [("rosAFE-ros", signal.SIGINT), ("rosAFE-ros", signal.SIGTERM), ("bass-ros", signal.SIGHUP)],
)
def test_a_signal_ends_a_node_cleanly(graph: Graph, program: str, number: int) -> None:
    name = f"/{program.removesuffix('-ros')}"
    with graph.node(program) as node:
        assert node.stop(number) == 0
        assert name not in graph.nodes()
        assert "Traceback" not in node.err


@FORKS
@PROGRAMS
def test_a_kill_request_ends_a_node(graph: Graph, program: str) -> None:
    name = program.removesuffix("-ros")
    with graph.node(program) as node:
        assert graph.call(f"/{name}/kill").genom_success
        assert node.wait() == 0
        assert f"/{name}" not in graph.nodes()


@FORKS
def test_rosnode_kill_ends_a_node(graph: Graph) -> None:
    with graph.node("bass-ros") as node:
        graph.run("rosnode", "kill", "/bass")
        assert node.wait() == 0


def test_nohup_is_respected(graph: Graph) -> None:
    with graph.start("nohup", "bass-ros", "-i", "lasting") as node:
        graph.wait_until_up(node, "bass", "lasting")
        os.kill(node.pid, signal.SIGHUP)
        assert graph.call("/lasting/Acquire", device="scene:", sampleRate=20000).genom_success
        graph.message("/lasting/Audio", accept=lambda message: message.lastFrameIndex > 30000)  # it would have ended
        assert node.alive
        assert node.stop(signal.SIGTERM) == 0


def test_a_script_may_start_a_node_in_the_background(graph: Graph) -> None:
    """In a script, a command with `&` ignores SIGINT."""
    with graph.start("sh", "-c", "trap '' INT QUIT; exec bass-ros") as node:
        wait_for(lambda: "/bass/kill" in graph.services(), what=lambda: str(node))
        assert node.signal_until_end(signal.SIGINT) == 0


def test_the_shells_process_is_the_node(graph: Graph) -> None:
    """Not its child. Its standard output is for the output of requests."""
    with graph.node("bass-ros") as node:
        assert f"Pid: {node.pid}\n" in graph.run("rosnode", "info", "/bass").stdout
        node.stop()
        assert node.out == ""


# --- names ------------------------------------------------------------------------------------------------------


@FORKS
@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["-i", "left"], "/left"),
        (["--name", "left"], "/left"),
        (["--instance=left"], "/left"),
        (["-i", "right", "__name:=left"], "/left"),
        (["-i", "left", "__ns:=/robot"], "/robot/left"),
    ],
)
def test_instance(graph: Graph, arguments: list[str], name: str) -> None:
    with graph.start("bass-ros", *arguments) as node:
        wait_for(lambda: f"{name}/kill" in graph.services(), what=lambda: str(node))
        assert not any(service.startswith("/bass/") for service in graph.services())
        assert node.stop() == 0


@FORKS
def test_master_and_address_by_remapping(graph: Graph) -> None:
    command = ["bass-ros", "-i", "mapped", f"__master:={graph.uri}", "__ip:=127.0.0.2"]
    with graph.start(*command, ROS_MASTER_URI="http://127.0.0.1:1", ROS_IP="") as node:
        wait_for(lambda: "/mapped/kill" in graph.services(), what=lambda: str(node))
        assert "127.0.0.2" in graph.run("rosservice", "uri", "/mapped/kill").stdout


# --- background -------------------------------------------------------------------------------------------------


def test_a_background_node_has_started_when_the_command_returns(graph: Graph) -> None:
    done = graph.run("bass-ros", "-b", "-i", "behind")  # returns although stdout is a pipe that the node could hold
    try:
        assert (done.stdout, done.returncode) == ("", 0)
        assert "/behind/kill" in graph.services()
    finally:
        graph.run("rosservice", "call", "/behind/kill", "{}")
    wait_for(lambda: "/behind" not in graph.nodes())


def test_background_keeps_writing_to_a_file(graph: Graph, tmp_path: Path) -> None:
    log = tmp_path / "log"
    graph.run("/bin/sh", "-c", f"bass-ros -b -i logged >{log} 2>&1")
    try:
        graph.run("rosservice", "call", "/logged/connect_port", "{local: a, remote: b}")
        wait_for(lambda: "no_such_inport" in log.read_text(), what=log.read_text)
    finally:
        graph.run("rosservice", "call", "/logged/kill", "{}")


# --- surroundings -----------------------------------------------------------------------------------------------


def test_a_missing_package_is_named(graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "rospy.py").write_text("raise ModuleNotFoundError('none', name='rospy')")
    done = graph.run("bass-ros", check=False, PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert done.stderr == "bass-ros: the Python package rospy is not installed; run scripts/install\n"


def test_symbolic_link_elsewhere(graph: Graph, tmp_path: Path) -> None:
    link = tmp_path / "bass"
    link.symlink_to(SCRIPTS / "bass-ros")
    done = graph.run(str(link), "--version", PYTHONPATH="", PATH="/usr/bin:/bin")
    assert done.stdout == f"bass {__version__}\n"


def test_starts_without_any_environment(graph: Graph) -> None:
    """No env.sh, no PYTHONPATH, no HOME, another folder."""
    command = ["env", "-i", f"ROS_MASTER_URI={graph.uri}", str(SCRIPTS / "bass-ros"), "-i", "bare"]
    with graph.start(*command, cwd=Path("/")) as node:
        wait_for(lambda: "/bare/kill" in graph.services(), what=lambda: str(node))
        assert node.stop() == 0


@pytest.mark.skipif(os.getuid() != 0, reason="becoming another user takes root")
def test_home_that_is_not_writable(graph: Graph) -> None:
    with fresh_copy() as copy:
        temporary = copy.with_name("tmp")
        temporary.mkdir()
        temporary.chmod(0o1777)
        command = [str(word) for word in without_rights(copy / "scripts" / "bass-ros", "-i", "poor")]
        poor = {"HOME": "/nonexistent", "ROS_HOME": "/nonexistent/.ros", "TMPDIR": str(temporary), "PYTHONPATH": ""}
        with Process(command, {**graph.env, **poor}) as node:
            wait_for(lambda: "/poor/kill" in graph.services(), what=lambda: str(node))
            assert "WARNING" not in node.err
            assert node.stop() == 0


def test_the_time_to_end_is_limited_when_threads_hang(graph: Graph, tmp_path: Path) -> None:
    program = tmp_path / "stuck"
    program.write_text(
        f"""#!/usr/bin/python3
import sys, threading
sys.path.insert(0, {str(SCRIPTS.parent)!r})
from rosafe import interface
from rosafe.ros1.component.startup import run_server
class Stuck:
    finished = threading.Event()
    def shutdown(self, by):
        threading.Event().wait()
def build(instance):
    threading.Thread(target=threading.Event().wait).start()
    import rospy
    rospy.set_param("/stuck_is_up", True)
    return Stuck()
sys.exit(run_server(interface.BASS, build))
"""
    )
    program.chmod(0o755)
    with Process([str(program)], graph.env) as node:
        graph.client()
        wait_for(lambda: rospy.get_param("/stuck_is_up", False), what=lambda: str(node))
        assert node.stop(signal.SIGTERM) == 0
