"""Direction models: learned from less sound than usual, which takes seconds to minutes, or with random numbers."""

from __future__ import annotations

import fcntl
from pathlib import Path

import numpy as np
import pytest

from rosafe.localization import angles, cues, training
from rosafe.localization.direction_model import TABLES, DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.model_cache import model_of
from tests import harness

SOUND_SECONDS = {44100: 100.0}  # by sample rate; the accuracy of the demo's scene needs no more
OTHER_SOUND_SECONDS = 120.0


def cache(factory: pytest.TempPathFactory) -> Path:
    """Return the folder for XDG_CACHE_HOME that all processes of one run of the tests share."""
    folder = harness.folder_of_run(factory) / "models"
    folder.mkdir(exist_ok=True)
    return folder


def learn(
    factory: pytest.TempPathFactory, sample_rate: float, seconds: float | None = None, head: Head | None = None
) -> DirectionModel:
    """Return the model of a head (the sphere) for a sample rate; the first process of a run that needs it learns it."""
    return learn_in(cache(factory), sample_rate, seconds, head or Head.sphere())


def learn_in(folder: Path, sample_rate: float, seconds: float | None, head: Head) -> DirectionModel:
    """Return the model of a head; the first process that needs it stores it in a folder."""
    with (
        open(folder / f"{head.key}-{sample_rate:g}.lock", "w") as lock,
        pytest.MonkeyPatch.context() as patch,
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setattr(training, "SOUND_SECONDS", seconds or SOUND_SECONDS.get(round(sample_rate), OTHER_SOUND_SECONDS))
        return model_of(head, sample_rate, None, lambda part: None)


def random_model(channels: int, random: np.random.Generator) -> DirectionModel:
    """Return a model for 16 kHz whose tables are random."""
    parameters = cues.model_parameters(cues.describe(16000.0, {"fb_nChannels": channels}))
    description = {
        "sample_rate": 16000,
        "parameters": parameters,
        "head": "random",
        "is_sphere": False,
        "max_itd": 1e-3,
        "level_gain_db": 0.0,
    }
    rows = channels * cues.CLASSES
    tables = [random.standard_normal((rows * bins + 1, len(angles.grid()) + 1)) for bins in TABLES.values()]
    for table in tables:
        table[-1] = 0.0  # of frames without cues
    return DirectionModel(description, *tables)
