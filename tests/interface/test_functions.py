"""The functions for one representation: numbers of `rosafe.process`, arguments and help of the declaration."""

from __future__ import annotations

import inspect
import pickle
import pydoc
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.interface import KINDS, functions
from rosafe.representations import BUILTIN
from rosafe.testing import _values_of
from tests.plugins.support import python

RATE = 16000
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, 6000))
FEW: dict[str, Any] = {"fb_nChannels": 5, "fb_highFreqHz": 5000.0}
PLUGIN = """
from rosafe.plugin import Parameter, Representation, Stage, variant
from rosafe.representations.ratemap import Ratemap

Slow = variant(Ratemap, "slow", "srm", "Slow ratemap", srm_decaySec=0.1)
View = variant(Ratemap, "tree", "vw", "Has the name of a package")
Process = variant(Ratemap, "process", "prc", "Has the name of a function")


class Odd(Stage):
    REPRESENTATION = Representation(
        kind="odd",
        doc="Parameters whose names without the prefix are not free",
        parent="ihc",
        axes=("ear", "channel", "time"),
        parameters=[
            Parameter(name, "double", 1.0, "x", 0.0, 2.0)
            for name in ("od_lambda", "od_2d", "od_sound", "od_a_b", "od_b", "gain", "od_gain")
        ],
    )

    def process(self, block, extra=None):
        return block * self.values["od_lambda"]
"""


def computed(function: Any, *arguments: Any, **named: Any) -> Any:
    """Return the value, or the text of the ValueError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return function(*arguments, **named)
    except ValueError as problem:
        return str(problem)


@pytest.mark.parametrize("kind", sorted(BUILTIN))
def test_numbers_are_those_of_process(kind: str) -> None:
    """With the defaults, and with random values, some of which are refused."""
    draw = random.Random(kind)
    own = functions.arguments(KINDS[kind])
    for _ in range(3):
        chosen = {name: draw.choice(_values_of(p)) for name, p in own.items() if draw.random() < 0.4}
        chosen = {name: value for name, value in chosen.items() if name not in ("nChannels", "wSizeSec", "hSizeSec")}
        whole = {own[name].name: value for name, value in chosen.items()}
        few = {name: value for name, value in FEW.items() if name not in whole}
        expected = computed(rosafe.process, SOUND, RATE, parameters={**few, **whole}, outputs=kind)
        got = computed(getattr(rosafe, kind), SOUND, RATE, **chosen, **few)
        if isinstance(expected, str):
            assert got == expected
            continue
        arrays = got if isinstance(got, dict) else {kind: got}
        assert arrays.keys() == KINDS[kind].outputs.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(np.asarray(array), expected[name])
            assert tuple(array.axes) == expected.axes[name]
            assert tuple(map(len, array.axes.values())) == array.shape
            np.testing.assert_array_equal(array.axes["time"], expected[f"{kind}_time"])


def test_axes() -> None:
    array = rosafe.crossCorrelation(SOUND, RATE, maxDelaySec=5e-4, **FEW)
    result = rosafe.process(SOUND, RATE, parameters={"cc_maxDelaySec": 5e-4, **FEW}, outputs="crossCorrelation")
    np.testing.assert_array_equal(array.axes["channel"], result["fb_cfHz"])
    np.testing.assert_array_equal(array.axes["lag"], result["cc_lags"])
    assert not vars(array[0])["axes"] and not vars(array + 1)["axes"]  # coordinates of other arrays are not known
    again = pickle.loads(pickle.dumps(array))
    assert again.axes["lag"].tolist() == array.axes["lag"].tolist() and np.array_equal(again, array)
    assert rosafe.ratemap(SOUND[0], RATE, **FEW).axes["ear"].tolist() == ["left"]
    assert pickle.loads(pickle.dumps(rosafe.ratemap)) is rosafe.ratemap


@pytest.mark.parametrize("kind", sorted(BUILTIN))
def test_signature_and_help_follow_the_declaration(kind: str) -> None:
    signature = inspect.signature(getattr(rosafe, kind))
    own = [p for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    for argument, parameter in zip(own, KINDS[kind].parameters, strict=True):
        assert argument.name == parameter.name.partition("_")[2]
        by_sound = parameter.name in ("in_doNormalize", "fb_highFreqHz", "ams_highFreqHz")
        assert argument.default == (None if by_sound else parameter.default)
    text = " ".join(pydoc.plain(pydoc.render_doc(getattr(rosafe, kind))).split()).replace("( ", "(")
    for expected in (KINDS[kind].doc, *(p.doc for p in KINDS[kind].parameters), f"{kind}(sound, sample_rate"):
        assert expected in text


def test_samples_and_rate_determine_defaults() -> None:
    whole = (SOUND * 2**31).astype(np.int32)
    for sound in (SOUND, whole):
        for value in ({}, {"doNormalize": None}, {"doNormalize": False}):
            parameters = {f"in_{name}": v for name, v in value.items() if v is not None}
            expected = rosafe.process(sound, RATE, parameters=parameters, outputs="input")["input"]
            np.testing.assert_array_equal(np.asarray(rosafe.input(sound, RATE, **value)), expected)
    expected = rosafe.process(SOUND, 8000, outputs="gammatone")
    for one in (rosafe.gammatone(SOUND, 8000), rosafe.gammatone(SOUND, 8000, highFreqHz=None)):
        np.testing.assert_array_equal(one.axes["channel"], expected["fb_cfHz"])


def test_refusals_are_those_of_process() -> None:
    for name, value in (("decay", 1.0), ("rm_decay", 1.0), ("fb_nChannels", -1), ("rm_decaySec", None)):
        text = computed(rosafe.process, SOUND, RATE, parameters={name: value}, outputs="ratemap")
        assert isinstance(text, str)
        assert computed(rosafe.ratemap, SOUND, RATE, **{name: value}) == text
    assert computed(rosafe.ratemap, SOUND, RATE, decaySec=1.0, rm_decaySec=0.5).startswith("rm_decaySec: expected one")
    assert "ild" in computed(rosafe.ild, SOUND[0], RATE)
    with pytest.raises(TypeError):
        rosafe.ratemap(SOUND, RATE, 0.01)  # type: ignore[call-arg, arg-type]
    for name in ("ratemaps", "tree.plot", "_ratemap", ""):
        assert not hasattr(rosafe, name)


def test_plugins_have_functions(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(PLUGIN)
    code = (
        "import inspect, numpy as np, rosafe\n"
        "from rosafe import odd, slow, tree\n"
        "sound = np.random.default_rng(0).standard_normal((2, 4000))\n"
        "assert np.array_equal(slow(sound, 16000), rosafe.ratemap(sound, 16000, decaySec=0.1))\n"
        "assert np.array_equal(slow(sound, 16000, decaySec=0.008), rosafe.ratemap(sound, 16000))\n"
        "assert 'slow' in dir(rosafe) and slow.__doc__.startswith('Slow ratemap.')\n"
        "print(inspect.signature(slow).parameters['decaySec'])\n"
        "print(*inspect.signature(odd).parameters)\n"
        "print(np.array_equal(odd(sound, 16000, od_lambda=0.0), 0 * rosafe.ihc(sound, 16000)))\n"
        "print(type(tree), rosafe.process.__module__)\n"
    )
    done = python(code, tmp_path)
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "decaySec=0.1",
        "sound sample_rate od_lambda od_2d od_sound a_b b gain od_gain parameters",
        "True",
        "<class 'module'> rosafe.processing.process",
    ]
