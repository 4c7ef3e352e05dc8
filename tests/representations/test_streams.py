"""Properties of all framed stages: block boundaries, prefixes, silence, new channels, copies, invalid blocks."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations import KINDS, STAGES

from .chain import Chain, FloatArray

RATEMAP = SignalFormat(16000.0, 100.0, True, 160, 320, (200.0, 500.0, 1200.0, 3000.0, 2500.0), "gammatone")
CORRELATIONS = replace(RATEMAP, lags=3)
MAP = {"trm_fuseWithinSec": 0.03, "trm_minSpread": 2, "trm_minStrengthdB": 1.0}
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
]
every = pytest.mark.parametrize(
    ("kind", "root", "parameters"), CASES, ids=["-".join(map(str, (k, *p.values()))) for k, _, p in CASES]
)
block_sizes = st.lists(st.one_of(st.sampled_from([0, 1, 2]), st.integers(0, 30)), min_size=1, max_size=8).filter(any)


def chain(kind: str, root: str, parameters: dict[str, Any]) -> Chain:
    return Chain(CORRELATIONS if root in ("itd", "ic") else RATEMAP, [kind], parameters, root)


def frames(root: str, number: int, seed: int = 0, channels: int = 5) -> FloatArray:
    """Return input of `root`: correlations of any shape, or rates with a range of 200 dB; some are silent."""
    rng = np.random.default_rng(seed)
    if root in ("itd", "ic"):
        made = rng.standard_normal((channels, 7, number))
        made[..., rng.random(number) < 0.2] = 0.0
        return made
    steps = rng.standard_normal((2, channels, number)) + 2 * rng.standard_normal((2, 1, number))
    made = 10 ** ((3 * steps.cumsum(axis=-1) - 60) / 10)
    made[..., rng.random(number) < 0.1] = 0.0
    return made


@every
@settings(max_examples=30)
@given(sizes=block_sizes, seed=st.integers(0, 5))
def test_block_boundaries_have_no_effect(
    kind: str, root: str, parameters: dict[str, Any], sizes: list[int], seed: int
) -> None:
    given_frames = frames(root, 60, seed)
    whole = chain(kind, root, parameters).run(given_frames)[kind]
    in_parts = chain(kind, root, parameters).run(given_frames, sizes)[kind]
    np.testing.assert_array_equal(in_parts, whole)


@every
@settings(max_examples=15)
@given(number=st.integers(0, 59))
def test_a_prefix_gives_a_prefix(kind: str, root: str, parameters: dict[str, Any], number: int) -> None:
    given_frames = frames(root, 60)
    whole = chain(kind, root, parameters).run(given_frames)[kind]
    first = chain(kind, root, parameters)
    part = first.run(given_frames[..., :number])[kind]
    assert part.shape[-1] == first.stages[kind].output_count(number)
    np.testing.assert_allclose(part, whole[..., : part.shape[-1]], rtol=1e-12, atol=1e-12 * np.abs(whole).max())


@every
def test_shape_and_type_of_the_output(kind: str, root: str, parameters: dict[str, Any]) -> None:
    one = chain(kind, root, parameters)
    given_frames = frames(root, 50)
    kept = given_frames.copy()
    for block in (given_frames[..., :0], given_frames[..., :1], given_frames):
        made = one.process(block)[kind]
        assert isinstance(made, np.ndarray)
        assert made.dtype == np.float64
        assert made.flags.c_contiguous and made.flags.writeable
        assert made.shape[:-1] == one.stages[kind].output_rows(block.shape[:-1])
        assert made.ndim == len(KINDS[kind].parts[0].axes)
        assert not np.shares_memory(made, block)
        made[...] = np.nan  # the caller may modify it
    np.testing.assert_array_equal(given_frames, kept)
    again = one.process(given_frames)[kind]
    assert np.isfinite(again).all()


@every
@pytest.mark.filterwarnings("error")
def test_silence(kind: str, root: str, parameters: dict[str, Any]) -> None:
    """At the start, after sound, and in one ear: all numbers are finite, without warnings."""
    silence = np.zeros((5, 7, 40) if root in ("itd", "ic") else (2, 5, 40))
    silent = chain(kind, root, parameters).run(silence, 7)[kind]
    if kind != "spectralFeatures":
        assert not silent.any()
    sound = frames(root, 40)
    for first, second in ((1, 0), (0, 1), (1e-308, 1), (-1, 1), (1e60, 0)):
        both = np.concatenate([first * sound, second * sound], axis=-1)
        assert np.isfinite(chain(kind, root, parameters).run(both, 9)[kind]).all()
    if root not in ("itd", "ic"):
        silence[0] = sound[0]
        assert np.isfinite(chain(kind, root, parameters).run(silence, 9)[kind]).all()


@every
def test_reset(kind: str, root: str, parameters: dict[str, Any]) -> None:
    one = chain(kind, root, parameters)
    expected = one.run(frames(root, 60), 11)[kind]
    for stage in one.stages.values():
        stage.reset()
    np.testing.assert_array_equal(one.run(frames(root, 60), 11)[kind], expected)


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
        np.testing.assert_array_equal(one.run(later, 13)[kind], fresh.run(later, 13)[kind])


@pytest.mark.parametrize(("kind", "root", "parameters"), [case for case in CASES if case[0] != "spectralFeatures"])
def test_blocks_of_another_shape_reset_the_state(kind: str, root: str, parameters: dict[str, Any]) -> None:
    """Except for spectral features, whose channels have frequencies."""
    one = chain(kind, root, parameters)
    one.process(frames(root, 37))
    later = frames(root, 40, 3, 2)
    expected = chain(kind, root, parameters).run(later, 13)[kind]
    np.testing.assert_array_equal(one.run(later, 13)[kind], expected)


@every
def test_copies_may_be_changed_and_discarded(kind: str, root: str, parameters: dict[str, Any]) -> None:
    expected = chain(kind, root, parameters).run(frames(root, 60), 10)[kind]
    one = chain(kind, root, parameters)
    made = []
    for block in np.split(frames(root, 60), 6, axis=-1):
        for stage in one.stages.values():
            planned = copy.copy(stage)
            planned.configure(**{name: stage.parameters[name] for name in planned.parameters})
            if "trm_minSpread" in planned.parameters:
                planned.configure(trm_minSpread=9, trm_fuseWithinSec=0.2)
            if "sf_requests" in planned.parameters:
                planned.configure(sf_requests="hfc")
            planned.set_input_format(replace(stage.input_format, center_frequencies=(1.0,), rate=7.0))
        made.append(one.process(block)[kind])
    np.testing.assert_array_equal(np.concatenate(made, axis=-1), expected)


@every
def test_invalid_blocks_raise(kind: str, root: str, parameters: dict[str, Any]) -> None:
    stage = chain(kind, root, parameters).stages[kind]
    axes = len(STAGES[kind].INPUT)
    for block in (np.zeros((2,) * (axes + 1)), np.zeros(5), np.zeros((2,) * axes, complex)):
        with pytest.raises(ValueError, match=r"^block: "):
            stage.process(block, np.zeros(block.shape))
    if STAGES[kind].INPUT[0] == "ear":
        with pytest.raises(ValueError, match=r"^block: "):
            stage.process(np.zeros((3, 5, 7)), np.zeros((3, 5, 7)))
