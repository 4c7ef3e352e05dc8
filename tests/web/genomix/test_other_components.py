"""Components of other ROS packages through genomixd: a small test component."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe import interface
from rosafe.interface import ComponentError
from rosafe.ros1.client import installed_components, tcpros
from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.arm.package import generate
from tests.web.genomix.world import Http, HttpError, World

pytestmark = pytest.mark.ros

POSE = {"position": {"x": 1.5, "y": -2}, "angles": [0.1, 0.2, 0.3], "frame": "base"}


def search_path(graph: harness.Graph, folder: Path) -> str:
    return f"{folder}:{graph.env['PYTHONPATH']}"


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A graph with genomixd and two instances of the component."""
    folder = generate(tmp_path_factory.mktemp("packages"))
    server = str(Path(__file__).with_name("arm") / "server.py")
    with harness.private_graph(tmp_path_factory.mktemp("home")) as (graph, master):
        graph.env["PYTHONPATH"] = search_path(graph, folder)
        with (
            worlds.genomixd(graph) as (process, port),
            graph.start(harness.PYTHON, server, "arm"),
            graph.start(harness.PYTHON, server, "left"),
        ):
            harness.wait_for(lambda: {"/arm/Move/goal", "/left/Move/goal"} <= topics(graph), what="the components")
            yield World(graph, master, process, port)


def topics(graph: harness.Graph) -> set[str]:
    return {topic for topic, _ in graph.readers()}


def test_load_describes_the_installed_package(robot: World) -> None:
    described = robot.http.get("/load/arm")
    assert described["component"] == described["instance"] == "arm"
    assert set(described["services"]) == {"connect_port", "kill", "SetSpeed", "GetSpeed", "SetPose", "Move"}
    assert described["services"]["Move"]["activity"] and not described["services"]["SetPose"]["activity"]
    assert list(described["services"]["SetPose"]["parameters"]) == ["pose", "path", "tries"]
    assert described["services"]["SetPose"]["outputs"] == {"pose": "::arm::arm_pose", "points": "unsigned long"}
    speed = described["services"]["SetSpeed"]["parameters"]["speed"]
    assert speed["required"] and speed["choices"] == ["::arm::SLOW", "::arm::FAST"]
    assert {name: port["multiple"] for name, port in described["ports"].items()} == {
        "genom_state": False,
        "State": False,
        "Joint": True,
    }
    assert robot.http.get("/load/arm", i="left")["instance"] == "left"


def test_functions_with_structures_and_enumerations(robot: World) -> None:
    call = robot.http.call
    path = [{"x": 1, "y": 2}, {"x": "3", "y": "4.5"}]
    assert call("arm/SetPose", {"pose": POSE, "path": path, "tries": 2}) == {"pose": POSE, "points": 2}
    assert call("arm/SetPose", [POSE, [], "3"]) == {"pose": POSE, "points": 0}
    for given, shown in (("FAST", "::arm::FAST"), ("::arm::SLOW", "::arm::SLOW")):
        assert call("arm/SetSpeed", [given]) == {}
        assert call("arm/GetSpeed") == {"speed": shown}
    with pytest.raises(HttpError) as raised:
        call("arm/SetPose", [POSE, [], 0])
    assert raised.value.ex == "::arm::e_tries" and raised.value.body["detail"]["least"] == 1


@pytest.mark.parametrize(
    ("service", "given", "what"),
    [
        ("SetSpeed", ["RAPID"], "::arm::SLOW, ::arm::FAST"),
        ("SetSpeed", [], "speed is missing"),
        ("SetPose", [{"frame": "x"}, [], 1], "pose: expected an object with position, angles, frame"),
        ("SetPose", [{**POSE, "angles": [1, 2]}, [], 1], "angles"),
        ("SetPose", [{**POSE, "position": 3}, [], 1], "position: expected an object with x, y, got 3"),
        ("SetPose", [POSE, {"x": 1, "y": 2}, 1], "path"),
        ("SetPose", [POSE, [], 1e9], "tries: expected a number in the range of short, got 1000000000.0"),
        ("SetPose", ["x {y", [], 1], "pose: expected an object"),
        ("Move", [1], "speed is missing"),
    ],
)
def test_wrong_arguments_are_named(robot: World, service: str, given: object, what: str) -> None:
    with pytest.raises(HttpError) as raised:
        robot.http.call(f"arm/{service}", given)
    assert raised.value.ex == "::genom::serialization"
    assert what in raised.value.what


def test_ports(robot: World) -> None:
    robot.http.call("left/SetPose", [POSE, [{"x": 1, "y": 2}], 1])
    robot.http.get("/load/left")
    state = robot.http.get("/call/left/State")["State"]
    assert state["pose"] == POSE and state["path"] == [{"x": 1, "y": 2}]
    assert state["raw"] == [1, 255] and state["speed"] == "::arm::SLOW" and state["stamp"] == {"sec": 7, "nsec": 8}
    assert robot.http.get("/call/left/Joint/left") == {"Joint": {"x": 0.5, "y": -0.5}}
    assert robot.http.get("/call/left/genom_state")["genom_state"]["version"] == "1.2"


