"""Malicious files: other formats, wrong lengths, data that decompress to large sizes, and code."""

from __future__ import annotations

import bz2
import json
import os
import struct
import subprocess
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
import rosbag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe.audio.devices import base, open_source
from rosafe.interface import ComponentError
from tests.audio import bags
from tests.audio.bags import number, record
from tests.commands.command import environment
from tests.harness import PYTHON, ROOT

GIGABYTE = 2**30
MAGIC = b"#ROSBAG V2.0\n"
MEGABYTES = 320  # of the process: Python with numpy and scipy 240, the rest for libsndfile and libmpg123


class Done(NamedTuple):
    """The result of a command."""

    code: int
    err: str
    megabytes: float  # maximum resident size of the process up to the end of the command


# Records from the devices one after another, without an output.
MEASURED = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from rosafe.commands.__main__ import main
for device in sys.argv[2:]:
    code = main(["record", "--quiet", "--device", device, "--seconds", "5"])
    sys.stderr.write(f"\\0{code} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}\\0")
    sys.stderr.flush()
"""
# A small process starts it, as the size of the parent counts for a forked process.
START = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"


def play(devices: Sequence[str]) -> list[Done]:
    """Record from each device without an output."""
    arguments = [PYTHON, "-c", START, PYTHON, "-c", MEASURED, str(ROOT), *devices]
    done = subprocess.run(arguments, env=environment(), capture_output=True, text=True, timeout=300, check=True)
    *parts, rest = done.stderr.split("\0")
    assert not rest and len(parts) == 2 * len(devices), done
    results = [result.split() for result in parts[1::2]]
    return [Done(int(code), err, int(kB) / 1024) for err, (code, kB) in zip(parts[::2], results, strict=True)]


def sparse(path: Path, begin: bytes, size: int) -> Path:
    path.write_bytes(begin)
    os.truncate(path, size)
    return path


def chunk(data: bytes, size: int | None = None, compression: bytes = b"none", length: int | None = None) -> bytes:
    size = len(data) if size is None else size
    return record(5, data, length, compression=compression, size=number(size))


def message(data: bytes, length: int | None = None) -> bytes:
    return record(2, data, length, conn=number(0), time=number(0, 8))


def lz4(data: bytes) -> bytes:
    import roslz4

    return bytes(roslz4.compress(data))


# --- bags -------------------------------------------------------------------------------------------------------


def zeros(folder: Path) -> Path:
    return sparse(folder / "a.bag", b"", 10 * GIGABYTE)


def magic_and_zeros(folder: Path) -> Path:
    return sparse(folder / "a.bag", MAGIC, 10 * GIGABYTE)


def older_format(folder: Path) -> Path:
    return sparse(folder / "a.bag", b"#ROSBAG V1.2\n", GIGABYTE)


def long_header(folder: Path) -> Path:
    return sparse(folder / "a.bag", MAGIC + number(2**32 - 1), 10 * GIGABYTE)


def many_connections(folder: Path) -> Path:
    return bags.forge(folder / "a.bag", b"", connections=2**32 - 1)


def long_message(folder: Path) -> Path:
    """The bytes exist, as a hole in the file."""
    begin = chunk(message(b"", 3 * GIGABYTE), length=3 * GIGABYTE + 100)
    return bags.forge(folder / "a.bag", begin, hole=3 * GIGABYTE + 100)


def message_beyond_the_chunk(folder: Path) -> Path:
    return bags.forge(folder / "a.bag", chunk(message(b"short", 100_000_000)))


def chunk_beyond_the_file(folder: Path) -> Path:
    return bags.forge(folder / "a.bag", chunk(message(b"short", 2**32 - 1), length=2**32 - 1))


def bz2_message(folder: Path) -> Path:
    plain = message(b"", 2**32 - 100)
    packed = bz2.compress(plain + bytes(20_000_000))
    return bags.forge(folder / "a.bag", chunk(packed, 2**32 - 1, b"bz2"))


def bz2_of_others(folder: Path) -> Path:
    """A message of another topic is skipped; it is the last one."""
    plain = record(2, bytes(150_000_000), conn=number(7), time=number(0, 8))
    return bags.forge(folder / "a.bag", chunk(bz2.compress(plain), len(plain), b"bz2"))


def lz4_of_others(folder: Path) -> Path:
    plain = record(2, bytes(300_000_000), conn=number(7), time=number(0, 8))
    return bags.forge(folder / "a.bag", chunk(lz4(plain), len(plain), b"lz4"))


def window_of_wrong_length(folder: Path) -> Path:
    """A message that claims to contain 2^32 - 1 samples."""
    plain = struct.pack("<IIIQI", 44100, 1, 2**32 - 1, 5, 2**32 - 1)
    return bags.forge(folder / "a.bag", chunk(message(plain)))


MALICIOUS = (
    (zeros, "a.bag: expected a complete bag of format 2.0, got one that is not a bag of format 2.0"),
    (magic_and_zeros, "was not closed by its recorder, or is truncated"),
    (older_format, "a.bag: expected a complete bag of format 2.0, got one that is not a bag of format 2.0"),
    (long_header, "was not closed by its recorder, or is truncated"),
    (many_connections, "expected at most 10000 connections, got 4294967295"),
    (long_message, "is damaged: expected a field of at most 134218752 bytes, got 3221225472"),
    (message_beyond_the_chunk, "is damaged: a record of 100000000 bytes, but only 5 remain"),
    (chunk_beyond_the_file, "is damaged: expected a field of at most 134218752 bytes, got 4294967295"),
    (bz2_message, "is damaged: expected a field of at most 134218752 bytes, got 4294967196"),
    (bz2_of_others, "stream 1 is not in the bag"),
    (lz4_of_others, "stream 1 is not in the bag"),
    (window_of_wrong_length, "samples do not fit into a message of 24 bytes"),
)


def test_bags(tmp_path: Path) -> None:
    devices = []
    for make, _ in MALICIOUS:
        folder = tmp_path / make.__name__
        folder.mkdir()
        devices.append(f"bag:{make(folder)}")
    for (make, why), done in zip(MALICIOUS, play(devices), strict=True):
        assert done.code == 1 and why in done.err and done.err.count("\n") == 1, (make, done)
        assert done.megabytes < MEGABYTES, (make, done)


def test_code_in_a_bag_is_not_run(tmp_path: Path) -> None:
    """rosbag generates Python code from the definition of an unknown type, with the names of its constants."""
    kind = type(bags.message(bags.stream(10), 10, 10))
    mark = tmp_path / "MARK"
    code = f"int32 print;__import__('os').mkdir('{mark}');Y=5\n"
    evil = type("Evil", (kind,), {"_md5sum": "0" * 32, "_full_text": code})
    path = bags.write(tmp_path / "a.bag", [])
    with rosbag.Bag(str(path), "w") as bag:
        for index in range(0, 101, 10):
            known = bags.message(bags.stream(100), index, 10)
            known.__class__ = evil
            bag.write("/bass/Audio", known)
    with pytest.raises(ComponentError, match="expected md5sum"):
        open_source(f"bag:{path}", 0, 10, threading.Event())
    assert not mark.exists()
    with rosbag.Bag(str(path)) as bag:  # the attack works with rosbag
        list(bag.read_messages(raw=True))
    assert mark.exists()


def test_stop_ends_the_search(tmp_path: Path) -> None:
    """Many chunks that decompress from a few kB to 4 GB, which would take hours."""
    plain = record(2, b"", 2**32 - 100, conn=number(7), time=number(0, 8))
    packed = bz2.compress(plain + bytes(900_000 * 20))
    path = bags.forge(tmp_path / "a.bag", chunk(packed + bytes(10**6), 2**32 - 1, b"bz2") * 50)
    small = record(2, b"", conn=number(7), time=number(0, 8)) * 100_000
    for name in ("a.bag", "b.bag"):
        if name == "b.bag":
            path = bags.forge(tmp_path / name, chunk(small) * 10)
        stopping = threading.Event()
        stopping.set()
        with pytest.raises(ComponentError, match="stopped before the first audio"):
            open_source(f"bag:{path}", 0, 10, stopping)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return small bags of each compression."""
    folder = tmp_path_factory.mktemp("good")
    messages = [bags.message(bags.stream(60), index, 20) for index in range(0, 61, 10)]
    return {
        kind: bags.write(folder / "a.bag", messages, compression=kind, chunk_threshold=400).read_bytes()
        for kind in ("none", "bz2", "lz4")
    }


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=st.sampled_from(("none", "bz2", "lz4")), data=st.data())
def test_randomly_damaged_bags(
    good: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, data: st.DataObject
) -> None:
    """With changed bytes, increased lengths or missing pieces, a bag is played or rejected with a named error."""
    content = bytearray(good[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        if not content:
            break
        at = data.draw(st.integers(0, len(content) - 1))
        how = data.draw(st.sampled_from(("byte", "length", "cut", "end")))
        if how == "byte":
            content[at] = data.draw(st.integers(0, 255))
        elif how == "length":
            content[at : at + 4] = data.draw(
                st.sampled_from((b"\xff\xff\xff\xff", b"\0\0\0\x80", bytes(4), b"\0\0\0\x04"))
            )
        elif how == "cut":
            del content[at : at + data.draw(st.integers(1, 50))]
        else:
            del content[at + 1 :]
    (tmp_path / "a.bag").write_bytes(content)
    monkeypatch.setattr(base.Pacer, "wait", lambda pacer, frames: 0.0)
    try:
        source = open_source(f"bag:{tmp_path / 'a.bag'}", 0, 10, threading.Event())
        try:
            while source.read() is not None:
                pass
        finally:
            source.close()
    except ComponentError as problem:
        assert problem.ex == "::bass::e_device" and problem.reason.isprintable()


# --- sound files ------------------------------------------------------------------------------------------------


def wav(size: int = 2**32 - 9, channels: int = 2, rate: int = 44100, bits: int = 16) -> bytes:
    """Return the beginning of a WAV file with any values in its header."""
    block = channels * bits // 8 & 0xFFFF
    header = struct.pack("<4sI4s4sI", b"RIFF", 2**32 - 1, b"WAVE", b"fmt ", 16)
    header += struct.pack("<HHIIHH", 1, channels, rate, rate * block & 0xFFFFFFFF, block, bits)
    return header + struct.pack("<4sI", b"data", size)


SOUND_FILES = (
    ("zeros.wav", b"", 10 * GIGABYTE),
    ("zeros.flac", b"fLaC", 10 * GIGABYTE),
    ("zeros.ogg", b"OggS", 2 * GIGABYTE),
    ("zeros.mp3", b"ID3\x04\0\0\x7f\x7f\x7f\x7f", 2 * GIGABYTE),
    ("zeros.aiff", b"FORM\x7f\xff\xff\xffAIFF", 2 * GIGABYTE),
    ("cut.wav", wav(2**30), 1000),
    ("channels.wav", wav(channels=1024), 3 * GIGABYTE),
    ("more_channels.wav", wav(channels=65535), 3 * GIGABYTE),
    ("rate.wav", wav(rate=2**32 - 1), 1000),
    ("short_rate.wav", wav(3000, rate=2**31 - 1), 3044),
    ("list.wav", b"RIFF\xff\xff\xff\xffWAVELIST\xf0\xff\xff\xff", 3 * GIGABYTE),
)


def test_sound_files(tmp_path: Path) -> None:
    devices = [f"file:{sparse(tmp_path / name, begin, size)}" for name, begin, size in SOUND_FILES]
    for (name, _, _), done in zip(SOUND_FILES, play(devices), strict=True):
        *others, line = done.err.splitlines()
        assert done.code == 1 and line.startswith("rosafe record: ") and f"/{name}" in line, done
        assert all("libmpg123" in other for other in others), done  # prints further lines
        assert done.megabytes < MEGABYTES, (name, done)


def test_a_long_silence_is_a_sound_file(tmp_path: Path) -> None:
    """A file of 3 GB is read while it is played."""
    path = sparse(tmp_path / "a.wav", wav(3 * GIGABYTE - 44), 3 * GIGABYTE)
    source = open_source(f"file:{path}", 0, 4410, threading.Event())
    chunk_of_it = source.read()
    source.close()
    assert chunk_of_it is not None and not chunk_of_it.samples.any()


SECRET = b"zQ9$jX7!kV5:qWzJ:20779:0:~~~" + bytes(range(128, 256))


@pytest.mark.parametrize("kind", ["file", "bag"])
@pytest.mark.parametrize(
    "begin", [b"", b"#ROSBAG V2.0", b"#ROSBAG V2.0 ", b"#ROSBAG V1.2\n", b"RIFF", b"NIST_1A\n", b"ID3"]
)
@pytest.mark.parametrize("name", ["secret", "secret.mp3", "secret.gsm", "secret.bag"])
def test_errors_contain_no_byte_of_another_file(tmp_path: Path, kind: str, begin: bytes, name: str) -> None:
    (tmp_path / name).write_bytes(begin + SECRET * 20)
    with pytest.raises(ComponentError) as caught:
        open_source(f"{kind}:{tmp_path / name}", 0, 10, threading.Event())
    # The path is not a leak, whatever the names of its folders.
    text = (json.dumps(caught.value.detail) + str(caught.value)).replace(str(tmp_path), "")
    parts = [SECRET[at : at + 3] for at in range(len(SECRET) - 2)]
    leaked = [part for part in parts if repr(part)[2:-1] in text or part.decode("latin-1") in text]
    assert not leaked, text
