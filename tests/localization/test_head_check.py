"""Heads that do not belong to the sound are noticed, from a walk around; rooms and other heads cause no alarm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import soundfile

import rosafe
from rosafe.commands.__main__ import main
from rosafe.localization.cues import KINDS
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head_check import HeadCheck, HeadReport, check_sound
from tests.localization.conftest import RATE, modulated

WALK = np.arange(0, 360, 15)


def walk(head: rosafe.Head, azimuths: np.ndarray = WALK, drr_db: float | None = None) -> np.ndarray:
    """Return half a second of sound from each direction, counter-clockwise, in a room if a ratio is given."""
    random = np.random.default_rng(7)
    parts = []
    for seed, azimuth in enumerate(azimuths):
        sound = modulated(0.5, seed)
        ears = head.render(sound, RATE, float(azimuth))
        if drr_db is not None:
            decay = 10 ** (-3 * np.arange(RATE * 3 // 10) / (0.4 * RATE))
            tail = np.zeros_like(ears)
            for late in range(0, 360, 30):
                dense = decay * random.standard_normal(len(decay))
                tail += head.render(scipy.signal.fftconvolve(sound, dense)[: len(sound)], RATE, float(late))
            ears = ears + tail * np.std(ears) / np.std(tail) * 10 ** (-drr_db / 20)
        parts.append(ears)
    ears = np.concatenate(parts, axis=1)
    return ears + 2e-4 * random.standard_normal(ears.shape)


def checked(sound: np.ndarray, model: DirectionModel | Path) -> HeadReport:
    report = check_sound(sound, RATE, model)
    assert report is not None
    return report


@pytest.mark.parametrize("drr_db", [None, 5.0, 0.0])
def test_heads_give_no_alarm(kemar: rosafe.Head, kemar_model: Path, sphere_model: Path, drr_db: float | None) -> None:
    """KEMAR and the sphere, also the sphere as the model of KEMAR."""
    for head, models in ((kemar, (kemar_model, sphere_model)), (rosafe.Head.sphere(), (sphere_model,))):
        sound = walk(head, drr_db=drr_db)
        for model in models:
            report = checked(sound, model)
            assert report.problem == "" and report.slope > 2 and 0.5 < report.max_lag < 0.85
            assert report.first_side == "left"


@pytest.mark.parametrize("drr_db", [None, 0.0])
@pytest.mark.parametrize("spacing", [0.058, 0.2])
def test_microphones_without_a_head(sphere_model: Path, spacing: float, drr_db: float | None) -> None:
    report = checked(walk(rosafe.Head.pair(spacing), drr_db=drr_db), sphere_model)
    assert report.problem.startswith(
        "no level differences at high frequencies: these are microphones without a head; use"
    )
    assert "--head pair:SPACING" in report.problem and abs(report.slope) < 1.5
    if drr_db is None:
        assert report.max_lag == pytest.approx(1000 * spacing / 343, abs=0.03)


def test_a_head_between_the_microphones_of_a_pair(pair_model: DirectionModel) -> None:
    report = checked(walk(rosafe.Head.sphere()), pair_model)
    assert report.problem.startswith("level differences of ") and "use --head sphere" in report.problem


def test_delays_that_the_spacing_does_not_allow(pair_model: DirectionModel) -> None:
    assert checked(walk(rosafe.Head.pair(0.058)), pair_model).problem == ""
    problem = checked(walk(rosafe.Head.pair(0.12)), pair_model).problem
    assert problem.startswith("delays up to 0.3") and "this head allows 0.1" in problem
    assert problem.endswith("use --head pair:0.12, or more")


def test_delays_that_a_head_does_not_allow(sphere_model: Path) -> None:
    ears = walk(rosafe.Head.sphere())
    lead = walk(rosafe.Head.pair(0.33))  # more delay, and the levels of the sphere
    gain = [np.std(ear.reshape(len(WALK), -1), axis=1, keepdims=True) for ear in ears]
    wide = np.stack(
        [(ear.reshape(len(WALK), -1) * level / np.mean(gain)).ravel() for ear, level in zip(lead, gain, strict=True)]
    )
    problem = checked(wide, sphere_model).problem
    assert problem.startswith("delays up to 0.9") and "this head allows 0.7" in problem
    assert problem.endswith("recordings of this head (rosafe head learn)")


@pytest.mark.parametrize("gain_db", [-3.0, 2.5])
def test_gains(sphere_model: Path, pair_model: DirectionModel, gain_db: float) -> None:
    for head, model in ((rosafe.Head.sphere(), sphere_model), (rosafe.Head.pair(0.058), pair_model)):
        report = checked(walk(head) * np.array([[10 ** (gain_db / 20)], [1.0]]), model)
        assert report.gain_db == pytest.approx(gain_db, abs=0.5) and "the gains differ by" in report.problem
        assert ("lower that of the left" in report.problem) == (gain_db > 0)


def test_exchanged_ears_are_reported_by_the_order(sphere_model: Path) -> None:
    report = checked(walk(rosafe.Head.sphere())[::-1], sphere_model)
    assert report.first_side == "right" and "the ears are swapped" in report.lines[-1]


def test_levels_that_contradict_the_times(sphere_model: Path) -> None:
    ears = walk(rosafe.Head.pair(0.15))
    loud = np.repeat(-8 * np.sin(np.radians(WALK)), ears.shape[1] // len(WALK)) / 2
    contrary = ears * 10 ** (np.stack((loud, -loud)) / 20)
    assert checked(contrary, sphere_model).problem.startswith("times and levels contradict each other")


@pytest.mark.parametrize("azimuths", [[60], [0], [-10, 30]])
def test_few_directions_give_no_alarm(sphere_model: Path, azimuths: list[int]) -> None:
    for drr_db in (None, 0.0):
        sound = walk(rosafe.Head.sphere(), np.repeat(azimuths, 16 // len(azimuths)), drr_db)
        report = check_sound(sound, RATE, sphere_model)
        assert report is None or report.problem == ""


def test_blocks_do_not_matter(sphere_model: Path) -> None:
    model = DirectionModel.load(sphere_model)
    features = rosafe.process(walk(rosafe.Head.sphere()), RATE, parameters=model.parameters, outputs=list(KINDS))
    reports = []
    for step in (7, 10_000):
        check = HeadCheck(model)
        for begin in range(0, features["itd"].shape[1], step):
            check.update({kind: features[kind][..., begin : begin + step] for kind in KINDS})
        reports.append(check.report())
    assert reports[0] == reports[1] is not None


def test_noise_and_silence_give_no_report(sphere_model: Path) -> None:
    assert check_sound(np.zeros((2, 5 * RATE)), RATE, sphere_model) is None
    noise = 0.01 * np.random.default_rng(1).standard_normal((2, 5 * RATE))
    assert check_sound(noise, RATE, sphere_model) is None


def test_the_command(tmp_path: Path, sphere_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for head, status in ((rosafe.Head.sphere(), 0), (rosafe.Head.pair(0.058), 1)):
        path = tmp_path / f"{status}.wav"
        soundfile.write(path, walk(head).T, RATE)
        for arguments in ([str(path), "--check"], ["--check", str(path)]):
            assert main(["localize", *arguments, "--head", str(sphere_model)]) == status
            out = capsys.readouterr().out
            assert "time differences up to" in out and ("pair:SPACING" in out) == bool(status)
    silent = tmp_path / "silent.wav"
    soundfile.write(silent, np.zeros((RATE, 2)), RATE)
    assert main(["localize", str(silent), "--check", "--head", str(sphere_model)]) == 1
    assert "expected a second of sound from one direction at a time" in capsys.readouterr().err
