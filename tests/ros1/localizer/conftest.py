"""Fixtures of the localizer's tests: bass, rosAFE and a localizer for all tests of a module; quick models of heads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile

from tests.harness import Graph, Process
from tests.localization.conftest import KEMAR, RATE, kemar_model, modulated, sphere_model
from tests.ros1.localizer.session import Localizer, running_localizer, scene_file

__all__ = ["KEMAR", "RATE", "kemar_model", "sphere_model"]


@pytest.fixture(scope="module")
def bass(graph: Graph) -> Iterator[Process]:
    """Run bass."""
    with graph.node("bass-ros") as process:
        yield process


@pytest.fixture(scope="module")
def afe(graph: Graph, bass: Process) -> Iterator[Process]:
    """Run rosAFE."""
    with graph.node("rosAFE-ros") as process:
        yield process


@pytest.fixture(scope="module")
def localizer(graph: Graph, afe: Process, sphere_model: Path) -> Iterator[Localizer]:
    """Run a localizer with a model of the sphere."""
    with running_localizer(graph, "--head", str(sphere_model)) as process:
        yield process
        assert "Traceback" not in process.process.err, process.process.err


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a sound file of 4 s whose level changes as that of speech."""
    path = tmp_path_factory.mktemp("sounds") / "talker.wav"
    soundfile.write(path, modulated(4.0, 3), RATE, subtype="FLOAT")
    return path


@pytest.fixture(scope="module")
def device(talker: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a scene with a talker at 40 degrees."""
    text = f"sample_rate: {RATE}\nsources:\n  - {{name: talker, file: {talker}, loop: true, azimuth: 40}}\n"
    return scene_file(tmp_path_factory.mktemp("scene"), text)


@pytest.fixture(scope="module")
def other_talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return another one."""
    path = tmp_path_factory.mktemp("sounds") / "other.wav"
    soundfile.write(path, np.roll(modulated(4.4, 4), RATE), RATE, subtype="FLOAT")
    return path
