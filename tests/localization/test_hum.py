"""Cheap microphones: a constant offset and mains hum, equal in both channels, with quiet sound."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.localization import angles
from tests.localization.conftest import RATE, modulated

QUIET = 0.03  # of sound with an RMS of about -26 dB


def mains(frequency: float, seconds: float) -> np.ndarray:
    """Return hum with harmonics up to 600 Hz."""
    times = np.arange(round(seconds * RATE)) / RATE
    return sum(0.01 / order * np.sin(2 * np.pi * frequency * order * times + order) for order in range(1, 11))


OFFSETS = {"offset": (0.01, QUIET), "large offset": (0.9, QUIET / 10)}  # and the level of the sound


@pytest.mark.parametrize("disturbance", [*OFFSETS, "50", "60.2"])
def test_quiet_sound_is_localized(kemar: rosafe.Head, kemar_model: Path, disturbance: str) -> None:
    """The filters alone leave little of the smaller offset, but not of the large one."""
    offset, level = OFFSETS.get(disturbance, (0.0, QUIET))
    added = np.full(round(1.5 * RATE), offset) if offset else mains(float(disturbance), 1.5)
    right = 0
    azimuths = (-150, -120, -60, -30, 30, 60, 90, 120)
    for seed, azimuth in enumerate(azimuths):
        ears = kemar.render(level * modulated(1.5, seed), RATE, azimuth)
        ears = ears + added + 2e-5 * np.random.default_rng(seed).standard_normal(ears.shape)
        found = rosafe.localize(ears, RATE, kemar_model, 1.0)
        right += abs(float(angles.difference(found["azimuth"][-1], azimuth))) <= 5
    assert right >= len(azimuths) - 1


@pytest.mark.parametrize("frequency", [50.0, 60.0])
def test_hum_is_no_evidence_for_a_direction(kemar_model: Path, frequency: float) -> None:
    """Evidence in the channels of the harmonics is a hundredth of that of noise from a direction."""
    hum = np.stack([mains(frequency, 1.5)] * 2)
    found = rosafe.localize(hum + 1e-6 * np.random.default_rng(1).standard_normal(hum.shape), RATE, kemar_model, 1.0)
    assert found["confidence"][-1] < 0.5
