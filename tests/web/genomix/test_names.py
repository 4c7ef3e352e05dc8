"""Host names that genomixd accepts, and the errors for other names."""

from __future__ import annotations

import asyncio
import socket
import xmlrpc.client

import pytest

from rosafe.ros1.client.graph import Graph as RosGraph
from rosafe.web.genomix import routes
from tests.harness import Graph
from tests.web.genomix.world import Http, port_of

pytestmark = pytest.mark.ros


def status(port: int, host: str, path: str = "/components") -> int:
    code, body = Http(port).raw(path, headers={"Host": host})
    assert (code == 403) == ("--name" in body), body
    return code


def test_names_that_are_given_and_those_of_the_machine(graph: Graph) -> None:
    short = socket.gethostname().partition(".")[0]
    with graph.start("genomixd", "-v", "-p", "0", "--name", "Ears.lab", "--name=other", ROS_HOSTNAME="Known") as server:
        port = port_of(server)
        for host in ("ears.lab", "EARS.LAB.:1234", "other", short, f"{short.upper()}.local:80", "known", "127.0.0.1"):
            assert status(port, host) == 200, host
        for host in ("ears", "ears.lab.example", "knownn"):
            assert status(port, host) == 403, host
        assert status(port, "evil.example", "/components?syntax=packed") == 403


def test_names_in_the_ros_parameter(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """They take effect when they are set, also while genomixd runs."""
    monkeypatch.setattr(routes, "READ_SECONDS", 0.0)
    monkeypatch.setattr(routes.log, "propagate", True)
    master = xmlrpc.client.ServerProxy(graph.uri)

    async def scenario() -> None:
        ours = RosGraph(graph.uri)
        try:
            known = routes.Names(ours, "/test_names/names", {"Robot.", "10.0.0.1", "::1"})
            assert known.known == {"robot", "10.0.0.1"}
            assert await known.from_parameter() == ()
            for value, expected in (("Ears.lab", {"ears.lab"}), (["one", "two.lab."], {"one", "two.lab"})):
                master.setParam("/test", "/test_names/names", value)
                assert await known.from_parameter() == expected
            assert not caplog.messages
            master.setParam("/test", "/test_names/names", ["a b", 7, "three"])
            for _ in range(2):
                assert await known.from_parameter() == {"three"}
            assert [text.partition(": ")[2] for text in caplog.messages] == [
                "expected the name of a host, such as robot.lab, got 'a b'",
                "expected the name of a host, such as robot.lab, got 7",
            ]
            ours.uri = "http://127.0.0.1:1"  # the master is unreachable: its last answer remains valid
            assert await known.from_parameter() == {"three"}
            ours.uri = graph.uri
            master.deleteParam("/test", "/test_names/names")
            assert not await known.from_parameter()
        finally:
            await ours.close()

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("arguments", "namespace", "expected"),
    [
        ([], "", "/genomixd/names"),
        (["-v", "__name:=g", "a:=b"], "", "/g/names"),
        (["__name:=g"], "/robot/", "/robot/g/names"),
        (["__ns:=/left"], "robot", "/left/genomixd/names"),
    ],
)
def test_the_name_of_the_parameter(arguments: list[str], namespace: str, expected: str) -> None:
    assert routes.parameter_name(arguments, {"ROS_NAMESPACE": namespace}) == expected


def test_the_parameter_of_a_genomixd_that_runs(graph: Graph) -> None:
    with graph.start("genomixd", "-v", "-p", "0", "__name:=genomixd_of_names") as server:
        port = port_of(server)
        master = xmlrpc.client.ServerProxy(graph.uri)
        master.setParam("/test", "/genomixd_of_names/names", "Ears.lab")
        try:
            assert status(port, "ears.lab.:99") == 200
            assert status(port, "other.lab") == 403
        finally:
            master.deleteParam("/test", "/genomixd_of_names/names")


@pytest.mark.parametrize("name", ["", "a b", "http://robot", "robot/x", "*"])
def test_an_invalid_name(graph: Graph, name: str) -> None:
    done = graph.run("genomixd", "--name", name, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "--name: expected the name of a host" in done.stderr and repr(name) in done.stderr
