"""A ROS graph with a genomixd for the tests, an HTTP client that knows its errors, and Tcl scripts that run in it."""

from __future__ import annotations

import http.client
import json
import re
import subprocess
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from tests import harness


class HttpError(Exception):
    """An answer with another status than 200. `ex` and `what` are members of its body."""

    def __init__(self, status: int, body: dict[str, Any]) -> None:
        super().__init__(status, body)
        self.status = status
        self.body = body
        self.ex = body.get("ex", "")
        self.what = body.get("detail", {}).get("what", "") or body.get("what", "")


class Http:
    """GET requests to one genomixd; every call opens a new connection, like curl."""

    def __init__(self, port: int) -> None:
        self.port = port

    def raw(self, url: str, method: str = "GET", headers: dict[str, str] | None = None) -> tuple[int, str]:
        """Return status and body of any URL."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=90)
        try:
            connection.request(method, url, headers=headers or {})
            response = connection.getresponse()
            return response.status, response.read().decode()
        finally:
            connection.close()

    def get(self, path: str, given: Any = None, **query: Any) -> Any:
        """Return the value of the JSON answer; `given` are the arguments. HttpError for another status than 200."""
        if given is not None:
            query["input"] = json.dumps(given)
        status, body = self.raw(f"{quote(path)}?{urlencode(query)}")
        value: Any = json.loads(body) if body else ""
        if status != 200:
            raise HttpError(status, value)
        return value

    def call(self, target: str, given: Any = None, **query: Any) -> Any:
        """Call `component/service` and return its result."""
        return self.get(f"/call/{target}", given, **query)

    def send(self, target: str, given: Any = None, **query: Any) -> str:
        """Send a request in the session ``t`` and return its id."""
        return str(self.get(f"/send/{target}", given, **{"s": "t", **query})["id"])

    def status(self, number: str, **query: Any) -> dict[str, Any]:
        """Return the status of a request of the session ``t``."""
        return dict(self.get("/request/status", id=number, **{"s": "t", **query}))

    def wait(self, number: str, status: str, seconds: float = harness.PATIENCE, s: str = "t") -> dict[str, Any]:
        """Wait until a request of the session `s` has a status, and return all of it."""
        return harness.wait_for(
            lambda: (now := self.status(number, s=s))["status"] == status and now,
            seconds,
            lambda: f"{status} of {self.status(number, s=s)}",
        )

    @contextmanager
    def listening(self, **query: Any) -> Iterator[Iterator[tuple[str, str]]]:
        """Yield the events of a session as they arrive: (name, data)."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=90)
        connection.request("GET", f"/session/listen?{urlencode(query)}")
        response = connection.getresponse()
        assert response.status == 200
        assert response.getheader("Content-Type") == "text/event-stream"
        try:
            yield _events(response)
        finally:
            response.close()
            connection.close()


def _events(response: http.client.HTTPResponse) -> Iterator[tuple[str, str]]:
    fields: dict[str, str] = {}
    for raw in response:
        line = raw.decode().rstrip("\n")
        if line.startswith(":"):
            continue
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
        elif fields:
            yield fields["event"], fields["data"]
            fields = {}


class World:
    """A graph with its master, and the genomixd that works in it."""

    def __init__(self, graph: harness.Graph, master: harness.MasterProcess, server: harness.Process, port: int) -> None:
        self.graph = graph
        self.master = master
        self.server = server
        self.port = port
        self.http = Http(port)
        self.afe: harness.Process | None = None  # rosAFE-ros, if the world has nodes

    def tcl(
        self, script: str, timeout: float = 120.0, check: bool = True, shell: str = "tclsh"
    ) -> subprocess.CompletedProcess[str]:
        """Run a script in a Tcl shell; ``$address`` is that of genomixd; the prelude has further commands."""
        prelude = f"""
            package require genomix
            set address 127.0.0.1:{self.port}
            proc show {{args}} {{puts [join $args |]}}
            proc failure {{script}} {{
                if {{![catch {{uplevel 1 $script}} message options]}} {{error "no error: $script"}}
                return [list $message [dict get $options -errorcode]]
            }}
            proc load_both {{}} {{uplevel #0 {{
                set g [genomix::connect $address]
                $g load bass
                $g load rosAFE
                rosAFE::connect_port Audio bass/Audio
            }}}}
            proc start_tree {{}} {{
                load_both
                bass::Acquire scene:
                rosAFE::InputProc
                rosAFE::PreProc
                rosAFE::GammatoneProc {{fb_nChannels 4}}
            }}
        """
        path = self.graph.home / "script.tcl"
        path.write_text(textwrap.dedent(prelude) + textwrap.dedent(script), "utf-8")
        return self.graph.run(shell, str(path), timeout=timeout, check=check)

    def lines(self, script: str, timeout: float = 120.0, shell: str = "tclsh") -> list[str]:
        """Return the lines that a script prints."""
        return self.tcl(script, timeout, shell=shell).stdout.splitlines()

    def reset(self) -> None:
        """Stop all activities, so that the components are idle for the next test."""
        for component in ("rosAFE", "bass"):
            self.http.call(f"{component}/Stop")


def port_of(process: harness.Process) -> int:
    """Wait until a genomixd started with -v serves, and return its port."""

    def said() -> str:
        assert process.alive, process
        found = re.search(r"serving http://[^ ]*:(\d+)", process.err)
        return found[1] if found else ""

    return int(harness.wait_for(said, what=lambda: f"start of {process}"))


@contextmanager
def genomixd(graph: harness.Graph, *arguments: str) -> Iterator[tuple[harness.Process, int]]:
    """A genomixd on a free port."""
    with graph.start(str(harness.SCRIPTS / "genomixd"), "-v", "-p", "0", *arguments) as process:
        yield process, port_of(process)


@contextmanager
def changed_genomixd(world: World, changes: str) -> Iterator[World]:
    """A second genomixd of a world, whose constants the Python code `changes` changes."""
    code = f"import sys; sys.path.insert(0, {str(harness.ROOT)!r})\n{textwrap.dedent(changes)}\n{_MAIN}"
    with world.graph.start(harness.PYTHON, "-c", code) as server:
        yield World(world.graph, world.master, server, port_of(server))


_MAIN = """
from rosafe.web.genomix import daemon
sys.exit(daemon.main(["-v", "-p", "0", *sys.argv[1:]]))
"""


@contextmanager
def world(home: Path, nodes: bool = True) -> Iterator[World]:
    """A new graph with genomixd and, by default, bass-ros and rosAFE-ros."""
    with harness.private_graph(home) as (graph, master), genomixd(graph) as (server, port):
        this = World(graph, master, server, port)
        if not nodes:
            yield this
            return
        with graph.node("bass-ros"), graph.node("rosAFE-ros") as this.afe:
            yield this
