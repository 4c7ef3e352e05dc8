"""Representations of the scene, computed once for all tests here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.audio.devices.scene import Scene
from rosafe.results.view.representations import Representations

OUTPUTS = ("gammatone", "ild", "ratemap", "crossCorrelation")
WALK = 3.0  # s


def aligned(result: Mapping[str, Any]) -> Representations:
    """Return the representations of a result of `rosafe.process` with windows of two hops (the default)."""
    series = {
        "ratemap": result["ratemap"],
        "ild": result["ild"],
        "crossCorrelation": result["crossCorrelation"].mean(0),
    }
    times = {kind: (1 + np.arange(data.shape[-1])) / result[f"{kind}_frameRate"] for kind, data in series.items()}
    return Representations.aligned(
        result["fb_cfHz"], result["cc_lags"], *((times[kind], data) for kind, data in series.items())
    )


@pytest.fixture(scope="session")
def walk() -> Representations:
    """Return the representations of a source that moves from left to right."""
    signal = Scene(44100, seconds=WALK).frames(round(WALK * 44100))
    return aligned(rosafe.process(signal, 44100, outputs=OUTPUTS))


def tail(shown: Representations, seconds: float) -> Representations:
    """Return the last `seconds`."""
    last = shown.times >= shown.times[-1] - seconds
    kept = {name: getattr(shown, name)[..., last] for name in ("times", "ratemap", "ild", "correlation")}
    return dataclasses.replace(shown, **kept)
