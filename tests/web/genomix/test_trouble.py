"""Missing, killed, hanging and restarted components and masters: clear errors, and recovery without a restart."""

from __future__ import annotations

import os
import signal
import threading
import time
import xmlrpc.client
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rosafe.interface import COMPONENTS
from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.test_server import start_tree
from tests.web.genomix.world import HttpError, World

pytestmark = pytest.mark.ros

ACTION_TOPICS = ("goal", "cancel", "status", "result")


def problem(world: World, target: str, given: object = None) -> str:
    with pytest.raises(HttpError) as caught:
        world.http.call(target, given)
    assert (caught.value.status, caught.value.ex) == (502, "::genom::mwerr")
    return caught.value.what


def test_a_component_that_starts_ends_and_restarts(empty_world: World) -> None:
    world = empty_world
    assert "bass is not running" in problem(world, "bass/Stop")
    with world.graph.node("bass-ros") as bass:
        world.http.get("/load/bass", s="t")
        number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
        waiting = world.http.send("bass/DedicatedSocket", s="u")
        bass.stop(signal.SIGKILL)
        assert "bass ended before its activity did" in world.http.wait(number, "error")["exception"]["detail"]["what"]
        assert world.http.status(waiting, s="u")["status"] in ("error", "sent")
        assert "/bass/Stop" in world.graph.services()
        reported = problem(world, "bass/Stop")
        assert "bass is not running any more, though it is still registered at the master" in reported
    assert "bass is not running" in problem(world, "bass/Stop")
    assert "bass is not running" in problem(world, "bass/Audio")
    failed = world.http.send("bass/Acquire", {"device": "scene:"})
    assert "bass is not running" in world.http.wait(failed, "error")["exception"]["detail"]["what"]
    with world.graph.node("bass-ros"):
        assert world.http.call("bass/Stop", s="t") == {}
        number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
        assert world.http.status(number)["status"] == "sent"
        harness.wait_for(lambda: world.http.call("bass/Audio")["Audio"]["lastFrameIndex"] > 0)
        world.http.call("bass/kill")
        assert world.http.wait(number, "done")["output"] == {}


def test_a_component_that_hangs_does_not_delay_others(empty_world: World) -> None:
    world = empty_world
    with world.graph.node("bass-ros") as bass, world.graph.node("rosAFE-ros"):
        world.http.call("bass/Stop")
        harness.freeze(bass.pid)
        answers: list[object] = []
        caller = threading.Thread(target=lambda: answers.append(world.http.call("bass/Stop")))
        caller.start()
        parameters = world.http.call("rosAFE/getParameters")["parameters"]
        assert parameters["input"] == []
        assert answers == []
        number = world.http.send("bass/Stop")
        with pytest.raises(HttpError) as caught:
            world.http.get("/request/abort", id=number, s="t")
        assert (caught.value.ex, caught.value.status) == ("::genom::syserr", 422)
        os.kill(bass.pid, signal.SIGCONT)
        caller.join(harness.PATIENCE)
        assert answers == [{}]


def test_a_master_that_restarts(empty_world: World) -> None:
    world = empty_world
    with world.graph.node("bass-ros"):
        number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
        world.http.call("bass/Audio")
        world.master.kill()
        # Connected clients continue without a master; new requests report that it is missing.
        assert world.http.call("bass/Audio")["Audio"]["sampleRate"] == 44100
        assert "no ROS master at" in problem(world, "rosAFE/Stop")
        world.http.get("/request/abort", id=number, s="t")
        world.http.wait(number, "done")
        world.master.start(world.graph.env)
        harness.wait_for(lambda: "/bass/Stop" in world.graph.services(), what="bass tells the new master")
        assert world.http.call("bass/Stop") == {}
        number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
        assert world.http.status(number) == {"id": number, "status": "sent"}
        world.http.call("bass/Stop")
        world.http.wait(number, "done")


@pytest.mark.parametrize("how", ["killed", "hanging"])
def test_known_components_continue_without_a_master(tmp_path: Path, how: str) -> None:
    """New services, activities, sessions and ports, over HTTP and in Tcl."""
    with worlds.world(tmp_path) as world:
        http = world.http
        start_tree(http)
        await_clients(world)
        with away(world.master, how):
            go_on(world)


@contextmanager
def away(master: harness.MasterProcess, how: str) -> Iterator[None]:
    """Meanwhile the master does not answer."""
    assert master.process is not None
    if how == "killed":
        master.kill()
        yield
        return
    harness.freeze(master.process.pid)
    try:
        yield
    finally:
        os.kill(master.process.pid, signal.SIGCONT)


