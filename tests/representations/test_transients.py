"""Onset and offset strength: known levels, and silence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.representations.onset_offset_strength import OffsetStrength, OnsetStrength

from .chain import FloatArray

RATE = 16000.0
GIVEN = SignalFormat(RATE, 100.0, True, 160, 320, (500.0, 900.0), "gammatone")
KINDS_AND_LIMITS: list[tuple[type[Stage], str, int]] = [
    (OnsetStrength, "ons_maxOnsetdB", 1),
    (OffsetStrength, "ofs_maxOffsetdB", -1),
]
both = pytest.mark.parametrize(("kind", "limit", "sign"), KINDS_AND_LIMITS)


def rates(levels: Any) -> FloatArray:
    """Return rates (2, 2, F) with these levels (F,) in dB."""
    return np.broadcast_to(10 ** (np.array(levels, float) / 10), (2, 2, len(levels))).copy()


def made_by(stage: Stage, block: FloatArray) -> FloatArray:
    """Return the output of the stage for one block."""
    made = stage.process(block)
    assert isinstance(made, np.ndarray)
    return made


@both
def test_steps(kind: type[Stage], limit: str, sign: int) -> None:
    made = kind(GIVEN, **{limit: 25.0}).process(rates([-50, -47, -47, -60, -20, -20.5, -90]))
    changes = [0, 3, 0, -13, 40, -0.5, -69.5]
    expected = [min(max(sign * change, 0), 25) for change in changes]
    np.testing.assert_allclose(made, np.broadcast_to(expected, (2, 2, 7)), rtol=0, atol=1e-12)
    assert not np.signbit(made).any()


@both
def test_ears_and_channels_are_independent(kind: type[Stage], limit: str, sign: int) -> None:
    levels = np.random.default_rng(3).uniform(-300, 100, (2, 2, 20))
    made = made_by(kind(GIVEN, **{limit: 1000.0}), 10 ** (levels / 10))
    for ear, channel, frame in np.ndindex(2, 2, 20):
        change = levels[ear, channel, frame] - levels[ear, channel, max(0, frame - 1)]
        assert made[ear, channel, frame] == pytest.approx(max(sign * change, 0.0), abs=1e-10)


@both
@pytest.mark.filterwarnings("error")
def test_silence_is_2000_db_below_1(kind: type[Stage], limit: str, sign: int) -> None:
    """Also values below 0, which ratemaps do not contain."""
    block = rates([0] * 8)
    block[:] = [0.0, -3.0, 1e-200, 5e-324, 1.0, 0.0, -1e300, 1e100]
    made = made_by(kind(GIVEN, **{limit: 1000.0}), block)[0, 0]
    expected = [0, 0, 0, 0, 1000, 0, 0, 1000] if sign > 0 else [0, 0, 0, 0, 0, 1000, 0, 0]
    np.testing.assert_allclose(made, expected, rtol=0, atol=0)


@both
def test_the_level_for_the_maps(kind: type[Stage], limit: str, sign: int) -> None:
    stage = kind(GIVEN)
    block = rates([-50, -47, -3000, 12])
    stage.process(block)
    assert stage.provided == {}
    stage.provide = frozenset({"level"})
    stage.process(block)
    np.testing.assert_allclose(stage.provided["level"][1, 1], [-50, -47, -2000, 12], rtol=0, atol=1e-12)
    stage.process(block[..., :0])
    assert stage.provided["level"].shape == (2, 2, 0)


@both
def test_a_new_limit_keeps_the_last_level(kind: type[Stage], limit: str, sign: int) -> None:
    stage = kind(GIVEN)
    stage.process(rates([0]))
    stage.configure(**{limit: 7.0})
    np.testing.assert_array_equal(stage.process(rates([sign * 50])), 7.0)
    stage.configure(**{limit: 1000.0})
    np.testing.assert_allclose(stage.process(rates([sign * 150])), 100.0, rtol=1e-13)


@both
def test_other_steps_of_the_ratemap_keep_the_last_level(kind: type[Stage], limit: str, sign: int) -> None:
    stage = kind(GIVEN)
    stage.process(rates([0]))
    stage.set_input_format(SignalFormat(RATE, 50.0, True, 320, 640, (500.0, 900.0), "gammatone"))
    assert stage.output_format.rate == 50.0
    np.testing.assert_allclose(stage.process(rates([sign * 9])), 9.0, rtol=1e-13)
