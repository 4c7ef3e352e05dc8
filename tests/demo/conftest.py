"""The model of the demo's head exists before the first demo starts: learning it takes half a minute of two cores."""

from __future__ import annotations

import fcntl

import pytest

from rosafe.localization.localizer import SPHERE
from rosafe.localization.model_cache import model_of
from tests import harness

DEMO_RATE = 44100.0


@pytest.fixture(scope="session", autouse=True)
def model_of_the_sphere(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Learn the model, in one process of a run of the tests, unless the user's cache has it."""
    with open(harness.folder_of_run(tmp_path_factory) / "sphere.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        model_of(SPHERE, DEMO_RATE, None, lambda part: None)
