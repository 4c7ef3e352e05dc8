"""A device name that would run a command is rejected by each interface that leads to bass, and nothing is run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosafe.ros1.component import serialization
from tests.commands.command import refused, rosafe
from tests.harness import Graph, Process
from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.world import HttpError, World

pytestmark = pytest.mark.ros
ATTACKS = (
    "tee:null,'|touch MARK',raw",
    "plug:\"file:'|touch MARK',raw\"",
    "plug:SLAVE='file:FILE=|touch MARK'",
    "file1:a/b",
)
WHY = "expected the name of a PCM"
ACTION = """
import sys, actionlib, rospy
from bass.msg import AcquireAction, AcquireGoal
rospy.init_node("attacker", anonymous=True)
client = actionlib.SimpleActionClient("/bass/Acquire", AcquireAction)
assert client.wait_for_server(rospy.Duration(60))
client.send_goal_and_wait(AcquireGoal(device=sys.argv[1]), rospy.Duration(60))
print(client.get_result().genom_exdetail)
"""


@pytest.fixture(scope="module")
def nodes_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Start a graph with a bass that has a working directory of its own."""
    with worlds.world(tmp_path_factory.mktemp("world"), nodes=False) as world:
        work = world.graph.home / "work"
        work.mkdir()
        with world.graph.node("bass-ros", cwd=work):
            yield world


def service(world: World, name: str) -> str:
    return world.graph.run("rosservice", "call", "/bass/Acquire", json.dumps({"device": name})).stdout


def action(world: World, name: str) -> str:
    return world.graph.run("/usr/bin/python3", "-c", ACTION, name).stdout


def http(world: World, name: str) -> str:
    with pytest.raises(HttpError) as caught:
        world.http.call("bass/Acquire", {"device": name})
    return f"{caught.value.ex} {caught.value.what}"


def tcl(world: World, name: str) -> str:
    hexed = name.encode().hex()
    script = f"""
        set c [genomix::connect $address]
        $c load bass
        set name [encoding convertfrom utf-8 [binary decode hex {hexed}]]
        puts [failure {{bass::Acquire [dict create device $name]}}]
    """
    return world.tcl(script).stdout


def in_octave(world: World, name: str) -> str:
    characters = [ord(character) for character in name]
    script = f"""
        client = genomix.client;
        bass = client.load('bass');
        r = bass.Acquire(char({characters}));
        show('told', {{r.status, r.exception.ex}});
    """
    return str(octave.run_and_parse(world, script)["told"])


@pytest.mark.parametrize("call", [service, action, http, tcl, in_octave], ids=lambda call: call.__name__)
def test_through_the_node(nodes_world: World, call: Callable[[World, str], str]) -> None:
    """All names, or one in programs that start slowly."""
    for name in ATTACKS[:1] if call in (action, tcl, in_octave) else ATTACKS:
        assert "::bass::e_device" in call(nodes_world, name), name
        assert os.listdir(nodes_world.graph.home / "work") == []


@pytest.mark.parametrize("name", ATTACKS, ids=range(len(ATTACKS)))
def test_through_the_command(tmp_path: Path, name: str) -> None:
    refused(rosafe("record", "--device", name, "--seconds", "1", cwd=tmp_path), WHY)
    refused(rosafe("record", "a.wav", "--device", name, "--seconds", "1", cwd=tmp_path), WHY)
    assert os.listdir(tmp_path) == []


def test_the_reason_is_returned_and_the_acquisition_continues(graph: Graph, bass_node: Process) -> None:
    assert graph.call("/bass/Acquire", device="scene:", sampleRate=8000, nFramesPerChunk=400).genom_success
    answer = graph.call("/bass/Acquire", device=ATTACKS[0])
    error = json.loads(answer.genom_exdetail)
    assert error["ex"] == "::bass::e_device"
    audio = serialization.message_class("bass", "::binaudio::portStruct")
    newest = graph.message("/bass/Audio", audio).lastFrameIndex
    graph.message("/bass/Audio", audio, accept=lambda message: message.lastFrameIndex > newest + 800)
    assert WHY in bass_node.err and bass_node.err.count("tee:null") == 1


def test_almost_correct_names_get_a_hint(graph: Graph, bass_node: Process) -> None:
    listed = "see ListDevices and `arecord -L` for the available devices)"
    for name, hint in {
        "scen:": "; did you mean scene:?",
        "Scene:?seconds=3": "; did you mean scene:?",
        "scene": "; did you mean scene:?",
        "'scene:'": "; did you mean scene:?",
        "File:/tmp/a.wav": "; did you mean file:?",
        "bags:/tmp/a.bag": "; did you mean bag:?",
        "hw:1.0": listed,
        "no_such_pcm": listed,
    }.items():
        error = json.loads(graph.call("/bass/Acquire", device=name).genom_exdetail)
        assert error["ex"] == "::bass::e_device" and error["what"].endswith(hint), (name, error)
