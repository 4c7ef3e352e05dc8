"""Plugins for tests: nine valid ones, and one with each kind of fault at run time."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import tomllib

from rosafe.declarations.representation import Representation
from rosafe.dsp.stage import Stage

HEAD = """\
from collections import deque
from dataclasses import replace

import numpy as np

from rosafe.plugin import Derived, FramedStage, Parameter, Part, Representation, Stage, frame_parameters
"""
FACTOR = 'Parameter("my_factor", "double", 2.0, "Factor", minimum=0.5, maximum=10.0)'
PLAIN = """

class Mine(Stage):
    REPRESENTATION = Representation(
        kind="mine", doc="Rates times a factor", parent="ratemap", axes=("ear", "channel", "time"),
        parameters=({parameters},), {declared}
    )

    def process(self, block, extra=None):
        return block * self.values["my_factor"]
"""
SAMPLES = PLAIN.replace('parent="ratemap"', 'parent="gammatone"')
FRAMED = """

class Mine(FramedStage):
    REPRESENTATION = Representation(
        kind="mine", doc="Mean of each frame", parent="gammatone", axes=("ear", "channel", "time"),
        parameters=(*frame_parameters("my"), {parameters}), {declared}
    )
    prefix = "my"

    def frame(self, frames):
        return frames.mean(axis=-1) * self.values["my_factor"]
"""
DERIVED = 'derived=(Derived("my_count", "unsigned long", "Number"),)'


class Fault(NamedTuple):
    """A plugin with a fault: the overriding code, the expected error, and further declarations."""

    text: str
    body: str
    expected_text: str
    declared: str = ""
    at_run_time: bool = True  # otherwise only the check command finds it


def process(*lines: str) -> str:
    """Return the source of a method `process`."""
    return "\n".join(["    def process(self, block, extra=None):", *(f"        {line}" for line in lines)])


_CLASSES = {"plain": PLAIN, "samples": SAMPLES, "framed": FRAMED}
FAULTS: Mapping[str, Fault] = {
    name: Fault(
        _CLASSES[fault.get("class", "plain")],
        fault.get("body", ""),
        fault["expected"],
        fault.get("declared", ""),
        fault.get("at_run_time", True),
    )
    for name, fault in tomllib.loads(Path(__file__).with_name("faults.toml").read_text("utf-8")).items()
}


def text_of(fault: Fault) -> str:
    """Return the source of the plugin."""
    plugin = fault.text.format(parameters=FACTOR, declared=fault.declared)
    if fault.declared.startswith("parts"):
        plugin = plugin.replace('axes=("ear", "channel", "time"),', "")
    return f"{HEAD}{plugin}\n{fault.body}\n"


def loaded(path: Path, name: str = "mine_for_tests") -> type[Stage]:
    """Load the representation in a file."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    (stage,) = (
        value
        for value in vars(module).values()
        if isinstance(value, type) and isinstance(vars(value).get("REPRESENTATION"), Representation)
    )
    return stage
