"""The built-in scene: its physics, its independence of the chunk length, and rejected options."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rosafe.audio.devices import open_source
from rosafe.audio.devices.scene import Scene
from rosafe.interface import ComponentError

RATE = 44100


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    """Return ten seconds from left to right as float, (2, frames)."""
    return Scene(RATE).frames(10 * RATE) / 2.0**31


def band(samples: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.asarray(signal.sosfiltfilt(signal.butter(4, (low, high), "bandpass", fs=RATE, output="sos"), samples))


def itd(ears: np.ndarray) -> float:
    """Return the delay (s) of the right ear: the interpolated peak of the cross-correlation."""
    left, right = ears
    reach = 60
    lags = np.arange(-reach, reach + 1)
    sums = [np.dot(left[reach:-reach], right[reach + lag : len(right) - reach + lag]) for lag in lags]
    k = int(np.argmax(sums))
    before, peak, after = sums[k - 1 : k + 2]
    return float(lags[k] + (before - after) / (2 * (before - 2 * peak + after))) / RATE


def level_difference(ears: np.ndarray) -> float:
    """Return the level of the right ear relative to the left, dB."""
    left, right = np.sqrt(np.mean(ears**2, axis=1))
    return float(20 * np.log10(right / left))


def test_azimuth_moves_from_left_to_right_and_back() -> None:
    assert Scene(RATE).azimuth(np.array([0, 2.5, 5, 10, 15, 20])).tolist() == [90, 45, 0, -90, 0, 90]
    assert Scene(RATE, seconds=4.0).azimuth(4.0) == -90


def test_itd_is_woodworths(walk: np.ndarray) -> None:
    pieces = band(walk, 3000, 8000).reshape(2, 20, -1)
    azimuth = np.radians(Scene(RATE).azimuth(np.arange(20) / 2 + 0.25))
    measured = np.array([itd(pieces[:, k]) for k in range(20)])
    expected = 0.0875 / 343 * (azimuth + np.sin(azimuth))  # a source on the left reaches the left ear first
    assert np.abs(measured - expected).max() < 60e-6  # the series of the sphere has more delay than its limit
    assert (np.diff(measured) < 0).all()
    assert measured[0] > 600e-6 and measured[-1] < -600e-6


def test_ild_follows_the_side(walk: np.ndarray) -> None:
    ild = np.array([level_difference(piece) for piece in band(walk, 4000, 8000).reshape(2, 20, -1).swapaxes(0, 1)])
    assert (ild[:10] < 0).all() and (ild[10:] > 0).all()
    assert (np.diff(ild[2:18]) > 0).all()  # at larger angles the bright spot behind a sphere reduces the difference
    assert np.abs(ild + ild[::-1]).max() < 1.5  # the same on both sides


def test_level_is_that_of_the_source_and_nothing_clips(walk: np.ndarray) -> None:
    assert np.abs(walk).max() < 0.9
    assert 10 * np.log10(np.mean(walk[:, 4 * RATE : 6 * RATE] ** 2)) == pytest.approx(
        -28, abs=0.5
    )  # the sphere adds up to 2.5 dB
    softer = Scene(RATE, level=-50).frames(RATE) / 2.0**31
    assert np.allclose(softer, walk[:, :RATE] / 10, atol=2e-9)


@settings(max_examples=10)
@given(st.lists(st.integers(1, 9000), min_size=1, max_size=6), st.sampled_from([4000, 16000, 44100, 96000]))
def test_samples_do_not_depend_on_the_chunks(cuts: list[int], rate: int) -> None:
    scene, whole = Scene(rate), Scene(rate).frames(sum(cuts))
    for begin, end in itertools.pairwise(np.cumsum([0, *cuts]).tolist()):
        assert np.array_equal(scene.frames(end - begin), whole[:, begin:end])


def test_options() -> None:
    default = Scene(8000).frames(8000)
    assert np.array_equal(Scene(8000, seconds=10, level=-30, seed=0).frames(8000), default)
    assert not np.array_equal(Scene(8000, seed=1).frames(8000), default)
    source = open_source("scene:?seconds=0.5&seed=7", 8000, 800, threading.Event())
    chunk = source.read()
    assert chunk is not None
    assert np.array_equal(chunk.samples, Scene(8000, seconds=0.5, seed=7).frames(800))
    assert open_source("scene:", 0, 1, threading.Event()).sample_rate == 44100


def test_a_room() -> None:
    """The reverberation of the talker has its ratio to the direct sound, and does not depend on the chunks."""
    dry = Scene(16000).frames(48000) / 2.0**31
    scene = Scene(16000, rt60=0.3, drr=3.0)
    pieces = [scene.frames(count) for count in (1, 4095, 43904)]
    wet = np.concatenate(pieces, axis=1) / 2.0**31
    assert np.array_equal(Scene(16000, rt60=0.3, drr=3.0).frames(48000), np.concatenate(pieces, axis=1))
    assert 10 * np.log10(np.sum(dry**2) / np.sum((wet - dry) ** 2)) == pytest.approx(3, abs=1)
    chunk = open_source("scene:?rt60=0.3&drr=3", 16000, 800, threading.Event()).read()
    assert chunk is not None and np.array_equal(chunk.samples / 2.0**31, wet[:, :800])


@pytest.mark.parametrize("rate", [1000, 8000, 192000, 768000])
def test_any_sample_rate(rate: int) -> None:
    samples = Scene(rate).frames(rate // 4)
    assert samples.shape == (2, rate // 4)
    assert 10**6 < np.abs(samples.astype(float)).max() < 2**31 - 1


@pytest.mark.parametrize(
    ("device", "rate", "exception", "why"),
    [
        ("scene:seconds=5", 44100, "e_device", "question mark"),
        (
            "scene:?speed=5",
            44100,
            "e_device",
            "unknown option 'speed'; expected one of seconds, level, seed, rt60, drr",
        ),
        ("scene:?rt60=0", 44100, "e_device", "rt60: expected a number of seconds from 0.05 to 5"),
        ("scene:?rt60=1&drr=90", 44100, "e_device", "drr: expected a number from -20 to 40"),
        ("scene:?drr=5", 44100, "e_device", "drr: expected together with rt60"),
        ("scene:?seconds=0", 44100, "e_device", "seconds: expected a number of seconds from 0.1"),
        ("scene:?level=3", 44100, "e_device", "level: expected a number from -120 to 0"),
        ("scene:?seed=-1", 44100, "e_device", "seed: expected a whole number"),
        ("scene:", 10, "e_hwparams", "at least 1000 Hz"),
    ],
)
def test_invalid_options_are_rejected(device: str, rate: int, exception: str, why: str) -> None:
    with pytest.raises(ComponentError) as caught:
        open_source(device, rate, 100, threading.Event())
    assert caught.value.ex == f"::bass::{exception}"
    assert why in caught.value.reason
