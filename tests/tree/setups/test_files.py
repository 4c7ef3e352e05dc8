"""Setup files: writing and reading are inverse, errors name the line, hostile texts are rejected."""

from __future__ import annotations

import math
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.interface import KINDS, MAX_SETUP, Parameter
from rosafe.interface.remarks import PRESETS
from rosafe.representations import STAGES
from rosafe.tree.setups import AcquireSettings, Setup, SetupError, SetupProcessor, read, setup_processor, write
from rosafe.tree.setups.setup import parameters_of
from rosafe.tree.tree_planner import ExistingProcessor

TREE = """\
sound:
  device: "scene:"
connections: {Audio: bass/Audio}
processors:
  input: {kind: input, nFramesPerBlock: 4410}
  time: {kind: time, parent: input}
  bank:
    kind: filterbank
    parent: time
    fb_cfHz: [500, 1e3, 2000.25]
  ihc: {kind: ihc, parent: bank}
  ild: {kind: ild, parent: ihc, ild_hSizeSec: 0.0050000000000000001}
"""


def test_a_setup_written_by_hand() -> None:
    setup = read(TREE)
    assert setup.sound == AcquireSettings({"device": "scene:"})
    assert setup.connections == {"Audio": "bass/Audio"}
    assert [(w.name, w.kind, w.parent, dict(w.explicit)) for w in setup.processors] == [
        ("input", "input", "", {"nFramesPerBlock": 4410}),
        ("time", "preProc", "input", {}),
        ("bank", "gammatone", "time", {"fb_cfHz": [500.0, 1000.0, 2000.25]}),
        ("ihc", "ihc", "bank", {}),
        ("ild", "ild", "ihc", {"ild_hSizeSec": 0.005}),
    ]
    assert read(write(setup)) == setup
    assert read(write(setup, full=True)) == setup


def test_the_settings_of_a_localizer() -> None:
    setup = read(TREE + "localizer: {head: robot.head, seconds: 1}\n")
    assert setup.localizer == {"head": "robot.head", "seconds": 1.0}
    assert read(write(setup)) == setup == read(write(setup, full=True))
    assert read("localizer: {}").localizer == {} and read(write(read("localizer: {}"))).localizer == {}
    assert read(TREE).localizer is None
    for text, reason in (
        ("localizer: {haed: x}", "line 1: localizer: unknown 'haed'; expected one of head, .*; did you mean head?"),
        ("localizer: {seconds: 0}", "line 1: localizer: seconds: "),
        ("localizer: [1]", "line 1: localizer"),
    ):
        with pytest.raises(SetupError, match=reason):
            read(text)


def test_a_preset_applies_to_all_processors() -> None:
    """Values of a processor take precedence."""
    text = "preset: speech\nprocessors:\n  input: {kind: input}\n  time: {kind: time, parent: input}\n"
    text += "  bank: {kind: filterbank, parent: time}\n  ihc: {kind: ihc, parent: bank}\n"
    text += "  ac: {kind: autocorrelation, parent: ihc}\n  pitch: {kind: pitch, parent: ac, pi_confThres: 0.5}\n"
    explicit = {processor.name: processor.explicit for processor in read(text).processors}
    assert (
        explicit["ac"] == {name: PRESETS["speech"][name] for name in ("ac_wSizeSec", "ac_K")} and not explicit["bank"]
    )
    assert explicit["pitch"]["pi_confThres"] == 0.5
    assert explicit["pitch"]["pi_medianOrder"] == PRESETS["speech"]["pi_medianOrder"]


def test_parents_can_follow_and_defaults_can_be_omitted() -> None:
    setup = read("processors:\n  ild: {kind: ILD}\n  ihc: {kind: ihc}\n  gammatone: {kind: gammatone}\n"
                 "  preProc: {kind: preProc, pp_bRemoveDC: yes}\n  input: {kind: input}\n")  # fmt: skip
    assert [w.name for w in setup.processors] == ["input", "preProc", "gammatone", "ihc", "ild"]
    assert setup.processors[1].explicit == {"pp_bRemoveDC": True}


@pytest.mark.parametrize("text", ["", "# nothing\n", "processors:\n", "---\n...\n", "sound: ~\n"])
def test_empty_setups(text: str) -> None:
    assert read(text) == Setup()


def _values(parameter: Parameter) -> st.SearchStrategy[Any]:
    low, high = parameter.minimum, parameter.maximum
    if parameter.idl == "boolean":
        return st.booleans()
    if parameter.choices:
        words = st.sampled_from(parameter.choices)
        return st.lists(words, min_size=1, max_size=3) if parameter.idl.startswith("sequence") else words
    if parameter.idl in ("double", "float"):
        numbers = st.floats(low, high, exclude_min=parameter.open_minimum, allow_nan=False, allow_infinity=False)
        return numbers.filter(lambda value: not (value == 0 and math.copysign(1, value) < 0))
    return st.integers(int(low or 0), int(high if high is not None else 2**31))


_SIMPLE = [
    kind
    for kind in KINDS.values()
    if STAGES[kind.kind].effective_values.__func__ is STAGES["ihc"].effective_values.__func__  # type: ignore[attr-defined]
]


