"""Invalid declarations: only the affected plugin is left out, and reported with file, kind and reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import pytest
import tomllib

from rosafe.declarations.representation import Derived
from rosafe.declarations.signals import layout
from rosafe.interface import KINDS, ROSAFE
from rosafe.representations import plugin_conflicts

from .support import python

GOOD = """
import numpy as np
from rosafe.plugin import Derived, FramedStage, Parameter, Part, Representation, Stage, frame_parameters


class Mine(Stage):
    REPRESENTATION = Representation(
        kind="{kind}", doc="What it computes", parent="ihc", axes=("ear", "channel", "time"),
        parameters=(Parameter("{kind}_gain", "double", 1.0, "Gain", minimum=0.0, maximum=2.0),),
    )

    def process(self, block, extra=None, out=None):
        return block * self.values["{kind}_gain"]
"""


class Case(NamedTuple):
    """A replacement in the valid plugin, and the expected reason."""

    old: str
    new: str
    reason: str


CASES = [
    Case(group["old"], group["new"].replace("VALUE", value), reason)
    for group in tomllib.loads(Path(__file__).with_name("declarations.toml").read_text("utf-8"))["group"]
    for value, reason in group["cases"]
]


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the problems in a process with all of these plugins and a valid one, which is used."""
    folder = tmp_path_factory.mktemp("plugins")
    (folder / "good.py").write_text(GOOD.format(kind="good"))
    for number, case in enumerate(CASES):
        assert case.old in GOOD, case
        (folder / f"case{number}.py").write_text(GOOD.replace(case.old, case.new).format(kind=f"kind{number}"))
    code = """
import json, numpy, rosafe, rosafe.interface
from rosafe.ros1.component import generate
from rosafe.representations import BUILTIN, PROBLEMS, STAGES
result = rosafe.process(numpy.zeros((2, 100)), 16000, outputs=["good"])
assert result["good"].shape[-1] == 100
generate.ensure_messages()
import rosAFE.srv
assert rosAFE.srv.GoodProc
print(json.dumps({"problems": PROBLEMS, "kinds": sorted(set(STAGES) - BUILTIN)}))
"""
    done = python(code, folder)
    assert done.returncode == 0, done.stderr
    reported: dict[str, list[str]] = json.loads(done.stdout)
    return reported


def test_only_the_valid_plugin_is_loaded(loaded: dict[str, list[str]]) -> None:
    assert loaded["kinds"] == ["good"]
    assert len(loaded["problems"]) == len(CASES)
    assert len(CASES) >= 60


@pytest.mark.parametrize("number", range(len(CASES)), ids=lambda number: f"{number}-{CASES[number].reason[:40]}")
def test_the_problem_contains_the_reason(loaded: dict[str, list[str]], number: int) -> None:
    (line,) = [line for line in loaded["problems"] if f"/case{number}.py: " in line]
    assert CASES[number].reason in line
    assert "\n" not in line
    fails_first = any(word in CASES[number].new for word in ("raise ", "class :", "f()", "nothing_like"))
    kind_itself = "kind=" in CASES[number].new or "Parameter(" in CASES[number].new or "Part(" in CASES[number].new
    if not (fails_first or kind_itself or "Derived(" in CASES[number].new or "{{" in CASES[number].new):
        assert f"kind{number}" in line


def test_a_derived_value_needs_no_description() -> None:
    assert Derived("own_x", "double", "").doc == ""


def test_the_reserved_names_are_those_of_the_component() -> None:
    kinds = [name for kind in KINDS.values() for name in (kind.request, *kind.request_aliases)]
    requests = {name for s in (*ROSAFE.on_graph, *ROSAFE.client_side_services) for name in (s.name, *s.aliases)}
    assert requests - set(kinds) == set(plugin_conflicts.REQUESTS)
    ports = {name for port in ROSAFE.ports for name in (port.name, *port.aliases)}
    assert ports - {name for kind in KINDS.values() for name in (kind.port, *kind.port_aliases)} < set(
        plugin_conflicts.PORTS
    )
    messages = {layout(kind).idl for kind in KINDS.values() if len(kind.parts) == 1}
    assert messages == {f"::rosAFE::{name}SignalPortStruct" for name in plugin_conflicts.STRUCTS}
