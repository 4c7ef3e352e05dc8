"""The original user's guide, typed word for word, and the ways in which published scripts use genomix."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import tomllib

from tests import harness
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

SHELLS = ("tclsh", "eltclsh")


def guide_commands() -> list[str]:
    """The guide's commands for eltclsh, with a sound device that exists everywhere."""
    text = harness.shared("spec", "original-user-guide.txt").read_text("utf-8")
    commands = re.findall(r"^.*eltclsh[ ]*>[ ]*(.*?)[ ]*$", text, re.MULTILINE)
    assert len(commands) == 18
    return [command.replace("hw:1,0", "scene:") for command in commands]


PATTERNS = {
    name: pattern["script"]
    for name, pattern in tomllib.loads(Path(__file__).with_name("patterns.toml").read_text("utf-8")).items()
}


@pytest.mark.parametrize(
    ("pattern", "shell"),
    [
        pytest.param(pattern, shell, marks=() if (number + position) % 2 else pytest.mark.exploration)
        for number, pattern in enumerate(PATTERNS)
        for position, shell in enumerate(SHELLS)
    ],
)
def test_usage_patterns_of_published_scripts(world: World, pattern: str, shell: str) -> None:
    """Each shows an empty line on success."""
    if "left" in PATTERNS[pattern]:
        with world.graph.node("bass-ros", "-i", "left"):
            assert world.lines(PATTERNS[pattern], shell=shell) == [""]
    else:
        assert world.lines(PATTERNS[pattern], shell=shell) == [""]


@pytest.mark.parametrize("shell", SHELLS)
def test_pattern_24_a_shell_script_that_execs_a_tcl_shell(world: World, shell: str) -> None:
    """OPT, LER: stop scripts are separate executables."""
    script = world.graph.home / "stop.tcl"
    script.write_text(
        f'#!/bin/sh\n# the next line restarts using {shell} \\\nexec {shell} "$0" ${{1+"$@"}}\n'
        "package require genomix\nset g [genomix::connect [lindex $argv 0]]\n$g rpath /tmp\n$g load bass\n"
        "bass::Stop\nputs stopped\n"
    )
    script.chmod(0o755)
    assert world.graph.run(str(script), f"127.0.0.1:{world.port}").stdout == "stopped\n"