@settings(max_examples=40, derandomize=True)
@given(st.data())
def test_each_parameter_is_preserved_to_the_last_digit(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(_SIMPLE))
    given = {p.name: data.draw(_values(p)) for p in parameters_of(kind) if "sequence<double>" not in p.idl}
    line = [kind]
    while line[0].parent:
        line.insert(0, KINDS[line[0].parent])
    parents = ["", *(k.name for k in line[:-1])]
    processors = [SetupProcessor(k.name, k.kind, parent) for k, parent in zip(line, parents, strict=True)]
    differing = {p.name: given[p.name] for p in parameters_of(kind) if given.get(p.name, p.default) != p.default}
    processors[-1] = SetupProcessor(kind.name, kind.kind, parents[-1], differing)
    setup = Setup(processors=tuple(processors))
    assert read(write(setup)) == setup
    assert read(write(setup, full=True)) == setup


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"fb_nChannels": 17},
        {"fb_nERBs": 2.0, "fb_highFreqHz": 4000.0},
        {"fb_cfHz": [100.1, 333.3333333333333, 7999.999999999999]},
        {"fb_type": "drnl", "fb_nChannels": 5},
    ],
)
def test_a_filterbank_is_described_as_it_was_requested(values: dict[str, Any]) -> None:
    kind = KINDS["gammatone"]
    stage = STAGES["gammatone"](44100.0, **values)
    found = setup_processor(ExistingProcessor("bank", "gammatone", "preProc", stage.parameters))
    assert found.explicit == {name: value for name, value in values.items() if value != kind.parameter(name).default}
    assert STAGES["gammatone"](44100.0, **found.values).parameters == stage.parameters


WRONG = {
    "processors:\n  a: {kind: input}\n  b: {kind: preProc, parent: a, pp_cutoffHzDC: -3}": (3, "pp_cutoffHzDC"),
    "processors:\n  a: {kind: input}\n  b:\n    kind: preProc\n    parent: a\n    fb_nERBs: 3": (6, "'fb_nERBs'"),
    "processors:\n  a: {kind: input}\n  b: {kind: preProcessor, parent: a}": (3, "unknown kind 'preProcessor'"),
    "processors:\n  a: {kind: input}\n  b:\n    kind: preProc\n    parent: c": (5, "got 'c', which is not in"),
    "processors:\n  a: {kind: input}\n  b: {kind: ihc, parent: a}": (3, "kind gammatone, got 'a' of kind input"),
    "processors:\n  a: {kind: input}\n  b: {kind: input}": (3, "two inputs"),
    "processors:\n  a: {kind: input}\n  a: {kind: input}": (3, "twice, first in line 2"),
    "processors:\n  a: {parent: b}": (2, "kind is missing"),
    "processors:\n  a: {kind: input}\n  b: {kind: preProc, parent: a, pp_refSPLdB: 90, pp_refSPLdBS: 80}": (
        3,
        "occurs twice",
    ),
    "processors: [input]": (1, "NAME: VALUE"),
    "processors:\n  a: {kind: input, nFramesPerBlock: 0}": (2, "nFramesPerBlock"),
    "processors:\n  a: {kind: input, nFramesPerBlock: 1.5}": (2, "whole number"),
    "processors:\n  a: {kind: input, nFramesPerBlock: }": (2, "nFramesPerBlock: expected one value"),
    "processors:\n  a: {kind: input, in_doNormalize: perhaps}": (2, "boolean"),
    "processors:\n  a: {kind: input}\n  'b c': {kind: preProc, parent: a}": (3, "also names a topic"),
    "sound: {device: 3, rate: 4}": (1, "'rate'"),
    "sound:\n  sampleRate: .nan": (2, "sampleRate"),
    "connections:\n  audio: bass/Audio": (2, "expected one of Audio"),
    "connections:\n  Audio: bass Audio": (2, "expected the name of a topic"),
    "sounds: {}": (1, "expected one of sound, connections, processors, preset"),
    "preset: music": (1, "preset: expected one of speech, onsets, got 'music'"),
    "processors:\n\t- a": (2, "not YAML"),
    "a: b: c": (1, "not YAML"),
    "a\n---\nb": (3, "a second document"),
    "x": (1, "NAME: VALUE"),
}


@pytest.mark.parametrize("text", WRONG)
def test_errors_name_the_line(text: str) -> None:
    line, what = WRONG[text]
    with pytest.raises(SetupError) as error:
        read(text)
    assert str(error.value).startswith(f"line {line}: ")
    assert what in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000


HOSTILE = [
    "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n",
    "processors: !!python/object/apply:os.system ['touch /tmp/hacked']\n",
    "processors: {<<: {a: {kind: input}}}\n",
    "sound: !!binary aGVsbG8=\n",
    "processors: " + "[" * 100_000,
    "processors: " + "{a: " * 50_000,
    "? [a, b]\n: c\n",
    "%YAML 9.9\n---\na: b\n",
    "%TAG ! tag:x,2000:\n---\n!foo a: b\n",
    "\0",
    "\ud800",
    "a: \x07",
    "x" * (MAX_SETUP + 1),
    "processors:\n" + "".join(f"  a{i}: {{kind: input}}\n" for i in range(10_001)),
    "processors:\n  a: {kind: input, nFramesPerBlock: " + "9" * 100_000 + "}\n",
    "processors:\n  " + "a" * 100_000 + ": {kind: input}\n",
    "processors:\n  a: {kind: input}\n  p: {kind: preProc, parent: a}\n  g: {kind: gammatone, parent: p, fb_cfHz: ["
    + "1," * 20_000 + "]}\n",
]  # fmt: skip


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_texts_are_rejected_quickly(text: str) -> None:
    begun = time.thread_time()
    with pytest.raises(SetupError) as error:
        read(text)
    assert time.thread_time() - begun < 5
    assert len(str(error.value)) < 1000
