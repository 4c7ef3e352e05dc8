"""The command genomixd: options, background, ports, and its end."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess

import pytest

from rosafe import __version__
from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.world import Http

pytestmark = pytest.mark.ros
GENOMIXD = str(harness.SCRIPTS / "genomixd")


@pytest.fixture(scope="module")
def home_graph(tmp_path_factory: pytest.TempPathFactory) -> harness.Graph:
    """The environment of a graph whose master does not run: genomixd does not need one to start."""
    return harness.Graph(f"http://127.0.0.1:{harness.free_port()}", tmp_path_factory.mktemp("home"))


def test_help_and_version(home_graph: harness.Graph) -> None:
    output = home_graph.run(GENOMIXD, "-h").stdout
    for word in ("-p PORT", "--host", "-b", "example:", "curl"):
        assert word in output
    assert home_graph.run(GENOMIXD, "--version").stdout == f"genomixd {__version__}\n"


@pytest.mark.parametrize("arguments", [["-p", "65536"], ["--port"], ["extra"]])
def test_a_wrong_command_line_is_reported_in_one_line(home_graph: harness.Graph, arguments: list[str]) -> None:
    done = home_graph.run(GENOMIXD, *arguments, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "genomixd -h lists the options" in done.stderr


def test_a_port_in_use_is_reported_in_one_line(home_graph: harness.Graph) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        backgrounds: tuple[list[str], ...] = ([], ["-b"])
        for background in backgrounds:
            done = home_graph.run(GENOMIXD, "-p", str(port), *background, check=False)
            assert done.returncode == 1
            assert done.stderr.splitlines() == [
                f"genomixd: port {port} of 127.0.0.1 is in use, perhaps by another instance of this program; "
                "choose another with --port"
            ]


def test_a_foreign_address_is_reported_in_one_line(home_graph: harness.Graph) -> None:
    done = home_graph.run(GENOMIXD, "-p", "0", "--host", "192.0.2.1", check=False)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_regardless_of_clients(home_graph: harness.Graph, number: int) -> None:
    with worlds.genomixd(home_graph) as (process, port), Http(port).listening(s="x") as events:
        kept = socket.create_connection(("127.0.0.1", port))
        kept.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert kept.recv(10) == b"HTTP/1.1 2"
        assert process.signal_until_end(number) == 0
        assert next(events) == ("quit", "")
        kept.close()
        assert "Traceback" not in process.err


def test_nohup_is_respected_and_a_script_may_start_it_in_the_background(home_graph: harness.Graph) -> None:
    command = ["sh", "-c", f"trap '' HUP INT QUIT; exec {GENOMIXD} -v -p 0"]
    with home_graph.start(*command) as process:
        port = worlds.port_of(process)
        os.kill(process.pid, signal.SIGHUP)
        for _ in range(10):  # one that ends may still answer the first
            assert Http(port).raw("/")[0] == 200
        assert process.stop(signal.SIGINT) == 0


def test_background_mode_returns_when_it_serves(home_graph: harness.Graph) -> None:
    port = str(harness.free_port())

    def servers() -> list[int]:
        ours = [GENOMIXD, "-b", "-p", port, ""]
        found = []
        for path in harness.proc().glob("[0-9]*/cmdline"):
            with contextlib.suppress(OSError):  # it has ended meanwhile
                if path.read_text("utf-8", "replace").split("\0")[1:] == ours:
                    found.append(int(path.parent.name))
        return found

    home_graph.run(GENOMIXD, "-b", "-p", port)
    try:
        assert Http(int(port)).raw("/")[0] == 200
        assert len(servers()) == 1
    finally:
        for pid in servers():
            os.kill(pid, signal.SIGTERM)
    harness.wait_for(lambda: not servers())


def test_a_private_server_ends_with_its_parent(home_graph: harness.Graph) -> None:
    process = subprocess.Popen(
        [GENOMIXD, "-p", "0", "--until-eof"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=home_graph.env,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    port = int(process.stdout.readline())
    assert Http(port).raw("/")[0] == 200
    process.stdin.close()
    assert process.wait(harness.PATIENCE) == 0


def test_verbosity(home_graph: harness.Graph) -> None:
    with worlds.genomixd(home_graph, "-d") as (process, port):
        Http(port).raw("/components?s=me")
        harness.wait_for(lambda: re.search(r'"GET /components\?s=me HTTP/1.1" 200', process.err))


def test_a_read_only_log_directory_is_not_an_error(home_graph: harness.Graph) -> None:
    process = home_graph.start(GENOMIXD, "-v", "-p", "0", ROS_LOG_DIR="/dev/null/none", ROS_HOME="/dev/null/none")
    with process:
        assert Http(worlds.port_of(process)).raw("/")[0] == 200
