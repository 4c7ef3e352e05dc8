"""Files that were made to hurt: what is no bag or sound, lengths that lie, little that unpacks to much, and code."""

from __future__ import annotations

import bz2
import json
import os
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import rosbag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe.bass.sources import base, open_source
from rosafe.interface import ComponentError
from tests.bass import bags
from tests.bass.bags import number, record
from tests.cli.command import ROSAFE, environment
from tests.harness import PYTHON

GIGABYTE = 2**30
MAGIC = b"#ROSBAG V2.0\n"
MEGABYTES = 320  # of all of it: Python with numpy and scipy, 240, and what libsndfile and libmpg123 look at


class Done(NamedTuple):
    """How a command ended."""

    code: int
    err: str
    megabytes: float  # at most resident


# From a small process: what is forked from a large one counts as that large.
MEASURED = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:])
print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def play(device: str) -> Done:
    """Record from `device`, without an output."""
    command = [str(ROSAFE), "record", "--quiet", "--device", device, "--seconds", "5"]
    done = subprocess.run(
        [PYTHON, "-c", MEASURED, *command], env=environment(), capture_output=True, text=True, timeout=150, check=True
    )
    code, kilobytes = done.stdout.splitlines()[-1].split()
    return Done(int(code), done.stderr, int(kilobytes) / 1024)


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
    """It is there: a hole in the file."""
    begin = chunk(message(b"", 3 * GIGABYTE), length=3 * GIGABYTE + 100)
    return bags.forge(folder / "a.bag", begin, hole=3 * GIGABYTE + 100)


def message_beyond_the_chunk(folder: Path) -> Path:
    return bags.forge(folder / "a.bag", chunk(message(b"short", 100_000_000)))


def chunk_beyond_the_file(folder: Path) -> Path:
    return bags.forge(folder / "a.bag", chunk(message(b"short", 2**32 - 1), length=2**32 - 1))


def bz2_message(folder: Path) -> Path:
    plain = message(b"", 2**32 - 100)
    packed = bz2.compress(plain + bytes(400_000_000))
    return bags.forge(folder / "a.bag", chunk(packed, 2**32 - 1, b"bz2"))


def bz2_of_others(folder: Path) -> Path:
    """A message of another topic is left out; nothing comes after it."""
    plain = record(2, bytes(400_000_000), conn=number(7), time=number(0, 8))
    return bags.forge(folder / "a.bag", chunk(bz2.compress(plain), len(plain), b"bz2"))


def lz4_of_others(folder: Path) -> Path:
    plain = record(2, bytes(400_000_000), conn=number(7), time=number(0, 8))
    return bags.forge(folder / "a.bag", chunk(lz4(plain), len(plain), b"lz4"))


def window_that_lies(folder: Path) -> Path:
    """A message that says it holds 2^32 - 1 samples."""
    plain = struct.pack("<IIIQI", 44100, 1, 2**32 - 1, 5, 2**32 - 1)
    return bags.forge(folder / "a.bag", chunk(message(plain)))


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (zeros, "a.bag is not a bag of format 2.0"),
        (magic_and_zeros, "was not closed by its recorder, or is cut off"),
        (older_format, "a.bag is not a bag of format 2.0"),
        (long_header, "was not closed by its recorder, or is cut off"),
        (many_connections, "4294967295 connections, at most 10000 go"),
        (long_message, "is damaged: 3221225472 bytes are announced, at most 134218752 go there"),
        (message_beyond_the_chunk, "is damaged: 100000000 bytes are announced where 5 are left"),
        (chunk_beyond_the_file, "is damaged: 4294967295 bytes are announced"),
        (bz2_message, "is damaged: 4294967196 bytes are announced, at most 134218752 go there"),
        (bz2_of_others, "no stream 1 of sound in the bag"),
        (lz4_of_others, "no stream 1 of sound in the bag"),
        (window_that_lies, "samples are announced in a message of 24 bytes"),
    ],
)
def test_bags(tmp_path: Path, make: Callable[[Path], Path], why: str) -> None:
    done = play(f"bag:{make(tmp_path)}")
    assert done.code == 1 and why in done.err and done.err.count("\n") == 1, done
    assert done.megabytes < MEGABYTES


def test_code_in_a_bag_is_not_run(tmp_path: Path) -> None:
    """rosbag makes Python code of the definition of a type that it does not know; a constant's name goes into it."""
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
    with pytest.raises(ComponentError, match="of another version of its type"):
        open_source(f"bag:{path}", 0, 10, threading.Event())
    assert not mark.exists()
    with rosbag.Bag(str(path)) as bag:  # that the attack is one
        list(bag.read_messages(raw=True))
    assert mark.exists()


