"""Models of the demo's head for the tests and the programs that they start."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests import models

SCENE_RATE = 44100
Learn = Callable[[int], object]


@pytest.fixture
def learn(tmp_path_factory: pytest.TempPathFactory) -> Learn:
    """Return a function that adds the model for a sample rate to the cache."""
    return lambda sample_rate: models.learn(tmp_path_factory, sample_rate)


@pytest.fixture(autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(models.cache(tmp_path_factory)))
