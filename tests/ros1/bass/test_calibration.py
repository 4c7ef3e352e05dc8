"""`rosafe record --calibrate`: with the printed value, internal levels are equal to the calibrator's level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rosafe
from tests.commands.command import as_int32, refused, write
from tests.commands.command import rosafe as command

RATE = 16000


def tone(amplitudes: tuple[float, float], seconds: float = 0.5) -> np.ndarray:
    """Return 1 kHz for both ears."""
    return np.outer(amplitudes, np.sin(2 * np.pi * 1000 * np.arange(int(seconds * RATE)) / RATE))


@pytest.mark.parametrize(("spl", "amplitude"), [(94, 0.01), (114, 0.3)])
def test_the_printed_value_gives_correct_levels(tmp_path: Path, spl: int, amplitude: float) -> None:
    sound = tone((amplitude, amplitude))
    path = write(tmp_path / "calibrator.wav", sound, RATE, "PCM_24")
    done = command("record", "--calibrate", str(spl), "--device", f"file:{path}", "--seconds", "0.5", "-q")
    assert (done.returncode, done.stderr) == (0, ""), done
    name, _, value = done.stdout.splitlines()[-1].partition("=")
    values = {"pp_bLevelScaling": True, name: float(value)}
    inside = rosafe.process(as_int32(sound), RATE, parameters=values, outputs="preProc")["preProc"]
    assert 100 + 20 * np.log10(np.sqrt(np.mean(inside**2))) == pytest.approx(spl, abs=0.01)


def test_calibration_of_a_single_microphone(tmp_path: Path) -> None:
    path = write(tmp_path / "left.wav", tone((0.1, 0.001)), RATE)
    done = command("record", "--calibrate", "94", "--device", f"file:{path}", "--seconds", "0.5", "-q")
    assert done.stdout.splitlines()[-1] == "pp_refSPLdB=82.99"  # 200 - 94 + 20 log10(0.1 / sqrt(2))
    assert "the ears differ (left 82.99, right 43.0" in done.stderr


def test_unusable_signals_are_rejected(tmp_path: Path) -> None:
    for amplitude, words in ((0.0, "the sound was silent"), (1.2, "clipped; reduce the gain")):
        path = write(tmp_path / f"{amplitude}.wav", np.clip(tone((amplitude, amplitude)), -1, 1), RATE)
        done = command("record", "--calibrate", "94", "--device", f"file:{path}", "--seconds", "0.5", "-q")
        assert done.returncode == 1 and words in done.stderr and "pp_refSPLdB" not in done.stdout
    refused(command("record", "--calibrate", "loud"), "expected a level in dB SPL, such as 94, from 0 to 200", code=2)
