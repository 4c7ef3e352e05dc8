"""Direction models at 16 kHz of the sphere, of the MIT KEMAR head and of two microphones."""

from __future__ import annotations

import fcntl
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import soundfile

from rosafe.localization import training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head import Head
from tests import harness, models

from .sounds import RATE, RECORDINGS, music

TALKER, MUSIC = 30.0, -40.0  # degrees, in `take`
KEMAR = Path("/usr/share/libmysofa/MIT_KEMAR_normal_pinna.sofa")


@pytest.fixture(scope="session")
def sphere_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a model of the sphere, learned from less sound than usual."""
    path = tmp_path_factory.mktemp("model") / "sphere.head"
    models.learn(tmp_path_factory, RATE).save(path)
    return path


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Return a recording of a talker and music, and both parts of it (2, 2, N)."""
    paths = sorted(RECORDINGS.glob("*_*.wav"))
    if not paths:
        pytest.skip("Debian's alsa-utils is not installed")
    speech = np.concatenate(
        [scipy.signal.resample_poly(sound, RATE, rate) for sound, rate in map(soundfile.read, paths)]
    )
    tune = music(6.0, 4)
    speech = np.resize(speech, len(tune))
    head = Head.sphere()
    sources = (0.08 * speech / np.std(speech), TALKER), (0.04 * tune / np.std(tune), MUSIC)
    parts = [head.render(dry, RATE, azimuth) for dry, azimuth in sources]
    path = tmp_path_factory.mktemp("take") / "take.wav"
    soundfile.write(path, np.sum(parts, axis=0).T, RATE, subtype="PCM_32")
    return path, np.array(parts)


@pytest.fixture(scope="session")
def kemar() -> Head:
    """Return the MIT KEMAR head."""
    if not KEMAR.exists():
        pytest.skip("Debian's libmysofa1 is not installed")
    return Head.from_sofa(KEMAR)


@pytest.fixture(scope="session")
def kemar_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a model of the MIT KEMAR head, learned from as much sound as usual, which rooms need.

    The first process of a run of the tests that needs it learns it.
    """
    if not KEMAR.exists():
        pytest.skip("Debian's libmysofa1 is not installed")
    path = harness.folder_of_run(tmp_path_factory) / "kemar.head"
    with open(path.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            training.learn_head(Head.from_sofa(KEMAR), RATE).save(path)
    return path


@pytest.fixture(scope="session")
def pair_model(tmp_path_factory: pytest.TempPathFactory) -> DirectionModel:
    """Return the model of microphones with a distance of 58 mm, learned from less sound than usual."""
    return models.learn(tmp_path_factory, RATE, head=Head.pair(0.058))


def modulated(seconds: float, seed: int, rate: int = RATE) -> np.ndarray:
    """Return noise whose level changes as in speech, with an RMS of about -26 dB."""
    random = np.random.default_rng(seed)
    levels = np.repeat(10 ** (random.uniform(-20, 0, int(seconds * 10) + 1) / 20), rate // 10)
    return 0.1 * levels[: round(seconds * rate)] * random.standard_normal(round(seconds * rate))


__all__ = ["KEMAR", "RATE", "DirectionModel", "modulated"]
