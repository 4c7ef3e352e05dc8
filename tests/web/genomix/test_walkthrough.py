"""The guide's session, step by step, compared with the table of the original's behaviour.

The steps run once, in order, in one Tcl shell; each has a test of its output.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness import wait_for
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

STEPS = {
    "load": "set g [::genomix::connect $address]; $g load bass; $g load rosAFE; "
    "list $g [namespace exists ::bass] [namespace exists ::rosAFE]",
    "connect before acquisition": "::rosAFE::connect_port Audio bass/Audio",
    "input without sound": "::rosAFE::InputProc {name input}",
    "acquire": "set acquire [::bass::Acquire {device scene: sampleRate 44100 nFramesPerChunk 2205 nChunksOnPort 20} &]",
    "input": "set input [::rosAFE::InputProc {nFramesPerBlock 2205 bufferSize_s_getSignal 0.1 name input} &]; "
    "soon $input",
    "preProc at once": "set preProc [::rosAFE::PreProc {name preProc upperDepName input pp_bRemoveDC 0 "
    "pp_cutoffHzDC 20 pp_bPreEmphasis false pp_coefPreEmphasis 0.97 pp_bNormalizeRMS FALSE "
    "pp_middleEarModel jespen} &]; soon $preProc",
    "gammatone": "::rosAFE::GammatoneProc {name gammatone upperDepName preProc fb_type gammatone fb_lowFreqHz 80 "
    "fb_highFreqHz 8000 fb_nERBs 1 fb_nChannels 0 fb_cfHz {} fb_nGamma 4 fb_bwERBs 1.0180}",
    "ihc": "::rosAFE::IhcProc {name ihc upperDepName gammatone ihc_method dau}",
    "leaves": "set leaves [list [::rosAFE::IldProc {ild_hSizeSec 10E-3 ild_wSizeSec 20E-3} &] "
    "[::rosAFE::RatemapProc {} &] [::rosAFE::CrossCorrelationProc &]]; lmap leaf $leaves {soon $leaf}",
    "leaves have data": "frames ildPort ild",
    "modify with spaces": ":: rosAFE :: modifyParameter {nameProc input nameParam pp_bRemoveDC newValue 1} &",
    "modify": "::rosAFE::modifyParameter {nameProc input nameParam pp_bRemoveDC newValue 1}",
    "modify the right one": "::rosAFE::modifyParameter {newValue 1 nameParam pp_bRemoveDC nameProc preProc}",
    "parameters": "set r [::rosAFE::getParameters &]; $r wait 60000; $r result",
    "dependencies": "set r [::rosAFE::getDependencies {nameProc ratemap} &]; $r wait 60000; $r result",
    "signals": "set r [::rosAFE::getSignals {} &]; $r wait 60000; lmap {kind all} [dict get [$r result] signals] "
    "{list $kind [dict size $all]}",
    "signals without argument": "string length [::rosAFE::getSignals]; ::rosAFE::getSignal; list fine",
    "a port": "dict keys [dict get [::rosAFE::preProcPort preProc] preProcPort]",
    "no such port": "::rosAFE::preProcPort dummyName",
    "defaults of an acquisition": "::bass::Acquire {}",
    "modify without arguments": "::rosAFE::modifyParameter",
    "dependencies without arguments": "::rosAFE::getDependencies",
    "remove without arguments": "::rosAFE::removeProcessor",
    "any order and any number": "::rosAFE::GammatoneProc {fb_highFreqHz 4E3 upperDepName preProc name one "
    "fb_cfHz 500}; dict get [::rosAFE::getParameters] parameters gammatone 1 fb_cfHz",
    "single zero": "::rosAFE::GammatoneProc {fb_cfHz 0 fb_nChannels 3 name three}; "
    "dict get [::rosAFE::getParameters] parameters gammatone 2 fb_nChannels",
    "true and false": "::rosAFE::PreProc {name flags pp_bRemoveDC true pp_bPreEmphasis 1 pp_bLevelScaling false "
    "pp_refSPLdBS 94}; lrange [dict get [::rosAFE::getParameters] parameters preProc 1] 0 19",
    "remove": "::rosAFE::removeProcessor {nameProc flags}; ::rosAFE::removeProcessor {name preProc}",
    "removed": "lmap {kind all} [dict get [::rosAFE::getParameters] parameters] {list $kind [dict size $all]}",
    "their requests": "concat [list [$preProc wait 60000]] [lmap leaf $leaves {$leaf wait 60000}] "
    "[list [$input status] [$acquire status]]",
    "their ports": "::rosAFE::ildPort ild",
}

PRELUDE = """
proc soon {request} {update; after 150; update; $request status}
proc frames {port name} {
    for {set i 0} {$i < 1200} {incr i} {
        set message [dict get [::rosAFE::$port $name] $port]
        if {[dict get $message lastFrameIndex] > 0} {return "[dict get $message framesOnPort] frames"}
        after 50
    }
}
proc step {name script} {
    if {[catch {uplevel #0 $script} result]} {set result "error $result"}
    puts "$name>[string map {"\\n" " "} $result]"
}
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("walk")


@pytest.fixture(scope="module")
def walked(home: Path) -> Iterator[tuple[World, dict[str, str]]]:
    """The world after the session, and the output of each step."""
    with worlds.world(home) as world:
        script = PRELUDE + "\n".join(f"step {{{name}}} {{{text}}}" for name, text in STEPS.items())
        lines = world.lines(script)
        yield world, dict(line.split(">", 1) for line in lines)


TREE = "input, preProc, gammatone, ihc, ild, ratemap, crosscorrelation"


def no_processor(name: str) -> str:
    return f"error ex ::rosAFE::e_noSuchProcessor what {{there is no processor '{name}'; there are: {TREE}}}"


EXPECTED = {
    "load": "genomix1 1 1",
    "connect before acquisition": "",
    "input without sound": "error ex ::rosAFE::e_noData what {no audio from /bass/Audio: is bass acquiring?}",
    "input": "sent",
    "preProc at once": "sent",
    "gammatone": "",
    "ihc": "",
    "leaves": "sent sent sent",
    "leaves have data": "100 frames",
    "modify": "error ex ::rosAFE::e_noSuchParameter what {processors of kind input have no 'pp_bRemoveDC'; they have: "
    "in_doNormalize, in_normalizeValue}",
    "modify the right one": "",
    "dependencies": "dependencies {0 input 1 preProc 2 gammatone 3 ihc 4 ratemap}",
    "signals": "{input 1} {preProc 1} {gammatone 1} {ihc 1} {ild 1} {ratemap 1} {crossCorrelation 1}",
    "signals without argument": "fine",
    "a port": "sampleRate lastFrameIndex framesOnPort left right",
    "modify without arguments": no_processor("nameProc"),
    "dependencies without arguments": no_processor("nameProc"),
    "remove without arguments": no_processor("name"),
    "any order and any number": "0 500.0",
    "single zero": "3",
    "remove": "",
    "removed": "{input 1} {preProc 0} {gammatone 0} {ihc 0} {ild 0} {ratemap 0} {crossCorrelation 0}",
    "their requests": "done done done done sent sent",
}


@pytest.mark.parametrize("step", EXPECTED)
def test_steps_with_one_answer(walked: tuple[World, dict[str, str]], step: str) -> None:
    assert walked[1][step] == EXPECTED[step]


@pytest.mark.parametrize(
    ("step", "part"),
    [
        ("acquire", "::"),
        ("modify with spaces", "::"),
        ("parameters", "pp_middleEarModel jepsen"),
        ("parameters", "fb_nChannels 31"),
        ("parameters", "in_doNormalize 1 in_normalizeValue 2147483647"),
        ("no such port", "error ex ::genom::no_such_outport"),
        ("defaults of an acquisition", "error ex ::bass::e_device"),  # hw:1,0, as the interface file says
        ("true and false", "pp_bRemoveDC 1 pp_cutoffHzDC 20.0 pp_bPreEmphasis 1"),
        ("true and false", "pp_bLevelScaling 0 pp_refSPLdB 94.0"),
        ("their ports", "error ex ::genom::no_such_outport"),
    ],
)
def test_details_of_steps(walked: tuple[World, dict[str, str]], step: str, part: str) -> None:
    assert part in walked[1][step]


def test_topics_of_the_graph(walked: tuple[World, dict[str, str]]) -> None:
    """The input and its port remain; the ports of removed processors are closed, and there are no others."""
    topics = walked[0].graph.topics()
    assert {"/rosAFE/inputProcPort", "/rosAFE/dataObj", "/bass/Audio"} <= topics
    wait_for(lambda: not [t for t in walked[0].graph.topics() if "Port/" in t])
