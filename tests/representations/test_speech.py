"""What the representations of frames say of real speech: a talker off to one side, without a room and in one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.sound.audiofile import AudioFile
from tests import harness

from .chain import FloatArray, process

OUTPUTS = ["ratemap", "itd", "ic", "onsetStrength", "onsetMap", "offsetMap"]


@pytest.fixture(scope="module")
def made() -> dict[str, dict[str, Any]]:
    """The representations by place."""
    results = {}
    for place in ("anechoic", "room"):
        file = AudioFile(harness.shared("audio", f"speech_{place}_16k.wav"))
        signal = file.read(file.frames)
        results[place] = process(signal, file.sample_rate, OUTPUTS, {"fb_highFreqHz": 7200.0}, 12000)
    return results


def loud(result: dict[str, Any], what: str) -> FloatArray:
    """One number for each of the louder half of the units."""
    rates = result["ratemap"].mean(axis=0)
    units: FloatArray = result[what][rates > np.median(rates)]
    return units


def test_where_the_talker_is(made: dict[str, dict[str, Any]]) -> None:
    """On the right; the room blurs it, but not beyond recognition."""
    assert np.median(loud(made["anechoic"], "itd")) == pytest.approx(0.36e-3, abs=0.02e-3)
    assert np.median(loud(made["room"], "itd")) == pytest.approx(0.25e-3, abs=0.02e-3)
    for place in ("anechoic", "room"):
        counts, edges = np.histogram(loud(made[place], "itd"), 11, (-1.1e-3, 1.1e-3))
        assert edges[counts.argmax()] > 0.09e-3


def test_how_coherent_the_ears_are(made: dict[str, dict[str, Any]]) -> None:
    ranges = {"anechoic": [0.981, 0.995, 0.998], "room": [0.687, 0.914, 0.998]}
    for place, expected in ranges.items():
        np.testing.assert_allclose(np.percentile(loud(made[place], "ic"), [5, 50, 95]), expected, rtol=0, atol=0.005)


def test_how_strong_onsets_are(made: dict[str, dict[str, Any]]) -> None:
    for place, percentile in (("anechoic", 17.0), ("room", 13.0)):
        strengths = made[place]["onsetStrength"]
        assert np.percentile(strengths, 99) == pytest.approx(percentile, abs=0.3)
        assert 29 <= strengths.max() <= 30


def test_onsets_lie_where_the_level_rises_and_offsets_where_it_falls(made: dict[str, dict[str, Any]]) -> None:
    """Frames in which four channels or more have one, against the level of all channels 40 ms before and after."""
    for place in ("anechoic", "room"):
        levels = 10 * np.log10(made[place]["ratemap"].sum(axis=1) + 1e-12)
        changes = np.zeros(levels.shape)
        changes[:, 4:-4] = levels[:, 8:] - levels[:, :-8]
        for kind, sign in (("onsetMap", 1), ("offsetMap", -1)):
            channels = made[place][kind].sum(axis=1)
            there = sign * changes[:, : channels.shape[1]][channels >= 4]
            assert len(there) > 20
            assert np.median(there) > {"anechoic": 10, "room": 1}[place]
            assert np.mean(there > 0) > np.mean(sign * changes > 0) + 0.15
