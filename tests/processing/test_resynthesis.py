"""`rosafe.resynthesize` and `rosafe.Resynthesizer`: errors in dB, alignment, masks, chunks, refused arguments."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import scipy.signal

import rosafe
from rosafe.dsp.erb import erb_rate_to_frequency
from rosafe.localization.training import _training_sound
from rosafe.processing import resynthesis

MANY = {"fb_nChannels": 64, "fb_lowFreqHz": 80.0, "fb_highFreqHz": 7000.0}


@lru_cache(maxsize=8)
def sound(rate: int, low: float = 96.0, high: float = 5600.0, seconds: float = 0.8) -> np.ndarray:
    """Return voiced and unvoiced sound (2, N) between two frequencies, with silence at both ends."""
    random = np.random.default_rng(1)
    count = round(seconds * rate)
    ears = np.stack([_training_sound(number, count, rate, random) for number in (0, 1)])
    sections = scipy.signal.butter(6, [low, min(high, 0.375 * rate)], "band", fs=rate, output="sos")
    faded = ears * scipy.signal.windows.tukey(count, 0.1)
    silence = np.zeros((2, rate // 10))
    limited = scipy.signal.sosfiltfilt(sections, np.concatenate((silence, faded, silence), axis=1), axis=1)
    return np.asarray(limited / np.std(limited))


def error_db(found: np.ndarray, expected: np.ndarray) -> float:
    return float(10 * np.log10(np.sum((found - expected) ** 2) / np.sum(expected**2)))


RATES = (8000, 16000, 44100, 48000)
FILTERS: tuple[tuple[dict[str, Any], float], ...] = (
    ({}, -55.0),
    (MANY, -60.0),
    ({"fb_nChannels": 40}, -55.0),
    ({"fb_nERBs": 2.0}, -50.0),
)
SAMPLE = [(rate, *filters) for rate, filters in zip(RATES, FILTERS, strict=True)]
OTHERS = [(rate, *filters) for rate in RATES for filters in FILTERS if (rate, *filters) not in SAMPLE]


@pytest.mark.parametrize(
    ("rate", "parameters", "limit"), [*SAMPLE, *(pytest.param(*one, marks=pytest.mark.exploration) for one in OTHERS)]
)
def test_the_error(rate: int, parameters: dict[str, Any], limit: float) -> None:
    chosen = {**parameters, "fb_highFreqHz": 3800.0} if rate == 8000 else parameters
    ears = sound(rate)
    result = rosafe.process(ears, rate, parameters=chosen, outputs=["gammatone"])
    found = rosafe.resynthesize(result)
    assert found.shape == ears.shape and error_db(found, ears) < limit
    for ear, restored in zip(ears, found, strict=True):
        correlation = scipy.signal.correlate(restored, ear)
        assert abs(int(np.argmax(correlation)) - (ears.shape[1] - 1)) <= 1
        assert abs(20 * np.log10(np.std(restored) / np.std(ear))) < 0.01


def test_one_ear_and_single_precision_and_files(tmp_path: Any) -> None:
    ears = sound(16000)
    result = rosafe.process(ears[0], 16000, outputs=["gammatone"], dtype="float32")
    found = rosafe.resynthesize(result)
    assert found.shape == (1, ears.shape[1]) and found.dtype == np.float64
    assert error_db(found[0], ears[0]) < -55
    result.save(tmp_path / "one.npz")
    assert np.array_equal(rosafe.resynthesize(rosafe.load(tmp_path / "one.npz")), found)


@pytest.mark.parametrize(
    ("parameters", "rate"),
    [
        ({"pp_bLevelScaling": True, "pp_refSPLdB": 40.0}, 8000),
        ({"pp_bPreEmphasis": True}, 16000),
        ({"pp_bMiddleEarFiltering": True}, 8000),
        ({"pp_bMiddleEarFiltering": True, "pp_middleEarModel": "lopezpoveda", "pp_bLevelScaling": True}, 16000),
    ],
)
def test_preprocessing_is_compensated(parameters: dict[str, Any], rate: int) -> None:
    ears = sound(rate)
    plain = rosafe.process(ears, rate, parameters=parameters, outputs=["preProc"])["preProc"]
    assert error_db(plain, ears) > -10
    result = rosafe.process(ears, rate, parameters=parameters, outputs=["gammatone"])
    assert error_db(rosafe.resynthesize(result), ears) < -45


@pytest.mark.parametrize("rate", [8000, 16000])
def test_an_abrupt_end_behind_a_filter_with_a_long_delay_is_not_amplified(rate: int) -> None:
    noise = sound(rate)[:, rate // 5 : rate // 2]
    result = rosafe.process(noise, rate, parameters={"pp_bMiddleEarFiltering": True}, outputs=["gammatone"])
    assert np.abs(rosafe.resynthesize(result)).max() < 1.5 * np.abs(noise).max()


def test_other_filters() -> None:
    parameters = {"fb_nGamma": 3, "fb_bwERBs": 1.3, "fb_cfHz": erb_rate_to_frequency(np.arange(3.0, 31.0)).tolist()}
    ears = sound(16000, 150.0, 4000.0)
    result = rosafe.process(ears, 16000, parameters=parameters, outputs=["gammatone"])
    assert error_db(rosafe.resynthesize(result), ears) < -50


@pytest.mark.parametrize("parameters", [{"fb_bwERBs": 0.05}, {"fb_nChannels": 1}, {"fb_nGamma": 64}])
def test_filters_that_do_not_cover_the_spectrum_amplify_nothing(parameters: dict[str, Any]) -> None:
    noise = np.random.default_rng(5).standard_normal((2, 4000))
    result = rosafe.process(noise, 16000, parameters=parameters, outputs=["gammatone"])
    assert np.std(rosafe.resynthesize(result)) < 1.1 * np.std(noise)


def test_chunks_are_seamless(monkeypatch: pytest.MonkeyPatch) -> None:
    result = rosafe.process(sound(16000), 16000, outputs=["gammatone", "ild"])
    mask = np.random.default_rng(2).random(result["ild"].shape)
    whole = [rosafe.resynthesize(result), rosafe.resynthesize(result, mask)]
    monkeypatch.setattr(resynthesis, "_CHUNK", 2**13)
    for kept, found in zip(whole, [rosafe.resynthesize(result), rosafe.resynthesize(result, mask)], strict=True):
        assert error_db(found, kept) < -55


def test_masks_scale_and_select() -> None:
    rate = 16000
    ears = sound(rate)
    result = rosafe.process(ears, rate, outputs=["gammatone", "ild"])
    whole, frequencies = rosafe.resynthesize(result), result["fb_cfHz"]
    channels, samples = len(frequencies), ears.shape[1]
    frames = result["ild"].shape[1]
    half = rosafe.resynthesize(result, np.full((channels, frames), 0.5))
    assert np.allclose(half, 0.5 * whole, rtol=0, atol=1e-12)
    assert not rosafe.resynthesize(result, np.zeros((channels, samples), bool)).any()
    one_ear = np.zeros((2, channels, frames))
    one_ear[0] = 1
    left = rosafe.resynthesize(result, one_ear)
    assert not left[1].any() and np.allclose(left[0], whole[0])
    below = (frequencies < 1000.0)[:, np.newaxis] * np.ones(frames)
    low = rosafe.resynthesize(result, below)
    spectrum = np.abs(np.fft.rfft(low)) ** 2 / (
        np.abs(np.fft.rfft(whole)) ** 2 + 1e-9 * np.max(np.abs(np.fft.rfft(whole)))
    )
    bins = np.fft.rfftfreq(samples, 1 / rate)
    assert np.median(spectrum[:, (bins > 150) & (bins < 700)]) > 0.9
    assert np.median(spectrum[:, (bins > 1500) & (bins < 4000)]) < 0.01


@pytest.mark.parametrize(
    ("rate", "options"),
    [
        (8000, {}),
        (16000, {"pad": True}),
        (44100, {"dtype": "float32"}),
        *(pytest.param(96000, one, marks=pytest.mark.exploration) for one in ({}, {"pad": True}, {"dtype": "float32"})),
    ],
)
def test_abrupt_ends(rate: int, options: dict[str, Any]) -> None:
    """The last 20 ms, which the response of the filters follows, are as those of a sound that silence follows."""
    count = round(0.3 * rate)
    noise = sound(rate, 150.0, 3000.0)[:, rate // 5 : rate // 5 + count]
    last = slice(count - round(0.02 * rate), None)
    followed = rosafe.process(np.pad(noise, ((0, 0), (0, rate // 5))), rate, outputs=["gammatone"])
    best = error_db(rosafe.resynthesize(followed)[:, :count][:, last], noise[:, last])
    found = rosafe.resynthesize(rosafe.process(noise, rate, outputs=["gammatone"], **options))
    assert error_db(found[:, last], noise[:, last]) < max(best, -50.0) + 6.0
    assert best < -30


@pytest.mark.parametrize(
    "parameters", [{"pp_bMiddleEarFiltering": True, "pp_middleEarModel": "lopezpoveda"}, {"pp_bPreEmphasis": True}]
)
def test_abrupt_ends_of_preprocessed_sound_and_with_masks(parameters: dict[str, Any]) -> None:
    rate, count = 16000, 4000
    noise = sound(rate, 300.0, 3000.0)[:, rate // 5 : rate // 5 + count]
    followed = np.pad(noise, ((0, 0), (0, count)))
    short, long = (
        rosafe.process(ears, rate, parameters=parameters, outputs=["gammatone", "ild"]) for ears in (noise, followed)
    )
    high = (short["fb_cfHz"] > 1000)[:, np.newaxis]
    for of_short, of_long in ((short["ild"].shape[1], long["ild"].shape[1]), (count, 2 * count)):
        found = rosafe.resynthesize(short, high * np.ones(of_short))
        kept = rosafe.resynthesize(long, high * np.ones(of_long))[:, :count]
        assert error_db(found[:, -320:], kept[:, -320:]) < -30


def test_ends_of_channels_that_belong_to_no_sound_are_not_amplified() -> None:
    rate = 16000
    random = np.random.default_rng(6)
    for change in (random.random((31, 1)), random.random((2, 31, 4000)) > 0.5):
        result = rosafe.process(sound(rate)[:, 3200:7200], rate, outputs=["gammatone"])
        result["gammatone"] *= change
        assert np.abs(rosafe.resynthesize(result)[:, -320:]).max() < np.abs(sound(rate)).max()


def test_frames_of_a_mask_are_those_of_ild() -> None:
    """A mask that opens at a frame opens the sound at the middle of this frame."""
    rate = 16000
    noise = np.random.default_rng(3).standard_normal((2, rate))
    for pad in (False, True):
        result = rosafe.process(noise, rate, outputs=["gammatone", "ild"], pad=pad)
        mask = np.zeros(result["ild"].shape)
        mask[:, 50:] = 1
        opened = rosafe.resynthesize(result, mask)
        middle = round(result["ild_time"][50] * rate)
        power = np.mean(opened**2, axis=0)
        assert power[: middle - 400].mean() < 1e-3 and 0.7 < power[middle + 400 :].mean() < 1.3
    by_sample = np.repeat(mask, 160, axis=1)
    assert by_sample.shape[1] == rate
    assert rosafe.resynthesize(result, by_sample).shape == (2, rate)


def test_refused_arguments() -> None:
    rate = 16000
    noise = np.random.default_rng(4).standard_normal((2, 1600))
    result = rosafe.process(noise, rate, outputs=["gammatone", "ild"])
    channels, frames = result["ild"].shape
    for wrong, message in (
        (np.ones((channels, frames + 3)), "mask: expected 9 frames as of ild, or 1600 samples, got 12"),
        (np.ones((channels - 1, frames)), f"mask: expected {channels} channels"),
        (np.ones((3, channels, frames)), "one or 2 ears"),
        (np.ones(frames), "mask: expected numbers of shape"),
        (np.full((channels, frames), "a"), "mask: expected numbers of shape"),
        (np.full((channels, frames), 1.5), "mask: expected values from 0 to 1, got 1.5 to 1.5"),
        (np.full((channels, frames), np.nan), "mask: expected values from 0 to 1, got nan to nan"),
        ([[1.0], [1.0, 1.0]], "mask: expected an array, got rows of different lengths"),
        (np.ma.masked_less(np.zeros((channels, frames)), 1), "mask: expected an array of weights, got a masked array"),
    ):
        with pytest.raises(ValueError, match=message):
            rosafe.resynthesize(result, wrong)
    with pytest.raises(ValueError, match=r"result: expected the output gammatone, got ild"):
        rosafe.resynthesize(rosafe.process(noise, rate, outputs=["ild"]))
    with pytest.raises(ValueError, match=r"result: expected a result of rosafe\.process or rosafe\.load, got dict"):
        rosafe.resynthesize(dict(result))  # type: ignore[arg-type]
    drnl = rosafe.process(noise, rate, parameters={"fb_type": "drnl"}, outputs=["gammatone"])
    with pytest.raises(ValueError, match="DRNL filters are not linear"):
        rosafe.resynthesize(drnl)
    for wrong in (np.inf, 1e308):
        result["gammatone"][0, 0, 0] = wrong
        with pytest.raises(ValueError, match="gammatone: expected finite numbers"):
            rosafe.resynthesize(result)
    result["gammatone"] = result["gammatone"][:, 1:]
    with pytest.raises(ValueError, match="gammatone: expected shape"):
        rosafe.resynthesize(result)


def test_no_samples() -> None:
    result = rosafe.process(np.zeros((2, 0)), 16000, outputs=["gammatone"])
    assert rosafe.resynthesize(result).shape == (2, 0)
    result = rosafe.process(np.zeros((2, 5)), 16000, outputs=["gammatone"])
    assert not rosafe.resynthesize(result).any()


# --- streaming ---


def streamed(ears: np.ndarray, rate: int, delay: float, lengths: list[int]) -> tuple[np.ndarray, rosafe.Resynthesizer]:
    stream = rosafe.Stream(rate, outputs=["gammatone"])
    resynthesizer = rosafe.Resynthesizer(rate, delay=delay)
    parts, first, number = [], 0, 0
    while first < ears.shape[1]:
        length = lengths[number % len(lengths)]
        parts.append(resynthesizer.process(stream.process(ears[:, first : first + length])["gammatone"]))
        first, number = first + length, number + 1
    return np.concatenate(parts, axis=1), resynthesizer


@pytest.mark.parametrize(
    ("rate", "delay", "limit"), [(16000, 0.004, -20.0), (16000, 0.016, -40.0), (44100, 0.01, -30.0)]
)
def test_a_stream_has_the_named_delay_and_error(rate: int, delay: float, limit: float) -> None:
    ears = sound(rate)
    found, resynthesizer = streamed(ears, rate, delay, [rate // 10])
    late = resynthesizer.delay_samples
    assert resynthesizer.delay == late / rate and abs(resynthesizer.delay - delay) < 1 / rate
    measured = error_db(found[:, late:], ears[:, :-late])
    assert measured < limit and resynthesizer.error_db < limit + 5
    assert measured < resynthesizer.error_db + 6


def test_a_stream_does_not_depend_on_blocks() -> None:
    ears = sound(16000)
    once, _ = streamed(ears, 16000, 0.01, [ears.shape[1]])
    found, _ = streamed(ears, 16000, 0.01, [160, 1, 0, 733])
    assert np.abs(found - once).max() < 1e-12


def test_a_stream_with_masks_and_reset() -> None:
    stream = rosafe.Stream(16000, {"pp_bLevelScaling": True, "pp_refSPLdB": 60.0}, outputs=["gammatone"])
    resynthesizer = rosafe.Resynthesizer(16000, {"pp_bLevelScaling": True, "pp_refSPLdB": 60.0})
    ears = sound(16000)
    channels = stream.process(ears)["gammatone"]
    whole = resynthesizer.process(channels)
    late = resynthesizer.delay_samples
    assert error_db(whole[:, late:], ears[:, :-late]) < -40
    resynthesizer.reset()
    half = resynthesizer.process(channels, np.full(channels.shape[1:], 0.5))
    assert np.allclose(half, 0.5 * whole)
    for wrong in (channels[:, 1:], channels[:1], channels[0]):
        with pytest.raises(ValueError, match="channels: expected shape"):
            resynthesizer.process(wrong)
    with pytest.raises(ValueError, match="mask: expected"):
        resynthesizer.process(channels, np.ones((channels.shape[1], 3)))
    with pytest.raises(ValueError, match=r"sample_rate: expected at most \d+ Hz for a delay of 0\.016 s, got 1e"):
        rosafe.Resynthesizer(1e9)
    with pytest.raises(ValueError, match="channels: expected finite numbers"):
        resynthesizer.process(np.where(channels > 0, np.nan, 0))
    with pytest.raises(ValueError, match=r"channels: expected finite numbers up to 1e\+100"):
        resynthesizer.process(np.full_like(channels, 1e308))
    for delay in (0, True, np.nan):
        with pytest.raises(ValueError, match="delay: expected"):
            rosafe.Resynthesizer(16000, delay=delay)
    assert rosafe.Resynthesizer(16000, delay=np.float32(0.008)).delay_samples == 128  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="DRNL"):
        rosafe.Resynthesizer(16000, {"fb_type": "drnl"})
