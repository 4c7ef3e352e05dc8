"""Self-check: a node calls its own TCP ports and reports to /diagnostics and systemd whether it can be called."""

from __future__ import annotations

import io
import socket
import struct
import threading
import time
from typing import Any
from urllib.parse import urlsplit

import rosgraph.network
import rospy
from diagnostic_msgs.msg import DiagnosticStatus
from rosgraph.network import write_ros_handshake_header
from rospy.impl import tcpros_base

from rosafe.ros1.transport import master, registration, server_limits, systemd

PERIOD = 10.0  # seconds between two calls, but at most a third of the interval of systemd's watchdog
CALL_SECONDS = 3.0  # for the answer on one port, but at most a third of the period
FAILURES = 2  # in a row before an error is reported


class SelfCheck:
    """Periodic calls of this node to itself, on a separate thread that `start` starts.

    Parameters
    ----------
    finished : threading.Event
        Event that ends the thread.
    """

    def __init__(self, finished: threading.Event) -> None:
        self.failures = 0  # in a row
        self._problem = ""
        self._seconds = 0.0  # duration of the last successful call
        self._finished = finished
        self._watchdog = systemd.watchdog_seconds()
        self._period = PERIOD if self._watchdog is None else min(PERIOD, self._watchdog / 3)

    def start(self) -> None:
        threading.Thread(target=self._run, name="self-check", daemon=True).start()

    def health(self, status: Any) -> Any:
        """Report the result; a task for diagnostic_updater."""
        if self.failures < FAILURES:
            status.summary(DiagnosticStatus.OK, "this node can be called")
        else:
            status.summary(DiagnosticStatus.ERROR, f"this node cannot be called: {self._problem}")
        status.add("last answer took (ms)", f"{1000 * self._seconds:.1f}")
        status.add("failed calls in a row", str(self.failures))
        return status

    def _run(self) -> None:
        while not self._finished.is_set():
            self._try()
            if self.failures < FAILURES and self._watchdog is not None:
                systemd.notify("WATCHDOG=1")
            self._finished.wait(self._period)

    def _try(self) -> None:
        begin = time.monotonic()
        problem = check_own_interfaces(min(CALL_SECONDS, self._period / 3))
        if self._finished.is_set():
            return
        if not problem:
            if self.failures >= FAILURES:
                rospy.logwarn("this node can be called again")
            self.failures, self._seconds = 0, time.monotonic() - begin
            return
        self.failures, self._problem = self.failures + 1, problem
        if self.failures == FAILURES:
            rospy.logerr(f"this node cannot be called: {problem}")


def check_own_interfaces(seconds: float) -> str:
    """Call this node on each of its two ports; return the problem, such as a timeout, or an empty string."""
    host = rosgraph.network.get_bind_address()
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    for port, call in (("XML-RPC", _call_api), ("TCPROS", _call_service)):
        try:
            call(host, seconds)
        except TimeoutError:
            return f"{port}: no answer within {seconds:.3g} s"
        except Exception as problem:  # any failure means that the node cannot be called
            return f"{port}: {getattr(problem, 'strerror', None) or f'{type(problem).__name__}: {problem}'}"
    return ""


def _call_api(host: str, seconds: float) -> None:
    port = urlsplit(registration.registrar().manager.uri).port
    with master.proxy(f"http://{f'[{host}]' if ':' in host else host}:{port}/", seconds) as node:
        node.getPid(rospy.get_name())


def _call_service(host: str, seconds: float) -> None:
    """Call a service that every node has and that does little work, without a lookup at the master."""
    _, port = tcpros_base.get_tcpros_server_address()
    name = f"{rospy.get_name()}/get_loggers"
    with socket.create_connection((host, port), seconds) as sock:
        fields = {"service": name, "md5sum": rospy.names.SERVICE_ANYTYPE, "callerid": rospy.get_name()}
        write_ros_handshake_header(sock, fields)
        header = server_limits.read_header(sock, io.BytesIO(), 4096)
        if "error" in header:
            raise ValueError(header["error"])
        sock.sendall(struct.pack("<I", 0))
        with sock.makefile("rb") as answer:
            good, size = struct.unpack("<BI", answer.read(5))
            if len(answer.read(size)) < size or not good:
                raise ValueError("incomplete answer")
