"""What the representations of frames say of real speech, without a room and in one; and of syllables that are known."""

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


# --- syllables whose truth is known -----------------------------------------------------------------------------

RATE = 16000
STARTS = np.array([0.3, 0.75, 1.2, 1.65])  # s
LENGTH = 0.25  # s


def syllables() -> FloatArray:
    """A voice that glides up by half an octave in each syllable, over faint noise; the left ear is 0.25 ms late."""
    time = np.arange(int(2.2 * RATE)) / RATE
    sound = 1e-4 * np.random.default_rng(1).standard_normal(len(time))
    for start in STARTS:
        within = (time >= start) & (time < start + LENGTH)
        since = time[within] - start
        phase = np.cumsum(_glide(since)) / RATE
        edges = np.clip(np.minimum(since, LENGTH - since) / 0.01, 0.0, 1.0)
        sound[within] += 0.1 * edges * sum(np.cos(2 * np.pi * h * phase) / h**0.5 for h in range(1, 16))
    return np.stack((np.roll(sound, 4), sound))


def _glide(since: FloatArray) -> FloatArray:
    """The pitch (Hz) so long (s) after a syllable's start."""
    hertz: FloatArray = 130.0 * 2 ** (0.5 * since / LENGTH)
    return hertz


def test_syllables() -> None:
    """Onsets at their starts, offsets at their ends, the pitch of the voice inside and none outside."""
    window = 0.04
    parameters = {"fb_highFreqHz": 6500.0, "ac_wSizeSec": window}
    got = process(syllables(), RATE, ["pitch", "onsetMap", "offsetMap"], parameters, 1000)
    for kind, edges, late in (("onsetMap", STARTS, 0.03), ("offsetMap", STARTS + LENGTH, 0.06)):
        for ear in got[kind]:
            # ends of frames: the first that hold something of the sound, and the channels' own delay
            at = 0.02 + np.nonzero(ear.sum(axis=0) >= 8)[0] / got[f"{kind}_frameRate"]
            nearest = edges[np.abs(at[:, np.newaxis] - edges).argmin(axis=1)]
            assert set(nearest) == set(edges)
            assert np.all(at - nearest > -0.01) and np.all(at - nearest < late)
    middle = np.arange(got["pitch"].shape[-1]) / got["pitch_frameRate"] + window / 2
    since = middle - STARTS[:, np.newaxis]
    for found in got["pitch"][:, 0]:
        for one in since:
            inside = (one > 0.6 * window) & (one < LENGTH - 0.6 * window)
            assert np.mean(~np.isnan(found[inside])) > 0.9
            voiced = inside & ~np.isnan(found)
            np.testing.assert_allclose(found[voiced], _glide(one[voiced]), rtol=0.02)
        # before the first syllable nothing clearer has come, and noise may have a pitch
        silent = np.all((since < -window) | (since > LENGTH + window), axis=0) & (since[0] > 0)
        assert silent.sum() > 30 and np.isnan(found[silent]).all()
