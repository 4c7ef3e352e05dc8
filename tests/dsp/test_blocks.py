"""The output does not depend on block boundaries (bit-identical with kernels); shapes and ownership of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rosafe.dsp import kernels
from rosafe.dsp.stage import Stage
from rosafe.representations import STAGES
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.haircell import InnerHairCell
from rosafe.representations.preproc import PreProc

from .bare import cut, run, single
from .stages import CHANNELS, MODES, NAMES, RATE, make, noise, rows

SAMPLES = 600

every_mode = pytest.mark.parametrize(("kind", "parameters"), MODES, ids=NAMES)
# gain control starts from its first block: 16 samples are one time constant, later ones do not affect the start
sizes = st.lists(st.one_of(st.sampled_from([0, 1, 2]), st.integers(0, 250)), min_size=1, max_size=12).filter(any)


def assert_same(pieces: Any, whole: Any, what: str = "") -> None:
    """Compare bit by bit; without kernels, rounding may differ."""
    if kernels.compiled():
        np.testing.assert_array_equal(pieces, whole, err_msg=what)
    else:
        np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-12 * max(1.0, np.abs(whole).max()), err_msg=what)


def process(stage: Stage, block: Any) -> Any:
    """Process a block, with an envelope for a hair cell."""
    return stage.process(block, np.abs(block)) if isinstance(stage, InnerHairCell) else stage.process(block)


@every_mode
@given(sizes=sizes)
@example(sizes=[1])
@settings(max_examples=4, derandomize=True, database=None)
def test_block_boundaries_have_no_effect(kind: str, parameters: dict[str, Any], sizes: list[int]) -> None:
    signal = noise(kind, SAMPLES)
    whole = single(make(kind, parameters).process(signal))
    blocks = cut(signal, [16, *sizes]) if parameters.get("pp_bNormalizeRMS") else cut(signal, sizes)
    pieces = run(make(kind, parameters), blocks)
    assert whole.shape[-1] == frames(parameters, SAMPLES)
    assert_same(pieces, whole)


def frames(parameters: dict[str, Any], samples: int) -> int:
    """Return the number of frames in `samples` samples; of a stage without windows, the number of samples."""
    lengths = {name[-8:]: round(value * RATE) for name, value in parameters.items() if name.endswith("SizeSec")}
    return (samples - lengths["wSizeSec"]) // lengths["hSizeSec"] + 1 if lengths else samples


def test_window_longer_than_many_blocks() -> None:
    """A window of 1000 samples and blocks of 7: the buffer grows, fills and is moved many times."""
    signal = noise("ild", 5000)
    parameters = {"ild_wSizeSec": 1000 / RATE, "ild_hSizeSec": 3 / RATE}
    whole = single(make("ild", parameters).process(signal))
    assert whole.shape == (CHANNELS, (5000 - 1000) // 3 + 1)
    assert_same(run(make("ild", parameters), cut(signal, 7)), whole)


@every_mode
def test_shapes_and_ownership(kind: str, parameters: dict[str, Any]) -> None:
    for samples in (0, 1, 20, 333):
        stage = STAGES[kind](RATE, **parameters)
        block = noise(kind, samples)
        block.setflags(write=False)
        before = block.copy()
        out = process(stage, block)
        assert out.shape[:-1] == stage.output_rows(rows(kind))
        assert out.dtype == np.float64
        assert out.flags.c_contiguous
        assert not np.shares_memory(out, block)
        kept = out.copy()
        assert not np.shares_memory(process(stage, noise(kind, samples, seed=2)), out)
        np.testing.assert_array_equal(out, kept)
        np.testing.assert_array_equal(block, before)


@every_mode
def test_memory_order_and_plain_lists(kind: str, parameters: dict[str, Any]) -> None:
    block = noise(kind, 200)
    expected = make(kind, parameters).process(block)
    for other in (np.asfortranarray(block), np.repeat(block, 2, axis=-1)[..., ::2]):
        got = STAGES[kind](RATE, **parameters)
        out = single(got.process(other, np.abs(other) + 0.5 if isinstance(got, InnerHairCell) else None))
        assert out.flags.c_contiguous
        np.testing.assert_array_equal(out, expected[:2] if kind == "gammatone" else expected)


@every_mode
def test_a_reset_stage_equals_a_new_one(kind: str, parameters: dict[str, Any]) -> None:
    stage = STAGES[kind](RATE, **parameters)
    first = process(stage, noise(kind, 333))
    process(stage, noise(kind, 50, seed=3))
    stage.reset()
    np.testing.assert_array_equal(process(stage, noise(kind, 333)), first)


@every_mode
def test_another_channel_count_resets_the_state(kind: str, parameters: dict[str, Any]) -> None:
    if len(rows(kind)) == 1:
        return  # no channels to change
    stage = make(kind, parameters)
    stage.process(noise(kind, 250, channels=3))
    block = noise(kind, 300, seed=4, channels=5)
    got = stage.process(block)
    np.testing.assert_array_equal(got, make(kind, parameters).process(block))
    back = noise(kind, 300, seed=5, channels=3)
    np.testing.assert_array_equal(stage.process(back), make(kind, parameters).process(back))


@every_mode
def test_bad_blocks(kind: str, parameters: dict[str, Any]) -> None:
    stage = STAGES[kind](RATE, **parameters)
    good = noise(kind, 10)
    wrong: list[Any] = [good[0], good[np.newaxis], good * 1j, good > 0]
    for bad in (*wrong, [["a"], ["b"]]):
        with pytest.raises(ValueError, match="block: "):
            stage.process(bad)
    for ears in (good[:1], np.concatenate([good, good[:1]])):
        with pytest.raises(ValueError, match=r"block: expected numbers of shape \(2 ears, .*got float64 of shape"):
            stage.process(ears)


def test_the_envelope_is_computed_on_request_only() -> None:
    bank = Filterbank(RATE, fb_nChannels=2, fb_highFreqHz=4000.0)
    shapes = []
    for wanted in (False, True, False):
        bank.provide = frozenset({"envelope"} if wanted else ())
        bank.process(noise("gammatone", 50))
        shapes.append({name: array.shape for name, array in bank.provided.items()})
    assert shapes == [{}, {"envelope": (2, 2, 50)}, {}]
    assert InnerHairCell(RATE, ihc_method="hilbert").required_extra == "envelope"
    assert not InnerHairCell(RATE).required_extra
    with pytest.raises(ValueError, match="envelope: bernstein"):
        InnerHairCell(RATE, ihc_method="bernstein").process(noise("ihc", 5))
    with pytest.raises(ValueError, match="envelope: hilbert"):
        InnerHairCell(RATE, ihc_method="hilbert").process(noise("ihc", 5), noise("ihc", 4))


@pytest.mark.parametrize("fb_type", ["gammatone", "drnl"])
def test_a_later_request_for_the_envelope_gives_the_same_one(fb_type: str) -> None:
    signal = noise("gammatone", 200)
    early, late = (Filterbank(RATE, fb_type=fb_type, fb_cfHz=[300.0, 1000.0]) for _ in range(2))
    early.provide = frozenset({"envelope"})
    for stage in (early, late):
        stage.process(signal[:, :90])
    late.provide = frozenset({"envelope"})
    for stage in (early, late):
        stage.process(signal[:, 90:])
    np.testing.assert_array_equal(early.provided["envelope"], late.provided["envelope"])


def test_gain_control_starts_at_each_ears_first_sound() -> None:
    """Silent and empty blocks do not start an ear; a later start of one ear does not affect the other."""
    stage = PreProc(RATE, pp_bNormalizeRMS=True, pp_intTimeSecRMS=0.01)
    sound = noise("preProc", 400)
    assert not stage.process(np.zeros((2, 100))).any()
    stage.process(np.zeros((2, 0)))
    left_only = sound[:, :200] * [[1.0], [0.0]]
    first = stage.process(left_only)
    second = stage.process(sound[:, 200:])

    retention = np.exp(-1 / (0.01 * RATE))
    power = [np.mean(sound[0, :160] ** 2), np.mean(sound[1, 200:360] ** 2)]
    expected = np.zeros((2, 400))
    for n in range(400):
        x = [sound[0, n], sound[1, n] if n >= 200 else 0.0]
        loudest = 0.0
        for ear in range(2):
            if ear == 0 or n >= 200:
                power[ear] = retention * power[ear] + (1 - retention) * x[ear] ** 2
                loudest = max(loudest, np.sqrt(power[ear]) + 1e-8)
        expected[:, n] = np.array(x) / loudest
    np.testing.assert_allclose(np.concatenate([first, second], axis=-1), expected, rtol=1e-12, atol=0)
