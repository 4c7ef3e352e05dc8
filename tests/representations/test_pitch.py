"""Pitch: a direct implementation frame by frame, memory and look-ahead, and a glide."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations import pitch
from rosafe.representations.pitch import Pitch

from .chain import Chain, FloatArray, cut

FS = 1000.0
# 10 frames per second: 5 s are 50 frames; lags from 0 to 30 ms
GIVEN = SignalFormat(FS, 10.0, True, 100, 31, (200.0, 300.0), "gammatone", lags=30)
WIDE: dict[str, Any] = {"pi_rangeHz": [40.0, 400.0]}  # lags 3 to 25


def correlations(frames: int, seed: int = 0, channels: int = 2, lags: int = 31) -> FloatArray:
    """Return numbers with few different values, for plateaus and ties; some frames are silent, some negative."""
    rng = np.random.default_rng(seed)
    made = rng.integers(-3, 6, (2, channels, lags, frames)) / 8
    made[..., rng.random(frames) < 0.1] = 0.0
    made[..., rng.random(frames) < 0.1] -= 2.0
    return made


def peaks_at(lags: list[int], heights: list[float]) -> FloatArray:
    """Return frames of both ears whose only peak is at these lags; none if the height is 0."""
    made = np.zeros((2, 2, 31, len(lags)))
    for frame, (lag, height) in enumerate(zip(lags, heights, strict=True)):
        made[:, :, lag, frame] = height
    return made


def by_the_book(
    frames: FloatArray, limits: list[float], threshold: float, order: int, rate: float = 10.0, ratio: float = 1.0
) -> tuple[list[float], list[float], list[float]]:
    """Compute pitch, rawPitch and confidence of one ear (C, L, F), without pending frames."""
    raw: list[float] = []
    confidence: list[float] = []
    chosen: list[float] = []
    reach = max(1, math.floor(5 * rate + 0.5))
    for frame in np.moveaxis(frames, -1, 0):
        summary = [math.fsum(values) / len(values) for values in frame.T]
        lags = [lag for lag in range(len(summary)) if 1 / max(limits) <= lag / FS <= 1 / min(limits)]
        curve = np.array([summary[lag] for lag in lags])
        peaks = [(float(curve[at]), -int(at)) for at in scipy.signal.find_peaks(curve)[0] if curve[at] > 0]
        height, place = max(peaks, default=(0.0, 0))
        lag = lags[-place]
        halves = [
            peak
            for peak in peaks
            if ratio < 1 and peak[0] >= ratio * height and abs(2 * lags[-peak[1]] - lag) <= max(1, 0.03 * lag)
        ]
        height, place = max(halves, default=(height, place))
        raw.append(FS / lags[-place] if peaks else 0.0)
        confidence.append(height)
        chosen.append(raw[-1] if height >= threshold * max(confidence[-reach:]) else 0.0)
    known = len(raw) - (math.ceil(order / 2) - 1)
    padded = [0.0] * order + chosen
    medians = [
        statistics.median(padded[order + k - order // 2 : order + k + math.ceil(order / 2)]) for k in range(known)
    ]
    pitch = [value if value > 0 else math.nan for value in medians]
    return pitch, raw[: max(0, known)], confidence[: max(0, known)]


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize(
    ("order", "threshold"), [(1, 0.0), (2, 0.5), (3, 0.7), (4, 1.0), (7, 0.5), (8, 0.0), (99, 0.7)]
)
def test_the_result_follows_the_formula(threshold: float, order: int, channels: int) -> None:
    x = correlations(170, order, channels)
    parameters = {**WIDE, "pi_confThres": threshold, "pi_medianOrder": order}
    got = Pitch(GIVEN, **parameters).process(x)
    for ear in range(2):
        expected = by_the_book(x[ear], [40.0, 400.0], threshold, order)
        np.testing.assert_allclose(got[ear], expected, rtol=1e-14, atol=1e-15)
    if channels == 1:
        assert (got[:, 1] == 0).any() and (got[:, 1] > 0).any()


@pytest.mark.parametrize("ratio", [0.2, 0.6, 0.9, 1.0])
def test_a_peak_at_half_the_lag(ratio: float) -> None:
    """It counts if it is high enough; with blocks of any length."""
    x = correlations(170, 5)
    stage = Pitch(GIVEN, **WIDE, pi_peakRatio=ratio)
    got = np.concatenate([stage.process(block) for block in cut(x, [1, 3, 0, 40])], axis=-1)
    for ear in range(2):
        expected = by_the_book(x[ear], [40.0, 400.0], 0.7, 3, ratio=ratio)
        np.testing.assert_allclose(got[ear], expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(
    ("lags", "ratio", "expected"),
    [
        ([8, 16], 0.9, 8),
        ([8, 16], 0.91, 16),
        ([8, 16], 1.0, 16),
        ([8, 17], 0.9, 8),  # one sample of rounding
        ([9, 16], 0.9, 16),  # not an octave
        ([5, 16], 0.5, 16),
        ([10, 16], 0.5, 16),
        ([6, 24], 0.5, 24),
    ],
)
def test_only_an_octave_is_corrected(lags: list[int], ratio: float, expected: int) -> None:
    x = np.zeros((2, 2, 31, 1))
    x[:, :, lags[0]], x[:, :, lags[1]] = 0.9, 1.0
    got = Pitch(GIVEN, **WIDE, pi_medianOrder=1, pi_peakRatio=ratio).process(x)[:, 1:, 0]
    np.testing.assert_allclose(got, [[FS / expected, 0.9 if expected == lags[0] else 1.0]] * 2, rtol=1e-15)


@pytest.mark.parametrize(
    ("curve", "lag", "height"),
    [
        ([0, 0, 1, 0, 0, 0], 2, 1),
        ([0, 0, 1, 1, 0, 0], 2, 1),  # a plateau: its middle, rounded down
        ([0, 1, 1, 1, 0, 0], 2, 1),
        ([0, 1, 1, 1, 1, 0], 2, 1),
        ([0, 1, 0, 2, 0, 2], 3, 2),  # the last value is the end of the range
        ([3, 1, 2, 1, 0, 4], 2, 2),  # the first value is not a peak
        ([0, 1, 0, 1, 0, 0], 1, 1),  # the first of equals
        ([0, 1, 1, 2, 2, 0], 3, 2),  # a step in a rise is not a peak
        ([2, 2, 1, 1, 1, 2], 0, 0),
        ([0, 1, 2, 3, 3, 3], 0, 0),  # a plateau at the end
        ([0, 0, 0, 0, 0, 0], 0, 0),
        ([-9, -3, -9, -9, -9, -9], 0, 0),  # below 0
        ([-9, 0, -9, -9, -9, -9], 0, 0),
        ([-9, 0.5, -9, 0, -9, -9], 1, 0.5),
    ],
)
def test_peaks(curve: list[float], lag: int, height: float) -> None:
    """The range ends at lags 10 and 15, with more on both sides."""
    x = np.full((2, 1, 31, 1), 7.0)
    x[:, 0, 10:16, 0] = curve
    got = Pitch(GIVEN, pi_rangeHz=[FS / 15.5, FS / 9.5], pi_medianOrder=1, pi_confThres=0).process(x)
    assert got[0, 1:, 0].tolist() == [FS / (10 + lag) if height else 0.0, height]
    assert got[1, 0, 0] == got[0, 1, 0] or (math.isnan(got[1, 0, 0]) and not height)


@pytest.mark.parametrize("limits", [[80.0, 400.0], [100.0, 300.0], [0.1, 7.0], [49.0, 1e9], [90.0, 110.0]])
@pytest.mark.parametrize("rate", [8000.0, 16000.0, 44100.0, 48000.0, 11025.0])
def test_the_range(rate: float, limits: list[float]) -> None:
    """Both ends are included, by the quotients; the lowest pitch comes first."""
    format_ = SignalFormat(rate, 100.0, True, round(rate / 100), 2, (), "", lags=round(rate / 50))
    lags = [lag for lag in range(format_.lags + 1) if 1 / limits[1] <= lag / rate <= 1 / limits[0]]
    if len(lags) < 3:
        with pytest.raises(ValueError, match=r"^pi_rangeHz: .* lags"):
            Pitch(format_, pi_rangeHz=limits)
        return
    with pytest.raises(ValueError, match=r"^pi_rangeHz: expected ascending numbers, got "):
        Pitch(format_, pi_rangeHz=limits[::-1])
    for given_limits in (limits,):
        stage = Pitch(format_, pi_rangeHz=given_limits, pi_medianOrder=1)
        assert stage._range == slice(lags[0], lags[-1] + 1)
        x = np.zeros((2, 1, format_.lags + 1, 3))
        for frame, lag in enumerate((lags[0], lags[1], lags[-2])):
            x[:, 0, lag, frame] = 1.0
        np.testing.assert_allclose(stage.process(x)[0, 1], [0.0, rate / lags[1], rate / lags[-2]], rtol=1e-15)


@pytest.mark.parametrize(("rate", "reach"), [(10.0, 50), (1.3, 7), (0.01, 1), (0.3, 2), (0.29, 1)])
def test_five_seconds_of_confidences(rate: float, reach: int) -> None:
    """A clear frame suppresses less clear ones for 5 s, and none before it."""
    lags = [9] * (2 * reach + 5)
    heights = [0.5] * len(lags)
    heights[2] = 1.0
    x = peaks_at(lags, heights)
    for sizes in ([len(lags)], [1], [3, 0, 7]):
        stage = Pitch(replace(GIVEN, rate=rate), **WIDE, pi_medianOrder=1)
        got = np.concatenate([stage.process(block) for block in cut(x, sizes)], axis=-1)
        silenced = np.isnan(got[1, 0])
        assert silenced.tolist() == [3 <= k < 2 + reach for k in range(len(lags))]
        np.testing.assert_allclose(got[1, 1], FS / 9)
        np.testing.assert_allclose(got[1, 2], heights)


# --- streams ----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_silence_has_no_pitch() -> None:
    got = Pitch(GIVEN, **WIDE).process(np.zeros((2, 4, 31, 20)))
    assert np.isnan(got[:, 0]).all()
    assert not got[:, 1:].any()
    chain = Chain(8000.0, ["pitch"], {"fb_cfHz": [300.0, 900.0]})
    for samples in (0, 1, 100, 1000, 900):
        made = chain.process(np.zeros((2, samples)))["pitch"]
        assert isinstance(made, np.ndarray)
        assert np.isnan(made[:, 0]).all()
        assert not made[:, 1:].any()


# --- parameters -------------------------------------------------------------------------------------------------


def test_the_defaults_and_the_documentations_names() -> None:
    stage = Pitch(SignalFormat(16000.0, 100.0, True, 160, 320, (), "", lags=318))
    assert stage.parameters == {
        "pi_rangeHz": [80.0, 400.0],
        "pi_confThres": 0.7,
        "pi_medianOrder": 3,
        "pi_peakRatio": 1.0,
    }
    stage.configure(p_pitchRangeHz=[100, 300], p_confThresPerc=0, p_orderMedFilt=5)
    assert stage.parameters == {
        "pi_rangeHz": [100.0, 300.0],
        "pi_confThres": 0.0,
        "pi_medianOrder": 5,
        "pi_peakRatio": 1.0,
    }


@pytest.mark.parametrize("orders", [(3, 9), (9, 3), (1, 99), (99, 1), (4, 5), (5, 4), (2, 1)])
def test_another_order_of_the_median(orders: tuple[int, int]) -> None:
    """The next output frame follows the previous one; each is computed as if its order had always been set."""
    x = correlations(150)
    stage = Pitch(GIVEN, **WIDE, pi_medianOrder=orders[0])
    made = [stage.process(x[..., :70])]
    stage.configure(pi_medianOrder=orders[1])
    made += [stage.process(block) for block in cut(x[..., 70:], [0, 1, 5, 30])]
    wholes = [Pitch(GIVEN, **WIDE, pi_medianOrder=order).process(x) for order in orders]
    count = 70 - (math.ceil(orders[0] / 2) - 1)
    assert made[0].shape[-1] == max(0, count)
    expected = np.concatenate((wholes[0][..., : max(0, count)], wholes[1][..., max(0, count) :]), axis=-1)
    np.testing.assert_array_equal(np.concatenate(made, axis=-1), expected)


def test_thresholds_and_ranges_apply_to_later_frames() -> None:
    """Pending frames do not change; past confidences are kept."""
    x = peaks_at([9, 9, 20, 20, 20, 20], [1.0, 0.5, 0.5, 0.5, 0.9, 0.6])
    stage = Pitch(GIVEN, **WIDE, pi_medianOrder=1, pi_confThres=0.8)
    made = [stage.process(x[..., :3])]
    stage.configure(pi_confThres=0.6)
    made.append(stage.process(x[..., 3:4]))
    stage.configure(pi_rangeHz=[40.0, 60.0])
    made.append(stage.process(x[..., 4:]))
    got = np.concatenate(made, axis=-1)[0]
    np.testing.assert_allclose(got[0], [FS / 9, math.nan, math.nan, math.nan, FS / 20, FS / 20])
    np.testing.assert_allclose(got[1], [FS / 9, FS / 9, *[FS / 20] * 4])

    stage = Pitch(GIVEN, **WIDE, pi_medianOrder=5, pi_confThres=0.4)
    made = [stage.process(x)]
    stage.configure(pi_confThres=1.0, pi_rangeHz=[100.0, 400.0])
    made.append(stage.process(peaks_at([6, 6], [0.1, 0.1])))
    got = np.concatenate(made, axis=-1)[0]
    np.testing.assert_allclose(got[1], [FS / 9, FS / 9, *[FS / 20] * 4])
    np.testing.assert_allclose(got[0], [FS / 20, FS / 20, FS / 20, FS / 20, FS / 20, FS / 20])


def test_another_step_of_the_parent() -> None:
    """5 s are another number of frames; past frames are kept."""
    stage = Pitch(GIVEN, **WIDE, pi_medianOrder=1)
    assert not np.isnan(stage.process(peaks_at([9] * 20, [0.9] * 19 + [1.0]))[0, 0]).any()
    stage.set_input_format(replace(GIVEN, rate=4.0, hop=250))  # 20 frames
    assert stage.output_format.rate == 4.0
    assert np.isnan(stage.process(peaks_at([9] * 19, [0.65] * 19))[0, 0]).all()
    stage.set_input_format(replace(GIVEN, rate=1.0, hop=1000))  # 5 frames
    assert not np.isnan(stage.process(peaks_at([9], [0.5]))[0, 0]).any()


def test_another_window_of_the_parent() -> None:
    stage = Pitch(GIVEN, pi_rangeHz=[20.0, 400.0])
    stage.process(correlations(10))
    stage.set_input_format(replace(GIVEN, lags=12))
    assert stage._range == slice(3, 13)
    assert stage.process(correlations(10, lags=13)).shape == (2, 3, 10)  # with the pending frame
    with pytest.raises(ValueError, match=r"^pi_rangeHz: .* got 2 from"):
        stage.set_input_format(replace(GIVEN, lags=4))
    assert stage.input_format.lags == 12
    assert stage.process(correlations(10, lags=13)).shape == (2, 3, 10)
    with pytest.raises(ValueError, match=r"^block: expected 13 lags, got 31"):
        stage.process(correlations(10))


@pytest.mark.parametrize(
    "limits",
    [[], [80.0], 80.0, [80.0, 100.0, 400.0], [0.0, 400.0], [100.0, 100.0], [1e-9, 2e-9]],
    ids=str,
)
def test_invalid_ranges(limits: Any) -> None:
    with pytest.raises(ValueError, match=r"^pi_rangeHz: "):
        Pitch(GIVEN, pi_rangeHz=limits)
    stage, reference_stage = Pitch(GIVEN, **WIDE), Pitch(GIVEN, **WIDE)
    with pytest.raises(ValueError, match=r"^pi_rangeHz: "):
        stage.configure(pi_confThres=0.1, pi_rangeHz=limits)
    np.testing.assert_array_equal(stage.process(correlations(20)), reference_stage.process(correlations(20)))


# --- sound ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [2, 3, 5, 1000])
def test_the_fast_path_finds_the_same_peaks(steps: int) -> None:
    """Values with few levels have plateaus, those with many have none."""
    rng = np.random.default_rng(steps)
    for size in (3, 4, 17, 100):
        curves = rng.integers(-1, steps, (2, 5, size)) / 10
        curves[:, 0] = 0.0
        for some in (curves, curves[:, 1:], curves[:1, 1:2]):
            got, simple = pitch._peaks(some), pitch._peaks_and_plateaus(some)
            np.testing.assert_array_equal(got[0], simple[0])
            found = simple[0] > -np.inf
            np.testing.assert_array_equal(got[1][found], simple[1][found])
