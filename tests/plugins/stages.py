"""Plugins for tests: nine valid ones, and one with each kind of fault at run time."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

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
TWO_PARTS = 'parts=(Part("a", ("channel", "time")), Part("b", ("channel", "time")))'
PARTS = """
    def output_rows(self, rows):
        return rows[1:]

    def part_rows(self, rows):
        return rows[1:], rows[1:]"""
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


def _frame(*lines: str) -> str:
    return "\n".join(["    def frame(self, frames):", *(f"        {line}" for line in lines)])


def _property(name: str, *lines: str) -> str:
    return "\n".join(["    @property", f"    def {name}(self):", *(f"        {line}" for line in lines)])


FAULTS: Mapping[str, Fault] = {
    "raises": Fault(PLAIN, process("return block / undefined"), "NameError"),
    "exits": Fault(PLAIN, process("raise SystemExit(3)"), "SystemExit"),
    "raises without a text": Fault(
        PLAIN,
        process("raise type('Odd', (ValueError,), {'__str__': lambda self: None})()"),
        "Odd: (its text cannot be read)",
    ),
    "starts wrong": Fault(
        PLAIN, "    def __init__(self, *a, **k):\n        pass", "expected a call of super().__init__"
    ),
    "writes": Fault(PLAIN, process("block *= 1000", "return block.copy()"), "read-only"),
    "unlocks": Fault(PLAIN, process("block.flags.writeable = True", "return block.copy()"), "WRITEABLE"),
    "writes the base": Fault(PLAIN, process("block.base[...] = 0", "return block.copy()"), "TypeError"),
    "its input": Fault(PLAIN, process("return block"), "shares memory with the input"),
    "a view": Fault(PLAIN, process("return block[:, ::-1]"), "shares memory with the input"),
    "a list": Fault(PLAIN, process("return block.tolist()"), "expected a float64 array, got list"),
    "nothing": Fault(PLAIN, process("pass"), "expected a float64 array, got NoneType"),
    "complex": Fault(PLAIN, process("return block * 1j"), "expected a float64 array, got complex128"),
    "objects": Fault(PLAIN, process("return block.astype(object)"), "expected a float64 array, got object"),
    "single precision": Fault(PLAIN, process("return block.astype('f4')"), "got one of float32", at_run_time=False),
    "not contiguous": Fault(PLAIN, process("return np.asfortranarray(block * 2)"), "not contiguous", at_run_time=False),
    "one ear": Fault(PLAIN, process("return block[0] * 2"), "expected shape (2, 31, frames)"),
    "a channel less": Fault(PLAIN, process("return block[:, 1:] * 2"), "expected shape (2, 31, frames)"),
    "two arrays": Fault(PLAIN, process("return block * 2, block * 3"), "expected 1 arrays"),
    "a part less": Fault(
        PLAIN,
        process("return block[0] * 2") + PARTS,
        "expected 2 arrays",
        TWO_PARTS,
    ),
    "parts of different lengths": Fault(
        PLAIN,
        process("return block[0] * 2, block[0, :, 1:] * 2") + PARTS,
        "as in the first part",
        TWO_PARTS,
    ),
    "a frame less": Fault(PLAIN, process("return block[..., 1:] * 2"), "as output_count declares"),
    "twice the frames": Fault(PLAIN, process("return np.repeat(block, 2, axis=-1)"), "as output_count declares"),
    "frames dropped": Fault(FRAMED, _frame("return frames[..., 1:, :].mean(axis=-1)"), "as output_count declares"),
    "not a number": Fault(PLAIN, process("return np.log(block - 1)"), "expected finite numbers"),
    "infinite in silence": Fault(
        PLAIN, process("return np.log10(block)"), "expected finite numbers", at_run_time=False
    ),
    "overflows": Fault(SAMPLES, process("return np.exp(block)"), "expected finite numbers", at_run_time=False),
    "empty blocks": Fault(
        SAMPLES, process("return block - 0 * block[..., :1] + block.min() * 0"), "ValueError", at_run_time=False
    ),
    "long blocks": Fault(
        SAMPLES, process("assert block.shape[-1] < 1000", "return 2 * block"), "AssertionError", at_run_time=False
    ),
    "depends on blocks": Fault(
        SAMPLES, process("return block - block.mean(axis=-1, keepdims=True)"), "depends on blocks", at_run_time=False
    ),
    "its buffer again": Fault(
        SAMPLES,
        process(
            "if getattr(self, 'kept', None) is None or self.kept.shape != block.shape:",
            "    self.kept = np.empty(block.shape)",
            "np.multiply(block, 2, out=self.kept)",
            "return self.kept",
        ),
        "depends on blocks",
        at_run_time=False,
    ),
    "fixed number of channels": Fault(
        PLAIN,
        process("return block * self.weights")
        + "\n    def build(self, values, changed):"
        + "\n        self.weights = np.ones((len(self.input_format.center_frequencies), 1))",
        "5 channels during the sound",
        at_run_time=False,
    ),
    "raises after a change": Fault(
        PLAIN,
        process("return block * self.factor")
        + "\n    def build(self, values, changed):"
        + "\n        self.factor = {2.0: 2.0}[values['my_factor']]",
        "KeyError",
        at_run_time=False,
    ),
    "alters what it has": Fault(
        PLAIN,
        process("return block * self.factor[0]")
        + "\n    def build(self, values, changed):"
        + "\n        self.factor = getattr(self, 'factor', [2.0])"
        + "\n        self.factor[0] += 1",
        "build must create new objects",
        at_run_time=False,
    ),
    "no reset": Fault(
        SAMPLES,
        "    count = 0\n"
        + process("self.count += block.shape[-1]", "return block + (self.count - block.shape[-1] > 0)"),
        "",
        at_run_time=False,
    ),
    "remembers all": Fault(
        PLAIN,
        "    def reset(self):\n        self.kept = ()\n"
        + process("self.kept = (*getattr(self, 'kept', ()), block.copy())", "return block * 2"),
        "its state grows",
        at_run_time=False,
    ),
    "cannot be copied": Fault(
        PLAIN,
        "    def __copy__(self):\n        raise TypeError('no copies')",
        "no copies",
        at_run_time=False,
    ),
    "state seen twice": Fault(
        SAMPLES,
        "    def __init__(self, *arguments, **parameters):\n"
        "        super().__init__(*arguments, **parameters)\n        self.reset()\n"
        "    def reset(self):\n        self.count = np.zeros(1)\n        self.view = self.count[:]\n"
        + process(
            "first = self.view[0]",
            "self.count += block.shape[-1]",
            "return block + 1e-6 * (first + np.arange(block.shape[-1]))",
        ),
        "a deep copy of the stage",
        at_run_time=False,
    ),
    "rows as a list": Fault(
        PLAIN,
        "    def output_rows(self, rows):\n        return list(rows)",
        "output_rows: expected a tuple of integers",
    ),
    "rows as floats": Fault(
        PLAIN, "    def output_rows(self, rows):\n        return (2, rows[1] / 2)", "output_rows: expected a tuple"
    ),
    "too few rows": Fault(PLAIN, "    def output_rows(self, rows):\n        return (2,)", "a length for each of"),
    "no count": Fault(
        PLAIN, "    def output_count(self, count):\n        return None", "output_count: expected a number"
    ),
    "no derived": Fault(PLAIN, "", "my_count is missing", DERIVED),
    "derived raises": Fault(PLAIN, _property("derived", "return 1 / 0"), "ZeroDivisionError", DERIVED),
    "derived of a wrong type": Fault(PLAIN, _property("derived", "return {'my_count': 'a'}"), "my_count", DERIVED),
    "derived no dict": Fault(PLAIN, _property("derived", "return [3]"), "derived: expected a dict", DERIVED),
    "parameters raise": Fault(PLAIN, _property("parameters", "raise RuntimeError('never')"), "RuntimeError: never"),
    "built wrongly": Fault(PLAIN, "    def build(self, values, changed):\n        values['other']", "KeyError"),
    "no format": Fault(PLAIN, _property("output_format", "return 100.0"), "output_format: expected a SignalFormat"),
    "advice raises": Fault(
        PLAIN, "", "advice: KeyError: 'none'", "advice=lambda values: values['none']", at_run_time=False
    ),
    "advice without a text": Fault(
        PLAIN, "", "advice: expected a text, got None", "advice=lambda values: None", at_run_time=False
    ),
    "refuses without a name": Fault(
        PLAIN,
        "    def build(self, values, changed):\n        if values['my_factor'] > 3:\n"
        "            raise ValueError('too much')",
        "too much",
        at_run_time=False,
    ),
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