def go_on(world: World) -> None:
    """Use known and new services of both components."""
    http = world.http
    assert http.call("rosAFE/getDependencies", ["gammatone"])["dependencies"][-1] == "gammatone"
    assert http.get("/load/rosAFE", s="new")["instance"] == "rosAFE"
    first = http.call("bass/Audio")["Audio"]["lastFrameIndex"]
    harness.wait_for(lambda: http.call("bass/Audio")["Audio"]["lastFrameIndex"] > first)
    number = http.send("rosAFE/IhcProc", s="new", ack=1)
    assert http.status(number, s="new") == {"id": number, "status": "sent"}
    assert http.call("rosAFE/ihcPort/ihc")["ihcPort"]["numberOfChannels"] == 4
    made = http.call("rosAFE/request", ["ratemap", {"nFramesPerBlock": 4410, "fb_nChannels": 4}])
    assert made["reused"] and made["created"][-1] == "ratemap_0"
    with pytest.raises(HttpError) as caught:
        http.call("rosAFE/ihcPort/none")
    assert (caught.value.ex, caught.value.what) == ("::genom::no_such_outport", "ihcPort has no element 'none'")
    http.call("rosAFE/removeProcessor", ["ihc"])
    assert http.wait(number, "done", s="new")["output"] == {}
    assert world.lines("""
        set g [genomix::connect $address]
        $g load rosAFE
        $g load bass
        bass::Stop
        set acquire [bass::Acquire scene: &]
        while {![dict get [bass::getAcquisition] running]} { after 10 }
        show [dict get [rosAFE::getParameters] parameters gammatone 0 name]
        show [dict get [rosAFE::gammatonePort gammatone] gammatonePort numberOfChannels] [$acquire status]
        bass::Stop
        show [$acquire wait]
    """) == ["gammatone", "4|sent", "done"]
    with pytest.raises(HttpError, match="no ROS master at"):
        http.get("/load/stranger")


def await_clients(world: World) -> None:
    """Wait until genomixd is connected to all activities of both components."""
    master: Any = xmlrpc.client.ServerProxy(world.graph.uri)
    for component in COMPONENTS.values():
        parts = {f"/{component.name}/{s.name}/{p}" for s in component.activities for p in ACTION_TOPICS}
        node = xmlrpc.client.ServerProxy(master.lookupNode("/test", f"/{component.name}")[2])

        def connected(node: Any = node, parts: set[str] = parts) -> bool:
            return parts <= {connection[4] for connection in node.getBusInfo("/test")[2]}

        harness.wait_for(connected, what=f"all connections to {component.name}")


# bass-ros that opens a source only when the file argv[1] exists, unless it is stopped before.
SLOW_BASS = """
import os, sys
from rosafe.ros1.bass import node
at_once = node.open_source
def open_source(*arguments):
    while not (os.path.exists(sys.argv[1]) or arguments[-1].wait(0.02)):
        pass
    return at_once(*arguments)
node.open_source = open_source
sys.exit(node.main([]))
"""


@contextmanager
def slow_bass(world: World, opened: Path) -> Iterator[harness.Process]:
    code = f"import sys; sys.path.insert(0, {str(harness.ROOT)!r}){SLOW_BASS}"
    with world.graph.start(harness.PYTHON, "-c", code, str(opened)) as process:
        world.graph.wait_until_up(process, "bass")
        yield process


def test_every_request_is_answered(empty_world: World, tmp_path: Path) -> None:
    """Clients such as Octave have no time limit: an activity that does not begin, and a component that hangs."""
    world = empty_world
    changes = "from rosafe.web.genomix import routes\nroutes.ANSWER_SECONDS = 3.0"
    with slow_bass(world, tmp_path / "opened") as bass, worlds.changed_genomixd(world, changes) as hasty:
        harness.wait_for(lambda: hasty.http.raw("/load/bass")[0] == 200)
        number = hasty.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
        assert hasty.http.status(number) == {"id": number, "status": "sent"}
        harness.freeze(bass.pid)
        with ThreadPoolExecutor() as pool:
            answers = pool.map(hasty.http.raw, ("/call/bass/Stop", "/call/bass/ListDevices"))
        for status, reason in answers:
            assert status == 502 and "::genom::mwerr" in reason and "no answer within 3 s" in reason
        os.kill(bass.pid, signal.SIGCONT)
        world.http.call("bass/Stop")
        assert hasty.http.wait(number, "error")["exception"]["ex"] == "::genom::interrupted"


def test_acknowledged_activities_run(empty_world: World, tmp_path: Path) -> None:
    """A slow start that is stopped ends normally."""
    world, opened = empty_world, tmp_path / "opened"
    numbers: list[str] = []
    sender = threading.Thread(
        target=lambda: numbers.append(world.http.send("bass/Acquire", {"device": "scene:"}, ack=1))
    )
    with slow_bass(world, opened):
        sender.start()
        harness.wait_for(lambda: "Acquire" in str(world.http.call("bass/genom_state")))
        sender.join(0.8)
        assert numbers == []
        opened.touch()
        sender.join(harness.PATIENCE)
        world.http.call("bass/Stop")
        assert world.http.wait(numbers[0], "done")["output"] == {}


def test_load_waits_for_a_component_that_is_starting(empty_world: World) -> None:
    world = empty_world
    begin = time.monotonic()
    assert "bass is not running" in problem(world, "bass/Stop")
    assert time.monotonic() - begin > 1.9  # at least, as docs/genomixd.md says
    # long enough for a component to start on a busy machine
    changes = "from rosafe.ros1.client import component_client\ncomponent_client.APPEAR_SECONDS = 60.0"
    with worlds.changed_genomixd(world, changes) as changed, ThreadPoolExecutor() as pool:
        patient = changed.http
        loads = [pool.submit(patient.get, "/load/bass", s=f"s{number}") for number in range(3)]
        assert patient.get("/components") == {}
        with world.graph.node("bass-ros"):
            assert [load.result()["component"] for load in loads] == ["bass"] * 3
