"""Self-check: a node detects whether it can be called, and reports it to /diagnostics, the log and systemd."""

from __future__ import annotations

import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from rosafe.ros1.transport import systemd
from tests.harness import Graph, MasterProcess, wait_for
from tests.ros1.afe.attacker import Target


class Systemd:
    """A socket that receives the datagrams of a service."""

    def __init__(self, address: str) -> None:
        self.messages: list[tuple[float, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while (data := self._socket.recv(4096)) != b"end":
            self.messages.append((time.monotonic(), data.decode()))

    def count(self, what: str) -> int:
        """Return the number of datagrams with this text."""
        return sum(message == what for _, message in self.messages)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.sendto(b"end", self._socket.getsockname())
        self._thread.join()
        self._socket.close()


@contextmanager
def listening(address: str) -> Iterator[Systemd]:
    systemd = Systemd(address)
    try:
        yield systemd
    finally:
        systemd.close()


@pytest.mark.parametrize("component", ["bass", pytest.param("rosAFE", marks=pytest.mark.exploration)])
def test_a_node_reports_that_it_cannot_be_called(graph: Graph, tmp_path: Path, component: str) -> None:
    """While subscribers that never read use all descriptors, systemd's watchdog is not notified."""
    name = f"{component}_watched"
    with (
        listening(str(tmp_path / "notify")) as systemd,
        graph.node(
            f"{component}-ros", "-i", name, NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="6000000"
        ) as process,
        graph.collect("/diagnostics", DiagnosticArray) as messages,
        ExitStack() as stack,
    ):

        def health() -> DiagnosticStatus:
            statuses = [s for m in list(messages) for s in m.status if s.name == f"{name}: calls"]
            return statuses[-1] if statuses else DiagnosticStatus(level=DiagnosticStatus.STALE)

        target = Target(graph, process, name)
        wait_for(lambda: systemd.count("WATCHDOG=1") > 1, what=lambda: f"{systemd.messages} {process}")
        assert systemd.messages[0][1] in ("READY=1", "WATCHDOG=1") and systemd.count("READY=1") == 1
        wait_for(lambda: (health().level, health().message) == (DiagnosticStatus.OK, "this node can be called"))

        limits = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        limit = target.descriptors + 60
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (limit, limits[1]))
        for number in range(limit):
            stack.enter_context(target.subscribe("genom_state", f"/deaf{number}", wait=False))
        wait_for(lambda: "this node cannot be called: " in health().message, what=lambda: str(process))
        assert health().level == DiagnosticStatus.ERROR and "no answer within" in health().message
        fed = systemd.count("WATCHDOG=1")
        wait_for(lambda: {v.key: v.value for v in health().values}["failed calls in a row"] > "3")
        assert systemd.count("WATCHDOG=1") == fed, "systemd can end it"
        assert process.err.count("this node cannot be called: ") == 1

        stack.close()
        wait_for(lambda: health().message == "this node can be called", what=lambda: str(process))
        wait_for(lambda: systemd.count("WATCHDOG=1") > fed + 1, what=lambda: f"{systemd.messages}")
        wait_for(lambda: process.err.count("this node can be called again") == 1, what=lambda: str(process))
        target.assert_healthy()
        assert process.stop(signal.SIGTERM) == 0
        assert systemd.messages[-1][1] == "STOPPING=1" and systemd.count("READY=1") == 1


def test_abstract_and_missing_notification_addresses(graph: Graph) -> None:
    """A watchdog for another process, or with an invalid interval, is ignored."""
    address = f"rosafe-test-{os.getpid()}"
    with listening(f"\0{address}") as systemd:
        for microseconds, pid in (("3000000", "1"), ("nonsense", ""), ("0", ""), ("", "")):
            with graph.node(
                "bass-ros", "-i", "unwatched", NOTIFY_SOCKET=f"@{address}", WATCHDOG_USEC=microseconds, WATCHDOG_PID=pid
            ) as process:
                wait_for(lambda: systemd.count("READY=1"))
                assert process.stop(signal.SIGTERM) == 0
            assert [what for _, what in systemd.messages] == ["READY=1", "STOPPING=1"]
            systemd.messages.clear()
    with graph.node("bass-ros", "-i", "unwatched", NOTIFY_SOCKET="/nowhere/at/all", WATCHDOG_USEC="3000000") as process:
        assert process.stop(signal.SIGTERM) == 0 and process.complaints == ""


def test_the_watchdog_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    for text, seconds in {"3000000": 3.0, "1": 1e-6, "": None, "0": None, "-5": None, "2e6": None, "²": None}.items():
        monkeypatch.setenv("WATCHDOG_USEC", text)
        assert systemd.watchdog_seconds() == seconds
    monkeypatch.setenv("WATCHDOG_USEC", "5000000")
    for pid, seconds in {str(os.getpid()): 5.0, "1": None}.items():
        monkeypatch.setenv("WATCHDOG_PID", pid)
        assert systemd.watchdog_seconds() == seconds


@pytest.mark.parametrize("command", [("bass-ros",), ("rosafe", "localize")])
def test_systemd_allows_a_node_to_wait_for_a_master(
    private_graph: tuple[Graph, MasterProcess], tmp_path: Path, command: tuple[str, ...]
) -> None:
    """The commands of the units in systemd/: they become ready when there is a master, and then notify the watchdog."""
    graph, master = private_graph
    master.kill()
    address = str(tmp_path / "notify")
    with (
        listening(address) as systemd,
        graph.start(*command, "--wait", NOTIFY_SOCKET=address, WATCHDOG_USEC="3000000") as process,
    ):
        wait_for(lambda: len(systemd.messages) > 2, what=lambda: str(process))
        status = f"STATUS=waiting for a ROS master at {graph.uri}\nEXTEND_TIMEOUT_USEC=30000000"
        assert systemd.messages[-1][1] == status
        master.start(graph.env)
        wait_for(lambda: systemd.count("READY=1"), what=lambda: f"{systemd.messages} {process}")
        wait_for(lambda: systemd.count("WATCHDOG=1") > 2, what=lambda: f"{systemd.messages} {process}")


def test_the_self_check_does_not_need_the_master(private_graph: tuple[Graph, MasterProcess], tmp_path: Path) -> None:
    """A node without a master can be called by connected clients, and is not ended by systemd."""
    graph, master = private_graph
    address = str(tmp_path / "notify")
    with (
        listening(address) as systemd,
        graph.node("bass-ros", NOTIFY_SOCKET=address, WATCHDOG_USEC="3000000") as process,
    ):
        master.kill()
        wait_for(lambda: "no answer from the ROS master" in process.err)
        fed = systemd.count("WATCHDOG=1")
        wait_for(lambda: systemd.count("WATCHDOG=1") > fed + 3, what=lambda: f"{systemd.messages} {process}")
        assert "cannot be called" not in process.err
