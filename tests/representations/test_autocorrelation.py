"""Autocorrelation: sums and Fourier transforms as matrices, and signals with known results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.windows import ALL_NAMES, window
from rosafe.representations.autocorrelation import Autocorrelation

from .chain import FloatArray

RATE = 8000.0
SOUND = SignalFormat(RATE, RATE, center_frequencies=(100.0, 1000.0, 3000.0), filterbank="gammatone")


def framed(size: int, hop: int, **more: Any) -> dict[str, Any]:
    return {"ac_wSizeSec": size / RATE, "ac_hSizeSec": hop / RATE, **more}


def sound(samples: int, seed: int = 0, channels: int = 3) -> FloatArray:
    """Return periodic noise, half-wave rectified in the left ear, with some silence."""
    rng = np.random.default_rng(seed)
    x = 0.3 * rng.standard_normal((2, channels, samples)) + np.sin(2 * np.pi * np.arange(samples) / 17)
    x[0] = np.maximum(x[0], 0)
    x[..., 150:300] = 0
    return x


def clipped_by_the_book(x: list[float], method: str, alpha: float) -> list[float]:
    above, below = alpha * abs(max(x)), alpha * abs(min(x))
    y = []
    for value in x:
        kept = 0.0
        if value >= above:
            kept = {"clp": value, "clc": value - above, "sgn": float(value > 0)}[method]
        if value <= -below:
            kept = {"clp": value, "clc": value + below, "sgn": -float(value < 0)}[method]
        y.append(kept)
    return y


def by_the_book(frame: FloatArray, method: str, alpha: float, exponent: float) -> FloatArray:
    """Compute the result for a windowed frame (w,) by sums of products, or by Fourier transforms as matrices."""
    size = len(frame)
    y = np.array(clipped_by_the_book(frame.tolist(), method, alpha))
    if exponent == 2:
        r = np.array([np.dot(y[: size - lag], y[lag:]) for lag in range(size - 1)])
    else:
        points = 2
        while points < 2 * size - 1:
            points *= 2
        turns = np.exp(-2j * np.pi * (np.outer(np.arange(points), np.arange(points)) % points) / points)
        spectrum = np.abs(turns[:, :size] @ y) ** exponent
        r = (turns.conj() @ spectrum).real[: size - 1] / points
    if r[0] == 0:
        return np.zeros(size - 1)
    return r / r[0] * size / (size - np.arange(size - 1))


@pytest.mark.parametrize(
    ("method", "alpha", "exponent"),
    [  # all pairs of two values
        *(("clp", 0.0, 2.0), ("clc", 0.0, 2 / 3), ("sgn", 0.0, 1.0), ("clp", 0.0, 7.0)),
        *(("clc", 0.3, 2.0), ("sgn", 0.3, 2 / 3), ("clp", 0.3, 1.0), ("clc", 0.3, 7.0)),
        *(("sgn", 0.6, 2.0), ("clp", 0.6, 2 / 3), ("clc", 0.6, 1.0), ("sgn", 0.6, 7.0)),
        *(("clp", 1.0, 2.0), ("clc", 1.0, 2 / 3), ("sgn", 1.0, 1.0), ("clp", 1.0, 7.0)),
    ],
)
def test_it_is_the_formula(method: str, alpha: float, exponent: float) -> None:
    x = sound(400)
    stage = Autocorrelation(
        SOUND, **framed(50, 31, ac_clipMethod=method, ac_clipAlpha=alpha, ac_K=exponent, ac_wname="hamming")
    )
    got = stage.process(x)
    assert got.shape == (2, 3, 49, 12)
    for ear, channel, frame in np.ndindex(2, 3, 12):
        windowed = window("hamming", 50) * x[ear, channel, 31 * frame : 31 * frame + 50]
        expected = by_the_book(windowed, method, alpha, exponent)
        # signs have spectra with zeros, whose rounding errors are large after an exponent below 1
        tolerance = 1e-9 if method == "sgn" and exponent < 1 else 1e-12
        np.testing.assert_allclose(got[ear, channel, :, frame], expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("size", [2, 4, 6, 16, 32, 34, 64, 66, 130])
def test_sizes_and_windows(size: int) -> None:
    """All lags up to the last, with any length of the transform."""
    x = np.random.default_rng(size).standard_normal((2, 1, size + 3))
    for name in ALL_NAMES:
        stage = Autocorrelation(RATE, **framed(size, 3, ac_wname=name, ac_clipAlpha=0.2))
        got = stage.process(x)
        assert got.shape == (2, 1, size - 1, 2)
        for ear, frame in np.ndindex(2, 2):
            expected = by_the_book(window(name, size) * x[ear, 0, 3 * frame : 3 * frame + size], "clp", 0.2, 2.0)
            np.testing.assert_allclose(got[ear, 0, :, frame], expected, rtol=0, atol=1e-12 * size, err_msg=name)


def test_the_means_are_not_biased() -> None:
    """The correlation of a constant is equal at all lags, that of pulses at all multiples of their period."""
    plain: dict[str, Any] = {"ac_wname": "rectwin", "ac_clipAlpha": 0.0}
    constant = Autocorrelation(RATE, **framed(100, 50, **plain)).process(np.full((2, 2, 350), 0.3))
    assert constant.shape == (2, 2, 99, 6)
    np.testing.assert_allclose(constant, 1.0, rtol=1e-12)
    pulses = np.zeros((2, 1, 400))
    pulses[..., ::10] = 1.0
    got = Autocorrelation(RATE, **framed(100, 50, **plain)).process(pulses)
    expected = np.where(np.arange(99) % 10 == 0, 1.0, 0.0)
    np.testing.assert_allclose(got[1, 0], np.repeat(expected[:, np.newaxis], 7, axis=1), rtol=0, atol=1e-12)


def test_the_level_makes_no_difference() -> None:
    """From the quietest level to far above sound, with any exponent."""
    for method in ("clp", "clc", "sgn"):
        for exponent in (2.0, 10.0, 0.1):
            parameters = framed(100, 50, ac_clipMethod=method, ac_K=exponent)
            expected = Autocorrelation(RATE, **parameters).process(sound(1000))
            for scale in (1e-150, 2.0**-40, 1e60):
                got = Autocorrelation(RATE, **parameters).process(sound(1000) * scale)
                np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)


def test_the_sign_of_zeros() -> None:
    """Zeros of a half-wave rectified frame are neither above nor below."""
    x = np.zeros((2, 1, 40))
    x[..., ::8] = 1.0
    got = Autocorrelation(RATE, **framed(40, 40, ac_clipMethod="sgn", ac_wname="rectwin")).process(x)[0, 0, :, 0]
    np.testing.assert_allclose(got, np.where(np.arange(39) % 8 == 0, 1.0, 0.0), rtol=0, atol=1e-12)


# --- streams ----------------------------------------------------------------------------------------------------


def test_the_format_of_the_output() -> None:
    stage = Autocorrelation(SOUND, **framed(160, 70))
    output = stage.output_format
    assert (output.framed, output.hop, output.window, output.lags) == (True, 70, 160, 158)
    assert output.rate == RATE / 70
    assert stage.derived["ac_lags"] == [lag / RATE for lag in range(159)]
    stage.configure(ac_wSizeSec=100 / RATE)
    assert (stage.output_format.lags, stage.output_rows((2, 3)), len(stage.derived["ac_lags"])) == (98, (2, 3, 99), 99)


# --- parameters -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"ac_wname": "blackman"},
        {"ac_wSizeSec": 50 / RATE},
        {"ac_wSizeSec": 200 / RATE},
        {"ac_hSizeSec": 20 / RATE},
        {"ac_clipMethod": "sgn"},
        {"ac_clipAlpha": 0.0},
        {"ac_K": 0.7},
    ],
    ids=str,
)
def test_a_change_keeps_the_buffer(change: dict[str, Any]) -> None:
    """The start of the next frame does not change; the new parameters apply to the whole frame."""
    x = sound(900)
    before, after = framed(100, 40), {**framed(100, 40), **change}
    stage = Autocorrelation(SOUND, **before)
    assert stage.process(x[..., :430]).shape[-1] == 9  # frames at 0 ... 320; the next one at 360
    stage.configure(**change)
    np.testing.assert_allclose(
        stage.process(x[..., 430:]), Autocorrelation(SOUND, **after).process(x[..., 360:]), rtol=0, atol=1e-12
    )
