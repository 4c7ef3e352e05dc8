"""Direction models of the sphere, learned from less sound than usual: learning one takes half a minute of two cores."""

from __future__ import annotations

import fcntl
from pathlib import Path

import pytest

from rosafe.localization import training
from rosafe.localization.direction_model import DirectionModel
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


def learn(factory: pytest.TempPathFactory, sample_rate: float, seconds: float | None = None) -> DirectionModel:
    """Return the model for a sample rate; the first process of a run that needs it learns it."""
    folder = cache(factory)
    with open(folder / "lock", "w") as lock, pytest.MonkeyPatch.context() as patch:
        fcntl.flock(lock, fcntl.LOCK_EX)
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setattr(training, "SOUND_SECONDS", seconds or SOUND_SECONDS.get(round(sample_rate), OTHER_SOUND_SECONDS))
        return model_of(Head.sphere(), sample_rate, None, lambda part: None)
