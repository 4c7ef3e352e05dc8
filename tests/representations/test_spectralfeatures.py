"""Spectral features: other implementations, known spectra, and the kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import parts_of
from rosafe.representations.spectralfeatures import SpectralFeatures
from tests.dsp.implementations import NUMPY, Choice, using

from .chain import Chain, FloatArray

WORDS = [
    *("centroid", "crest", "spread", "entropy", "brightness", "hfc", "decrease", "flatness", "flux", "kurtosis"),
    *("skewness", "irregularity", "rolloff", "variation"),
]
FREQUENCIES = (300.0, 3000.0, 1000.0, 2000.0)  # the highest is not the last


def signal(frequencies: tuple[float, ...] = FREQUENCIES) -> SignalFormat:
    return SignalFormat(16000.0, 100.0, True, 160, 320, frequencies, "gammatone")


def features(
    spectra: Any, frequencies: tuple[float, ...] = FREQUENCIES, words: Any = "all", **parameters: Any
) -> dict[str, FloatArray]:
    """Return the features (F,) of spectra (C, F) by name."""
    block = np.stack([np.array(spectra, float)] * 2)
    block[1] *= 3.0
    stage = SpectralFeatures(signal(frequencies), sf_requests=words, **parameters)
    made = stage.process(block)
    return dict(zip(stage.parameters["sf_requests"], made[0], strict=True))


def spectra(frames: int, seed: int = 0, channels: int = 4) -> FloatArray:
    return 10 ** np.random.default_rng(seed).uniform(-4, 1, (channels, frames))


def test_against_other_definitions() -> None:
    """Of the features that `rosafe validate` does not compare with others, for energies far above E."""
    x, f = spectra(30), np.array(FREQUENCIES)[:, np.newaxis]
    got = features(x)
    share = x / x.sum(axis=0)
    levels = 10 * np.log10(x)
    expected = {
        "brightness": share[1] + share[3],
        "hfc": (f**2 * share).sum(axis=0),
        "decrease": ((x[1] - x[0]) + (x[2] - x[0]) / 2 + (x[3] - x[0]) / 3) / x[1:].sum(axis=0),
        "flux": np.sqrt(np.mean(np.diff(levels, axis=1, prepend=levels[:, :1]) ** 2, axis=0)),
        "irregularity": np.sqrt(np.mean(np.diff(levels, axis=0) ** 2, axis=0)),
        "variation": [
            scipy.spatial.distance.cosine(x[:, k], x[:, max(0, k - 1)]) if k else 0.0 for k in range(x.shape[1])
        ],
    }
    for word, values in expected.items():
        np.testing.assert_allclose(got[word], values, rtol=1e-9, atol=2e-11, err_msg=word)


def test_one_line() -> None:
    got = features([[0.0], [0.0], [0.5], [0.0]])
    expected = {"centroid": 1 / 3, "crest": 4, "spread": 0, "entropy": 0, "brightness": 0, "hfc": 1e6, "flatness": 0}
    expected |= {"decrease": 0.5, "rolloff": (3000 + 0.8 * (1000 - 3000)) / 3000, "flux": 0, "variation": 0}
    for word, value in expected.items():
        assert got[word].item() == pytest.approx(value, rel=1e-12, abs=1e-10), word


def test_a_flat_spectrum() -> None:
    got = features(np.full((4, 2), 0.2))
    expected = {"centroid": 6300 / 4 / 3000, "crest": 1, "entropy": 1, "brightness": 0.5, "decrease": 0, "flatness": 1}
    expected |= {"flux": 0, "kurtosis": -3, "skewness": 0, "irregularity": 0, "variation": 0}
    for word, value in expected.items():
        np.testing.assert_allclose(got[word], value, rtol=1e-12, atol=1e-12, err_msg=word)


@pytest.mark.filterwarnings("error")
def test_silence() -> None:
    for block in (np.zeros((4, 3)), np.full((4, 3), -1.0)):
        got = features(block)
        assert got.pop("kurtosis").tolist() == [-3, -3, -3]
        assert got.pop("variation").tolist() == [1, 1, 1]
        for word, values in got.items():
            assert values.tolist() == [0, 0, 0], word
            assert not np.signbit(values).any(), word


@pytest.mark.filterwarnings("error")
def test_one_channel() -> None:
    got = features([[0.5, 2.0, 0.0]], (700.0,))
    expected = {"centroid": [1, 1, 0], "crest": [1, 1, 0], "spread": [0, 0, 0], "entropy": [0, 0, 0]}
    expected |= {"brightness": [0, 0, 0], "decrease": [0, 0, 0], "flatness": [1, 1, 0], "kurtosis": [-3, -3, -3]}
    expected |= {"skewness": [0, 0, 0], "irregularity": [0, 0, 0], "rolloff": [1, 1, 0], "variation": [0, 0, 1]}
    for word, values in expected.items():
        np.testing.assert_allclose(got[word], values, rtol=1e-12, atol=1e-12, err_msg=word)


def test_rolloff() -> None:
    x = [[0.5, 0.9, 1, 0], [0.1, 0, 0, 0], [0.2, 0, 0, 0], [0.2, 0.1, 0, 1]]
    got = features(x, (100.0, 200.0, 400.0, 800.0), sf_roPerc=0.7)["rolloff"] * 800
    np.testing.assert_allclose(got, [200 + 0.5 * 200, 100, 100, 400 + 0.7 * 400], rtol=1e-12)
    for part in (1.0, 0.5, 1e-300):
        in_order = np.sort(spectra(50, seed=2), axis=0)
        rolloff = features(in_order, (100.0, 200.0, 400.0, 800.0), sf_roPerc=part)["rolloff"] * 800
        for sums, at in zip(in_order.cumsum(axis=0).T, rolloff, strict=True):
            expected = np.interp(part * sums[-1], sums, [100, 200, 400, 800])
            assert at == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("level", [1e-150, 1e-20, 1e-8, 1.0, 1e20, 1e130])
def test_features_independent_of_the_level(level: float) -> None:
    """Roll-off and variation, down to energies at which E has an effect in the original."""
    words = ["rolloff", "variation"] if level > 1e-10 else ["rolloff"]
    expected, got = features(spectra(20), words=words), features(level * spectra(20), words=words)
    for word in words:
        np.testing.assert_allclose(got[word], expected[word], rtol=1e-5, atol=5e-5)
    assert features(np.full((4, 2), 1e-8))["variation"][1] == pytest.approx(0, abs=1e-6)


def test_the_highest_frequency_need_not_be_the_last() -> None:
    x = spectra(5)
    forward, backward = features(x, (100.0, 200.0, 400.0, 800.0)), features(x[::-1], (800.0, 400.0, 200.0, 100.0))
    for word in ("centroid", "spread", "hfc", "brightness", "entropy", "crest"):
        np.testing.assert_allclose(forward[word], backward[word], rtol=1e-12)


def test_requests_in_order_with_repetitions() -> None:
    x = spectra(6)
    whole = features(x)
    words = ["variation", "flux", "flux", "centroid"]
    stage = SpectralFeatures(signal(), sf_requests=words)
    made = stage.process(np.stack([x, x]))
    assert stage.parameters["sf_requests"] == words
    assert stage.output_rows((2, 4)) == made.shape[:2] == (2, 4)
    np.testing.assert_array_equal(made[1], [whole[word] for word in words])
    assert SpectralFeatures(signal(), sf_requests="hfc").parameters["sf_requests"] == ["hfc"]
    for alias in ("all", ["all"], ["flux", "all", "hfc"], ("all", "all")):
        assert SpectralFeatures(signal(), sf_requests=alias).parameters["sf_requests"] == WORDS


def test_changes_keep_the_last_frame() -> None:
    """Flux and variation use the previous frame, even if they were not requested for it."""
    x = spectra(8)
    whole = SpectralFeatures(signal(), sf_requests=["flux", "variation", "brightness"], sf_brCF=500.0)
    expected = whole.process(np.stack([x, x]))
    stage = SpectralFeatures(signal(), sf_requests="crest")
    stage.process(np.stack([x[:, :5]] * 2))
    stage.configure(sf_requests=["flux", "variation", "brightness"])
    stage.configure(sf_br_cf=500.0, sf_ro_perc=0.1)
    assert stage.parameters["sf_brCF"] == 500.0
    assert stage.parameters["sf_roPerc"] == 0.1
    np.testing.assert_allclose(stage.process(np.stack([x[:, 5:]] * 2)), expected[..., 5:], rtol=1e-12)


def test_brightness_outside_the_range_of_channels() -> None:
    assert not features(spectra(3), sf_brCF=1e6)["brightness"].any()
    assert not features(spectra(3), sf_brCF=3000.0)["brightness"].any()  # above, not at
    np.testing.assert_allclose(features(spectra(3), sf_brCF=1e-9)["brightness"], 1, rtol=1e-8)


def test_fewer_features_after_a_change() -> None:
    chain = Chain(signal(), ["spectralFeatures"], {}, "spectralFeatures")
    assert parts_of(chain.process(np.stack([spectra(3)] * 2))["spectralFeatures"])[0].shape == (2, 14, 3)
    chain.modify("sf_requests", ["hfc"])
    assert parts_of(chain.process(np.stack([spectra(3)] * 2))["spectralFeatures"])[0].shape == (2, 1, 3)
    assert chain.stages["spectralFeatures"].parameters["sf_requests"] == ["hfc"]
    assert chain.stages["spectralFeatures"].output_format == replace(signal(), center_frequencies=())


@pytest.mark.parametrize("channels", [3, 5])
def test_channels_without_known_frequencies(channels: int) -> None:
    with pytest.raises(ValueError, match=r"^block: "):
        SpectralFeatures(signal()).process(np.zeros((2, channels, 3)))
    with pytest.raises(ValueError, match=r"^block: "):
        SpectralFeatures(16000.0).process(np.zeros((2, channels, 3)))


@pytest.mark.parametrize("level", [2, 3, 4, "aarch64"])
@settings(max_examples=40)
@given(st.integers(1, 9), st.integers(0, 12), st.integers(0, 99), st.floats(1e-3, 1.0), st.sampled_from([0, 40, 140]))
def test_the_kernel_equals_the_numpy_implementation(
    level: Choice, channels: int, frames: int, seed: int, part: float, wide: int
) -> None:
    rng = np.random.default_rng(seed)
    given_signal = signal(tuple(rng.uniform(50, 7000, channels).tolist()))
    block = 10 ** rng.uniform(-wide, wide + 1, (2, channels, frames)) * (rng.random((2, channels, frames)) < 0.9)
    made = []
    for implementation in (NUMPY, level):
        stage = SpectralFeatures(given_signal, sf_roPerc=part)
        with using(implementation):
            made.append(np.concatenate([stage.process(block[..., :3]), stage.process(block[..., 3:])], axis=-1))
    scale = np.abs(made[0]).max(axis=(0, 2), initial=1e-3)[:, np.newaxis]
    np.testing.assert_allclose(made[1] / scale, made[0] / scale, rtol=0, atol=1e-11)


@pytest.mark.parametrize("words", [[], None, "", ["flux", "Flux"], ["hfc", 3], 5])
def test_invalid_requests(words: Any) -> None:
    with pytest.raises(ValueError, match=r"^sf_requests: "):
        SpectralFeatures(signal(), sf_requests=words)
