"""Framed representations of real speech, without and in a room, and of synthetic syllables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.audio.files.audiofile import AudioFile
from tests import harness

from .chain import FloatArray, process

OUTPUTS = ["ratemap", "itd", "ic", "onsetStrength", "onsetMap", "offsetMap"]


@pytest.fixture(scope="module")
def made() -> dict[str, dict[str, Any]]:
    """Return the representations by room."""
    results = {}
    for place in ("anechoic", "room"):
        file = AudioFile(harness.shared("audio", f"speech_{place}_16k.wav"))
        signal = file.read(file.frames)
        results[place] = process(signal, file.sample_rate, OUTPUTS, {"fb_highFreqHz": 7200.0}, 12000)
    return results


def loud(result: dict[str, Any], what: str) -> FloatArray:
    """Return the values of the louder half of the units."""
    rates = result["ratemap"].mean(axis=0)
    units: FloatArray = result[what][rates > np.median(rates)]
    return units


def test_the_direction_of_the_talker(made: dict[str, dict[str, Any]]) -> None:
    """On the right; in the room with a larger spread."""
    assert np.median(loud(made["anechoic"], "itd")) == pytest.approx(0.36e-3, abs=0.02e-3)
    assert np.median(loud(made["room"], "itd")) == pytest.approx(0.25e-3, abs=0.02e-3)
    for place in ("anechoic", "room"):
        counts, edges = np.histogram(loud(made[place], "itd"), 11, (-1.1e-3, 1.1e-3))
        assert edges[counts.argmax()] > 0.09e-3


def test_interaural_coherence(made: dict[str, dict[str, Any]]) -> None:
    ranges = {"anechoic": [0.981, 0.995, 0.998], "room": [0.687, 0.914, 0.998]}
    for place, expected in ranges.items():
        np.testing.assert_allclose(np.percentile(loud(made[place], "ic"), [5, 50, 95]), expected, rtol=0, atol=0.005)


def test_onset_strength(made: dict[str, dict[str, Any]]) -> None:
    for place, percentile in (("anechoic", 17.0), ("room", 13.0)):
        strengths = made[place]["onsetStrength"]
        assert np.percentile(strengths, 99) == pytest.approx(percentile, abs=0.3)
        assert 29 <= strengths.max() <= 30


def test_the_level_rises_at_onsets_and_falls_at_offsets(made: dict[str, dict[str, Any]]) -> None:
    """Frames with transients in at least four channels: level of all channels 40 ms before and after."""
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


# --- synthetic syllables -----------------------------------------------------------------------------

RATE = 16000
STARTS = np.array([0.3, 0.75, 1.2, 1.65])  # s
LENGTH = 0.25  # s


def syllables() -> FloatArray:
    """Return a voice that glides up by half an octave in each syllable, with noise; the left ear lags by 0.25 ms."""
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
    """Return the pitch (Hz) at a time (s) after the start of a syllable."""
    hertz: FloatArray = 130.0 * 2 ** (0.5 * since / LENGTH)
    return hertz


def test_syllables() -> None:
    """Onsets at starts, offsets at ends, the pitch of the voice within syllables and none outside."""
    window = 0.04
    parameters = {"fb_highFreqHz": 6500.0, "ac_wSizeSec": window}
    got = process(syllables(), RATE, ["pitch", "onsetMap", "offsetMap"], parameters, 1000)
    for kind, edges, late in (("onsetMap", STARTS, 0.03), ("offsetMap", STARTS + LENGTH, 0.06)):
        for ear in got[kind]:
            # ends of the first frames with sound, and the delay of the channels
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
        # before the first syllable, noise may have a pitch
        silent = np.all((since < -window) | (since > LENGTH + window), axis=0) & (since[0] > 0)
        assert silent.sum() > 30 and np.isnan(found[silent]).all()
