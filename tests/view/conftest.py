"""The scene and the shared speech, computed once for all tests here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import rosafe
from rosafe.bass.sources.scene import Scene
from rosafe.sound.audiofile import AudioFile
from rosafe.view.representations import Representations
from tests.harness import shared

OUTPUTS = ("gammatone", "ild", "ratemap", "crossCorrelation")
WALK = 3.0  # s


def represented(signal: np.ndarray, sample_rate: float) -> Representations:
    """What there is to see of a signal."""
    return Representations.from_process(rosafe.process(signal, sample_rate, outputs=OUTPUTS))


@pytest.fixture(scope="session")
def walk() -> Representations:
    """One walk from left to right."""
    return represented(Scene(44100, seconds=WALK).frames(round(WALK * 44100)), 44100)


@pytest.fixture(scope="session", params=["speech_anechoic_16k.wav", "speech_room_16k.wav"])
def speech(request: pytest.FixtureRequest) -> Iterator[tuple[str, np.ndarray, Representations]]:
    """A speech file: name, samples, and what there is to see of it."""
    file = AudioFile(shared("audio", request.param))
    samples = file.read(file.frames)
    file.close()
    yield request.param, samples, represented(samples, 16000)
