"""scripts/demo with a sound device (the PulseAudio plugin of ALSA), also if it is unplugged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe.localization import model_cache
from tests.audio.pulseaudio import PulseServer
from tests.demo.conftest import SCENE_RATE, Learn
from tests.demo.running import DEMO_SECONDS, PORTS, Demo, path, table


def environment(pulse: PulseServer) -> dict[str, str]:
    """Return the environment for the sound server, with the models of heads."""
    cache = model_cache.folder()
    return {**pulse.env, "XDG_CACHE_HOME": str(cache.parent if cache else "")}


def noise_from_the_left(path: Path) -> Path:
    """Write noise that lasts longer than any demonstration."""
    noise = np.tile(0.1 * np.random.default_rng(0).normal(0, 1, 10 * 44100), round(DEMO_SECONDS / 10))
    delayed = np.concatenate((np.zeros(16), 0.4 * noise[:-16]))
    soundfile.write(path, np.stack((noise, delayed), axis=1), 44100, subtype="PCM_16")
    return path


@pytest.mark.exploration
def test_device(pulse: PulseServer, tmp_path: Path, learn: Learn) -> None:
    """Noise from the left: the requested duration on all ports, and azimuths on the left."""
    learn(SCENE_RATE)
    with (
        pulse.play(noise_from_the_left(tmp_path / "left.wav")),
        Demo("pulse", "--seconds", "3", "--out", tmp_path / "out", env=environment(pulse)) as running,
    ):
        assert running.wait(DEMO_SECONDS) == 0, running
        running.assert_gone()
        rows = table(running.out)
        assert set(rows) == set(PORTS)
        assert all(lost == 0 for *_, lost in rows.values())
        assert all(frames / rate > 2.9 for _, _, frames, rate, _ in rows.values())
        assert "from the beginning" not in running.out  # a device has no beginning
        azimuths = np.array(path(running.out))
        assert np.median(azimuths[:, 1]) > 10  # degrees; left is positive


@pytest.mark.exploration
def test_unplugged(pulse: PulseServer, tmp_path: Path, learn: Learn) -> None:
    """The direction is shown while noise from the left is recorded.

    If the device is unplugged during the recording, one line reports it, and no figure is saved.
    """
    learn(SCENE_RATE)
    with (
        pulse.play(noise_from_the_left(tmp_path / "left.wav")),
        Demo("pulse", "--seconds", "600", "--out", tmp_path / "out", env=environment(pulse)) as running,
    ):
        running.wait_for_output(" deg left\n")
        pulse.kill()
        assert running.wait(DEMO_SECONDS) == 1
        assert running.err.startswith("demo: pulse: ") and len(running.err.splitlines()) == 1
        assert "from the beginning" not in running.out  # a device has no beginning
        running.assert_gone()
    assert not (tmp_path / "out").exists()
