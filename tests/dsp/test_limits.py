"""Huge, tiny and invalid numbers: finite input gives finite output, and no state remains denormal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy

from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import LIMIT
from rosafe.dsp.sos_filter import SosFilter, leaky_integrator
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.input import Input
from rosafe.representations.preproc import PreProc

from .bare import cut, run, single
from .stages import MODES, NAMES, RATE, make, noise, rows

every_mode = pytest.mark.parametrize(("kind", "parameters"), MODES, ids=NAMES)

BIGGEST = float(np.finfo(np.float64).max)
SMALLEST = 5e-324
SAMPLES = 400

PATTERNS = {
    "constant 1e300": np.full(SAMPLES, 1e300),
    "alternating biggest": BIGGEST * (-1.0) ** np.arange(SAMPLES),
    "one huge among small": np.where(np.arange(SAMPLES) == 150, -BIGGEST, 1e-3),
    "huge, then smallest": np.where(np.arange(SAMPLES) < 100, 1e160, SMALLEST),
    "smallest": np.full(SAMPLES, SMALLEST),
    "tiny": np.full(SAMPLES, 1e-170),
    "at the limit": LIMIT * (-1.0) ** (np.arange(SAMPLES) // 20),
    "full scale integers": np.where(np.arange(SAMPLES) % 30 < 15, -(2.0**31), 2.0**31 - 1),
}


@every_mode
def test_finite_in_finite_out(kind: str, parameters: dict[str, Any]) -> None:
    for name, pattern in PATTERNS.items():
        stage = make(kind, parameters)
        block = np.broadcast_to(pattern, (*rows(kind), SAMPLES))
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            for part in (*cut(block, [1, 150, 64]), noise(kind, SAMPLES)):
                assert np.isfinite(stage.process(part)).all(), name


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [mode for mode in MODES if mode != ("preProc", {})],  # it does not change the samples
)
def test_tiny_samples_make_no_denormal_numbers(kind: str, parameters: dict[str, Any]) -> None:
    """They would be many times slower, and are inaudible."""
    for size in (1e-160, 1e-203, 1e-305, 1e-310):
        stage = make(kind, parameters)
        for part in cut(size * noise(kind, 1000, seed=3), [300, 700]):
            output = np.abs(stage.process(part))
            assert not ((output > 0) & (output < np.finfo(np.float64).tiny)).any(), size


def test_one_huge_sample_does_not_affect_the_rest() -> None:
    bank = Filterbank(RATE, fb_nChannels=3, fb_highFreqHz=4000.0)
    block = noise("gammatone", 1000)
    block[:, 10] = BIGGEST
    bank.process(block)
    for _ in range(60):
        bank.process(np.zeros((2, 1000)))
    sound = noise("gammatone", 1000, seed=2)
    expected = Filterbank(RATE, fb_nChannels=3, fb_highFreqHz=4000.0).process(sound)
    np.testing.assert_allclose(bank.process(sound), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_input_rejects_samples_that_are_not_finite(bad: float) -> None:
    stage = Input(RATE, in_doNormalize=False)
    block = noise("input", 10)
    block[1, 3] = bad
    with pytest.raises(ValueError, match=r"block: expected finite samples"):
        stage.process(block)


def test_sample_types() -> None:
    whole = np.arange(-6, 6).reshape(2, 6) * 1000
    for kind in (np.int16, np.int32, np.int64, np.float32, np.float64):
        np.testing.assert_array_equal(Input(RATE, in_doNormalize=False).process(whole.astype(kind)), whole)


# --- tiny states ------------------------------------------------------------------------------------------------


def silence_after_burst(kind: str, parameters: dict[str, Any], blocks: int) -> Any:
    """Return the output of the last of `blocks` silent blocks after a loud one."""
    stage = make(kind, parameters)
    stage.process(noise(kind, 1000))
    for _ in range(blocks):
        out = stage.process(np.zeros((*rows(kind), 1000)))
    return out


@pytest.mark.parametrize(
    ("kind", "parameters", "blocks"),
    [
        ("preProc", {"pp_bRemoveDC": True}, 250),
        ("gammatone", {"fb_cfHz": [80.0, 1000.0, 7000.0]}, 60),
        ("gammatone", {"fb_cfHz": [100.0, 1000.0, 6000.0], "fb_type": "drnl"}, 80),
        ("ihc", {"ihc_method": "dau"}, 10),
        ("ihc", {"ihc_method": "breebart"}, 10),
        ("ratemap", {"rm_scaling": "magnitude"}, 110),
    ],
)
def test_silence_becomes_exactly_0(kind: str, parameters: dict[str, Any], blocks: int) -> None:
    """Without flushing, a decaying state would remain at the smallest denormal."""
    out = silence_after_burst(kind, parameters, blocks)
    assert out.size
    assert not out.any()


@pytest.mark.parametrize("retention", [0.5, 0.99, 0.9999])
def test_states_are_never_denormal_for_long(retention: float) -> None:
    """States are flushed every 4096 samples, independent of block boundaries."""
    cascade = SosFilter(leaky_integrator(retention))
    cascade.process(np.ones((2, 96)))
    for _ in range(30):
        for samples in (1000, 2999, 1, 0, 0):
            cascade.process(np.zeros((2, samples)))
        assert cascade.state is not None
        size = np.abs(cascade.state)
        assert ((size == 0) | (size >= 1e-200)).all()
        cascade.process(np.zeros((2, 96)))


def test_complex_states_are_flushed_too() -> None:
    sections = np.tile(np.array([0.1, 0, 0, 1, -0.9 * np.exp(0.3j), 0]), (4, 1))
    cascade = SosFilter(sections)
    cascade.process(np.ones((2, 5)))
    for _ in range(10):
        cascade.process(np.zeros((2, 1000)))
    assert cascade.state is not None
    assert not cascade.state.any()


def test_tails_are_as_accurate_in_many_blocks() -> None:
    """The tail of a burst is the same in many short blocks and in one long block; bit-identical with kernels.

    numpy rounds between two blocks: relative to the largest number nearby.
    """
    signal = np.zeros((2, 30000))
    signal[:, :100] = noise("gammatone", 100)
    whole = Filterbank(RATE, fb_cfHz=[80.0]).process(signal)
    pieces = run(Filterbank(RATE, fb_cfHz=[80.0]), cut(signal, 100))
    if kernels.compiled():
        np.testing.assert_array_equal(pieces, whole)
    nearby = scipy.ndimage.maximum_filter1d(np.abs(single(whole)), 1200, axis=-1)
    assert (np.abs(single(pieces) - single(whole)) <= 1e-12 * nearby + 1e-199).all()


@pytest.mark.parametrize(("samples", "span"), [(2.4, 2), (2.5, 3), (3.5, 4), (0.2, 1)])
def test_gain_control_starts_from_whole_samples(samples: float, span: int) -> None:
    """The time constant in samples, rounded half away from zero, at least one."""
    sound = np.random.default_rng(4).standard_normal((2, 8))
    sound[1] = 0.0
    retention = np.exp(-1 / samples)
    power = retention * np.mean(sound[0, :span] ** 2) + (1 - retention) * sound[0, 0] ** 2
    out = PreProc(1000.0, pp_bNormalizeRMS=True, pp_intTimeSecRMS=samples / 1000).process(sound)
    np.testing.assert_allclose(out[0, 0], sound[0, 0] / (np.sqrt(power) + 1e-8), rtol=1e-12)
