"""Representations of the scene, computed once for all tests here."""

from __future__ import annotations

import numpy as np
import pytest

import rosafe
from rosafe.bass.sources.scene import Scene
from rosafe.view.representations import Representations

OUTPUTS = ("gammatone", "ild", "ratemap", "crossCorrelation")
WALK = 3.0  # s


def represented(signal: np.ndarray, sample_rate: float) -> Representations:
    """Return the representations of a signal."""
    return Representations.from_process(rosafe.process(signal, sample_rate, outputs=OUTPUTS))


@pytest.fixture(scope="session")
def walk() -> Representations:
    """Return the representations of a source that moves from left to right."""
    return represented(Scene(44100, seconds=WALK).frames(round(WALK * 44100)), 44100)
