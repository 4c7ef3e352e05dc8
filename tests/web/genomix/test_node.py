"""genomixd as a node of the graph: its name, its registration, and its removal."""

from __future__ import annotations

import asyncio
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import rosgraph

from rosafe.ros1.client import graph as client_graph
from tests.harness import PATIENCE, Graph, free_port, private_graph, wait_for
from tests.web.genomix.world import Http


def registrations(graph: Graph, node: str) -> int:
    """Return the number of topics and services of `node` that are registered at the master."""
    state: Any = rosgraph.Master("/test", master_uri=graph.uri).getSystemState()
    return sum(node in nodes for kind in state for _, nodes in kind)


def known(graph: Graph, node: str) -> bool:
    """Return whether `node` is registered at the master."""
    try:
        return bool(rosgraph.Master("/test", master_uri=graph.uri).lookupNode(node))
    except rosgraph.MasterError:
        return False


def test_it_leaves_the_graph_with_all_its_registrations(graph: Graph) -> None:
    port = free_port()
    with graph.node("bass-ros"), graph.node("rosAFE-ros"), graph.start("genomixd", "-p", str(port)) as server:
        wait_for(lambda: "/genomixd" in graph.nodes(), what=lambda: str(server))  # without any request
        for component in ("bass", "rosAFE"):
            wait_for(lambda: Http(port).get(f"/load/{component}"))  # noqa: B023
        wait_for(lambda: registrations(graph, "/genomixd") > 4 * 24)  # four topics of each action
        assert server.stop(signal.SIGTERM) == 0
        wait_for(lambda: not registrations(graph, "/genomixd"))
        assert not known(graph, "/genomixd")


def test_no_attempt_to_join_after_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """If there is no master, attempts are repeated; the end may come between two of them."""
    monkeypatch.setattr(client_graph, "JOIN_SECONDS", 0.2)

    async def check() -> None:
        graph = client_graph.Graph(f"http://127.0.0.1:{free_port()}")
        joining = asyncio.create_task(graph.join())
        await asyncio.sleep(0)  # it begins
        await asyncio.wait({graph.prepare()})
        await graph.close()
        await asyncio.wait_for(joining, PATIENCE)

    asyncio.run(check())


def test_names(graph: Graph) -> None:
    """The default is genomixd, unless a node of that name runs; a registration of a killed node is ignored."""

    def names() -> set[str]:
        return {node for node in graph.nodes() if "genomixd" in node or "ears" in node}

    with graph.start("genomixd", "-p", str(free_port())) as first:
        wait_for(lambda: names() == {"/genomixd"}, what=lambda: str(first))
        with graph.start("genomixd", "-p", str(free_port())) as second:
            wait_for(lambda: len(names()) == 2, what=lambda: str(second))
            assert first.alive and (names() - {"/genomixd"}).pop().startswith("/genomixd_")
            assert second.stop() == 0
        with graph.start("genomixd", "-p", str(free_port()), "__name:=ears", "__ns:=/robot") as third:
            wait_for(lambda: names() == {"/genomixd", "/robot/ears"}, what=lambda: str(third))
            assert third.stop() == 0
        first.stop(signal.SIGKILL)
        assert names() == {"/genomixd"}
        with graph.start("genomixd", "-p", str(free_port())) as successor:
            wait_for(lambda: f"Pid: {successor.pid}\n" in graph.run("rosnode", "info", "/genomixd", check=False).stdout)
            assert successor.stop() == 0
    assert not names()


def test_servers_that_start_at_the_same_moment(graph: Graph) -> None:
    """None of them takes the name of another one."""
    with ExitStack() as stack:
        servers = [stack.enter_context(graph.start("genomixd", "-p", str(free_port()))) for _ in range(5)]
        wait_for(lambda: sum("genomixd" in node for node in graph.nodes()) == 5, what=lambda: str(servers))
        assert all(server.alive for server in servers)


def test_a_master_that_starts_later(tmp_path: Path) -> None:
    with private_graph(tmp_path) as (graph, master):
        master.kill()
        port = free_port()
        with graph.start("genomixd", "-p", str(port)) as server:
            wait_for(lambda: _answers(port), what=lambda: str(server))
            master.start(graph.env)
            wait_for(lambda: "/genomixd" in graph.nodes(), what=lambda: str(server))
            assert server.stop() == 0
            assert not known(graph, "/genomixd")


def _answers(port: int) -> bool:
    try:
        return Http(port).get("/components") is not None
    except OSError:
        return False


def test_rosafe_live_is_a_node_with_a_name(graph: Graph) -> None:
    def start(*name: str) -> Any:
        return graph.start("rosafe", "live", "--no-browser", "--port", str(free_port()), *name)

    with start() as page:
        wait_for(lambda: "/rosafe_live" in graph.nodes(), what=lambda: str(page))
        assert page.stop() == 0
    wait_for(lambda: not known(graph, "/rosafe_live"))


def test_commands_take_the_name_that_roslaunch_gives(graph: Graph, tmp_path: Path) -> None:
    with graph.node("bass-ros"):
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        with graph.start("rosafe", "record", str(tmp_path / "a.wav"), "__name:=ears") as recorder:
            wait_for(lambda: ("/bass/Audio", "/ears") in graph.readers(), what=lambda: str(recorder))
            recorder.stop(signal.SIGINT)
        wait_for(lambda: not known(graph, "/ears"))
