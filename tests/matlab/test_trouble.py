"""The Octave client when components and genomixd end and are started again."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests import harness
from tests.matlab import octave
from tests.web.genomix import world as worlds

pytestmark = pytest.mark.ros


def test_components_and_servers_that_end(tmp_path: Path) -> None:
    """The script and the test synchronize with files."""

    def await_file(name: str) -> None:
        harness.wait_for(lambda: (tmp_path / name).exists() or not script.alive, what=lambda: f"{name}: {script}")
        assert script.alive, script

    with (
        harness.private_graph(tmp_path) as (graph, master),
        worlds.genomixd(graph) as (server, port),
        graph.node("bass-ros") as node,
    ):
        world = worlds.World(graph, master, server, port)
        script = graph.start(
            *octave.command(tmp_path, octave.script("components_and_servers_that_end")),
            cwd=None,
            **octave.environment(world),
        )
        await_file("1 kill the node")
        node.stop(signal.SIGKILL)
        await_file("2 start the node")
        with graph.node("bass-ros"):
            (tmp_path / "3 the node is back").touch()
            await_file("4 end the server")
            assert server.stop() == 0
            (tmp_path / "5 the server has ended").touch()
            await_file("6 start the server")
            with graph.start(str(harness.SCRIPTS / "genomixd"), "-v", "-p", str(port)) as again:
                assert worlds.port_of(again) == port
                (tmp_path / "7 the server is back").touch()
                with script:
                    assert script.wait() == 0
            results = octave.values(script.out)
    assert results["sent"] == results["back"] == "sent"
    assert results["killed"] == ["error", "::genom::mwerr", "bass ended before its activity did"]
    assert results["dead"] == ["error", "::genom::mwerr"]
    assert results["dead port"] == ["genomix.request", "error"]
    assert results["load"].startswith("genomix:load load bass: ::genom::mwerr: bass is not running")
    for name in ("gone", "gone status"):
        assert results[name].startswith(f"genomix:connection no answer from genomixd at 127.0.0.1:{port}")
    assert results["forgotten"] == ["error", "::genomix::e_noSuchRequest"]
    assert results["works"] == "done"
    assert results["closed"] == "genomix:connection the client has been deleted"
