"""`rosafe.direction_mask`, `rosafe.enhance` and `rosafe enhance`: improvement in dB, and refused arguments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import soundfile

import rosafe
from rosafe.commands.__main__ import main
from rosafe.localization import enhancement
from rosafe.localization.head import Head
from rosafe.localization.training import _training_sound
from rosafe.validation.systems import si_sdr
from tests.localization.conftest import RATE
from tests.localization.sounds import RECORDINGS


def voices(head: Head, azimuths: tuple[float, float], seconds: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Return two sounds like speech of equal level at two directions, (2, N) each."""
    random = np.random.default_rng(11)
    dry = [0.01 * _training_sound(2 * number, round(seconds * RATE), RATE, random) for number in (0, 1)]
    target, other = (head.render(sound, RATE, azimuth) for sound, azimuth in zip(dry, azimuths, strict=True))
    return target, other


def talkers(head: Head, azimuths: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return two recordings of speech of equal level at two directions, (2, N) each."""
    paths = [RECORDINGS / name for name in ("Front_Center.wav", "Rear_Right.wav")]
    if not all(path.exists() for path in paths):
        pytest.skip("Debian's alsa-utils is not installed")
    dry = [scipy.signal.resample_poly(sound, RATE, rate) for sound, rate in map(soundfile.read, paths)]
    count = min(map(len, dry))
    target, other = (
        head.render(0.02 * sound[:count] / np.std(sound[:count]), RATE, azimuth)
        for sound, azimuth in zip(dry, azimuths, strict=True)
    )
    return target, other


def test_the_ideal_mask_is_the_upper_limit(kemar: Head, kemar_model: Path) -> None:
    target, other = talkers(kemar, (0.0, 60.0))
    mixture = target + other
    power = [rosafe.process(sound, RATE, outputs=["ratemap"])["ratemap"] for sound in (target, other)]
    ideal = power[0].sum(0) / (power[0].sum(0) + power[1].sum(0))
    result = rosafe.process(mixture, RATE, outputs=["gammatone"])
    before = si_sdr(mixture, target)
    assert np.mean(si_sdr(rosafe.resynthesize(result, ideal), target) - before) > 7
    estimated = rosafe.direction_mask(mixture, RATE, 0, kemar_model)
    frames = ideal.shape[1]
    assert np.corrcoef(estimated[:, :frames].ravel(), ideal.ravel())[0, 1] > 0.6


def test_the_mask_of_a_single_source(sphere_model: Path) -> None:
    source, _ = voices(Head.sphere(), (40.0, 0.0), 1.0)
    toward, away = (rosafe.direction_mask(source, RATE, azimuth, sphere_model) for azimuth in (40, -40))
    assert toward.shape == away.shape == (31, 100) and toward.min() >= 0 and toward.max() <= 1
    assert toward.mean() > 0.7 and away.mean() < 0.3
    mirrored = rosafe.direction_mask(source, RATE, 140, sphere_model)
    assert np.allclose(mirrored, toward)  # a sphere does not distinguish front and back
    integers = np.round(source * 2**31 * 0.9).astype(np.int32)
    assert np.abs(rosafe.direction_mask(integers, RATE, 40, sphere_model) - toward).max() < 0.05


def test_blocks_are_seamless(sphere_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, other = voices(Head.sphere(), (0.0, 60.0))
    whole = rosafe.enhance(target + other, RATE, 0, sphere_model)
    monkeypatch.setattr(enhancement, "_BLOCK_SECONDS", 0.37)
    parts = rosafe.enhance(target + other, RATE, 0, sphere_model)
    assert np.sum((parts - whole) ** 2) < 1e-5 * np.sum(whole**2)


def test_a_sound_that_ends_abruptly_is_complete(sphere_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without weights the output is the input, also in the last 20 ms, where the error was -11 dB."""
    monkeypatch.setattr(enhancement._Enhancer, "mask", lambda _: np.ones((31, 100)))
    spectrum = np.fft.rfft(np.random.default_rng(3).standard_normal((2, 2 * RATE)))
    spectrum[:, :200] = spectrum[:, 12000:] = 0  # 100 Hz to 6 kHz
    sound = 0.1 * np.fft.irfft(spectrum)[:, :RATE]
    for rest in (0, 7):  # the last frame may be incomplete
        part = sound[:, : RATE - rest]
        error = rosafe.enhance(part, RATE, 0, sphere_model) - part
        end = slice(-RATE // 50, None)
        assert np.sum(error[:, end] ** 2) < 1e-4 * np.sum(part[:, end] ** 2)


def test_silence_and_short_sounds(sphere_model: Path) -> None:
    assert not rosafe.enhance(np.zeros((2, RATE // 2)), RATE, 0, sphere_model).any()
    assert rosafe.enhance(np.zeros((2, 10)), RATE, 0, sphere_model).shape == (2, 10)
    assert rosafe.enhance(np.zeros((2, 0)), RATE, 0, sphere_model).shape == (2, 0)


def test_refused_arguments(sphere_model: Path) -> None:
    ears = np.zeros((2, 1600))
    with pytest.raises(ValueError, match="sound: expected two ears"):
        rosafe.enhance(ears[0], RATE, 0, sphere_model)
    for wrong in (float("nan"), "left", None, 1e308, -1.1e6):
        with pytest.raises(ValueError, match="azimuth: expected a finite number from -1000000 to 1000000 degrees"):
            rosafe.direction_mask(ears, RATE, wrong, sphere_model)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="sample_rate: expected"):
        rosafe.enhance(ears, RATE / 2, 0, sphere_model)


def test_the_command(sphere_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, other = voices(Head.sphere(), (0.0, 60.0), 1.0)
    sound, out = tmp_path / "two.wav", tmp_path / "one.wav"
    soundfile.write(sound, (target + other).T, RATE, subtype="FLOAT")
    arguments = ["enhance", str(sound), "--azimuth", "0", "--head", str(sphere_model), "-o", str(out)]
    assert main(arguments) == 0
    found, rate = soundfile.read(out)
    assert rate == RATE and soundfile.info(out).subtype == "FLOAT"
    read, _ = soundfile.read(sound)
    assert np.abs(found.T - rosafe.enhance(read, RATE, 0, sphere_model)).max() < 1e-6
    assert main(arguments) == 1 and "one.wav" in capsys.readouterr().err  # it exists
    assert main([*arguments, "--force"]) == 0
    soundfile.write(sound, target[0], RATE)
    assert main([*arguments, "--force"]) == 1
    assert capsys.readouterr().err.startswith("rosafe enhance: ")
    for words in ([*arguments[:-1], "one.mp3"], [*arguments, "two.wav"], ["enhance", str(sound), "-o", str(out)]):
        with pytest.raises(SystemExit, match="2"):
            main(words)
    capsys.readouterr()
    for wrong in ("x", "nan", "400"):
        with pytest.raises(SystemExit, match="2"):
            main(["enhance", str(sound), "--azimuth", wrong, "-o", str(out)])
        error = capsys.readouterr().err
        assert f"--azimuth: expected a number of degrees from -360 to 360, got '{wrong}'" in error
    with pytest.raises(SystemExit, match="2"):
        main(["head", "forget", "a.sofa", "-o", "a.head"])
    assert "learn: expected learn, got 'forget'" in capsys.readouterr().err
