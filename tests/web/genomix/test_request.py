"""Whole trees in one request, with real nodes: over HTTP, in tclsh, on the command line, and concurrently."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests import harness
from tests.web.genomix.test_server import live_activities
from tests.web.genomix.world import HttpError, World

pytestmark = pytest.mark.ros

RATE = 16000
CHAIN = ["input_0", "time_0", "filterbank_0", "innerhaircell_0", "ild_0"]


@pytest.fixture
def sound(world: World) -> Iterator[World]:
    """The module's world, in which bass captures and rosAFE is idle."""
    world.http.call("bass/Acquire", {"device": "scene:", "sampleRate": RATE})
    yield world


def names(world: World, component: str = "rosAFE") -> list[str]:
    """All processors of a component."""
    parameters = world.http.call(f"{component}/getParameters")["parameters"]
    return [structure["name"] for structures in parameters.values() for structure in structures]


def parameters(world: World, kind: str) -> list[dict[str, Any]]:
    """The structures of all processors of one kind."""
    return list(world.http.call("rosAFE/getParameters")["parameters"][kind])


def refusal(call: Callable[[], object]) -> HttpError:
    """The error that a call ends with."""
    with pytest.raises(HttpError) as refused:
        call()
    return refused.value


def command(world: World, *arguments: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `rosafe request`."""
    done = world.graph.run("rosafe", "request", *arguments, check=False)
    return done.returncode, done.stdout, done.stderr


# --- HTTP -------------------------------------------------------------------------------------------------------


def test_another_instance_and_its_end(world: World) -> None:
    world.http.call("bass/Acquire", {"device": "scene:"})
    with world.graph.node("rosAFE-ros", "-i", "left") as node:
        code, out, err = command(world, "filterbank", "-i", "left", "fb_nChannels=2")
        assert (code, err) == (0, "")
        assert out.splitlines()[-1].split() == ["created", "filterbank_0", "/left/gammatonePort/filterbank_0"]
        assert names(world) == [] and len(names(world, "left")) == 3
        node.stop(signal.SIGKILL)
        assert refusal(lambda: world.http.call("left/request", ["ild"])).ex == "::genom::mwerr"
    code, _, err = command(world, "ild", "-i", "left")
    assert code == 1 and "start it with: rosAFE-ros -i left" in err and err.count("\n") == 1


# --- Tcl --------------------------------------------------------------------------------------------------------


def test_tcl(sound: World) -> None:
    script = """
        set g [genomix::connect $address]
        $g load rosAFE
        show [::rosAFE::request ild {fb_nChannels 16}]
        show [dict get [rosAFE::request {representation ild fb_nChannels 16}] created]
        show [dict get [rosAFE::request filterbank {fb_cfHz {500 1000}}] topic]
        show [dict get [rosAFE::request time] name]
        set request [rosAFE::request ratemap {fb_nChannels 16} & show callback]
        show [$request wait 60000] [dict get [$request result] name]
        after 50 {set forever 1}; vwait forever
        set structure [dict remove [dict get [rosAFE::getParameters] parameters gammatone 0] name]
        show [dict get [rosAFE::request ild $structure] name]
        show [lindex [failure {rosAFE::request}] 1 2 1]
        show [lindex [failure {rosAFE::request ild fb_nChannels 16}] 1 2 1]
        show [lindex [failure {rosAFE::request ild {fb_nChannels}}] 1 1]
        show [lindex [failure {rosAFE::request ild {fb_nERB 16}}] 1 1]
        show [lindex [failure {rosAFE::request ild {fb_nChannels 2000}}] 1 1]
        puts [rosAFE::request -h]
    """
    chain = "0 input_0 1 time_0 2 filterbank_0 3 innerhaircell_0 4 ild_0"
    lines = sound.lines(script)
    assert lines[:5] == [
        f"name ild_0 dependencies {{{chain}}} created {{{chain}}} reused {{}} unused {{}} port ildPort "
        "topic /rosAFE/ildPort/ild_0",
        "",
        "/rosAFE/gammatonePort/filterbank_1",
        "time_0",
        "done|ratemap_0",
    ]
    assert lines[5] == "callback|::genomix::request1"
    assert lines[6] == "ild_0"
    assert lines[7].startswith("request: representation is missing; one of input, time, filterbank")
    assert lines[8] == 'request: expected a dict of parameters after representation, got "fb_nChannels 16"'
    assert lines[9:12] == ["::genom::serialization"] * 2 + ["::rosAFE::e_badNewValue"]
    assert lines[13] == "  rosAFE::request representation ?{parameter value ...}?"
    assert lines[14].startswith("  representation (string, no default, one of input, time")


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command(sound: World) -> None:
    world = sound
    code, out, err = command(world, "ild", "fb_nChannels=16", "--connect", "bass/Audio", "nFramesPerBlock=1600")
    assert (code, err) == (0, "")
    ports = ["inputProcPort", "preProcPort/time_0", "gammatonePort/filterbank_0", "ihcPort/innerhaircell_0"]
    shown = [f"created  {name:15}  /rosAFE/{port}" for name, port in zip(CHAIN, [*ports, "ildPort/ild_0"], strict=True)]
    assert out.splitlines() == shown
    code, out, err = command(world, "time", "cc_wname=hann", "nFramesPerBlock=1")
    assert (code, out.split()[::3]) == (0, ["reused", "reused"])
    assert err.splitlines() == [
        "rosafe request: cc_wname has no effect on this representation",
        "rosafe request: nFramesPerBlock has no effect: the input exists already",
    ]
    # before a processor is created or rejected
    code, out, err = command(world, "ILD", "fb_highFreqHz=99999", "--connect", "foo/bar")
    assert (code, out) == (1, "")
    vain, refused = err.splitlines()
    assert vain == "rosafe request: connect has no effect: the input exists already"
    assert refused.startswith("rosafe request: ::rosAFE::e_badNewValue: fb_highFreqHz: ")
    code, out, err = command(world, "--json", "ratemap", "rm_decaySec=0.01", "fb_cfHz=500,1000,2000")
    assert (code, err) == (0, "")
    assert json.loads(out)["created"] == ["filterbank_1", "innerhaircell_1", "ratemap_0"]
    assert parameters(world, "gammatone")[1]["fb_cfHz"] == [500, 1000, 2000]
    assert parameters(world, "ratemap")[0]["rm_decaySec"] == 0.01


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], 2, "the following arguments are required: REPRESENTATION;"),
        (["spikes"], 1, "representation: expected one of input, time"),
        (["ild", "fb_nChannels"], 1, "expected NAME=VALUE, got 'fb_nChannels'"),
        (["ild", "fb_nChannels=1", "fb_nChannels=2"], 1, "fb_nChannels: expected one value, got two"),
        (["rate_map"], 1, "; did you mean ratemap?\n"),
        (["ild", "representation=time"], 1, "expected a known parameter, got 'representation'"),
        (["ild", "-i", "a b"], 1, "got 'a b'"),
        (["ild", "-i", "bass"], 1, "/bass: expected the component rosAFE, got bass"),
    ],
)
def test_mistakes_on_the_command_line(world: World, arguments: list[str], code: int, message: str) -> None:
    got, out, err = command(world, *arguments)
    assert (got, out) == (code, "")
    assert message in err and err.count("\n") == 1 and err.startswith("rosafe request: ")
    assert names(world) == []


def test_without_sound(world: World) -> None:
    """Rejected and interrupted requests without audio leave no processor, and the command prints the next step."""
    with world.graph.node("bass-ros", "-i", "mute"), world.graph.node("rosAFE-ros", "-i", "deaf"):
        refused = refusal(lambda: world.http.call("deaf/request", ["ild", {"connect": "mute/Audio"}]))
        assert (refused.status, refused.ex) == (422, "::rosAFE::e_noData")
        arguments = ("ild", "-i", "deaf", "--connect", "mute/Audio")
        code, out, err = command(world, *arguments)
        assert (code, out) == (1, "")
        message = "rosafe request: ::rosAFE::e_noData: no audio on the Audio port; start the sound first: "
        assert err.startswith(message) and err.count("\n") == 1
        assert names(world, "deaf") == []
        with world.graph.start("rosafe", "request", *arguments) as going:

            def waiting() -> bool:
                assert going.alive, going
                return live_activities(world, "deaf") == ["InputProc"]

            harness.wait_for(waiting)
            os.kill(going.pid, signal.SIGINT)
            assert "genom_success: True" in world.graph.run("sh", "-c", err.removeprefix(message)).stdout
            assert going.wait() == 130, going
            assert (going.out, going.err) == ("", "")
        assert names(world, "deaf") == []
        assert command(world, *arguments)[0] == 0
        assert names(world, "deaf") == CHAIN
