"""Amplitude modulation spectrograms: the reference vector, filters of scipy, Fourier transforms as sums, sines."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.windows import window
from rosafe.representations.amsfeatures import AmsFeatures

from .chain import FloatArray, cut

RATE = 16000.0
SOUND = SignalFormat(RATE, RATE, center_frequencies=(100.0, 1000.0, 3000.0), filterbank="gammatone")
GOLDEN = (1 + math.sqrt(5)) / 2


def framed(size: int, hop: int, ratio: int = 4, **more: Any) -> dict[str, Any]:
    """Return parameters for windows and hops in decimated samples."""
    rate = RATE / ratio
    return {"ams_wSizeSec": size / rate, "ams_hSizeSec": hop / rate, "ams_dsRatio": ratio, **more}


def sound(samples: int, seed: int = 0, channels: int = 3) -> FloatArray:
    """Return half-wave rectified noise with a varying level."""
    x = np.maximum(np.random.default_rng(seed).standard_normal((2, channels, samples)), 0)
    return x * (1.1 + np.sin(np.arange(samples) / 150)) * [[[1.0]], [[0.3]]]


def by_scipy(x: FloatArray, centres: list[float], ratio: int, size: int, hop: int, name: str) -> FloatArray:
    """Compute the log form of (..., N), each filter separately."""
    rate, taken, made = RATE / ratio, x[..., ::ratio], []
    for index, centre in enumerate(centres):
        if index == 0:
            b, a = scipy.signal.butter(1, centre, fs=rate)
        else:
            edges = [centre * (math.sqrt(1.25) - 0.5), centre * (math.sqrt(1.25) + 0.5)]
            b, a = scipy.signal.butter(1, edges, "bandpass", fs=rate)
        y = scipy.signal.lfilter(b, a, taken)
        starts = range(0, y.shape[-1] - size + 1, hop)
        made.append([np.abs(window(name, size) * y[..., k : k + size]).mean(axis=-1) for k in starts])
    return np.moveaxis(np.array(made), (0, 1), (-2, -1))


# --- log ----------------------------------------------------------------------------------------------------------


def test_the_default_centres() -> None:
    centres = AmsFeatures(44100.0).parameters["ams_cfHz"]
    assert len(centres) == 15
    known = [4, 5.9440, 8.8327, 13.1254, 19.5042, 28.9832, 43.0688, 64]
    np.testing.assert_allclose(centres[:8], known, atol=5e-5)
    np.testing.assert_allclose(np.diff(np.log2(centres)), 8 / 14, rtol=1e-12)
    assert centres[-1] == pytest.approx(1024, rel=1e-12)


@pytest.mark.parametrize(
    ("values", "centres"),
    [
        ({"ams_nFilters": 1}, [4.0]),
        ({"ams_nFilters": 2}, [4.0, 1024.0]),
        ({"ams_nFilters": 0}, [4.0 * 2**i for i in range(9)]),
        ({"ams_nFilters": 0, "ams_highFreqHz": 1023.9}, [4.0 * 2**i for i in range(8)]),
        ({"ams_nFilters": 0, "ams_lowFreqHz": 0.1, "ams_highFreqHz": 0.1 * 2**5}, [0.1 * 2**i for i in range(6)]),
        ({"ams_nFilters": 0, "ams_lowFreqHz": 3.0, "ams_highFreqHz": 3.1}, [3.0]),
        ({"ams_cfHz": [100.0]}, [100.0]),
        ({"ams_cfHz": [80.0, 3.0, 500.0], "ams_nFilters": 7}, [80.0, 3.0, 500.0]),
    ],
    ids=str,
)
def test_centres(values: dict[str, Any], centres: list[float]) -> None:
    stage = AmsFeatures(RATE, **values)
    np.testing.assert_allclose(stage.parameters["ams_cfHz"], centres, rtol=1e-14)
    assert stage.output_rows((2, 31)) == (2, 31, len(centres))
    assert AmsFeatures.effective_values({**AmsFeatures(RATE).parameters, "ams_cfHz": [], **values}) == stage.parameters


@pytest.mark.parametrize(
    ("size", "hop", "ratio", "name"), [(64, 32, 4, "hann"), (50, 71, 1, "rectwin"), (130, 11, 7, "triang")]
)
def test_log_equals_filters_of_scipy(size: int, hop: int, ratio: int, name: str) -> None:
    centres = [40.0, 4.0, 30.0, 200.0, 3.0] + [25.0 * 1.2**i for i in range(14)]  # the first is always a low-pass
    x = sound(3001)
    stage = AmsFeatures(SOUND, ams_cfHz=centres, **framed(size, hop, ratio), ams_wname=name)
    got, expected = stage.process(x), by_scipy(x, centres, ratio, size, hop, name)
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * expected.max())


# --- lin ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "hop", "ratio", "low", "high", "count"),
    [(64, 32, 4, 0.0, 1000.0, 15), (50, 71, 1, 30.0, 900.0, 1), (66, 5, 7, 100.0, 120.0, 4)],
)
def test_lin_is_the_formula(size: int, hop: int, ratio: int, low: float, high: float, count: int) -> None:
    x, rate = sound(700, channels=2), RATE / ratio
    values = {"ams_fbType": "lin", "ams_lowFreqHz": low, "ams_highFreqHz": high, "ams_nFilters": count}
    stage = AmsFeatures(RATE, **values, **framed(size, hop, ratio), ams_wname="hamming")
    got = stage.process(x)
    width = (high - low) / (count + 1)
    centres = [low + i * width for i in range(1, count + 1)]
    np.testing.assert_allclose(stage.parameters["ams_cfHz"], centres, rtol=1e-14)
    points = 2 ** math.ceil(math.log2(2 * size))
    bins = np.arange(points // 2 + 1)
    turns = np.exp(-2j * np.pi * np.outer(bins, np.arange(size)) / points)
    taken = x[..., ::ratio]
    frames = range(0, taken.shape[-1] - size + 1, hop)
    assert got.shape == (2, 2, count, len(frames))
    for ear, channel, index in np.ndindex(2, 2, len(frames)):
        frame = window("hamming", size) * taken[ear, channel, frames[index] : frames[index] + size]
        magnitudes = np.abs(turns @ frame) / points
        expected = [sum(np.maximum(0, 1 - np.abs(bins * rate / points - c) / width) * magnitudes) for c in centres]
        np.testing.assert_allclose(got[ear, channel, :, index], expected, rtol=0, atol=1e-13)


# --- frames -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "step", "ratio", "size", "hop"),
    [
        (0.032, 0.016, 4, 128, 64),
        (0.0331, 0.016, 4, 132, 64),  # 132.4 samples
        (0.0328, 0.016, 4, 132, 64),  # 131.2 samples: rounded to an even number
        (0.0327, 0.016, 4, 130, 64),  # of 130, not of 130.8 samples: 63.6
        (0.0003, 0.001, 4, 2, 7),  # of 2 samples, not of 1.2: 6.67, although 0.001 s are 4
        (0.01, 1e-6, 4, 40, 1),  # at least 1
        (0.001, 0.3, 1, 16, 4800),
    ],
)
@pytest.mark.parametrize("fb_type", ["log", "lin"])
def test_the_step_follows_from_the_window(
    seconds: float, step: float, ratio: int, size: int, hop: int, fb_type: str
) -> None:
    stage = AmsFeatures(RATE, ams_wSizeSec=seconds, ams_hSizeSec=step, ams_dsRatio=ratio, ams_fbType=fb_type)
    assert (len(stage.window), stage.output_format.hop) == (size, hop * ratio)
    assert stage.output_format.rate == RATE / ratio / hop
    assert stage.output_format.framed and stage.output_format.window == size * ratio
    samples = (size + 2 * hop - 1) * ratio + 1  # the last sample of frame 2
    assert stage.output_count(samples) == 3 and stage.output_count(samples - 1) == 2
    assert stage.process(sound(samples - 1)).shape[-1] == 2
    assert stage.process(sound(1)).shape[-1] == 1


def test_blocks_longer_than_spans() -> None:
    x = sound(40_000, channels=1)
    whole = AmsFeatures(RATE).process(x)
    stage = AmsFeatures(RATE)
    pieces = np.concatenate([stage.process(block) for block in cut(x, 882)], axis=-1)
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-12)


# --- parameters ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fb_type", ["log", "lin"])
@pytest.mark.parametrize(
    "change",
    [
        {"ams_wname": "blackman"},
        {"ams_wSizeSec": 0.02},
        {"ams_wSizeSec": 0.05},
        {"ams_hSizeSec": 0.003},
        {"ams_hSizeSec": 0.1, "ams_wSizeSec": 0.04, "ams_wname": "hann"},
    ],
    ids=str,
)
def test_a_change_of_frames_keeps_filters_and_buffer(fb_type: str, change: dict[str, Any]) -> None:
    """The start of the next frame does not change; filters and decimation keep their state."""
    x = sound(9001)
    before: dict[str, Any] = {**framed(128, 48), "ams_fbType": fb_type}
    stage = AmsFeatures(SOUND, **before)
    count = stage.process(x[..., :3333]).shape[-1]
    assert count == (834 - 128) // 48 + 1
    stage.configure(**change)
    got = np.concatenate([stage.process(block) for block in cut(x[..., 3333:], 777)], axis=-1)
    # filtered samples from there on, all visible with a step of 1
    fine = AmsFeatures(SOUND, **{**before, **change, "ams_hSizeSec": 1e-9}).process(x)
    expected = fine[..., count * 48 :: stage.output_format.hop // 4]
    np.testing.assert_allclose(got, expected[..., : got.shape[-1]], rtol=0, atol=1e-12)
    assert got.shape[-1] == expected.shape[-1] > 1


@pytest.mark.parametrize(
    "change",
    [
        {"ams_fbType": "lin"},
        {"ams_nFilters": 15},  # a parameter that is set counts as changed
        {"ams_lowFreqHz": 5.0},
        {"ams_highFreqHz": 900.0},
        {"ams_cfHz": [10.0, 20.0]},
        {"ams_dsRatio": 4},
        {"ams_dsRatio": 3},
        {"ams_dsRatio": 3, "ams_wname": "hann"},
    ],
    ids=str,
)
def test_any_other_change_resets_the_state(change: dict[str, Any]) -> None:
    x = sound(4000)
    stage = AmsFeatures(SOUND)
    stage.process(x[..., :2001])  # the next sample would be skipped
    stage.configure(**change)
    np.testing.assert_array_equal(stage.process(x[..., 2001:]), AmsFeatures(SOUND, **change).process(x[..., 2001:]))


def test_a_list_is_replaced_only_by_another_list() -> None:
    stage = AmsFeatures(RATE, ams_cfHz=[10.0, 20.0])
    stage.configure(ams_nFilters=4)
    assert stage.parameters["ams_cfHz"] == [10.0, 20.0]
    with pytest.raises(ValueError, match=r"^ams_cfHz: "):
        stage.configure(ams_fbType="lin")
    stage.configure(ams_cfHz=[])
    assert len(stage.parameters["ams_cfHz"]) == 4
    stage.configure(ams_fbType="lin")
    assert len(stage.parameters["ams_cfHz"]) == 4


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("ams_nFilters", {"ams_nFilters": 0, "ams_fbType": "lin"}),
        ("ams_lowFreqHz", {"ams_lowFreqHz": 0}),
        ("ams_lowFreqHz", {"ams_lowFreqHz": 0, "ams_nFilters": 0}),
        *(("ams_highFreqHz", {"ams_highFreqHz": value}) for value in (4, 3, 2000 / GOLDEN + 1e-6)),  # half of the rate
        ("ams_highFreqHz", {"ams_highFreqHz": 1300, "ams_nFilters": 0, "ams_lowFreqHz": 1250}),
        ("ams_highFreqHz", {"ams_highFreqHz": 2000.1, "ams_fbType": "lin"}),
        ("ams_highFreqHz", {"ams_dsRatio": 8, "ams_highFreqHz": 1024.0}),
        ("ams_highFreqHz", {"ams_lowFreqHz": 700, "ams_highFreqHz": 600, "ams_fbType": "lin"}),
        ("ams_cfHz", {"ams_cfHz": [10.0, 1300.0]}),
        ("ams_cfHz", {"ams_cfHz": [10.0], "ams_fbType": "lin"}),
        ("ams_wSizeSec", {"ams_wSizeSec": 1e-4}),
    ],
    ids=str,
)
def test_invalid_combinations(name: str, changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        AmsFeatures(RATE, **changes)
    stage, reference_stage = AmsFeatures(RATE), AmsFeatures(RATE)
    for each in (stage, reference_stage):
        each.process(sound(900))
    with pytest.raises(ValueError, match=f"^{name}: "):
        stage.configure(**changes)
    np.testing.assert_array_equal(stage.process(sound(900)), reference_stage.process(sound(900)))


def test_the_highest_filter_depends_on_the_rate() -> None:
    """The default follows the sample rate if it must; a given value does not."""
    for kind, edge in (("log", GOLDEN), ("lin", 1.0)):
        low = AmsFeatures(1000.0 * 4, ams_fbType=kind)
        assert low.parameters["ams_highFreqHz"] == pytest.approx(0.475 * 1000 / edge)
        assert low.parameters["ams_cfHz"][-1] <= 0.475 * 1000 / edge
        with pytest.raises(ValueError, match=r"^ams_highFreqHz: "):
            AmsFeatures(1000.0 * 4, ams_fbType=kind, ams_highFreqHz=1024.0)
    assert AmsFeatures(8000.0).parameters["ams_highFreqHz"] == pytest.approx(0.475 * 2000 / GOLDEN)
    assert AmsFeatures(8000.0, ams_dsRatio=2).parameters["ams_highFreqHz"] == 1024.0
    with pytest.raises(ValueError, match=r"^ams_highFreqHz: "):
        AmsFeatures(8000.0, ams_highFreqHz=1024.0)
    AmsFeatures(RATE, ams_highFreqHz=2000 / GOLDEN - 1e-6)
    AmsFeatures(RATE, ams_highFreqHz=2000.0, ams_fbType="lin")
    stage = AmsFeatures(SOUND, ams_highFreqHz=1024.0)
    with pytest.raises(ValueError, match=r"^ams_highFreqHz: "):
        stage.set_input_format(replace(SOUND, sample_rate=8000.0, rate=8000.0))
    assert stage.input_format is SOUND
    stage = AmsFeatures(SOUND)
    stage.set_input_format(replace(SOUND, sample_rate=8000.0, rate=8000.0))
    assert stage.parameters["ams_highFreqHz"] == pytest.approx(0.475 * 2000 / GOLDEN)


@pytest.mark.filterwarnings("error")
def test_frequencies_close_to_0() -> None:
    for low in (5e-324, 1e-300, 1e-9):
        for count in (0, 3):
            stage = AmsFeatures(RATE, ams_lowFreqHz=low, ams_nFilters=count)
            assert np.isfinite(stage.process(sound(2000))).all()
