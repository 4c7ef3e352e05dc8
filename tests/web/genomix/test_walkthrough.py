"""The guide's session, step by step, compared with the table of the original's behaviour.

The steps run once, in order, in one Tcl shell; each has a test of its output.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import tomllib

from tests.harness import wait_for
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

STEPS = tomllib.loads(Path(__file__).with_name("walkthrough.toml").read_text("utf-8"))
EXPECTED = {name: step["answer"] for name, step in STEPS.items() if "answer" in step}
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
        script = PRELUDE + "\n".join(f"step {{{name}}} {{{one['script']}}}" for name, one in STEPS.items())
        lines = world.lines(script)
        yield world, dict(line.split(">", 1) for line in lines)


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
