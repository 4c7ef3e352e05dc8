"""scripts/demo on a sound device (ALSA's PulseAudio plugin), which may be unplugged on the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import soundfile

from tests.bass.pulse import PulseServer
from tests.demo.running import DEMO_SECONDS, PORTS, demo, path, table


def test_device(pulse: PulseServer, tmp_path: Path) -> None:
    """Noise from the left: as much of everything as was asked for, and the left side."""
    noise = 0.1 * np.random.default_rng(0).normal(0, 1, 60 * 44100)
    late = np.concatenate((np.zeros(16), 0.4 * noise[:-16]))
    soundfile.write(tmp_path / "left.wav", np.stack((noise, late), axis=1), 44100, subtype="PCM_16")
    with (
        pulse.play(tmp_path / "left.wav"),
        demo("pulse", "--seconds", "3", "--out", tmp_path / "out", **pulse.env) as running,
    ):
        assert running.wait(DEMO_SECONDS) == 0, running
        running.assert_gone()
        rows = table(running.out)
        assert set(rows) == set(PORTS)
        assert all(lost == 0 for *_, lost in rows.values())
        assert all(frames / rate > 2.9 for _, _, frames, rate, _ in rows.values())
        assert "once more from the beginning" not in running.out  # a device has none
        course = np.array(path(running.out))
        assert np.median(course[:, 1]) < -10 and np.median(course[:, 2]) < -10


def test_unplugged(pulse: PulseServer, tmp_path: Path) -> None:
    """The device goes while it is followed: one line that says so, and no picture."""
    with demo("pulse", "--seconds", "60", "--out", tmp_path / "out", **pulse.env) as running:
        running.says("following")
        pulse.kill()
        assert running.wait(DEMO_SECONDS) == 1
        assert running.err.startswith("demo: pulse: ") and len(running.err.splitlines()) == 1
        running.assert_gone()
    assert not (tmp_path / "out").exists()
