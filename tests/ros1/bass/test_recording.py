"""The parts of recording: levels, WAV and bag files, losses, and full disks."""

from __future__ import annotations

import io
import itertools
import math
import os
import threading
import wave
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.audio.devices import base, open_source
from rosafe.audio.devices.base import Chunk
from rosafe.audio.files.audiofile import AudioFile
from rosafe.audio.files.levels import LevelMeter
from rosafe.commands._meter import PLAIN_SECONDS, Meter, clock
from rosafe.ros1.bass import recording
from rosafe.ros1.bass.recording import BagWriter, SoundRecorder, WavFile
from tests.audio import bags

RATE = 1000


def empty(path: Path) -> int:
    """Return a descriptor of a new file."""
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC)


# --- levels ---


@pytest.mark.parametrize("clipped", [0, 1])
def test_the_display_marks_the_ear_that_is_clipped(clipped: int) -> None:
    stream = io.StringIO()
    samples = np.full((2, round(PLAIN_SECONDS * RATE)), 2**20, np.int32)
    samples[clipped, 5:9] = 2**31 - 1
    Meter(stream, RATE, quiet=False).show(samples, lost=3)
    left, right = stream.getvalue().split(" R peak ")
    assert ["CLIP" in ear for ear in (left, right)] == [clipped == 0, clipped == 1]
    assert right.endswith("lost 3\n")


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0:00"), (6.6, "0:07"), (59.5, "1:00"), (754, "12:34"), (3722, "1:02:02")]
)
def test_durations(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def test_levels_of_known_signals() -> None:
    time = np.arange(RATE) / RATE
    sine = (2.0**30 * np.sin(2 * np.pi * 100 * time)).astype(np.int32)
    square = np.where(np.arange(RATE) % 2, -(2**31), 2**31 - 1).astype(np.int32)
    levels = LevelMeter()
    for part in np.array_split(np.stack((sine, square)), 7, axis=1):
        levels.add(part)
    assert levels.peak(0) == pytest.approx(20 * math.log10(0.5 * np.sin(0.4 * np.pi)), abs=1e-4)
    assert levels.rms(0) == pytest.approx(-9.031, abs=1e-3)
    assert levels.peak(1) == 0.0 and levels.rms(1) == pytest.approx(0, abs=1e-6)
    assert levels.clipped == [0, RATE]


def test_levels_of_silence_and_of_no_samples() -> None:
    levels = LevelMeter()
    assert levels.peak(0) == levels.rms(1) == -math.inf
    levels.add(np.zeros((2, 0), np.int32))
    levels.add(np.zeros((2, 5), np.int32))
    assert levels.peak(0) == levels.rms(1) == -math.inf and levels.clipped == [0, 0]


@pytest.mark.parametrize(
    ("sample", "clipped"), [(32767 << 16, 1), (-(2**31), 1), (-(32767 << 16), 1), (32766 << 16, 0)]
)
def test_the_maximum_of_16_bits_counts_as_clipped(sample: int, clipped: int) -> None:
    levels = LevelMeter()
    levels.add(np.array([[0, sample], [0, 0]], np.int32))
    assert levels.clipped == [clipped, 0]


# --- WAV ---


def test_wav_is_exact_and_readable_by_other_programs(tmp_path: Path) -> None:
    samples = bags.stream(2500)
    samples[:, :2] = [[-(2**31)], [2**31 - 1]]
    file = WavFile(empty(tmp_path / "a.wav"), RATE)
    for part in np.array_split(samples, 9, axis=1):
        file.write(part, 0)
    file.lose(70_000)
    file.close()
    file.close()
    expected = np.pad(samples, ((0, 0), (0, 70_000)))
    audio = AudioFile(tmp_path / "a.wav")
    assert (audio.sample_rate, audio.frames) == (RATE, 72_500)
    assert np.array_equal(audio.read(72_500), expected)
    with wave.open(str(tmp_path / "a.wav")) as plain:
        assert plain.getparams()[:4] == (2, 4, RATE, 72_500)
        assert plain.readframes(72_500) == expected.T.astype("<i4").tobytes()


def test_wav_that_was_not_closed_contains_all_except_the_last_second(tmp_path: Path) -> None:
    file = WavFile(empty(tmp_path / "a.wav"), RATE)
    samples = bags.stream(2300)
    for part in np.array_split(samples, 23, axis=1):
        file.write(part, 0)
    assert np.array_equal(soundfile.read(tmp_path / "a.wav", dtype="int32")[0].T, samples[:, :2000])
    file.close()


def test_long_wav_is_an_rf64(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = bags.stream(3000)
    monkeypatch.setattr(recording, "RIFF_LIMIT", 80 - 8 + 8 * 1999)
    file = WavFile(empty(tmp_path / "a.wav"), RATE)
    file.write(samples[:, :1999], 0)
    assert (tmp_path / "a.wav").read_bytes()[:4] == b"RIFF"
    file.write(samples[:, 1999:], 0)
    file.close()
    assert (tmp_path / "a.wav").read_bytes()[:4] == b"RF64"
    audio = AudioFile(tmp_path / "a.wav")
    assert audio.frames == 3000 and np.array_equal(audio.read(3000), samples)


def test_wav_beyond_4_gib(tmp_path: Path) -> None:
    """A real file that consists mostly of a hole."""
    file = WavFile(empty(tmp_path / "a.wav"), RATE)
    hole = 2**29  # frames
    file.frames = hole
    file._file.seek(80 + 8 * hole)
    samples = bags.stream(1000)
    file.write(samples, 0)
    file.close()
    assert soundfile.info(tmp_path / "a.wav").format == "RF64"
    audio = AudioFile(tmp_path / "a.wav")
    assert audio.frames == hole + 1000
    audio.seek(hole)
    assert np.array_equal(audio.read(2000), samples)


# --- bags ---


def play(path: Path, options: str = "") -> tuple[np.ndarray, int]:
    source = open_source(f"bag:{path}{options}", 0, 10, threading.Event())
    parts = []
    while (chunk := source.read()) is not None:
        parts.append(np.pad(chunk.samples, ((0, 0), (chunk.gap, 0))))
    return np.concatenate(parts, axis=1), source.lost_frames


@pytest.fixture
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base.Pacer, "wait", lambda pacer, frames: 0.0)


def test_bag_contains_each_frame_with_its_index_and_time(tmp_path: Path, no_pauses: None) -> None:
    import rosbag

    samples = bags.stream(500)
    file = BagWriter(empty(tmp_path / "a.bag"), RATE, 10, "/left/Audio", newest=700)
    file.write(samples[:, :35], 5_000_000_000)
    file.lose(15)
    file.write(samples[:, 50:], 6_000_000_000)  # more than a window
    file.close()
    samples[:, 35:50] = 0
    played, lost = play(tmp_path / "a.bag", "?topic=left/Audio")
    assert lost == 0  # the loss is zeros that count in the index, as published by bass
    assert np.array_equal(played, samples)
    with rosbag.Bag(str(tmp_path / "a.bag")) as bag:
        messages = [(message, time.to_nsec()) for _, message, time in bag.read_messages()]
    assert messages[0][0].lastFrameIndex == 735 and messages[-1][0].lastFrameIndex == 1200
    assert [time for _, time in messages[:3]] == [5_000_000_000, 5_560_000_000, 5_570_000_000]
    assert messages[-1][1] == 6_000_000_000
    assert all(message.stamp.sec * 10**9 + message.stamp.nsec == time for message, time in messages)


@pytest.mark.parametrize(("frames", "piece"), [(25, 25), (100, 7)])
def test_bag_of_less_than_a_window_and_of_pieces_that_do_not_divide_it(
    tmp_path: Path, no_pauses: None, frames: int, piece: int
) -> None:
    samples = bags.stream(frames)
    file = BagWriter(empty(tmp_path / "a.bag"), RATE, 10, "/bass/Audio", newest=5)
    for begin in range(0, frames, piece):
        file.write(samples[:, begin : begin + piece], 10**9)
    file.close()
    assert np.array_equal(play(tmp_path / "a.bag")[0][:, :frames], samples)


def test_bag_stops_while_there_is_space_for_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_pauses: None
) -> None:
    samples = bags.stream(200)
    file = BagWriter(empty(tmp_path / "a.bag"), RATE, 10, "/bass/Audio")
    file.write(samples[:, :100], 10**9)
    monkeypatch.setattr(recording, "BAG_RESERVE", 2**62)
    with pytest.raises(OSError, match="free disk space"):
        file.write(samples[:, 100:], 2 * 10**9)
    file.close()
    assert np.array_equal(play(tmp_path / "a.bag")[0], samples[:, :100])


