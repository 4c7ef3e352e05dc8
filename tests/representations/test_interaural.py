"""ITD and interaural coherence: parabolas, known delays and mixtures."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.itd_ic import Ic, Itd

from .chain import FloatArray

RATE = 16000.0
CHANNELS = [300.0, 500.0, 800.0]
GIVEN = SignalFormat(RATE, 100.0, True, 160, 320, (500.0,), "gammatone", lags=4)


def of(correlations: list[float] | FloatArray) -> tuple[float, float]:
    """Return ITD in samples and coherence of one frame of one channel."""
    block = np.array(correlations, float)[np.newaxis, :, np.newaxis]
    return Itd(GIVEN).process(block).item() * RATE, Ic(GIVEN).process(block).item()


@pytest.mark.parametrize("top", [-3.2, -2.5, -1.0, -0.2, 0.0, 0.3, 1.7, 3.49])
@pytest.mark.parametrize("height", [1e-250, 0.4, 1.0])
def test_the_top_of_a_parabola(top: float, height: float) -> None:
    lags = np.arange(-4, 5)
    itd, ic = of(height * (1 - 0.01 * (lags - top) ** 2))
    assert itd == pytest.approx(top, abs=1e-12)
    assert ic == pytest.approx(height, rel=1e-13)


def test_the_result_follows_the_formula() -> None:
    """In rational numbers, for all positions of the peak."""
    rng = np.random.default_rng(5)
    block = np.round(rng.standard_normal((40, 9, 50)), 1)  # with ties
    itd, ic = Itd(GIVEN).process(block) * RATE, Ic(GIVEN).process(block)
    places = set()
    for channel, frame in np.ndindex(40, 50):
        c = [Fraction(x) for x in block[channel, :, frame]]
        i = c.index(max(c))
        delta = Fraction(0)
        if 0 < i < 8:
            delta = (c[i - 1] - c[i + 1]) / (c[i - 1] - 2 * c[i] + c[i + 1]) / 2
            assert ic[channel, frame] == pytest.approx(float(c[i] - (c[i - 1] - c[i + 1]) * delta / 4), rel=1e-14)
        else:
            assert ic[channel, frame] == float(c[i])
        assert itd[channel, frame] == pytest.approx(float(i - 4 + delta), abs=1e-14)
        places.add(i)
    assert places == set(range(9))


def test_equal_values() -> None:
    assert of([0.0] * 9) == (0.0, 0.0)
    assert of([0.3] * 9) == (0.0, 0.3)  # all lags are equal
    assert of([-0.3] * 8 + [-0.4]) == (-4.0, -0.3)  # the first of equals, at the end: no parabola
    assert of([0, 0, 1, 1, 0, 0, 1, 0, 0]) == (-1.5, 1.125)  # the first peak, between its two equals
    assert of([0.1] * 8 + [0.2]) == (4.0, 0.2)


@pytest.mark.filterwarnings("error")
def test_a_peak_that_rounding_flattens() -> None:
    """The curvature would be rounded to 0 if 2 c[i] were subtracted first."""
    below = np.nextafter(1.0, 0.0)
    assert of([0, 0, 0, 0, below, 1, 1, 0, 0]) == (1.5, 1.0)
    itd, ic = of([0, 0, 5e-324, 1e-323, 5e-324, 0, 0, 0, 0])
    assert itd == -1.0
    assert ic == 1e-323


def test_one_silent_ear() -> None:
    sound = np.random.default_rng(2).standard_normal(3200)
    one_ear = np.stack([sound, 0 * sound])
    made = rosafe.process(one_ear, RATE, parameters={"fb_cfHz": CHANNELS}, outputs=["itd", "ic"])
    assert not made["itd"].any()
    assert not made["ic"].any()


def test_lags_may_change() -> None:
    sound = np.random.default_rng(2).standard_normal((2, 4800))
    changes = [(1, "cc_maxDelaySec", 0.0001), (2, "cc_maxDelaySec", 0.02)]
    options: dict[str, Any] = {"parameters": {"fb_cfHz": CHANNELS}, "outputs": ["itd", "ic"], "block_frames": 1600}
    made = rosafe.process(sound, RATE, **options, modifications=changes)["itd"]
    assert np.abs(made[:, 9:19] * RATE).max() <= 2
    options["parameters"] = {"fb_cfHz": CHANNELS, "cc_maxDelaySec": 0.02}
    np.testing.assert_allclose(made[:, 19:], rosafe.process(sound, RATE, **options)["itd"][:, 19:], rtol=0, atol=1e-12)
