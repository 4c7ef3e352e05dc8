"""Formats of sound files: the whole sound is read, or the file is refused, or a line names the missing part."""

from __future__ import annotations

import os
import struct
import subprocess
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

import rosafe
from rosafe.audio.devices import open_source
from rosafe.audio.devices.base import take_remarks
from rosafe.audio.files.audiofile import AudioFile, AudioFileError, to_int32
from rosafe.localization.recordings import learn_recordings
from rosafe.localization.scene_file import SceneError, read_scene
from rosafe.processing.sounds import read_ears
from tests.commands.command import environment
from tests.commands.command import rosafe as command
from tests.harness import PYTHON, ROOT, proc

RATE = 44100
FRAMES = 60000
TIME = np.arange(FRAMES) / RATE
SOUND = np.stack([0.4 * np.sin(2 * np.pi * 440 * TIME), 0.3 * np.sin(2 * np.pi * 300 * TIME**2)], axis=1)
NO_MP3 = pytest.mark.skipif("MP3" not in soundfile.available_formats(), reason="this libsndfile has no MP3")


def write(path: Path, form: str, subtype: str, sound: np.ndarray = SOUND) -> bytes:
    """Write a file and return its bytes."""
    soundfile.write(path, sound, RATE, subtype, format=form)
    return path.read_bytes()


def whole(path: Path) -> np.ndarray:
    """Return the sound of a file without remarks, (channels, frames)."""
    file = AudioFile(path)
    assert file.remark == ""
    sound = file.read(file.frames)
    assert sound.shape == (file.channels, file.frames)
    file.close()
    return sound


def refusal(path: Path) -> str:
    with pytest.raises(AudioFileError) as caught:
        AudioFile(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


# --- codecs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "subtype", "error"),
    [
        ("WAV", "GSM610", 0.1),
        ("AIFF", "GSM610", 0.1),
        ("WAV", "IMA_ADPCM", 0.02),
        ("AIFF", "IMA_ADPCM", 0.02),
        ("W64", "MS_ADPCM", 0.02),
        ("WAV", "NMS_ADPCM_32", 0.1),
        ("AU", "G721_32", 0.05),
        ("AU", "G723_24", 0.2),
        ("AU", "G723_40", 0.05),
        ("AIFF", "DWVW_16", 1e-4),
        ("AIFF", "DWVW_24", 1e-6),
        ("CAF", "ALAC_16", 1e-4),
        ("FLAC", "PCM_16", 1e-4),
        ("OGG", "VORBIS", 0.05),
    ],
)
def test_codecs_are_read_from_any_frame_on(tmp_path: Path, form: str, subtype: str, error: float) -> None:
    """Codecs that cannot seek included."""
    if not soundfile.check_format(form, subtype):
        pytest.skip(f"this libsndfile has no {subtype}")
    path = tmp_path / f"a.{form.lower()}"
    write(path, form, subtype, SOUND[:, :1])
    file = AudioFile(path)
    sound = file.read(file.frames)
    assert FRAMES <= file.frames < FRAMES + 2048 and sound.shape == (1, file.frames)
    assert np.abs(sound[0, 1000:20000] / 2**31 - SOUND[1000:20000, 0]).max() < error
    file.seek(30000)
    np.testing.assert_array_equal(file.read(500), sound[:, 30000:30500])
    source = open_source(f"file:{path}?start=0.5&loop=1&channels=1,1", 0, 40000, threading.Event())
    begin = round(0.5 * RATE)
    looped = np.concatenate([sound[0, begin:]] * 3)
    for at in (0, 40000):
        chunk = source.read()
        assert chunk is not None
        np.testing.assert_array_equal(chunk.samples, [looped[at : at + 40000]] * 2)
    source.close()


def flac_total(data: bytes, frames: int) -> bytes:
    """Replace the number of frames in the header."""
    fields = int.from_bytes(data[18:26], "big") >> 36 << 36 | frames
    return data[:18] + fields.to_bytes(8, "big") + data[26:]


