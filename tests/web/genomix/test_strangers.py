"""The Tcl and Octave clients with a server that is not genomixd or sends invalid data: an immediate error."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe.web.genomix.formats import PACKED
from tests import harness
from tests.matlab import octave

OK = b"HTTP/1.1 200 OK\r\n"
CHUNKED = OK + b"Transfer-Encoding: chunked\r\n\r\n"
ENDLESS = 64 * 2**20  # bytes that are sent if the client does not stop reading


class Stranger:
    """A server that gives every request the same answer, and closes the connection."""

    def __init__(self, answer: bytes, endless: bytes = b"") -> None:
        self._answer, self._endless = answer, endless
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._socket.getsockname()[1])
        self.swallowed = 0  # bytes of endless data that the client has read
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.settimeout(30)
                request = b""
                while not request.endswith(b"\r\n\r\n") and (new := connection.recv(65536)):
                    request += new  # closing with unread data would discard the answer
                connection.sendall(self._answer)
                block = self._endless * (65536 // max(1, len(self._endless)))
                while block and self.swallowed < ENDLESS:
                    connection.sendall(block)
                    self.swallowed += len(block)

    def close(self) -> None:
        # shutdown ends an accept that waits; close alone does not
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(40)


@contextlib.contextmanager
def stranger(answer: bytes, endless: bytes = b"") -> Iterator[Stranger]:
    """Run a server in the block."""
    server = Stranger(answer, endless)
    try:
        yield server
    finally:
        server.close()


def length(reported: object, body: bytes = b"abc") -> bytes:
    # Otherwise a client may use the connection again before it notices the end.
    return OK + f"Connection: close\r\nContent-Length: {reported}\r\n\r\n".encode() + body


LIES = {
    "silence": (b"", b""),
    "ssh": (b"SSH-2.0-OpenSSH_9.2\r\n", b""),
    "too long": (length(10**9), b""),
    "far too long": (length(10**30), b""),
    "negative": (length(-5), b""),
    "no number": (length("abc"), b""),
    "large chunk": (CHUNKED + b"ffffffff\r\nabc", b""),
    "negative chunk": (CHUNKED + b"-5\r\nabc", b""),
    "no chunk": (CHUNKED + b"zz\r\nabc", b""),
    "no last chunk": (CHUNKED + b"3\r\nabc\r\n", b""),
    "cut head": (b"HTTP/1.1 200 OK\r\nContent-Le", b""),
    "endless line": (b"", b"x"),
    "endless header": (OK + b"X: ", b"x"),
    "endless headers": (OK, b"X: y\r\n"),
    "endless chunk line": (CHUNKED, b"0"),
}


@pytest.mark.parametrize("lie", LIES)
def test_tcl(lie: str, tmp_path: Path) -> None:
    with stranger(*LIES[lie]) as server:
        script = tmp_path / "script.tcl"
        script.write_text(f"""
            package require genomix
            puts [catch {{genomix::connect 127.0.0.1:{server.port}}} message options]
            puts [dict get $options -errorcode]
        """)
        graph = harness.Graph("http://127.0.0.1:9", tmp_path)
        failed, code = graph.run("tclsh", str(script)).stdout.splitlines()
        assert failed == "1"
        assert code.startswith(f"GENOM ::genom::mwerr {{what {{genomixd at 127.0.0.1:{server.port}: ")
    assert server.swallowed < ENDLESS / 4  # some is in the kernel


@pytest.mark.parametrize(
    ("body", "reported"),
    [
        (b"unbalanced {", "expected the description of a component"),
        (b"name", "expected the description of a component"),
        (b"name x services y", "expected the description of a component"),
        (b"name x services {a {}} ports {b", "expected the description of a component"),
        (b"name {a b} services {} ports {}", "is not allowed as a namespace"),
        (b"name ::oo services {} ports {}", "is not allowed as a namespace"),
    ],
)
def test_tcl_reports_invalid_answers(body: bytes, reported: str, tmp_path: Path) -> None:
    with stranger(length(len(body), body)) as server:
        script = tmp_path / "script.tcl"
        script.write_text(f"""
            package require genomix
            set g [genomix::connect 127.0.0.1:{server.port}]
            catch {{$g load rosAFE}} message options
            puts [lindex [dict get $options -errorcode] 0]$message
        """)
        shown = harness.Graph("http://127.0.0.1:9", tmp_path).run("tclsh", str(script)).stdout
        assert shown.startswith("GENOM") and reported in shown


STRANGE = {
    "web page": b"<html>hello</html>",
    "number": PACKED.plain(7),
    "other structure": PACKED.plain({"a": 1}),
    "no structures": PACKED.plain({"name": "x", "instance": "x", "services": 1, "ports": 2}),
}


@pytest.mark.ros
def test_octave(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        servers = {name: stack.enter_context(stranger(length(len(body), body))) for name, body in STRANGE.items()}
        script = "".join(
            f"show('{name}', message(@() genomix.client('127.0.0.1:{server.port}').load('rosAFE')));\n"
            for name, server in servers.items()
        )
        graph = harness.Graph("http://127.0.0.1:9", tmp_path)
        reported = octave.values(graph.run(*octave.command(tmp_path, script), timeout=60, LANG="C.UTF-8").stdout)
    assert list(reported) == list(STRANGE)
    for name, text in reported.items():
        assert text.startswith("genomix:connection ") and "\n" not in text, (name, text)
