"""Sound files: exact samples of each width, options, pacing, and rejected files."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe.audio.devices import open_source
from rosafe.audio.files.audiofile import to_int32
from rosafe.interface import ComponentError

RATE = 48000


def noise(frames: int, channels: int = 2) -> np.ndarray:
    """Return full-range int32 noise with both extremes, (frames, channels)."""
    samples = np.random.default_rng(frames).integers(-(2**31), 2**31, (frames, channels)).astype(np.int32)
    samples[0], samples[1] = -(2**31), 2**31 - 1
    return samples


def read_all(device: str, chunk: int, rate: int = 0) -> np.ndarray:
    """Return all frames of a source until its end, (2, frames)."""
    source = open_source(device, rate, chunk, threading.Event())
    chunks = []
    while (part := source.read()) is not None:
        assert part.samples.shape == (2, chunk) and part.samples.dtype == np.int32 and part.gap == 0
        chunks.append(part.samples)
    source.close()
    return np.concatenate(chunks, axis=1)


@pytest.mark.parametrize(
    ("name", "subtype", "bits"),
    [
        ("a.wav", "PCM_U8", 8),
        ("a.wav", "PCM_16", 16),
        ("a.wav", "PCM_24", 24),
        ("a.wav", "PCM_32", 32),
        ("a.flac", "PCM_16", 16),
        ("a.flac", "PCM_24", 24),
        ("a.aiff", "PCM_16", 16),
    ],
)
def test_integer_samples_fill_the_upper_bits(tmp_path: Path, name: str, subtype: str, bits: int) -> None:
    samples = noise(1000) & ~np.int32(2 ** (32 - bits) - 1)  # the range of the width
    soundfile.write(tmp_path / name, samples, RATE, subtype=subtype)
    assert np.array_equal(read_all(f"file:{tmp_path / name}", 100), samples.T)


@pytest.mark.parametrize("subtype", ["FLOAT", "DOUBLE"])
def test_float_samples_are_scaled_rounded_and_clipped(tmp_path: Path, subtype: str) -> None:
    values = np.array([0.0, 1.0, -1.0, 0.5, -0.25, 1e-9, 1.5, -1.5, np.inf, -np.inf, np.nan, 0.1])
    soundfile.write(tmp_path / "f.wav", np.stack((values, -values), axis=1), RATE, subtype=subtype)
    stored = values.astype(np.float32 if subtype == "FLOAT" else np.float64).astype(float)
    full = 2**31 - 1
    left = [0, full, -full, 2**30, -(2**29), 2, full, -(2**31), full, -full, 0, round(stored[-1] * full)]
    assert stored[3] * full == 2**30 - 0.5  # a tie, which is rounded to the even number
    read = read_all(f"file:{tmp_path / 'f.wav'}", len(values))
    assert read[0].tolist() == left
    assert np.array_equal(read, to_int32(np.stack((stored, -stored))))
    assert to_int32(np.array([1e308, -1e308])).tolist() == [full, -(2**31)]


def test_last_chunk_is_padded_with_zeros(tmp_path: Path) -> None:
    samples = noise(250)
    soundfile.write(tmp_path / "a.wav", samples, RATE, subtype="PCM_32")
    read = read_all(f"file:{tmp_path / 'a.wav'}", 100, RATE)
    assert read.shape == (2, 300)
    assert np.array_equal(read[:, :250], samples.T)
    assert not read[:, 250:].any()


def test_start_and_loop(tmp_path: Path) -> None:
    samples = noise(1000)
    soundfile.write(tmp_path / "a.wav", samples, 1000, subtype="PCM_32")
    assert np.array_equal(read_all(f"file:{tmp_path / 'a.wav'}?start=0.9", 50), samples[900:].T)
    source = open_source(f"file:{tmp_path / 'a.wav'}?loop=1&start=0.9", 1000, 30, threading.Event())
    looped = np.concatenate([source.read().samples for _ in range(9)], axis=1)  # type: ignore[union-attr]
    assert np.array_equal(looped, np.tile(samples[900:].T, 3)[:, :270])


def test_path_is_relative_to_the_working_directory_or_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    soundfile.write(tmp_path / "is it?.wav", noise(10), RATE, subtype="PCM_32")
    monkeypatch.chdir(tmp_path)
    assert read_all("file:is it?.wav", 10).shape == (2, 10)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir("/")
    assert read_all("file:~/is it?.wav?start=0", 10).shape == (2, 10)


def test_paced_in_real_time_without_drift(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", noise(4000), 8000, subtype="PCM_16")
    source = open_source(f"file:{tmp_path / 'a.wav'}", 0, 400, threading.Event())
    begin = time.monotonic()
    first, second = source.read(), source.read()
    assert first is not None and second is not None
    assert time.monotonic() >= second.time  # no chunk is returned before its end
    assert second.time - first.time == pytest.approx(0.05, abs=1e-9)
    # After a pause, the reader gets the missed chunks at once, with the times at which they were due.
    late = threading.Event()
    assert not late.wait(0.2)
    times = [chunk.time for _ in range(8) if (chunk := source.read()) is not None]
    assert np.allclose(np.diff([first.time, second.time, *times]), 0.05, atol=1e-9)
    assert source.read() is None
    assert time.monotonic() - begin >= 0.5 - 1e-3


def test_stop_ends_a_wait(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", noise(8000), 8000, subtype="PCM_16")
    stopping = threading.Event()
    source = open_source(f"file:{tmp_path / 'a.wav'}", 0, 8000 * 60, stopping)
    threading.Timer(0.05, stopping.set).start()
    assert source.read() is None  # long before the chunk, which takes a minute, is complete


@pytest.fixture
def bad_files(tmp_path: Path) -> Path:
    """Create a folder with files that cannot be played."""
    soundfile.write(tmp_path / "good.wav", noise(1000), RATE, subtype="PCM_16")
    (tmp_path / "header.wav").write_bytes((tmp_path / "good.wav").read_bytes()[:20])
    (tmp_path / "empty.wav").touch()
    soundfile.write(tmp_path / "nothing.wav", np.zeros((0, 2), np.int16), RATE)
    (tmp_path / "text.wav").write_text("hello, world\n" * 100)
    soundfile.write(tmp_path / "mono.wav", noise(10, 1), RATE)
    soundfile.write(tmp_path / "five.wav", noise(10, 5), RATE)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "exception", "why"),
    [
        ("", "e_device", "expected file:PATH, got an empty path"),
        ("missing.wav", "e_device", "No such file"),
        ("empty.wav", "e_device", "expected a sound file, got an empty file"),
        ("nothing.wav", "e_device", "expected samples, got none"),
        ("text.wav", "e_device", "expected a sound file, got another file"),
        ("header.wav", "e_device", "expected a chunk of sound, got none; the file is truncated"),
        ("x" * 4000, "e_device", "too long"),
        ("good.wav?speed=2", "e_device", "unknown option 'speed'; expected one of channels, loop, start"),
        ("good.wav?loop=yes", "e_device", "loop: expected a whole number from 0 to 1, got 'yes'"),
        ("good.wav?start=nan", "e_device", "start: expected a number of seconds from 0 to 1e+09, got 'nan'"),
        ("good.wav?start=-1", "e_device", "start: expected a number of seconds"),
        ("good.wav?start=5", "e_device", "expected a start below"),
        ("five.wav", "e_hwparams", "expected 2 channels, got 5; choose two with ?channels=1,2"),
        ("five.wav?channels=5,6", "e_hwparams", "five.wav: expected a file with channel 6, got 5"),
        ("mono.wav?channels=1,2", "e_hwparams", "mono.wav: expected a file with channel 2, got 1 (the file is mono)"),
        ("five.wav?channels=0,1", "e_device", "two channel numbers from 1"),
        ("five.wav?channels=1,2,3", "e_device", "such as 3,4"),
        ("mono.wav", "e_hwparams", "?channels=1,1 uses it for both ears"),
        ("good.wav", "e_hwparams", "expected 44100 Hz, got 48000 Hz"),
    ],
)
def test_unusable_files_are_rejected(
    bad_files: Path, monkeypatch: pytest.MonkeyPatch, text: str, exception: str, why: str
) -> None:
    monkeypatch.chdir(bad_files)
    with pytest.raises(ComponentError) as caught:
        open_source(f"file:{text}", 44100, 100, threading.Event())
    assert caught.value.ex == f"::bass::{exception}"
    assert why in caught.value.reason and "\n" not in caught.value.reason


def test_file_that_is_truncated_while_it_is_played(tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, noise(100000), RATE, subtype="PCM_16")
    source = open_source(f"file:{path}", 0, 1000, threading.Event())
    assert source.read() is not None
    os.truncate(path, 10000)
    with pytest.raises(ComponentError, match=r"expected \d+ frames, got"):
        while source.read() is not None:
            pass


def test_channels(tmp_path: Path) -> None:
    """Any two of several channels can be selected, or one for both ears."""
    samples = noise(1000, 5)
    soundfile.write(tmp_path / "five.wav", samples, RATE, "PCM_32")
    soundfile.write(tmp_path / "mono.wav", samples[:, 0], RATE, "PCM_32")
    for name, chosen in {"five.wav?channels=3,4": [2, 3], "five.wav?loop=0&channels=5,1": [4, 0]}.items():
        np.testing.assert_array_equal(read_all(f"file:{tmp_path}/{name}", 500), samples[:, chosen].T)
    both = read_all(f"file:{tmp_path}/mono.wav?channels=1,1&start=0.00625", 350)
    np.testing.assert_array_equal(both, samples[300:, [0, 0]].T)
