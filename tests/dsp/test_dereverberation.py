"""Dereverberation: late sound is reduced, direct sound and tones are kept, and silence changes nothing."""

from __future__ import annotations

import numpy as np
import scipy.signal

from rosafe.dsp.dereverberation import Dereverberator
from rosafe.localization import spatial_filter
from rosafe.localization.spatial_filter import BINS, HOP, SIZE

RATE = 16000


def processed(ears: np.ndarray) -> np.ndarray:
    """Return both ears (2, N) after analysis, dereverberation and synthesis."""
    found, stage = np.zeros_like(ears), Dereverberator(BINS)
    for begin in range(0, ears.shape[1] - SIZE + 1, HOP):
        frame = stage.process(spatial_filter.spectrum(ears[:, begin : begin + SIZE]))
        found[:, begin : begin + SIZE] += [spatial_filter.overlap(ear) for ear in frame]
    return found


def error_db(found: np.ndarray, truth: np.ndarray) -> float:
    part = slice(2 * RATE, -SIZE)
    return float(10 * np.log10(np.sum((found - truth)[:, part] ** 2) / np.sum(truth[:, part] ** 2)))


def bursts(seconds: float, random: np.random.Generator) -> np.ndarray:
    """Return noise whose level changes every 80 ms, as that of speech."""
    levels = 10 ** (random.uniform(-40, 0, round(seconds / 0.08)) / 20)
    return np.asarray(np.repeat(levels, round(0.08 * RATE)) * random.standard_normal(round(seconds * RATE)))


def test_late_reverberation_is_reduced_and_direct_sound_is_kept() -> None:
    random = np.random.default_rng(1)
    dry = 0.1 * bursts(6.0, random)
    direct = np.stack((dry, 0.5 * dry))
    tail = random.standard_normal((2, RATE // 2)) * 10 ** (-3 * np.arange(RATE // 2) / (RATE // 2))
    tail[:, : round(0.03 * RATE)] = 0
    late = scipy.signal.fftconvolve(dry[np.newaxis], tail, axes=1)[:, : len(dry)]
    late *= np.sqrt(np.sum(direct**2) / np.sum(late**2)) / 2
    assert error_db(processed(direct + late), direct) < error_db(direct + late, direct) - 1
    assert error_db(processed(direct), direct) < -15


def test_a_tone_keeps_half_of_its_amplitude() -> None:
    tone = 0.1 * np.sin(2 * np.pi * 500 * np.arange(5 * RATE) / RATE)
    level = np.std(processed(np.stack((tone, tone)))[:, -2 * RATE : -SIZE]) / np.std(tone)
    assert 0.3 < level < 0.9, "it can be predicted"


def test_nothing_grows_in_silence() -> None:
    stage, random = Dereverberator(3), np.random.default_rng(2)
    frames = random.standard_normal((200, 2, 3)) + 1j * random.standard_normal((200, 2, 3))
    first = [stage.process(frame) for frame in frames]
    for _ in range(30000):
        assert not stage.process(np.zeros((2, 3), complex)).any()
    again = [stage.process(frame) for frame in frames]
    assert np.isfinite(again).all()
    assert np.sum(np.abs(again) ** 2) < 1.2 * np.sum(np.abs(first) ** 2)
