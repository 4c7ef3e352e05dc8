"""The source `bag:`: the recorded stream frame by frame, losses, and rejected bags."""

from __future__ import annotations

import itertools
import os
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import String

from rosafe.audio.devices import SoundSource, base, open_source
from rosafe.interface import ComponentError
from tests.audio import bags

RATE, CHUNK, WINDOW = 1000, 10, 40


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the pacing, which test_file_source.py tests for all paced sources."""
    monkeypatch.setattr(base.Pacer, "wait", lambda pacer, frames: 0.0)


def open_bag(path: Path, options: str = "", rate: int = 0, chunk: int = CHUNK) -> SoundSource:
    return open_source(f"bag:{path}{options}", rate, chunk, threading.Event())


def chunks(source: SoundSource) -> Iterator[tuple[int, np.ndarray]]:
    while (chunk := source.read()) is not None:
        yield chunk.gap, chunk.samples


def play(source: SoundSource) -> np.ndarray:
    """Return all frames, with zeros for gaps, (2, frames)."""
    return np.concatenate([np.pad(samples, ((0, 0), (gap, 0))) for gap, samples in chunks(source)], axis=1)


def whole(samples: np.ndarray, indexes: range | list[int]) -> list[Any]:
    return [bags.message(samples, index, WINDOW) for index in indexes]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_each_frame_is_played_once(tmp_path: Path, compression: str) -> None:
    samples = bags.stream(300)
    bags.write(tmp_path / "a.bag", whole(samples, range(0, 301, CHUNK)), compression=compression)
    source = open_bag(tmp_path / "a.bag", chunk=7)
    assert source.sample_rate == RATE
    played = play(source)
    assert played.shape == (2, 301)  # the last chunk is padded
    assert np.array_equal(played[:, :300], samples) and not played[:, 300:].any()
    assert source.overruns == source.lost_frames == 0


def test_late_recording_starts_with_its_first_window(tmp_path: Path) -> None:
    samples = bags.stream(300)
    bags.write(tmp_path / "a.bag", whole(samples, range(120, 301, CHUNK)))
    assert np.array_equal(play(open_bag(tmp_path / "a.bag")), samples[:, 80:])
    assert np.array_equal(play(open_bag(tmp_path / "a.bag", "?start=0.1")), samples[:, 180:])


def test_losses_of_the_recording_are_losses_of_the_source(tmp_path: Path) -> None:
    samples = bags.stream(300)
    bags.write(tmp_path / "a.bag", whole(samples, [10, 20, 60, 80, 83, 200, 200, 240, 300]))
    # The windows of frames 60, 200 and 300 start at 21, 161 and 261.
    source = open_bag(tmp_path / "a.bag")
    expected = samples.copy()
    expected[:, 83:160] = expected[:, 240:260] = 0
    found = list(chunks(source))
    assert sum(gap for gap, _ in found) == 70 + 20  # 84 to 90 complete the chunk in which the loss starts
    assert np.array_equal(play(open_bag(tmp_path / "a.bag")), expected)
    assert (source.overruns, source.lost_frames) == (2, 97)


def test_the_length_of_windows_does_not_matter(tmp_path: Path) -> None:
    samples = bags.stream(200)
    windows = itertools.cycle((10, 100, 40))
    bags.write(tmp_path / "a.bag", [bags.message(samples, i, next(windows)) for i in range(0, 201, CHUNK)])
    assert np.array_equal(play(open_bag(tmp_path / "a.bag")), samples)


def test_loop_and_start(tmp_path: Path) -> None:
    samples = bags.stream(100)
    bags.write(tmp_path / "is it?.bag", whole(samples, range(0, 101, CHUNK)))
    source = open_bag(tmp_path / "is it?.bag", "?loop=1&start=0.07", chunk=40)
    looped = np.concatenate([samples for _, samples in itertools.islice(chunks(source), 6)], axis=1)
    assert np.array_equal(looped, np.tile(samples[:, 70:], 8))
    source.close()


def test_consecutive_streams(tmp_path: Path) -> None:
    """A latched message from before is skipped; the error at the end of a stream refers to the next one."""
    first, second, third = bags.stream(200, 1), bags.stream(150, 2), bags.stream(50, 3)
    bags.write(
        tmp_path / "a.bag",
        [
            bags.message(bags.stream(900), 900, WINDOW),  # latched
            *whole(first, range(0, 201, CHUNK)),
            *whole(second, range(0, 151, CHUNK)),
            *(bags.message(third, i, WINDOW, rate=2000) for i in range(0, 51, CHUNK)),
        ],
    )
    for option, samples in (("", first), ("?stream=2", second)):
        source = open_bag(tmp_path / "a.bag", option)
        played = [source.read() for _ in range(samples.shape[1] // CHUNK)]
        assert np.array_equal(np.concatenate([c.samples for c in played if c], axis=1), samples)
        with pytest.raises(ComponentError, match=r"a new stream begins in the bag; play it with \?stream=.") as caught:
            source.read()
        assert caught.value.ex == "::bass::e_device"
    source = open_bag(tmp_path / "a.bag", "?stream=3")
    assert source.sample_rate == 2000 and np.array_equal(play(source), third)
    with pytest.raises(ComponentError, match="stream 4 is not in the bag"):
        open_bag(tmp_path / "a.bag", "?stream=4")


def test_a_single_message_is_a_stream_if_there_is_no_other(tmp_path: Path) -> None:
    samples = bags.stream(900)
    bags.write(tmp_path / "a.bag", [bags.message(samples, 900, WINDOW)])
    assert np.array_equal(play(open_bag(tmp_path / "a.bag")), samples[:, -WINDOW:])


def test_topics(tmp_path: Path) -> None:
    import rosbag

    left, right = bags.stream(100, 1), bags.stream(100, 2)
    bags.write(tmp_path / "a.bag", whole(left, range(0, 101, CHUNK)), "/left/Audio")
    assert np.array_equal(play(open_bag(tmp_path / "a.bag")), left)  # the only port, whatever its name
    with rosbag.Bag(str(tmp_path / "a.bag"), "a") as bag:
        for message in whole(right, range(0, 101, CHUNK)):
            bag.write("/right/Audio", message)
        bag.write("/text", String("hello"))
    assert np.array_equal(play(open_bag(tmp_path / "a.bag", "?topic=/right/Audio")), right)
    for option, why in (
        ("", "expected one port Audio, got several; choose one with ?topic=: /left/Audio, /right/Audio"),
        ("?topic=/bass/Audio", "expected the topic /bass/Audio, got /left/Audio, /right/Audio"),
        ("?topic=/text", "expected /text to be a port Audio, got type std_msgs/String"),
        ("?topic=", "topic: expected a topic"),
    ):
        with pytest.raises(ComponentError) as caught:
            open_bag(tmp_path / "a.bag", option)
        assert caught.value.ex == "::bass::e_device" and why in caught.value.reason


@pytest.fixture(scope="module")
def bad_bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    samples = bags.stream(3000)
    bags.write(folder / "good.bag", whole(samples, range(0, 3001, CHUNK)), chunk_threshold=4096)
    bags.write(folder / "text.bag", [String("hello")], "/text")
    bags.write(folder / "empty.bag", [])
    bags.write(folder / "nothing.bag", whole(samples, [0, 0]))
    uneven = bags.message(samples, 100, WINDOW)
    uneven.right = uneven.right[:-1].copy()
    bags.write(folder / "uneven.bag", [uneven])
    data = (folder / "good.bag").read_bytes()
    (folder / "cut.bag").write_bytes(data[: len(data) // 2])
    (folder / "header.bag").write_bytes(data[:100])
    at = data.index(struct.pack("<II", 0, WINDOW), len(data) // 2) + 4  # after the upper half of lastFrameIndex
    (folder / "damaged.bag").write_bytes(data[:at] + struct.pack("<I", 10**9) + data[at + 4 :])
    (folder / "zero.bag").touch()
    (folder / "noise.bag").write_bytes(os.urandom(5000))
    (folder / "version.bag").write_bytes(b"#ROSBAG V9.9\n" + data[13:])
    return folder


@pytest.mark.parametrize(
    ("text", "exception", "why"),
    [
        ("", "e_device", "expected bag:PATH, got an empty path"),
        ("missing.bag", "e_device", "No such file"),
        ("zero.bag", "e_device", "is not a bag of format 2.0"),
        ("noise.bag", "e_device", "is not a bag of format 2.0"),
        ("version.bag", "e_device", "is not a bag of format 2.0"),
        ("header.bag", "e_device", "truncated; repair it with `rosbag reindex header.bag`"),
        ("cut.bag", "e_device", "was not closed by its recorder, or is truncated"),
        ("empty.bag", "e_device", "expected a port Audio (type bass/binaudio_portStruct), got none"),
        ("text.bag", "e_device", "expected a port Audio (type bass/binaudio_portStruct), got none"),
        ("nothing.bag", "e_device", "expected a start within the stream"),
        ("uneven.bag", "e_device", "40 left and 39 right samples"),
        ("good.bag?start=3", "e_device", "expected a start within"),
        ("good.bag?stream=2", "e_device", "stream 2 is not in the bag"),
        ("good.bag?stream=0", "e_device", "expected a whole number from 1 to 999999"),
        ("good.bag?speed=2", "e_device", "unknown option 'speed'; expected one of topic, stream, start, loop"),
        ("good.bag", "e_hwparams", "expected 44100 Hz, got 1000 Hz"),
        ("x" * 4000, "e_device", "too long"),
        ("a\0b", "e_device", "control characters"),
    ],
)
def test_unusable_bags_are_rejected(
    bad_bags: Path, monkeypatch: pytest.MonkeyPatch, text: str, exception: str, why: str
) -> None:
    monkeypatch.chdir(bad_bags)
    rate = 44100 if exception == "e_hwparams" else 0
    with pytest.raises(ComponentError) as caught:
        open_source(f"bag:{text}", rate, CHUNK, threading.Event())
    assert caught.value.ex == f"::bass::{exception}"
    assert why in caught.value.reason and "\n" not in caught.value.reason


def test_damage_in_the_middle_ends_the_source_with_an_error(bad_bags: Path) -> None:
    source = open_bag(bad_bags / "damaged.bag")
    with pytest.raises(
        ComponentError,
        match=r"damaged\.bag: expected a complete bag of format 2\.0, got one that is damaged: 1000000000 samples",
    ) as caught:
        play(source)
    assert caught.value.ex == "::bass::e_device"
