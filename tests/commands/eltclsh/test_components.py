"""The user guide typed at the prompt of eltclsh, with real nodes: completion, questions, callbacks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.terminal import Terminal
from tests.web.genomix import world as worlds
from tests.web.genomix.test_guide import guide_commands

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """Start the nodes and genomixd for all tests of the module."""
    with worlds.world(tmp_path_factory.mktemp("world")) as world:
        yield world


@pytest.fixture
def guide(world: worlds.World, tmp_path: Path) -> Iterator[Terminal]:
    """Start eltclsh; the nodes are idle."""
    env = {**world.graph.env, "GENOMIXD": f"127.0.0.1:{world.port}", "HOME": str(tmp_path)}
    with Terminal([str(harness.SCRIPTS / "eltclsh")], env) as terminal:
        terminal.expect("eltclsh > ")
        yield terminal
    world.reset()


def test_the_guide_typed_at_the_prompt(guide: Terminal) -> None:
    error = "::rosAFE::e_noSuchParameter\n"  # the input has no pp_bRemoveDC; printed because no command waits for it
    outputs = [guide.run(command).replace(f"rosAFE::modifyParameter &: {error}", "") for command in guide_commands()]
    assert outputs[:4] == ["1.8", "genomix1", "rosAFE", ""]
    requests = outputs[4:7] + outputs[9:]
    assert requests == [f"::genomix::request{n}" for n in range(1, len(requests) + 1)]
    assert outputs[7:9] == ["", ""]
    assert guide.run("::genomix::request7 wait 60000").endswith("error")
    assert guide.shown.count(error) <= 1
    assert guide.run("::genomix::request8 wait 60000") == "done"
    assert guide.run("::genomix::request9 wait 60000") == "done"
    assert guide.run("::genomix::request8 result").startswith("parameters {input {0 {name input")
    assert guide.run("catch {::genomix::request7 result} e; dict get $e ex") == "::rosAFE::e_noSuchParameter"
    assert guide.run("::genomix::request9 result") == "dependencies {0 input 1 preProc 2 gammatone 3 ihc 4 ratemap}"
    # removeProcessor removes the whole tree below preProc
    guide.run("::genomix::request10 wait 60000")  # there is no element dummyName; the error may be printed here
    guide.run("::genomix::request11 wait 60000")
    assert guide.run("rosAFE::getDependencies preProc") == (
        "ex ::rosAFE::e_noSuchProcessor what {there is no processor 'preProc'; there are: input}"
    )
    assert guide.run("dict size [dict get [rosAFE::getParameters] parameters preProc]") == "0"


def test_a_callback_runs_while_the_prompt_waits(guide: Terminal) -> None:
    guide.run("package require genomix; [genomix::connect] load bass")
    guide.run('proc report {request} {puts "[$request status]: [catch {$request result} e] [dict get $e ex]"}')
    guide.press("bass::Acquire {device none} & report\r", "error: 1 ::bass::e_device\n")


def test_an_error_in_the_background_is_printed_once(guide: Terminal) -> None:
    guide.run("package require genomix; set g [genomix::connect]; $g load rosAFE; $g load bass")
    guide.press("rosAFE::modifyParameter {nameProc missing nameParam x newValue 1} &\r", "\n::genomix::request1\n")
    guide.expect(
        "rosAFE::modifyParameter &: ::rosAFE::e_noSuchProcessor: there is no processor 'missing'; there are: none\n"
    )
    guide.press("rosAFE::preProcPort dummyName &\r")
    guide.expect("preProcPort &: ::genom::no_such_outport: preProcPort has no element 'dummyName'; there are: none\n")
    assert guide.run("::genomix::request1 status") == "error"
    guide.run("proc report {request} {puts reported}")
    assert guide.run("bass::Acquire {device none} & report") == "::genomix::request3"
    guide.expect("reported\n")
    guide.run("set r [bass::Acquire {device none} &]; $r wait; catch {$r result}; after 1000 {set past 1}; vwait past")
    assert guide.shown.count(" &: ") == 2
    assert guide.shown.count("while executing") == 0


def test_missing_parameters_are_asked_for(guide: Terminal) -> None:
    guide.run("package require genomix; set g [genomix::connect]; $g load bass; $g load rosAFE")
    guide.press("rosAFE::connect_port\r", "\nstring local: Name of this component's input port > ")
    guide.press("\r", "local has no default\n")
    guide.expect("string local: ")
    guide.press("Audio\r", "string remote: ")
    guide.press("bass/Audio\r", "eltclsh > ")
    question = guide.press("bass::Acquire &\r", "(hw:1,0) > ")
    assert "\nstring device: " in question
    guide.press("scene:\r")
    for name, answer in (("sampleRate", "22050"), ("nFramesPerChunk", ""), ("nChunksOnPort", "")):
        guide.expect(f"{name}: ")
        guide.expect(") > ")
        guide.press(f"{answer}\r")
    guide.expect("::genomix::request1\n")
    guide.expect("eltclsh > ")
    guide.run(
        "while {[dict get [bass::Audio] Audio sampleRate] != 22050} {after 20}"
    )  # Acquire returns before the capture starts
    assert guide.run("dict get [bass::Audio] Audio sampleRate") == "22050"
    # No questions: with `--`, in a script or procedure, with an empty list, or for help.
    assert guide.run("rosAFE::InputProc --") == ""
    assert guide.run("proc f {} {rosAFE::PreProc}; f") == ""
    assert guide.run("rosAFE::GammatoneProc {}") == ""
    assert guide.run("bass::Acquire -h").startswith("bass::Acquire: ")
    guide.run("set f [open ~/s.tcl w]; puts $f rosAFE::IhcProc; close $f")
    assert guide.run("source ~/s.tcl") == ""
    assert guide.run("dict size [dict get [rosAFE::getParameters] parameters ihc]") == "1"
    guide.press("rosAFE::request\r")  # asks only for parameters without a default
    guide.expect("\nstring representation: The representation, such as ild > ")
    guide.press("ihc\r")
    assert "\nname ihc dependencies {0 input 1 preProc 2 gammatone 3 ihc} created {} " in guide.expect("eltclsh > ")
    guide.press("rosAFE::IldProc\r", "string name: ")
    guide.expect(") > ")
    assert "no input" in guide.press("\x04", "eltclsh > ")
    assert guide.run("dict size [dict get [rosAFE::getParameters] parameters ild]") == "0"


def test_tab_completes_the_parameters_of_components(guide: Terminal) -> None:
    guide.run("package require genomix; set g [genomix::connect]; $g load rosAFE")
    for typed, completed in (
        ("rosAFE::Gammat\tP", "rosAFE::Gammatone"),
        ("::rosAFE::getDep\t", "::rosAFE::getDependencies "),
        ("puts [rosAFE::getPar\t", "puts [rosAFE::getParameters "),
        ("rosAFE::GammatoneProc {fb_nC\t", "{fb_nChannels "),
        ("rosAFE::GammatoneProc {name a upp\t", "{name a upperDepName "),
        ("rosAFE::GammatoneProc -a\t{fb_nC\t", "-ack {fb_nChannels "),
        ("rosAFE::GammatoneProc fb_nC\t", "{fb_nChannels "),
        ("rosAFE::gammatonePort -h\t", "-help "),
        ("rosAFE::request inn\t", "rosAFE::request innerhaircell "),
        ("rosAFE::request ild {fb_nC\t", "{fb_nChannels "),
        ("rosAFE::request ild fb_nC\t", "{fb_nChannels "),
        ("rosAFE::request {rep\t", "{representation "),
        ("$g unl\t", "$g unload "),
    ):
        guide.press(typed, completed)
        guide.press("\x15")
    output = guide.press("rosAFE::IhcProc \t\t", "rosAFE::IhcProc {")
    output += guide.expect("rosAFE::IhcProc {")
    assert "name" in output and "upperDepName" in output and "ihc_method" in output
    guide.press("\x15rosAFE::IhcProc {name a \r upp\t", "upperDepName ")
    guide.press("\x15}\r")
