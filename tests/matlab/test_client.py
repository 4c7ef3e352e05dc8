"""The genomix client in Octave: components, requests, values, ports, errors, and questions at the prompt."""

from __future__ import annotations

import pytest

from rosafe.interface import BASS
from tests import harness
from tests.matlab import octave
from tests.terminal import Terminal
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


def test_components_and_errors(world: World) -> None:
    results = octave.run_and_parse(world, octave.script("components_and_errors"))
    services, ports = (world.http.get("/describe/rosAFE")[kind] for kind in ("services", "ports"))
    assert results["names"] == [*services, *ports]
    assert "unsigned long fb_nChannels: Number of channels; 0: as many as fb_nERBs gives (0)" in results["help"]
    assert results["no service"].startswith("genomix:component rosAFE: expected a service or port (Input")
    assert results["no service"].endswith("), got 'Ratemapproc_'")
    assert "expected '-i', 'instance'" in results["no instance"]
    assert "/rosAFE: expected the component bass, got rosAFE" in results["wrong instance"]
    assert results["no text"].startswith("genomix:connection address: expected a text")
    assert results["address"] == f"127.0.0.1:{world.port}"
    assert results["no server"].startswith("genomix:connection no answer from genomixd at 127.0.0.1:1 (")
    assert "genomixd &" in results["no server"]
    assert results["many"].startswith("InputProc: expected at most 4 arguments, got 5; InputProc takes name (string)")
    assert results["long"][0] == "error" and "expected arguments of at most 80000 characters" in results["long"][1]
    assert results["pairs"].endswith("expected the parameters in one object after representation, got 'fb_nChannels'")
    assert "was deleted" in results["deleted"]


def test_values(world: World) -> None:
    """All forms of arguments are accepted, and results have the classes and shapes that scripts expect."""
    octave.run(world, octave.script("values"))


def test_questions_at_the_prompt(world: World) -> None:
    """A service that is called at the prompt without arguments asks for them; one called in a function does not."""
    octave.require_program()
    command = [*octave.COMMAND, "--no-line-editing"]
    with Terminal(command, {**world.graph.env, **octave.environment(world)}) as terminal:
        terminal.expect("> ")
        terminal.press("client = genomix.client; bass = client.load('bass'); rosAFE = client.load('rosAFE');\r")
        terminal.press("r = bass.Acquire('-a');\r")
        terminal.expect(f"string device: {BASS.service('Acquire').parameter('device').doc} (hw:1,0) > ")
        terminal.press("'scene:'\r")  # the quotes are removed
        terminal.expect("unsigned long sampleRate: ")
        terminal.expect("(44100) > ")
        terminal.press("22050\r")
        for name in ("nFramesPerChunk", "nChunksOnPort"):
            terminal.expect(f"{name}: ")
            terminal.expect(") > ")
            terminal.press("\r")
        terminal.press("r\r", "r =")
        terminal.expect("  request with properties:")
        for line in ("       status: 'sent'", "       result: []", "    exception: []"):
            terminal.expect(line)
        harness.wait_for(lambda: world.http.call("bass/Audio")["Audio"]["sampleRate"] == 22050, what="the given rate")
        terminal.press("d = rosAFE.getDependencies('ild'); disp(['then ' d.status])\r", "then error")
        terminal.press("f = @() 1; function r = within(c), r = c.getDependencies(); end\r")
        terminal.press("d = within(rosAFE); disp(['within ' d.status])\r", "within error")
        terminal.press("p = rosAFE.ildPort()\r", "string element: name of the processor > ")
        terminal.press('"no\'body"\r')
        for line in ("status: 'error'", "result: []", "exception: [1x1 struct] ::genom::no_such_outport: "):
            terminal.expect(line)
        terminal.expect('ildPort has no element "no\'body"; there are: none')
        terminal.press("exit\r")
        terminal.end()
