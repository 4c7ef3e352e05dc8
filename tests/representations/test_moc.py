"""Medial olivocochlear attenuation: the cubic and its limits, invalid values."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.moc_reflex import Moc

from .chain import FloatArray

GIVEN = SignalFormat(16000.0, 100.0, True, 160, 320, (500.0,), "drnl")
FACTORS = [Fraction(x) for x in ("-0.00012411", "-0.051322", "-6.3528", "-206.11")]


def attenuation(levels: Any, **parameters: float) -> FloatArray:
    """Return the attenuation for levels (F,) 20 log10 R in dB."""
    rates = np.broadcast_to(10 ** (np.array(levels, float) / 20), (2, 1, len(levels)))
    return Moc(GIVEN, **parameters).process(rates)[1, 0]


def cubic(level: float) -> float:
    """Compute P(y) in rational numbers."""
    y, a, b, c, d = Fraction(level), *FACTORS
    return float(a * y**3 + b * y**2 + c * y + d)


def test_it_saturates() -> None:
    """The cubic itself would give 37 dB at -80 dB, 0 at -40 dB, and increase below -182 dB."""
    top, bottom = cubic(-93.821837), max(0.0, cubic(-181.858339))
    free = {"moc_thresholdRatedB": -1000.0, "moc_maxAttenuationdB": 200.0}
    np.testing.assert_allclose(attenuation([-93, -80, -40, 0, 100], **free), top, rtol=1e-12)
    np.testing.assert_allclose(attenuation([-182, -190, -250, -900], **free), bottom, rtol=1e-12)
    assert top == pytest.approx(40.656, abs=1e-3)
    np.testing.assert_array_equal(attenuation([-93, -80, -40, 0, 100]), 40.0)
    np.testing.assert_array_equal(attenuation([-93, -80], moc_maxAttenuationdB=7.5), 7.5)
    np.testing.assert_array_equal(attenuation([-93, -120], moc_maxAttenuationdB=0.0), 0.0)


def test_the_threshold() -> None:
    """Below it the attenuation is that at the threshold; 0 dB gives the maximum for any sound."""
    got = attenuation([-300, -150, -140.5, -120], moc_thresholdRatedB=-140.0)
    np.testing.assert_allclose(got, [cubic(-140.0)] * 3 + [cubic(-120.0)], rtol=1e-11)
    np.testing.assert_array_equal(attenuation([-300, -150, -93], moc_thresholdRatedB=0.0), 40.0)


@pytest.mark.filterwarnings("error")
def test_no_sound_is_no_attenuation() -> None:
    block = np.zeros((2, 1, 5))
    block[:] = [0.0, -1.0, -1e-320, 1e-320, 1e140]
    np.testing.assert_array_equal(Moc(GIVEN, moc_thresholdRatedB=0.0).process(block)[0, 0], [0, 0, 0, 40, 40])


def test_changes_take_effect_at_once() -> None:
    stage = Moc(GIVEN)
    block = np.full((2, 1, 3), 10 ** (-120 / 20))
    first = stage.process(block)
    stage.configure(moc_maxAttenuationdB=1.5)
    np.testing.assert_array_equal(stage.process(block), 1.5)
    stage.configure(moc_mocMaxAttenuationdB=40.0)
    np.testing.assert_array_equal(stage.process(block), first)


def test_the_documentations_names() -> None:
    names = ("moc_mocIpsi", "moc_mocContra", "moc_mocThresholdRatedB", "moc_mocMaxAttenuationdB")
    assert [Moc.REPRESENTATION.parameter(name) for name in names] == list(Moc.REPRESENTATION.parameters)


@pytest.mark.parametrize("name", ["moc_extIpsi", "moc_extContra"])
def test_factors_other_than_1(name: str) -> None:
    """They would have an effect only if the attenuation was fed back."""
    with pytest.raises(ValueError, match=f"^{name}: expected 1, "):
        Moc(GIVEN).configure(**{name: 0.5})