def test_activities(robot: World) -> None:
    robot.http.get("/load/arm", s="t")
    done = robot.http.send("arm/Move", {"distance": 2.5, "speed": "SLOW"})
    assert robot.http.wait(done, "done")["output"] == {"moved": 2.5}
    failed = robot.http.send("arm/Move", {"distance": -1, "speed": "SLOW"})
    assert robot.http.wait(failed, "error")["exception"]["ex"] == "::arm::e_distance"
    long = robot.http.send("arm/Move", {"distance": 1e6, "speed": "FAST"})
    robot.http.get("/request/abort", id=long, s="t")
    assert robot.http.wait(long, "error")["exception"]["ex"] == "::genom::interrupted"


def test_tcl(robot: World) -> None:
    lines = robot.lines("""
        set g [::genomix::connect $address]
        $g load arm
        $g load arm -i left
        ::left::SetSpeed FAST
        show [::left::GetSpeed]
        set pose {position {x 1 y 2} angles {0.5 0.25 0} frame base}
        show [dict get [::arm::SetPose [list pose $pose path {{x 1 y 2}} tries 1]] points]
        set state [dict get [::arm::State] State]
        show [dict get $state pose position x] [dict get $state pose frame]
        show [dict get [::arm::Joint left] Joint y]
        ::arm::Move {distance 1 speed SLOW}
        show moved
        show {*}[failure {::arm::SetSpeed RAPID}]
    """)
    assert lines[:5] == ["speed ::arm::FAST", "1", "1.0|base", "-0.5", "moved"]
    assert "::genom::serialization" in lines[5] and "::arm::FAST" in lines[5]


# Describes the component arm with each of some folders first in the path, and prints the error.
DESCRIBE = """
import os, sys
from rosafe.ros1.client import installed_components
from rosafe.interface import ComponentError
for folder in sys.argv[1:]:
    if os.fork() == 0:
        sys.path.insert(0, folder)
        try:
            installed_components.describe("arm")
        except ComponentError as problem:
            print(problem.ex, problem.detail["what"])
        sys.exit()
    os.wait()
"""


def test_the_error_names_a_missing_package(robot: World, tmp_path: Path) -> None:
    """The package, a message that the package needs, or the state that every component has."""
    empty = tmp_path / "empty"
    empty.mkdir()
    broken = generate(tmp_path / "broken")
    (broken / "arm" / "msg" / "_arm_point.py").unlink()
    old = generate(tmp_path / "old", without=("genom_state_component",))
    closed = generate(tmp_path / "closed", without=("connect_port",))
    foreign = tmp_path / "foreign"
    for part in ("msg", "srv"):
        (foreign / "arm" / part).mkdir(parents=True)
        for name in ("__init__", "_kill"):
            (foreign / "arm" / part / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    ours = robot.graph.env["PYTHONPATH"].partition(":")[2]
    expected = {
        empty: ["ROS package arm is not installed", "PYTHONPATH"],
        broken: ["arm.msg", "_arm_point"],
        old: ["genom_state_component"],
        closed: ["connect_port"],
        foreign: ["ROS package arm is not installed", "genpy"],
    }
    command = (harness.PYTHON, "-c", DESCRIBE, *map(str, expected))
    lines = robot.graph.run(*command, PYTHONPATH=f"{harness.ROOT}:{ours}").stdout.splitlines()
    for line, words in zip(lines, expected.values(), strict=True):
        assert line.startswith("::genomix::e_load ") and all(word in line for word in words), line
    home = harness.Graph(robot.graph.uri, tmp_path)
    home.env["PYTHONPATH"] = f"{foreign}:{ours}"
    with worlds.genomixd(home) as (_, port), pytest.raises(HttpError) as raised:
        Http(port).get("/load/arm")
    assert raised.value.ex == "::genomix::e_load" and "genpy" in raised.value.what
    assert not (tmp_path / "imported").exists()


@pytest.mark.parametrize("package", ["other.arm", ".arm", "arm.msg", "", "..", "a\0b", "a\nb", "1arm", "long"])
def test_a_type_that_names_no_package_imports_nothing(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any node may claim that its service is of any type."""
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "__init__.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(generate(tmp_path)))
    with pytest.raises(ComponentError) as raised:
        installed_components.describe("a" * 200_000 if package == "long" else package)
    assert raised.value.ex == "::genomix::e_load"
    assert len(str(raised.value)) < 1000 and "PACKAGE/connect_port" in str(raised.value)
    assert not (tmp_path / "imported").exists()


def test_topics_that_are_no_messages_are_no_ports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any node may register a topic of any type for the component."""
    monkeypatch.syspath_prepend(str(generate(tmp_path)))
    arm = installed_components.describe("arm")
    kinds = ["arm/__name__", "arm/_arm_point", "arm/__dict__", "arm/", "/", "*", "arm/x/y"]
    topics = {f"/left/{number}": kind for number, kind in enumerate(kinds)}
    assert installed_components.with_ports(arm, "/left", topics | {"/left/a": "arm/arm_point"}).ports == (
        *arm.ports,
        interface.PortSpec("a", "::arm::arm_point", ""),
    )


@pytest.mark.parametrize("size", [tcpros.LARGE - 1, tcpros.LARGE])
def test_a_large_message_does_not_delay_other_requests(size: int) -> None:
    """Structures are decoded in Python: 300,000 of them take seconds."""

    class Message:
        def deserialize(self, data: bytearray) -> threading.Thread:
            return threading.current_thread()

    thread = asyncio.run(tcpros.decode(Message(), bytearray(size)))
    assert (thread is threading.current_thread()) == (size < tcpros.LARGE)