# --- the recorder ---


class Scripted:
    """A source of chunks of ten frames; each step is (gap, number of lost frames)."""

    name, sample_rate = "scripted", RATE

    def __init__(self, script: list[tuple[int, int]]) -> None:
        self._script = iter(script)
        self._numbers = itertools.count(1)
        self.overruns = self.lost_frames = 0

    def read(self) -> Chunk | None:
        """Return the next chunk."""
        step = next(self._script, None)
        if step is None:
            return None
        gap, within = step
        self.lost_frames += gap + within
        return Chunk(np.full((2, 10), next(self._numbers), np.int32), gap, 100.0)

    def close(self) -> None:
        """Do nothing."""


def record(path: Path | None, script: list[tuple[int, int]], frames: int | None = None) -> tuple[Any, list[str], bool]:
    reports: list[str] = []
    output = WavFile(empty(path), RATE) if path else None
    recorder = SoundRecorder(Scripted(script), output, frames, lambda samples, lost: None, reports.append)
    ended = recorder.run(threading.Event())
    if output:
        output.close()
    return recorder, reports, ended


def test_losses_are_zeros_and_reported_with_their_position(tmp_path: Path) -> None:
    recorder, reports, ended = record(tmp_path / "a.wav", [(0, 0), (25, 0), (0, 3), (0, 0)])
    assert ended and recorder.frames == 65 and recorder.lost == 28
    assert reports == [
        "lost 25 frames (0.025 s) after frame 10 (0.01 s)",
        "lost 3 frames (0.003 s) after frame 45 (0.04 s)",
    ]
    left = soundfile.read(tmp_path / "a.wav", dtype="int32")[0][:, 0]
    assert left.tolist() == [1] * 10 + [0] * 25 + [2] * 10 + [3] * 10 + [4] * 10


@pytest.mark.parametrize("frames", [1, 10, 17, 30, 36])
def test_exactly_the_requested_number_of_frames_is_recorded(tmp_path: Path, frames: int) -> None:
    recorder, _, ended = record(tmp_path / "a.wav", [(0, 0), (25, 0), (0, 0)], frames)
    assert not ended and recorder.frames == frames
    left = soundfile.read(tmp_path / "a.wav", dtype="int32")[0][:, 0]
    assert left.tolist() == ([1] * 10 + [0] * 25 + [2] * 10)[:frames]
