"""Race conditions, provoked on real nodes."""

from __future__ import annotations

import os
import signal
import threading
import xmlrpc.client
import xmlrpc.server
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any

import pytest
import rosgraph

from rosafe.ros1.transport import master
from tests.harness import PYTHON, Graph, MasterProcess, freeze, python_path, run_together, wait_for
from tests.ros1.afe.session import Session, error_of

# --- two simultaneous inputs ---------------------------------------------------------------------------------------

# A node whose first InputProc pauses at one point, and signals its progress by files.
STALLING = """
import sys, threading
from pathlib import Path
from rosafe.audio.stream import ring as audio
from rosafe.ros1.afe import node, published_tree
where, folder = sys.argv.pop(1), Path(sys.argv.pop(1))

def stall():
    (folder / "stalled").touch()
    while not (folder / "go").exists():
        threading.Event().wait(0.02)

open_reader = audio.AudioRing.open_reader
def stall_reading(ring, frames, *rest):
    reader = open_reader(ring, frames, *rest)
    if where == "reader" and frames == 1600:
        stall()
    return reader
audio.AudioRing.open_reader = stall_reading

add_input = published_tree.Tree.add_input
def stall_adding(tree, name, *rest):
    if where == "adding" and name == "first":
        stall()
    added = add_input(tree, name, *rest)
    if name == "second":
        (folder / "second").touch()
    return added
published_tree.Tree.add_input = stall_adding

class Lock:  # signals that a thread has to wait
    def __init__(self):
        self.lock = threading.RLock()
    def __enter__(self):
        if not self.lock.acquire(blocking=False):
            (folder / "waits").touch()
            self.lock.acquire()
    def __exit__(self, *_):
        self.lock.release()

create = published_tree.Tree.__init__
def with_lock(tree, *arguments, **options):
    create(tree, *arguments, **options)
    tree.lock = Lock()
published_tree.Tree.__init__ = with_lock
sys.exit(node.main())
"""


@pytest.mark.parametrize("where", ["reader", "adding"])
def test_the_newer_of_two_inputs_remains_at_any_point_of_the_older(graph: Graph, tmp_path: Path, where: str) -> None:
    """The older one has its audio but no processor yet, or is just creating it."""
    program = tmp_path / "stalling.py"
    program.write_text(STALLING)
    name = f"stalling_{where}"
    with graph.start(PYTHON, str(program), where, str(tmp_path), "-i", name, PYTHONPATH=python_path(graph)) as process:
        graph.wait_until_up(process, "rosAFE", name)
        session = Session(graph, process, name)
        session.listen()

        def first() -> Any:
            return session.call("InputProc", name="first", nFramesPerBlock=1600)

        def second() -> Any:
            wait_for((tmp_path / "stalled").exists, what=lambda: str(process))
            return session.call("InputProc", name="second", nFramesPerBlock=800)

        def release() -> None:
            wait_for(lambda: (tmp_path / "waits").exists() or (tmp_path / "second").exists(), what=lambda: str(process))
            (tmp_path / "go").touch()

        steps: list[Callable[[], Any]] = [first, second, release]
        older, newer, _ = run_together(3, lambda number: steps[number]())
        assert newer.genom_success, newer.genom_exdetail
        if where == "reader":
            assert error_of(older)[0] == "::genom::interrupted"
        session.wait_activities(["InputProc"])
        assert session.processors() == {"input": ["second"]}
        session.close()


# --- the master -------------------------------------------------------------------------------------------------


def test_a_new_master_with_one_registration_gets_all_others(private_graph: tuple[Graph, MasterProcess]) -> None:
    """It was started so quickly that the node did not notice, and one topic of the node is registered."""
    graph, master_process = private_graph
    with graph.node("bass-ros") as process:
        services = graph.services()
        address = rosgraph.Master("/test", master_uri=graph.uri).lookupNode("/bass")
        freeze(process.pid)
        try:
            master_process.kill()
            master_process.start(graph.env)
            decoy = rosgraph.Master("/bass", master_uri=graph.uri)
            decoy.registerPublisher("/bass/decoy", "std_msgs/String", address)
        finally:
            os.kill(process.pid, signal.SIGCONT)
        wait_for(lambda: services <= graph.services(), what=lambda: f"{services - graph.services()} {process}")


class SlowMaster(ThreadingMixIn, xmlrpc.server.SimpleXMLRPCServer):
    """A proxy between a node and its master: one call gets no answer, and takes effect late, after another call.

    Parameters
    ----------
    uri : str
        Of the master.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, uri: str) -> None:
        super().__init__(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self.uri = f"http://127.0.0.1:{self.server_address[1]}"
        self.held = ""  # the topic whose next unregisterPublisher is delayed
        self.late = threading.Event()  # it has taken effect
        self._waiting: list[tuple[Any, ...]] = []
        self._end = threading.Event()
        self._master_uri = uri

    def _dispatch(self, method: str, params: Any) -> Any:
        def call(name: str, arguments: tuple[Any, ...]) -> Any:
            with master.proxy(self._master_uri) as proxy:
                return getattr(proxy, name)(*arguments)

        if self.held and (method, *params[1:2]) == ("unregisterPublisher", self.held):
            self.held = ""
            self._waiting.append(params)
            self._end.wait()  # the node's timeout is shorter
        result = call(method, params)
        if self._waiting and method == "registerPublisher" and params[1] == self._waiting[0][1]:
            call("unregisterPublisher", self._waiting.pop())
            self.late.set()
        return result

    def close(self) -> None:
        self._end.set()
        self.shutdown()
        self.server_close()


@contextmanager
def slow_master(uri: str) -> Iterator[SlowMaster]:
    server = SlowMaster(uri)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield server
    finally:
        server.close()


def test_a_call_that_takes_effect_after_its_timeout_is_corrected(graph: Graph) -> None:
    """A topic is closed and advertised again; the master gets the calls in the wrong order, and is then corrected."""
    with slow_master(graph.uri) as server, graph.node("rosAFE-ros", "-i", "late", ROS_MASTER_URI=server.uri) as process:
        session = Session(graph, process, "late")
        session.build("PreProc")
        topic = session.topic("preProc")
        assert topic in graph.topics()
        server.held = topic
        session.ok("removeProcessor", name="preProc")
        session.ok("PreProc")
        assert server.late.wait(30), process
        wait_for(lambda: topic in graph.topics(), what=lambda: str(process))
        session.close()
