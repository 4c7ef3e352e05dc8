"""Invalid declarations: only the affected plugin is left out, and reported with file, kind and reason."""

from __future__ import annotations

import json
from typing import NamedTuple

import pytest

from rosafe.declarations.representation import Derived
from rosafe.declarations.signals import layout
from rosafe.interface import KINDS, ROSAFE
from rosafe.representations import checks

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
TWO_PARTS = 'parts=(Part("one", ("channel", "time")), Part("two", ("channel", "time")))'


class Case(NamedTuple):
    """A replacement in the valid plugin, and the expected reason."""

    old: str
    new: str
    reason: str


AXES = 'axes=("ear", "channel", "time")'
PARAMETER = 'Parameter("{kind}_gain", "double", 1.0, "Gain", minimum=0.0, maximum=2.0)'


def _field(name: str, value: str, reason: str) -> Case:
    """Return a case with a further field of Representation."""
    return Case('doc="What', f'{name}={value}, doc="What', reason)


def _parameter(text: str, reason: str) -> Case:
    return Case(PARAMETER, f"Parameter({text})", reason)


CASES = [
    # Representation: kind and doc
    *(
        Case('kind="{kind}"', f"kind={kind}", reason)
        for kind, reason in (
            ('""', "kind: expected a name"),
            ("None", "kind: expected a name"),
            ("5", "kind: expected a name"),
            ("['x']", "kind: expected a name"),
            ('"two words"', "kind: expected a name"),
            ('"9lives"', "kind: expected a name"),
            ('"ünïcode"', "kind: expected a name"),
            ('"class"', "kind: expected a name that is free"),
            ('"k" * 300', "at most 64 characters"),
            ('"a/b"', "kind: expected a name"),
            ('"line\\n"', "kind: expected a name"),
            ('"ild"', "ild has 'ild' already"),
            ('"RateMap"', "ratemap has 'RateMap' already"),
            ('"filterbank"', "gammatone has 'filterbank' already"),
        )
    ),
    *(
        Case('doc="What it computes"', f"doc={doc}", "doc: expected")
        for doc in ('""', '"  "', '"two\\nlines"', "None", "7", '"x" * 5000', '"\\x1b[31m"')
    ),
    # parent
    Case('parent="ihc"', 'parent=""', "parent: expected a kind of processor"),
    Case('parent="ihc"', "parent=None", "parent: expected a string"),
    Case('parent="ihc"', 'parent="nobody"', "got 'nobody'"),
    Case('parent="ihc"', 'parent="{kind}"', "parent: expected one of "),
    # axes and parts
    *(
        Case(AXES, f"axes={axes}", reason)
        for axes, reason in (
            ("()", "axes: expected different ones"),
            ("None", "axes: expected a tuple of strings"),
            ('"time"', "axes: expected a tuple of strings"),
            ('("channel",)', "time last"),
            ('("time", "channel")', "time last"),
            ('("channel", "channel", "time")', "different ones"),
            ('("channel", "colour", "time")', "different ones"),
            ('("channel", 3, "time")', "axes: expected a tuple of strings"),
            ('("channel", ["time"])', "axes: expected a tuple of strings"),
            ('("channel", "ear", "time")', "ear first"),
            ('("ear", "channel", "lag", "filter", "time")', "at most two besides ear and time"),
        )
    ),
    Case(AXES, 'parts=(Part("one", ("ear", "channel", "time")), Part("two", ("channel", "time")))', "has the axis ear"),
    *(
        Case(AXES, f'parts=(Part({name}, ("channel", "time")), Part("two", ("channel", "time")))', reason)
        for name, reason in (
            ('"a blank"', "part 'a blank': name: expected a name"),
            ('"two"', "two are called 'two'"),
            ('"sampleRate"', "the name of another field"),
            ('"time"', "of another result"),
            ('"self"', "expected a name that is free"),
            ('""', "expected a name"),
            ("None", "expected a name"),
        )
    ),
    Case(AXES, "parts=(5,)", "parts: expected a tuple of Part"),
    Case(AXES, 'parts=(Part("one", None),)', "axes: expected a tuple of strings"),
    Case(AXES, TWO_PARTS, "the method part_rows is missing"),
    # names that follow from the kind
    _field("request", '"getSignals"', "'getSignals' is one of the component's own"),
    _field("request", '"stop"', "'stop' is one of the component's own"),
    _field("request", '"request"', "'request' is one of the component's own"),
    _field("request", '"ildProc"', "ild has 'ildProc' already"),
    _field("request", '"import"', "request: expected a name that is free"),
    _field("request", "5", "request: expected a string"),
    _field("request_aliases", '("kill",)', "'kill' is one of the component's own"),
    _field("request_aliases", '"Mine"', "request_aliases: expected a tuple"),
    _field("port", '"Audio"', "'Audio' is one of the component's own"),
    _field("port", '"ratemapPort"', "ratemap has 'ratemapPort' already"),
    _field("port", '"a b"', "port: expected a name"),
    _field("port_aliases", '("genom_state",)', "'genom_state' is one of the component's own"),
    _field("port_doc", "5", "port_doc: expected a string"),
    _field("name", '"ratemap"', "ratemap has 'ratemap' already"),
    _field("name", '"/slash"', "name: expected a name"),
    _field("word", '"filterbank"', "gammatone has 'filterbank' already"),
    _field("word_aliases", "(1,)", "word_aliases: expected a tuple of strings"),
    _field("allow_nan", "1", "allow_nan: expected True or False"),
    _field("unit", "b'dB'", "unit: expected a string"),
    _field("level", "3", "level: expected 0, 10 or 20 dB, got 3"),
    _field("amplitude_choice", '("{kind}_gain", "x")', "expected a parameter and one of its choices"),
    _field("amplitude_choice", '"power"', "amplitude_choice: expected a tuple"),
    _field("background", '"ild"', "background: expected a kind with the axes ear, channel, time, got 'ild'"),
    _field("background", '"nothing"', "background: expected a kind with the axes ear, channel, time"),
    _field("background", "5", "background: expected a string"),
    _field("channel_parameter", '"{kind}_gain"', "channel_parameter: expected a sequence<double>"),
    _field("advice", '"text"', "advice: expected a function, got 'text'"),
    _field("centred", '"lag"', "centred: expected one of the axes"),
    _field("features", '("a", "b")', "features: expected none without an axis feature"),
    _field("request_order", '("other",)', "request_order: expected the names of all parameters"),
    _field("coordinates", '("nothing",)', "coordinates: expected a parameter or derived value"),
    _field("coordinates", '("{kind}_gain",)', "that is a sequence"),
    Case(AXES, 'axes=("ear", "feature", "time"), features=("a", "a")', "features: 'a' occurs twice"),
    Case(AXES, 'axes=("ear", "feature", "time"), features=("a", 2)', "features: expected a tuple of strings"),
    # derived values
    *(
        _field("derived", f"(Derived({text}),)", reason)
        for text, reason in (
            ('"{kind}_x", "double", "Doc"', "the property derived is missing"),
            ('"{kind}_x", "quaternion", "Doc"', "type: expected one of"),
            ('"{kind}_x", None, "Doc"', "type: expected one of"),
            ('"", "double", "Doc"', "expected a name"),
            ('"{kind}_x", "double", 5', "expected one line of text"),
            ('"{kind}_gain", "double", "Doc"', "or a derived value, are called"),
        )
    ),
    _field("derived", "5", "derived: expected a tuple of Derived"),
    # parameters
    Case("parameters=(" + PARAMETER + ",)", "parameters=5", "parameters: expected a tuple of Parameter"),
    Case("parameters=(" + PARAMETER + ",)", 'parameters=("gain",)', "parameters: expected a tuple of Parameter"),
    Case(PARAMETER, PARAMETER + ", " + PARAMETER, "two parameters"),
    *(
        _parameter(f'{name}, "double", 1.0, "Doc"', reason)
        for name, reason in (
            ('"name"', "'name' is the name of another field"),
            ('"upperDepName"', "'upperDepName' is the name of another field"),
            ('"genom_success"', "another field"),
            ('"input_format"', "another field"),
            ('"fb_nERBs"', "gammatone has 'fb_nERBs' already"),
            ('"set_rm_scailing"', "ratemap has 'set_rm_scailing' already"),
            ('"cc_lags"', "crossCorrelation has 'cc_lags' already"),
            ('"lambda"', "name: expected a name that is free"),
            ('"serialize"', "name: expected a name that is free"),
            ('"a-b"', "name: expected a name"),
            ('"p" * 1000', "at most 64 characters"),
            ("None", "name: expected a name"),
        )
    ),
    *(
        _parameter(f'"{{kind}}_p", {rest}', reason)
        for rest, reason in (
            ('"float", 1.0, "Doc"', "is of type float"),
            ('float, 1.0, "Doc"', "type: expected one of"),
            ('"sequence<sequence<double>>", (), "Doc"', "type: expected one of"),
            ('"double", 1.0, "a\\nb"', "doc: expected one line"),
            ('"double", 1.0, None', "doc: expected one line"),
            ('"double", float("nan"), "Doc"', "default: "),
            ('"double", object(), "Doc"', "default: "),
            ('"double", 3.0, "Doc", minimum=0.0, maximum=2.0', "default: "),
            ('"double", 1.0, "Doc", minimum=2.0, maximum=0.0', "minimum: 2.0 is above"),
            ('"double", 1.0, "Doc", minimum="0"', "minimum: expected a finite number"),
            ('"double", 1.0, "Doc", maximum=float("nan")', "maximum: expected a finite number"),
            ('"double", 1.0, "Doc", minimum=True', "minimum: expected a finite number"),
            ('"double", 1.0, "Doc", open_minimum=1', "open_minimum: expected True or False"),
            ('"double", 1.0, "Doc", unit=5', "unit: expected one line"),
            ('"double", 1.0, "Doc", choices=("1",)', "choices: expected none for the type double"),
            ('"boolean", False, "Doc", minimum=0', "minimum: expected None"),
            ('"string", "c", "Doc", choices=("a", "b")', "default: "),
            ('"string", "a", "Doc", choices="ab"', "choices: expected a tuple of strings"),
            ('"string", "a", "Doc", choices=("a", 1)', "choices: expected a tuple of strings"),
            ('"string", "a", "Doc", choices=("a", ["b"])', "choices: expected a tuple of strings"),
            ('"string", "a", "Doc", choices=("a", "a")', "occurs twice"),
            ('"string", "a", "Doc", choices=("a", "b\\n")', "choices: expected one line"),
            ('"string", "a", "Doc", choices=("a",), fallback="b"', "fallback: expected one of the choices"),
            ('"string", "a", "Doc", spellings=5', "spellings: expected a mapping"),
            ('"string", "a", "Doc", aliases=("b c",)', "aliases: expected a name"),
            ('"string", "a", "Doc", aliases=("name",)', "'name' is the name of another field"),
            ('"sequence<double>", (1.0, float("nan")), "Doc"', "default: "),
            ('"sequence<double>", (1.0,), "Doc", least=2', "default: "),
            ('"sequence<double>", (), "Doc", least=3, most=2', "least: 3 is above most"),
            ('"sequence<double>", (), "Doc", most=1.5', "most: expected a count"),
        )
    ),
    # the class
    Case("def process", "def compute", "expected a method process"),
    Case("def process(self, block, extra=None, out=None)", "def process(self)", "process: expected a method"),
    Case("def process", "process = 5\n\n    def compute", "process: expected a method"),
    Case("def process", "output_rows = (2,)\n\n    def process", "output_rows: expected a method"),
    Case("def process", "def build(self):\n        pass\n\n    def process", "build: expected a method"),
    Case("def process", 'EXTRAS = "level"\n\n    def process', "EXTRAS: expected a tuple of names"),
    Case("def process", "look_ahead = 1.5\n\n    def process", "look_ahead: expected a property"),
    Case(
        "def process", "def look_ahead(self):\n        return 1\n\n    def process", "look_ahead: expected a property"
    ),
    Case("def process", 'required_extra = "sugar"\n\n    def process', "ihc has no 'sugar'"),
    Case("class Mine(Stage)", "class Mine", "expected a subclass of Stage"),
    Case("class Mine(Stage)", "class Mine(FramedStage)", "prefix: expected a name"),
    Case(
        "    def process",
        '    REPRESENTATION = {{"kind": "x"}}\n\n    def process',
        "REPRESENTATION: expected a Representation, got {'kind': 'x'}",
    ),
    Case(
        "class Mine(Stage):",
        'class Mine(FramedStage):\n    prefix = "other"',
        "prefix: expected frame_parameters('other'), which declare other_wname",
    ),
    # the module
    Case("import numpy as np", "import nothing_like_this", "ModuleNotFoundError"),
    Case("import numpy as np", "class :", "SyntaxError"),
    Case("import numpy as np", "raise SystemExit(3)", "SystemExit: 3"),
    Case("import numpy as np", "raise KeyboardInterrupt", "KeyboardInterrupt"),
    Case("import numpy as np", "raise BaseException('no')", "BaseException: no"),
    Case("import numpy as np", "raise GeneratorExit", "GeneratorExit"),
    Case("import numpy as np", "def f():\n    f()\nf()", "RecursionError"),
    Case("import numpy as np", "class E(Exception):\n    def __str__(self):\n        raise E\nraise E", "E:"),
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
    assert requests - set(kinds) == set(checks.REQUESTS)
    ports = {name for port in ROSAFE.ports for name in (port.name, *port.aliases)}
    assert ports - {name for kind in KINDS.values() for name in (kind.port, *kind.port_aliases)} < set(checks.PORTS)
    messages = {layout(kind).idl for kind in KINDS.values() if len(kind.parts) == 1}
    assert messages == {f"::rosAFE::{name}SignalPortStruct" for name in checks.STRUCTS}
