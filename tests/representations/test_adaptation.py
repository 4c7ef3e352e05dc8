"""Adaptation loops: the formulas sample by sample, steady sound, onsets, and every change."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.adaptation import EVEN_TAU, TAU, Adaptation, hearing_threshold

from .chain import Chain, FloatArray, cut

RATE = 8000.0
FREQUENCIES = (100.0, 1000.0, 4000.0)
SOUND = SignalFormat(RATE, RATE, center_frequencies=FREQUENCIES, filterbank="gammatone")
DRNL = replace(SOUND, filterbank="drnl")


def sound(samples: int, seed: int = 0, channels: int = 3) -> FloatArray:
    """Return half-wave rectified noise with steps of level, from silence to 120 dB; some samples are below 0."""
    rng = np.random.default_rng(seed)
    levels = 10.0 ** rng.uniform(-6, 1, samples // 50 + 1)
    levels[rng.random(len(levels)) < 0.2] = 0
    x = np.maximum(rng.standard_normal((2, channels, samples)), -0.1)
    return x * np.repeat(levels, 50)[:samples]


def by_the_book(x: FloatArray, threshold_db: float, tau: list[float], lim: float, drnl: bool = False) -> list[float]:
    """Compute one channel (N,) sample by sample, with the limit in the form of the papers."""
    least = 10 ** ((threshold_db - 100) / 20)
    rest = [least ** (2.0**-j) for j in range(1, len(tau) + 1)]
    states, made = list(rest), []
    for sample in x:
        v = max((sample * 10 ** (50 / 20)) ** 2 if drnl else sample, least)
        for j, t in enumerate(tau):
            v /= states[j]
            if lim > 1 and v > 1:
                m = (1 - rest[j] ** 2) * lim - 1
                v = 2 * m / (1 + math.exp(min(-2 * (v - 1) / m, 700.0))) - m + 1
            a = math.exp(-1 / (t * RATE))
            states[j] = a * states[j] + (1 - a) * v
        made.append(100 * (v - rest[-1]) / (1 - rest[-1]))
    return made


@pytest.mark.parametrize(
    ("parameters", "drnl"),
    [
        ({}, True),
        ({}, False),
        ({"adpt_lim": 0.0}, False),
        ({"adpt_lim": 1.0, "adpt_mindB": 40.0}, True),
        ({"adpt_lim": 1.4, "adpt_mindB": 99.0}, False),  # all m below 0
        ({"adpt_lim": 1.2}, False),  # of the last loops
        ({"adpt_lim": 1e6, "adpt_mindB": -300.0}, False),
        ({"adpt_lim": 5.0, "adpt_tau": [0.001]}, False),
        ({"adpt_lim": 3.0, "adpt_tau": [3600.0, 1e-3, 0.02, 1e-3, 0.1, 0.5, 2.0, 1e-4, 1e-5]}, False),
    ],
    ids=str,
)
def test_it_is_the_formula(parameters: dict[str, Any], drnl: bool) -> None:
    stage = Adaptation(DRNL if drnl else SOUND, **parameters)
    values = stage.parameters
    x = sound(700) * (1e-2 if drnl else 1)
    got = stage.process(x)
    for ear, channel in np.ndindex(2, 3):
        expected = by_the_book(x[ear, channel], values["adpt_mindB"], values["adpt_tau"], values["adpt_lim"], drnl=drnl)
        np.testing.assert_allclose(got[ear, channel], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_the_constants() -> None:
    stage = Adaptation(SOUND)
    rest = [0.00316228, 0.0562341, 0.237137, 0.486968, 0.697831]
    np.testing.assert_allclose(stage._loops.rest[:, 0], rest, rtol=2e-6)
    np.testing.assert_allclose(stage._loops.limits, [8.9999, 8.968377, 8.437659, 6.628626, 4.130325], rtol=1e-7)
    at = np.array([100.0, 1000.0, 4000.0, 8000.0])
    np.testing.assert_allclose(hearing_threshold(at), [22.953, 3.369, -3.388, 4.786], atol=5e-4)


def test_a_limit_of_one() -> None:
    """lim = 1 / (1 - s**2) makes m 0: the maximum is 1, which is 100."""
    rest = 10 ** (-100 / 40)
    stage = Adaptation(RATE, adpt_tau=[0.05], adpt_lim=1 / (1 - rest**2))
    x = np.geomspace(1e-4, 1e3, 500) * np.ones((2, 2, 1))
    assert stage.process(x).max() == pytest.approx(100.0, rel=1e-12)


def test_silence_is_zero_and_below_it_after_sound() -> None:
    silence = np.zeros((2, 3, 400))
    np.testing.assert_allclose(Adaptation(SOUND).process(silence), 0, atol=1e-11)
    stage = Adaptation(SOUND)
    stage.process(np.full((2, 3, 4000), 0.1))
    after = stage.process(silence)
    assert (after < -100).all()
    assert (np.diff(after) > 0).all()


def test_negative_input_counts_as_the_threshold() -> None:
    np.testing.assert_array_equal(
        Adaptation(SOUND).process(-sound(300)), Adaptation(SOUND).process(np.maximum(-sound(300), 0))
    )


# --- streams ----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("lim", [0.0, 1.2, 10.0])
@pytest.mark.parametrize("tau", [TAU, (3600.0, 1e-3, 1e-3), (5e-324, 1e-300), (1e-3,) * 32])
def test_the_output_is_always_finite(tau: tuple[float, ...], lim: float) -> None:
    """Even if a loop has almost no memory, or if silence follows sound of 1500 dB."""
    rng = np.random.default_rng(0)
    x = 10.0 ** rng.choice([-300.0, -4.0, 0.0, 70.0, 300.0], (2, 3, 600)) * rng.choice([-1, 1, 1], (2, 3, 600))
    x[..., 100:300] = 0
    for given_signal in (SOUND, DRNL):
        stage = Adaptation(given_signal, adpt_tau=tau, adpt_lim=lim)
        for block in cut(x, 150):
            assert np.isfinite(stage.process(block)).all()


# --- parameters -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"adpt_lim": 3.0},
        {"adpt_mindB": 20.0},
        {"adpt_tau": [0.1, 0.2]},
        {"adpt_model": "adt_puschel"},
        {"adpt_lim": 10},
    ],
    ids=str,
)
def test_any_change_resets_the_loops(change: dict[str, Any]) -> None:
    stage = Adaptation(SOUND)
    stage.process(sound(200))
    stage.configure(**change)
    np.testing.assert_array_equal(stage.process(sound(200, 1)), Adaptation(SOUND, **change).process(sound(200, 1)))


def test_models_and_effective_values() -> None:
    assert Adaptation(SOUND).parameters == {
        "adpt_lim": 10.0,
        "adpt_mindB": 0.0,
        "adpt_tau": [0.005, 0.05, 0.129, 0.253, 0.5],
        "adpt_model": "",
    }
    requested = {"adpt_lim": 7.0, "adpt_mindB": 5.0, "adpt_tau": [1.0]}

    def in_force(model: str) -> tuple[Any, ...]:
        values = Adaptation(SOUND, **requested, adpt_model=model).parameters
        return (*map(values.get, requested), values["adpt_model"])

    even = [0.005, 0.12875, 0.2525, 0.37625, 0.5]
    assert list(EVEN_TAU) == pytest.approx(even)
    assert in_force("adt_dau") == (10.0, 0.0, list(TAU), "adt_dau")
    assert in_force("adt_puschel") == (0.0, 0.0, list(EVEN_TAU), "adt_puschel")
    assert in_force("adt_breebaart") == (10.0, 0.0, list(EVEN_TAU), "adt_breebaart")
    assert in_force("adt_breebart") == (10.0, 0.0, list(EVEN_TAU), "adt_breebaart")
    assert in_force("adt_vandorpschuitman") == (0.0, 5.0, list(TAU), "adt_vandorpschuitman")

    stage = Adaptation(SOUND, adpt_model="adt_puschel")
    stage.configure(adpt_lim=3.0)  # overridden
    assert stage.parameters["adpt_lim"] == 0.0
    stage.configure(adpt_model="")
    assert stage.parameters["adpt_tau"] == list(EVEN_TAU)  # unchanged
    stage.configure(adpt_lim=3.0)
    assert stage.parameters["adpt_lim"] == 3.0
    expected = Adaptation(SOUND, **stage.parameters).process(sound(100))
    np.testing.assert_array_equal(stage.process(sound(100)), expected)


def test_the_threshold_of_hearing() -> None:
    signal = replace(SOUND, center_frequencies=(100.0, 4000.0, 20_000.0, 10.0))
    x = sound(300, channels=4)
    got = Adaptation(signal, adpt_model="adt_vandorpschuitman").process(x)
    for channel, threshold in enumerate((22.953, -3.388, 99.0, 99.0)):
        expected = by_the_book(x[1, channel], threshold, list(TAU), 0.0)
        np.testing.assert_allclose(got[1, channel], expected, rtol=0, atol=1e-3 * np.abs(expected).max())


def test_behind_drnl_in_a_chain() -> None:
    """The hair cell stage passes on the type of the filterbank."""
    chain = Chain(RATE, ["ihc", "adaptation"], {"fb_type": "drnl", "fb_cfHz": [500.0, 1000.0], "in_doNormalize": False})
    x = np.random.default_rng(0).standard_normal((2, 900))
    made = chain.run(x, 300, [(2, "fb_type", "gammatone")])
    expected = [
        Adaptation(DRNL).process(made["ihc"][..., :600]),
        Adaptation(SOUND).process(made["ihc"][..., 600:]),
    ]
    np.testing.assert_allclose(made["adaptation"], np.concatenate(expected, axis=-1), rtol=1e-12, atol=1e-9)
    assert np.abs(expected[0]).max() > 1


@pytest.mark.parametrize(
    "changes", [{"adpt_tau": []}, {"adpt_tau": [0.1, 0.0]}, {"adpt_model": "adt_vandorpschuitman"}]
)
def test_invalid_values(changes: dict[str, Any]) -> None:
    """The threshold of hearing needs channels with frequencies."""
    (name,) = changes
    stage, reference_stage = Adaptation(RATE), Adaptation(RATE)
    with pytest.raises(ValueError, match=f"^{name}: "):
        stage.configure(adpt_lim=5, **changes)
    np.testing.assert_array_equal(stage.process(sound(50)), reference_stage.process(sound(50)))
    if name == "adpt_model":
        with pytest.raises(ValueError, match=r"^block: expected 3 channels, got 2"):
            Adaptation(SOUND, **changes).process(sound(10, channels=2))
