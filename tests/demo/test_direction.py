"""The direction of the recorded sound, and the truth of a scene."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rosafe.demo.direction import SECONDS, DirectionFinder, nearest, true_azimuths
from rosafe.localization import training
from rosafe.localization.head import Head
from rosafe.localization.scene import Truth

RATE = 16000


class Sound:
    """A recorder that yields blocks of sound."""

    def __init__(self, *blocks: tuple[tuple[int, int], np.ndarray]) -> None:
        self._blocks = iter(blocks)
        self.ports = {"input": SimpleNamespace(take_sound=lambda: next(self._blocks))}


def test_the_newest_sound_since_the_start_of_the_audio_is_localized(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an empty cache of models, which are learned from less sound than usual."""
    monkeypatch.setattr(training, "SOUND_SECONDS", 60.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    head = Head.sphere()
    lines: list[str] = []
    finder = DirectionFinder(RATE, head, lines.append)
    assert lines and all(line.startswith("learning the directions of the head") for line in lines)
    assert np.isnan(finder.azimuth) and len(finder.result(10.0)["time"]) == 0
    noise = 0.1 * np.random.default_rng(0).standard_normal(RATE)
    left, right = head.render(noise, RATE, 40), head.render(noise, RATE, -60)
    recorder: Any = Sound(
        ((1, 0), left), ((2, 4000), right[:, : RATE // 2]), ((2, 4000 + RATE // 2), right[:, RATE // 2 :])
    )
    finder.update(recorder)
    assert finder.azimuth == pytest.approx(40, abs=5)
    finder.update(recorder)  # the audio has restarted
    finder.update(recorder)
    assert finder.azimuth == pytest.approx(-60, abs=5)
    found = finder.result(10.0)
    assert found["azimuth"] == pytest.approx(-60, abs=5) and found["posterior"].shape == (len(found["time"]), 72)
    assert found["time"][0] == pytest.approx(0.25 + SECONDS / 2, abs=0.011)  # the first complete window
    assert found["time"][-1] == pytest.approx(1.25 - SECONDS / 2, abs=0.011)
    assert finder.result(1.0)["time"][-1] == pytest.approx(1.0 - SECONDS / 2, abs=0.011)


def test_a_sample_rate_without_a_model_is_rejected() -> None:
    with pytest.raises(ValueError, match="sample"):
        DirectionFinder(1000, None, print)


def test_truth_of_several_sources() -> None:
    def truth(time: float) -> Truth:
        names, azimuths = (("a", "b"), (30.0, 150.0)) if time < 1 else (("b",), (-179.0,))
        return Truth(0.0, names, azimuths)

    series = true_azimuths(truth, np.array([0.0, 1.0]), folded=False)
    np.testing.assert_array_equal(series["a"], [30.0, np.nan])
    np.testing.assert_array_equal(series["b"], [150.0, -179.0])
    np.testing.assert_array_equal(true_azimuths(truth, np.array([0.0, 1.0]), folded=True)["b"], [30.0, -1.0])
    names, azimuths = nearest(np.array([170.0, 170.0]), series)
    assert names.tolist() == ["b", "b"] and azimuths.tolist() == [150.0, -179.0]
    names, azimuths = nearest(np.array([40.0, np.nan]), series)
    assert names.tolist() == ["a", "b"] and azimuths[0] == 30.0