@pytest.mark.parametrize("stated", [0, FRAMES // 2, 1])
def test_flac_of_unknown_or_wrong_length(tmp_path: Path, stated: int) -> None:
    data = write(tmp_path / "a.flac", "FLAC", "PCM_16")
    expected = whole(tmp_path / "a.flac")
    (tmp_path / "b.flac").write_bytes(flac_total(data, stated))
    np.testing.assert_array_equal(whole(tmp_path / "b.flac"), expected)
    (tmp_path / "tag.flac").write_bytes(data + b"TAG".ljust(128, b"\0"))
    np.testing.assert_array_equal(whole(tmp_path / "tag.flac"), expected)
    (tmp_path / "c.flac").write_bytes(flac_total(data, 2 * FRAMES))
    assert "truncated" in refusal(tmp_path / "c.flac")


def mpeg_frames(data: bytes) -> list[bytes]:
    """Return the frames of an MP3 of version 1, layer III."""
    rates = [0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320]
    frames, at = [], 0
    while at + 4 <= len(data):
        assert data[at] == 0xFF and data[at + 1] & 0xFE == 0xFA
        size = 144000 * rates[data[at + 2] >> 4] // RATE + (data[at + 2] >> 1 & 1)
        frames.append(data[at : at + size])
        at += size
    return frames


@NO_MP3
def test_mp3_without_length(tmp_path: Path) -> None:
    """libsndfile estimates the length by the bit rate of the first frame."""
    random = np.random.default_rng(1)
    loud = write(tmp_path / "loud.mp3", "MP3", "MPEG_LAYER_III", 0.3 * random.standard_normal((FRAMES, 2)))
    quiet = write(tmp_path / "quiet.mp3", "MP3", "MPEG_LAYER_III", np.zeros((FRAMES, 2)))
    parts = {
        name: [one for one in mpeg_frames(data) if not {b"Xing", b"Info"} & {one[36:40], one[21:25]}]
        for name, data in (("loud", loud), ("quiet", quiet))
    }
    assert len(parts["quiet"][9]) < len(parts["loud"][9])
    for first, second in (("loud", "quiet"), ("quiet", "loud")):
        path = tmp_path / f"{first}_first.mp3"
        frames = parts[first] + parts[second]
        path.write_bytes(b"".join(frames))
        # a frame can need bits of its predecessor, which is missing at the joint
        assert abs(whole(path).shape[1] - 1152 * len(frames)) <= 2 * 1152
    path.write_bytes(b"".join(parts["loud"] + parts["quiet"]) + parts["loud"][5][:100])
    assert "last frame of MPEG is not complete" in AudioFile(path).remark


@NO_MP3
def test_mp3_without_length_and_with_data_behind_it(tmp_path: Path) -> None:
    noise = 0.3 * np.random.default_rng(1).standard_normal((FRAMES, 2))
    data = b"".join(
        mpeg_frames(write(tmp_path / "a.mp3", "MP3", "MPEG_LAYER_III", noise))[1:]
    )  # without the Xing frame
    (tmp_path / "plain.mp3").write_bytes(data)
    path = tmp_path / "zeros.mp3"
    path.write_bytes(data + bytes(5000))
    file = AudioFile(path)
    assert "may be truncated" in file.remark or "behind the end" in file.remark
    assert np.array_equal(file.read(file.frames), whole(tmp_path / "plain.mp3"))
    file.close()


@NO_MP3
def test_mp3_with_length_and_without_its_last_bytes(tmp_path: Path) -> None:
    path = tmp_path / "cut.mp3"
    path.write_bytes(write(tmp_path / "a.mp3", "MP3", "MPEG_LAYER_III")[:-1])
    file = AudioFile(path)
    assert file.frames < AudioFile(tmp_path / "a.mp3").frames
    assert "the last frame of MPEG may be missing" in file.remark
    file.close()


@NO_MP3
def test_mp3_with_length(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mp3", "MP3", "MPEG_LAYER_III")
    assert abs(whole(tmp_path / "a.mp3").shape[1] - FRAMES) <= 1152
    (tmp_path / "tag.mp3").write_bytes(data + b"TAG".ljust(128, b"\0"))
    assert whole(tmp_path / "tag.mp3").shape == whole(tmp_path / "a.mp3").shape
    (tmp_path / "cut.mp3").write_bytes(2 * (b"ID3\4\0\0\0\0\x40\0" + bytes(8192)) + data[: len(data) // 2])
    assert "truncated" in refusal(tmp_path / "cut.mp3")
    (tmp_path / "two.mp3").write_bytes(data + data)
    assert f"two.mp3: {len(data)} bytes behind the end of the sound" in AudioFile(tmp_path / "two.mp3").remark


@pytest.mark.parametrize("subtype", ["VORBIS", "OPUS"])
def test_pages_of_ogg(tmp_path: Path, subtype: str) -> None:
    if not soundfile.check_format("OGG", subtype):
        pytest.skip(f"this libsndfile has no {subtype}")
    rate = 48000 if subtype == "OPUS" else RATE
    path = tmp_path / "a.ogg"
    soundfile.write(path, SOUND, rate, subtype, format="OGG")
    assert whole(path).shape == (2, FRAMES)
    data = path.read_bytes()
    pages = [b"OggS" + part for part in data.split(b"OggS")[1:]]
    for name, content, why in (
        ("chain", data + data, "expected one stream of sound, got several"),
        ("cut", data[: len(data) // 2], "truncated"),
        ("gap", b"".join(pages[:2] + pages[3:]), "gaps between them"),
        ("other", data[:200] + b"x" * 5 + data[200:], "Ogg"),
    ):
        (tmp_path / f"{name}.ogg").write_bytes(content)
        assert why in refusal(tmp_path / f"{name}.ogg"), name
    (tmp_path / "open.ogg").write_bytes(b"".join(pages[:-1]))
    assert "may be truncated" in AudioFile(tmp_path / "open.ogg").remark


# --- containers ---------------------------------------------------------------------------------------------------

CONTAINERS = ["WAV", "RF64", "W64", "AIFF", "AU", "CAF", "NIST", "WAVEX"]


@pytest.mark.parametrize("form", CONTAINERS)
def test_truncated_files_are_refused(tmp_path: Path, form: str) -> None:
    data = write(tmp_path / "a", form, "PCM_16")
    expected = whole(tmp_path / "a")
    assert expected.shape == (2, FRAMES)
    for size in (len(data) // 2, len(data) - 1000, len(data) - 4):
        (tmp_path / "b").write_bytes(data[:size])
        assert "truncated" in refusal(tmp_path / "b"), size
    (tmp_path / "b").write_bytes(data + bytes(4096))
    np.testing.assert_array_equal(whole(tmp_path / "b"), expected)
    (tmp_path / "b").write_bytes(data + b"\x01\x02\x03\x04" * 1000)
    file = AudioFile(tmp_path / "b")
    assert "4000 bytes behind the end of the sound" in file.remark
    np.testing.assert_array_equal(file.read(file.frames), expected)


@pytest.mark.parametrize(
    ("form", "name", "size"),
    [
        *(("WAV", b"data", struct.pack("<I", size)) for size in (0, 2**32 - 1, 2**31 - 1, 2**31, 2**31 - 4132)),
        ("AIFF", b"SSND", struct.pack(">I", 0)),
        ("AIFF", b"SSND", struct.pack(">I", 8)),
        ("AIFF", b"SSND", struct.pack(">I", 0x7F000008)),
        ("CAF", b"data", struct.pack(">q", -1)),
        ("W64", b"data\xf3\xac\xd3\x11\x8c\xd1\x00\xc0\x4f\x8e\xdb\x8a", struct.pack("<Q", 2**63 - 1)),
        ("AU", b".snd" + struct.pack(">I", 24), b"\xff" * 4),
        ("AU", b".snd" + struct.pack(">I", 24), bytes(4)),
        ("RF64", b"ds64\x1c\0\0\0", bytes(16)),
    ],
)
def test_unknown_length_is_that_of_the_file(tmp_path: Path, form: str, name: bytes, size: bytes) -> None:
    """Programs write such files to a pipe, or if they were killed before they could write the length."""
    data = bytearray(write(tmp_path / "a", form, "PCM_16"))
    expected = whole(tmp_path / "a")
    at = data.index(name) + len(name)
    data[at : at + len(size)] = size
    (tmp_path / "b").write_bytes(data)
    np.testing.assert_array_equal(whole(tmp_path / "b"), expected)


def test_chunks(tmp_path: Path) -> None:
    """Chunks behind the sound are known, even without the byte that makes their places even."""
    data = write(tmp_path / "a.wav", "WAV", "PCM_U8", SOUND[:999, :1])
    data = data[:44] + data[44 : 44 + 999]
    chunk = b"LIST" + struct.pack("<I", 8) + b"INFOISFT"
    for name, content in (("pad", data + b"\0" + chunk), ("none", data + chunk), ("tag", data + b"\0" + b"TAG" * 40)):
        (tmp_path / f"{name}.wav").write_bytes(content)
        assert whole(tmp_path / f"{name}.wav").shape == (1, 999), name
    odd = b"LIST" + struct.pack("<I", 5) + b"INFOx"
    for name, before in (("pad", odd + b"\0"), ("none", odd)):
        (tmp_path / f"{name}.wav").write_bytes(data[:36] + before + data[36:])
        if name != "none":  # libsndfile does not read it
            assert whole(tmp_path / f"{name}.wav").shape == (1, 999), name
        (tmp_path / f"{name}.wav").write_bytes(data[:36] + before + data[36:-100])
        assert "truncated" in refusal(tmp_path / f"{name}.wav"), name
    (tmp_path / "many.wav").write_bytes(data[:36] + b"LIST\0\0\0\0" * 10_000 + data[36:])
    assert "at most 10000 chunks" in refusal(tmp_path / "many.wav")
    (tmp_path / "two.wav").write_bytes(data + b"\0" + data[36:])
    assert "expected one chunk of sound, got several" in refusal(tmp_path / "two.wav")


def test_sound_beyond_4_gib_is_not_lost(tmp_path: Path) -> None:
    """The size in the header is that of the data modulo 2^32, or the greatest one."""
    for stated in (2**20, 2**32 - 1):
        data = write(tmp_path / "a.wav", "WAV", "PCM_16")
        (tmp_path / "a.wav").write_bytes(data[:40] + struct.pack("<I", stated) + data[44:])
        os.truncate(tmp_path / "a.wav", 44 + 2**32 + 2**20)
        assert "4 GiB" in refusal(tmp_path / "a.wav") and "ffmpeg -ignore_length 1" in refusal(tmp_path / "a.wav")


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("begin", "kind"),
    [
        (b"\0\0\0\x1cftypM4A \0\0\0\0", "MPEG-4"),
        (b"\x1a\x45\xdf\xa3\x01\0\0\0", "Matroska or WebM"),
        (b"BW64\xff\xff\xff\xffWAVE", "BW64"),
        (b"#!AMR\n", "AMR"),
        (bytes.fromhex("3026b2758e66cf11a6d9"), "Windows Media"),
        (b"RIFF\0\0\0\0AVI LIST", "AVI"),
        (b"\xff\xf1\x50\x80", "AAC"),
        (b"wvpk\0\0\0\0", "WavPack"),
    ],
)
def test_other_formats_are_named(tmp_path: Path, begin: bytes, kind: str) -> None:
    path = tmp_path / "a.wav"
    path.write_bytes(begin.ljust(1000, b"\0"))
    text = refusal(path)
    assert path not in map(Path.resolve, proc("self/fd").iterdir())
    assert f"got {kind}" in text and "`ffmpeg -i IN OUT.wav`" in text


@pytest.mark.parametrize("form", ["VOC", "AVR", "PAF", "IRCAM", "MAT5", "PVF", "HTK"])
def test_formats_without_a_check_of_their_length(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.snd"
    sound = SOUND[:, :1] if form == "HTK" else SOUND
    write(path, form, "PCM_16", sound)
    expected, _ = soundfile.read(path, dtype="int32", always_2d=True)
    file = AudioFile(path)
    assert np.array_equal(file.read(file.frames), expected.T) and file.frames == len(sound)
    assert file.remark == f"{path}: the length of {form} is not verified; the file may be truncated"
    file.close()


def test_bytes_behind_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.ogg"
    path.write_bytes(write(path, "OGG", "VORBIS") + b"x" * 500)
    file = AudioFile(path)
    assert "500 bytes behind the end" in file.remark
    file.close()


def test_standard_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AudioFileError, match="the standard input is not read"):
        AudioFile("-")


# --- remarks ------------------------------------------------------------------------------------------------------


def remarkable(folder: Path) -> Path:
    """Create a file with NaN, samples beyond full scale, and unread bytes."""
    sound = SOUND.copy()
    sound[500, 0], sound[700, 1] = np.nan, 1.5
    data = write(folder / "a.wav", "WAV", "FLOAT", sound)
    (folder / "a.wav").write_bytes(data + b"\x01\x02\x03\x04" * 100)
    return folder / "a.wav"


def test_a_device_remarks_once(tmp_path: Path) -> None:
    source = open_source(f"file:{remarkable(tmp_path)}?loop=1", 0, FRAMES // 3, threading.Event())
    remarks: list[str] = []
    for _ in range(7):
        assert source.read() is not None
        remarks += take_remarks(source)
    assert [text.partition(": ")[2] for text in remarks] == [
        "400 bytes behind the end of the sound are of no known kind and are not read",
        "samples that are NaN or infinite are replaced by silence or full scale",
        "samples beyond full scale are clipped",
    ]
    source.close()


def test_commands_print_remarks(tmp_path: Path) -> None:
    path = remarkable(tmp_path)
    lines = {
        "process": command("process", path, "-o", tmp_path / "a.npz", "--outputs", "input"),
        "plot": command("plot", path, "-o", tmp_path / "a.png", "--outputs", "input"),
        "trace": command("trace", path, "-o", tmp_path / "a.json"),
        "record": command("record", "--device", f"file:{path}", tmp_path / "b.wav"),
    }
    for name, done in lines.items():
        text = done.stdout + done.stderr
        assert f"{path}: 400 bytes behind" in text and ("NaN" in text or name == "trace"), done


def test_whole_sounds_are_read_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning) as caught:
        read_ears(remarkable(tmp_path))
    assert ["400 bytes" in str(one.message) for one in caught] == [True, False]


def test_scenes_and_recordings_refuse_them(tmp_path: Path) -> None:
    path = remarkable(tmp_path)
    (tmp_path / "a.yaml").write_text("sources: [{file: a.wav}]")
    with pytest.raises(SceneError, match="finite"):
        read_scene(tmp_path / "a.yaml")
    (tmp_path / "a.csv").write_text(f"file,azimuth_deg\n{path},0\n")
    with pytest.raises(ValueError, match="finite"):
        learn_recordings(tmp_path / "a.csv")


@pytest.mark.parametrize("factor", [32768, 32767.0])
def test_floats_in_the_range_of_int16(factor: float) -> None:
    """One warning, however many blocks there are."""
    loud = SOUND.T[:, :20000] * factor
    stream = rosafe.Stream(RATE, outputs=["input"])
    calls: list[Callable[[], object]] = [
        lambda: rosafe.process(loud, RATE, outputs=["input"]),
        lambda: [stream.process(loud[:, at : at + 1000]) for at in range(0, 20000, 1000)],
    ]
    for call in calls:
        with pytest.warns(UserWarning, match="full scale is 1; divide samples of int16 by 32768") as caught:
            call()
        assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rosafe.process(to_int32(SOUND.T), RATE, outputs=["input"])
        rosafe.process(SOUND.T * 100, RATE, outputs=["input"])


# --- memory -------------------------------------------------------------------------------------------------------

MEASURED = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from rosafe.localization.scene_file import read_scene
from rosafe.processing.sounds import read_ears
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = peak()
try:
    read_scene(sys.argv[2]) if sys.argv[2].endswith("yaml") else read_ears(sys.argv[2], (1, 2))
except Exception as problem:
    print(problem)
print((peak() - before) / 1024)
"""
# A small process starts it, as the size of the parent counts for a forked process.
START = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"


def header(rate: int, channels: int, frames: int) -> bytes:
    size = frames * channels * 2
    form = struct.pack("<HHIIHH", 1, channels, rate, min(rate * channels * 2, 2**32 - 1), channels * 2, 16)
    return b"RIFF" + struct.pack("<I", size + 36) + b"WAVEfmt \x10\0\0\0" + form + b"data" + struct.pack("<I", size)


@pytest.mark.parametrize(
    ("rate", "channels", "frames", "name", "why", "megabytes"),
    [
        (50_000_017, 1, 2000, "a.yaml", "expected a sample rate of 1 to 1000000 Hz", 20),
        (999_983, 1, 2000, "a.yaml", "terms of at most 262144, got 999983 Hz", 20),
        (44100, 42, 2**25 + 1, "a.yaml", "expected at most 33554432 frames", 20),
        (44100, 50, 2**21, "a.yaml", "", 150),
        (44100, 50, 2**21, "a.wav", "", 60),
        (44100, 2, 2**28, "a.wav", "expected at most 1024 MiB, got 2048 MiB", 20),
    ],
)
def test_memory(tmp_path: Path, rate: int, channels: int, frames: int, name: str, why: str, megabytes: float) -> None:
    """Sparse files that state large sizes."""
    begin = header(rate, channels, frames)
    (tmp_path / "a.wav").write_bytes(begin + b"\1\2" * 100)
    os.truncate(tmp_path / "a.wav", len(begin) + frames * channels * 2)
    (tmp_path / "a.yaml").write_text("sources: [{file: a.wav}]")
    line = [PYTHON, "-c", START, PYTHON, "-c", MEASURED, str(ROOT), str(tmp_path / name)]
    done = subprocess.run(line, env=environment(), capture_output=True, text=True, timeout=300, check=True)
    *text, peak = done.stdout.splitlines()
    assert why in "".join(text) and bool(text) == bool(why), done
    assert float(peak) < megabytes
