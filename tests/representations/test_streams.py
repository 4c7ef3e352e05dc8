"""Properties of the stages: block boundaries, prefixes, silence, new channels, copies, invalid blocks and values."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import parts_of
from rosafe.representations import KINDS, STAGES

from .chain import Chain, FloatArray

FREQUENCIES = (200.0, 500.0, 1200.0, 3000.0, 2500.0)
RATEMAP = SignalFormat(16000.0, 100.0, True, 160, 320, FREQUENCIES, "gammatone")
SOUND = SignalFormat(16000.0, 16000.0, center_frequencies=FREQUENCIES, filterbank="gammatone")
SLOW = replace(SOUND, sample_rate=2000.0, rate=2000.0)
FORMATS = {  # of the blocks, by the kind that receives them; others receive a ratemap
    **dict.fromkeys(("itd", "ic"), replace(RATEMAP, lags=3)),
    **dict.fromkeys(("adaptation", "amsFeatures", "autocorrelation"), SOUND),
    "precedence": SLOW,
    "gabor": replace(RATEMAP, rate=3.0),
    "pitch": SignalFormat(1000.0, 10.0, True, 100, 31, FREQUENCIES, "gammatone", lags=30),
}
SOUNDS = ("adaptation", "amsFeatures", "autocorrelation", "precedence")
PER_FRAME = 17  # samples of sound in place of a frame
# Rounding may depend on blocks, relative to the largest number; other kinds are equal to the last bit.
TOLERANCES = {"adaptation": 1e-12, "amsFeatures": 1e-12, "autocorrelation": 1e-12, "precedence": 1e-11, "gabor": 1e-9}
MAP = {"trm_fuseWithinSec": 0.03, "trm_minSpread": 2, "trm_minStrengthdB": 1.0}
AMS = {"ams_wSizeSec": 0.01, "ams_hSizeSec": 0.005}
CORRELATION = {"ac_wSizeSec": 0.004, "ac_hSizeSec": 0.002}
PITCH = {"pi_rangeHz": [40.0, 400.0]}
# (kind, the kind that receives the blocks, parameters)
CASES: list[tuple[str, str, dict[str, Any]]] = [
    ("itd", "itd", {}),
    ("ic", "ic", {}),
    ("onsetStrength", "onsetStrength", {"ons_maxOnsetdB": 12.0}),
    ("offsetStrength", "offsetStrength", {}),
    ("spectralFeatures", "spectralFeatures", {}),
    ("spectralFeatures", "spectralFeatures", {"sf_requests": ["flux", "centroid", "flux"], "sf_roPerc": 0.5}),
    ("moc", "moc", {"moc_maxAttenuationdB": 30.0}),
    ("onsetMap", "onsetStrength", MAP),
    ("onsetMap", "onsetStrength", {**MAP, "trm_fuseWithinSec": 0.02, "trm_minValuedB": -60.0}),
    ("offsetMap", "offsetStrength", {**MAP, "trm_minSpread": 4}),
    ("adaptation", "adaptation", {}),
    ("adaptation", "adaptation", {"adpt_lim": 0.0, "adpt_tau": [0.01, 0.1, 1.0]}),
    ("adaptation", "adaptation", {"adpt_model": "adt_vandorpschuitman"}),
    ("amsFeatures", "amsFeatures", AMS),
    ("amsFeatures", "amsFeatures", {**AMS, "ams_dsRatio": 3, "ams_wname": "triang", "ams_nFilters": 3}),
    ("amsFeatures", "amsFeatures", {"ams_wSizeSec": 0.008, "ams_hSizeSec": 0.02, "ams_fbType": "lin"}),
    ("autocorrelation", "autocorrelation", CORRELATION),
    ("autocorrelation", "autocorrelation", {"ac_wSizeSec": 0.003, "ac_hSizeSec": 0.007, "ac_clipMethod": "clc"}),
    ("autocorrelation", "autocorrelation", {**CORRELATION, "ac_K": 0.7, "ac_clipAlpha": 0.1}),
    ("autocorrelation", "autocorrelation", {**CORRELATION, "ac_K": 10.0, "ac_clipAlpha": 0.0, "ac_clipMethod": "sgn"}),
    ("gabor", "gabor", {}),
    ("precedence", "precedence", {"prec_wSizeSec": 0.03, "prec_hSizeSec": 0.015}),
    ("precedence", "precedence", {"prec_wSizeSec": 0.025, "prec_hSizeSec": 0.04, "prec_maxDelaySec": 0.02}),
    ("pitch", "pitch", PITCH),
    ("pitch", "pitch", {**PITCH, "pi_medianOrder": 8}),
]
every = pytest.mark.parametrize(
    ("kind", "root", "parameters"), CASES, ids=["-".join(map(str, (k, *p.values()))) for k, _, p in CASES]
)
block_sizes = st.lists(st.one_of(st.sampled_from([0, 1, 2]), st.integers(0, 30)), min_size=1, max_size=8).filter(any)


def chain(kind: str, root: str, parameters: dict[str, Any]) -> Chain:
    return Chain(FORMATS.get(root, RATEMAP), [kind], parameters, root)


def frames(root: str, number: int, seed: int = 0, channels: int = 5) -> FloatArray:
    """Return input of `root`: correlations of any shape, sound, or rates with a range of 200 dB; some are silent."""
    rng = np.random.default_rng(seed)
    if root in ("itd", "ic"):
        made = rng.standard_normal((channels, 7, number))
        made[..., rng.random(number) < 0.2] = 0.0
        return made
    if root == "pitch":
        made = rng.integers(-3, 6, (2, channels, 31, number)) / 8
        made[..., rng.random(number) < 0.1] = 0.0
        return made
    if root in SOUNDS:
        levels = np.repeat(rng.choice([0.0, 0.001, 0.03, 1.0], number), PER_FRAME)
        return np.maximum(rng.standard_normal((2, channels, number * PER_FRAME)), -0.1) * levels
    steps = rng.standard_normal((2, channels, number)) + 2 * rng.standard_normal((2, 1, number))
    made = 10 ** ((3 * steps.cumsum(axis=-1) - 60) / 10)
    made[..., rng.random(number) < 0.1] = 0.0
    return made


def run(one: Chain, kind: str, block: FloatArray, sizes: Any = None) -> list[FloatArray]:
    """Return the parts of the output for blocks of these sizes."""
    return list(one.run(block, sizes).values())


def assert_equal(kind: str, got: list[FloatArray], expected: list[FloatArray]) -> None:
    for one, other in zip(got, expected, strict=True):
        atol = TOLERANCES.get(kind, 0.0) * max(1.0, np.abs(other).max(initial=0.0))
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


@every
@settings(max_examples=20)
@given(sizes=block_sizes, seed=st.integers(0, 5))
def test_block_boundaries_have_no_effect(
    kind: str, root: str, parameters: dict[str, Any], sizes: list[int], seed: int
) -> None:
    given_frames = frames(root, 60, seed)
    steps = [size * PER_FRAME // 2 for size in sizes] if root in SOUNDS else sizes
    whole = run(chain(kind, root, parameters), kind, given_frames)
    assert_equal(kind, run(chain(kind, root, parameters), kind, given_frames, steps if any(steps) else [1]), whole)
    first = chain(kind, root, parameters)
    part = run(first, kind, given_frames[..., : sum(steps) // 2])  # a prefix gives a prefix
    assert part[0].shape[-1] == first.stages[kind].output_count(min(sum(steps) // 2, given_frames.shape[-1]))
    assert_equal(kind, part, [one[..., : part[0].shape[-1]] for one in whole])


@every
def test_shape_and_type_of_the_output(kind: str, root: str, parameters: dict[str, Any]) -> None:
    one = chain(kind, root, parameters)
    given_frames = frames(root, 50)
    kept = given_frames.copy()
    given_frames.setflags(write=False)
    for block in (given_frames[..., :0], given_frames[..., :1], given_frames, given_frames):
        made = parts_of(one.process(block)[kind])
        for part, declared, rows in zip(
            made, KINDS[kind].parts, one.stages[kind].part_rows(block.shape[:-1]), strict=True
        ):
            assert part.dtype == np.float64 and part.flags.c_contiguous and part.flags.writeable
            assert part.shape[:-1] == rows and part.ndim == len(declared.axes)
            assert not np.shares_memory(part, block)
            assert np.isfinite(part).all() or KINDS[kind].allow_nan
            part[...] = np.nan  # the caller may modify it
    np.testing.assert_array_equal(given_frames, kept)


@every
@pytest.mark.filterwarnings("error")
def test_silence(kind: str, root: str, parameters: dict[str, Any]) -> None:
    """At the start, after sound, and in one ear: all numbers are finite, without warnings."""
    sound = frames(root, 40)
    silence = np.zeros(sound.shape)

    def made(block: FloatArray) -> list[FloatArray]:
        parts = run(chain(kind, root, parameters), kind, block, 9)
        assert all(np.isfinite(part).all() for part in parts) or KINDS[kind].allow_nan
        return [np.nan_to_num(part) for part in parts]

    for part in made(silence):
        assert kind == "spectralFeatures" or np.abs(part).max(initial=0.0) < 1e-10
    for first, second in ((1, 0), (0, 1), (1e-308, 1), (-1, 1), (1e60, 0)):
        made(np.concatenate([first * sound, second * sound], axis=-1))
    if root not in ("itd", "ic"):
        silence[0] = sound[0]
        made(silence)


@every
def test_reset(kind: str, root: str, parameters: dict[str, Any]) -> None:
    one = chain(kind, root, parameters)
    expected = run(one, kind, frames(root, 60), 11)
    for stage in one.stages.values():
        stage.reset()
    for got, part in zip(run(one, kind, frames(root, 60), 11), expected, strict=True):
        np.testing.assert_array_equal(got, part)


@every
def test_other_channels_reset_the_state(kind: str, root: str, parameters: dict[str, Any]) -> None:
    """With or without notification; pending frames are dropped."""
    for channels in (5, 3):
        one = chain(kind, root, parameters)
        one.process(frames(root, 37))
        others = tuple(np.linspace(300.0, 3300.0, channels).tolist())
        given_signal = one.stages[root].input_format
        for stage in one.stages.values():
            stage.set_input_format(replace(stage.input_format, center_frequencies=others))
        fresh = Chain(replace(given_signal, center_frequencies=others), [kind], parameters, root)
        later = frames(root, 40, 3, channels)
        assert_equal(kind, run(one, kind, later, 13), run(fresh, kind, later, 13))


@pytest.mark.parametrize(
    ("kind", "root", "parameters"),
    [case for case in CASES if case[0] != "spectralFeatures" and "adpt_model" not in case[2]],
)
def test_blocks_of_another_shape_reset_the_state(kind: str, root: str, parameters: dict[str, Any]) -> None:
    """Except for stages that need the frequencies of the channels."""
    one = chain(kind, root, parameters)
    one.process(frames(root, 37))
    later = frames(root, 40, 3, 2)
    assert_equal(kind, run(one, kind, later, 13), run(chain(kind, root, parameters), kind, later, 13))


@every
def test_copies_may_be_changed_and_discarded(kind: str, root: str, parameters: dict[str, Any]) -> None:
    expected = run(chain(kind, root, parameters), kind, frames(root, 60), 10)
    one = chain(kind, root, parameters)
    made = []
    for block in np.split(frames(root, 60), 6, axis=-1):
        for stage in one.stages.values():
            planned = copy.copy(stage)
            planned.configure(**{name: value for name, value in stage.parameters.items() if name != "ams_cfHz"})
            for name, value in OTHERS.items():
                if name in planned.parameters:
                    planned.configure(**{name: value})
            rate = 7.0 if stage.input_format.framed else stage.input_format.rate
            planned.set_input_format(replace(stage.input_format, center_frequencies=(1.0,), rate=rate))
        made.append(parts_of(one.process(block)[kind]))
    assert_equal(kind, [np.concatenate(parts, axis=-1) for parts in zip(*made, strict=True)], expected)


OTHERS: dict[str, Any] = {
    "trm_minSpread": 9,
    "trm_fuseWithinSec": 0.2,
    "sf_requests": "hfc",
    "adpt_tau": [1.0],
    "adpt_mindB": 3,
    "ams_wSizeSec": 0.02,
    "ams_dsRatio": 2,
    "ac_wSizeSec": 0.01,
    "ac_K": 1,
    "gb_maxDynamicRangeDB": 10.0,
    "prec_wSizeSec": 0.05,
    "prec_maxDelaySec": 0.004,
    "pi_medianOrder": 9,
    "pi_confThres": 0,
}


@every
def test_invalid_blocks_raise(kind: str, root: str, parameters: dict[str, Any]) -> None:
    stage = chain(kind, root, parameters).stages[kind]
    axes = len(STAGES[kind].INPUT)
    for block in (np.zeros((2,) * (axes + 1)), np.zeros(5), np.zeros((2,) * axes, complex)):
        with pytest.raises(ValueError, match=r"^block: "):
            stage.process(block, np.zeros(block.shape))
    if STAGES[kind].INPUT[0] == "ear":
        with pytest.raises(ValueError, match=r"^block: "):
            stage.process(np.zeros((3,) * axes), np.zeros((3,) * axes))


@pytest.mark.parametrize("kind", STAGES)
def test_a_refused_value_changes_nothing(kind: str) -> None:
    """tests/interface tries values of all sorts."""
    for parameter in KINDS[kind].parameters:
        stage = STAGES[kind](FORMATS.get(kind, RATEMAP))
        before = stage.parameters
        for value in (object(), math.nan, [[1.0]]):
            with pytest.raises(ValueError, match=f"^{parameter.name}: "):
                stage.configure(**{parameter.name: value})
        assert stage.parameters == before