def test_stop_ends_the_search(tmp_path: Path) -> None:
    """A chunk of 4 GB out of few kB, again and again: hours of work."""
    plain = record(2, b"", 2**32 - 100, conn=number(7), time=number(0, 8))
    packed = bz2.compress(plain + bytes(900_000 * 20))
    path = bags.forge(tmp_path / "a.bag", chunk(packed + bytes(10**6), 2**32 - 1, b"bz2") * 50)
    small = record(2, b"", conn=number(7), time=number(0, 8)) * 100_000
    for name in ("a.bag", "b.bag"):
        if name == "b.bag":
            path = bags.forge(tmp_path / name, chunk(small) * 10)
        stopping = threading.Event()
        stopping.set()
        with pytest.raises(ComponentError, match="interrupted before its sound was found"):
            open_source(f"bag:{path}", 0, 10, stopping)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Small bags of each compression."""
    folder = tmp_path_factory.mktemp("good")
    messages = [bags.message(bags.stream(60), index, 20) for index in range(0, 61, 10)]
    return {
        kind: bags.write(folder / "a.bag", messages, compression=kind, chunk_threshold=400).read_bytes()
        for kind in ("none", "bz2", "lz4")
    }


@settings(max_examples=600, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=st.sampled_from(("none", "bz2", "lz4")), data=st.data())
def test_damaged_anyhow(
    good: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, data: st.DataObject
) -> None:
    """Bytes changed, lengths exaggerated, pieces cut out: it plays something, or is refused by name."""
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
    """The beginning of a WAV that says what it likes."""
    block = channels * bits // 8 & 0xFFFF
    header = struct.pack("<4sI4s4sI", b"RIFF", 2**32 - 1, b"WAVE", b"fmt ", 16)
    header += struct.pack("<HHIIHH", 1, channels, rate, rate * block & 0xFFFFFFFF, block, bits)
    return header + struct.pack("<4sI", b"data", size)


@pytest.mark.parametrize(
    ("name", "begin", "size"),
    [
        ("zeros.wav", b"", 10 * GIGABYTE),
        ("zeros.flac", b"fLaC", 10 * GIGABYTE),
        ("zeros.ogg", b"OggS", 2 * GIGABYTE),
        ("zeros.mp3", b"ID3\x04\0\0\x7f\x7f\x7f\x7f", 2 * GIGABYTE),
        ("zeros.aiff", b"FORM\x7f\xff\xff\xffAIFF", 2 * GIGABYTE),
        ("cut.wav", wav(2**30), 1000),
        ("channels.wav", wav(channels=1024), 3 * GIGABYTE),
        ("channels.wav", wav(channels=65535), 3 * GIGABYTE),
        ("rate.wav", wav(rate=2**32 - 1), 1000),
        ("rate.wav", wav(3000, rate=2**31 - 1), 3044),
        ("list.wav", b"RIFF\xff\xff\xff\xffWAVELIST\xf0\xff\xff\xff", 3 * GIGABYTE),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_sound_files(tmp_path: Path, name: str, begin: bytes, size: int) -> None:
    done = play(f"file:{sparse(tmp_path / name, begin, size)}")
    *others, line = done.err.splitlines()
    assert done.code == 1 and line.startswith("rosafe record: ") and name in line, done
    assert all("libmpg123" in other for other in others), done  # which tells more than it is asked
    assert done.megabytes < MEGABYTES


def test_a_long_silence_is_a_sound_file(tmp_path: Path) -> None:
    """Of 3 GB; what is played is read as it is played."""
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
def test_no_byte_of_another_file_is_told(tmp_path: Path, kind: str, begin: bytes, name: str) -> None:
    (tmp_path / name).write_bytes(begin + SECRET * 20)
    with pytest.raises(ComponentError) as caught:
        open_source(f"{kind}:{tmp_path / name}", 0, 10, threading.Event())
    text = json.dumps(caught.value.detail) + str(caught.value)
    parts = [SECRET[at : at + 3] for at in range(len(SECRET) - 2)]
    told = [part for part in parts if repr(part)[2:-1] in text or part.decode("latin-1") in text]
    assert not told, text


@pytest.mark.parametrize("kind", ["file", "bag"])
def test_what_is_no_file(tmp_path: Path, kind: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "fifo")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    for path in (
        "/dev/zero",
        "/dev/stdin",
        "/proc/self/mem",
        "/proc/kmsg",
        str(tmp_path),
        "fifo",
        "link",
        "round",
        "a/b",
    ):
        begin = time.monotonic()
        with pytest.raises(ComponentError) as caught:
            open_source(f"{kind}:{tmp_path / path}", 0, 10, threading.Event())
        assert caught.value.ex == "::bass::e_device" and time.monotonic() - begin < 5
