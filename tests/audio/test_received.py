"""Sound in messages of other drivers: formats, lost messages, clocks, pauses, and messages that cannot be used."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rosafe.audio.devices import received
from rosafe.audio.devices.received import BYTES, ReceivedSource
from rosafe.interface import ComponentError
from tests.harness import wait_for

RATE, LENGTH = 16000, 160
OPTIONS = f"/audio?format=S16LE&rate={RATE}&of=2"
BEGIN = 1_700_000_000_000_000_000  # ns


def noise(frames: int, channels: int = 2, seed: int = 0) -> np.ndarray:
    """Return int32 samples, (frames, channels), whose lower 16 bits are zero."""
    return np.random.default_rng(seed).integers(-(2**15), 2**15, (frames, channels)).astype(np.int32) << 16


def encode(samples: np.ndarray, form: str) -> bytes:
    """Return interleaved int32 samples (frames, channels) in a format."""
    if form == "F32LE":
        return (samples / 2.0**31).astype("<f4").tobytes()
    raw = np.ascontiguousarray(samples, "<i4").view(np.uint8).reshape(-1, 4)
    return raw[:, 4 - BYTES[form] :].tobytes()


def opened(text: str = OPTIONS, chunk: int = 0, patience: float = 0.0) -> ReceivedSource:
    return ReceivedSource(text, 0, chunk, threading.Event(), patience)


def read(source: ReceivedSource) -> np.ndarray:
    """Return all sound that has arrived, with zeros for gaps, as if no more arrived."""
    parts = [np.zeros((2, 0), np.int32)]
    assert source._order is not None
    with source.arrived:
        source._put_all(source._order.flush())
    while source._queue:
        chunk = source.read()
        assert chunk is not None
        parts += [np.zeros((2, chunk.gap), np.int32), chunk.samples]
    return np.concatenate(parts, axis=1)


class Driver:
    """Sends successive messages of a signal to a source."""

    def __init__(self, source: ReceivedSource, signal: np.ndarray, length: int = LENGTH) -> None:
        self.source, self.signal, self.length = source, signal, length
        self.number = 0

    def send(
        self, count: int = 1, late: Callable[[int], float] = lambda number: 0.0, numbered: bool = False, **fields: Any
    ) -> None:
        """Send messages with exact stamps, later by `late(number)` seconds."""
        for _ in range(count):
            first = self.number * self.length
            data = encode(self.signal[first : first + self.length], "S16LE")
            stamp = BEGIN + round((first / RATE + late(self.number)) * 1e9)
            number = self.number if numbered else None
            self.source.receive(data, stamp, number, **fields)
            self.number += 1

    def lose(self, count: int) -> None:
        self.number += count


@pytest.fixture
def source() -> ReceivedSource:
    return opened()


@pytest.mark.parametrize("form", BYTES)
@pytest.mark.parametrize(("channels", "ears"), [(1, (1, 1)), (2, (1, 2)), (4, (3, 2)), (64, (64, 1))])
def test_formats(form: str, channels: int, ears: tuple[int, int]) -> None:
    samples = noise(50, channels)
    options = f"?format={form.lower()}&rate=44100&of={channels}&channels={ears[0]},{ears[1]}"
    source = opened("/audio" + options)
    source.receive(encode(samples, form), BEGIN)
    source.begin()
    expected = samples[:, [ear - 1 for ear in ears]].T
    if form == "F32LE":  # full scale is 2^31 - 1, as in files
        expected = np.rint(expected / 2.0**31 * (2**31 - 1)).astype(np.int32)
    assert source.sample_rate == 44100 and np.array_equal(read(source), expected)


def test_lower_bits_and_floats_beyond_full_scale() -> None:
    exact = np.array([[-(2**31), 2**31 - 1, 0x01020304, -1]], np.int32).T
    for form, mask in (("S24LE", ~0xFF), ("S32LE", ~0)):
        source = opened(f"/audio?format={form}&rate=8000&of=1&channels=1,1")
        source.receive(encode(exact, form), BEGIN)
        assert np.array_equal(read(source)[0], exact[:, 0] & mask)
    source = opened("/audio?format=F32LE&rate=8000&of=1&channels=1,1")
    source.receive(np.array([1.0, -1.0, 1.5, -np.inf, np.nan], "<f4").tobytes(), BEGIN)
    source.receive(np.array([2.0], "<f4").tobytes(), BEGIN)
    assert read(source)[0].tolist() == [2**31 - 1, 1 - 2**31, 2**31 - 1, 1 - 2**31, 0, 2**31 - 1]
    assert len(source.remarks) == 2 and "are clipped" in source.remarks[1]


def test_lost_messages_by_stamps(source: ReceivedSource) -> None:
    """Also two losses in short succession, late messages before and after, and a loss at the end."""
    signal = noise(200 * LENGTH)
    driver = Driver(source, signal)
    driver.send(30)
    driver.lose(1)
    driver.send(3)
    driver.lose(7)
    driver.send(40, late=lambda number: 0.012 if number % 9 == 0 else 0.001 * (number % 3))
    driver.lose(20)
    driver.send(40)
    for lost in (slice(30, 31), slice(34, 41), slice(81, 101)):
        signal[lost.start * LENGTH : lost.stop * LENGTH] = 0
    sound = read(source)
    assert np.array_equal(sound, signal[: driver.number * LENGTH].T)
    assert (source.overruns, source.lost_frames) == (3, 28 * LENGTH)


@pytest.mark.parametrize("jitter", [0.0, 0.0005, 0.003])  # s; messages of 5 and 10 ms
def test_random_losses_are_found_where_they_are(jitter: float) -> None:
    """Also at the beginning, when the jitter is not known, and in short succession."""
    for seed in range(24):
        random = np.random.default_rng(seed)
        signal = noise(400 * LENGTH, seed=seed)
        source = opened()
        driver = Driver(source, signal, LENGTH // 2 if seed % 2 else LENGTH)
        expected = signal.copy()
        while driver.number * driver.length < 380 * LENGTH:
            if driver.number > 150 and random.random() < 0.02:
                lost = int(random.integers(1, 8))
                expected[driver.number * driver.length :][: lost * driver.length] = 0
                driver.lose(lost)
            driver.send(late=lambda _: random.uniform(0, jitter), numbered=seed % 3 == 0)  # noqa: B023
        driver.send(5)
        assert np.array_equal(read(source), expected[: driver.number * driver.length].T), seed


def test_overruns_of_the_driver_are_no_whole_messages(source: ReceivedSource) -> None:
    signal = noise(100 * LENGTH)
    driver = Driver(source, signal)
    driver.send(50, numbered=True)
    driver.send(50, late=lambda _: 1234 / RATE, numbered=True)
    sound = read(source)
    assert source.lost_frames == 1234 and np.array_equal(sound[:, 50 * LENGTH + 1234 :], signal[50 * LENGTH :].T)


@pytest.mark.parametrize("numbered", [False, True])
def test_late_messages_lose_nothing(source: ReceivedSource, numbered: bool) -> None:
    """Stamps of the time of publication: a delay that changes, stalls of up to 0.3 s with a burst after them."""
    random = np.random.default_rng(1)
    signal = noise(1000 * LENGTH)
    driver = Driver(source, signal)
    stall = {200: 0.3, 500: 0.15, 800: 0.05}

    def stalled(number: int) -> float:
        """Messages of a stall are all published at its end."""
        ends = [begin * 0.01 + seconds for begin, seconds in stall.items() if begin <= number]
        return max(0.0, *(end - number * 0.01 for end in ends)) if ends else 0.0

    for number in range(1000):
        driver.send(late=lambda number: max(stalled(number), 0.004 * random.random()), numbered=numbered)
        assert stalled(number) or source._waiting == driver.number * LENGTH, f"message {number} is held"
    assert np.array_equal(read(source), signal.T) and source.lost_frames == 0 and source.remarks == []


def test_the_clock_of_the_samples_drifts(source: ReceivedSource) -> None:
    signal = noise(3000 * LENGTH)
    for drift in (300e-6, -300e-6):
        fresh = opened()
        Driver(fresh, signal).send(3000, late=lambda number: drift * number * 0.01)  # noqa: B023  # called at once
        assert np.array_equal(read(fresh), signal.T) and fresh.lost_frames == 0


def test_numbers_show_single_losses_at_once_and_without_stamps() -> None:
    signal = noise(10 * LENGTH)
    for stamped in (True, False):
        source = opened()
        for number in (0, 1, 3, 4):
            data = encode(signal[number * LENGTH : (number + 1) * LENGTH], "S16LE")
            source.receive(data, (BEGIN + number * 10**7) * stamped, number + 7)
        assert source._waiting == 4 * LENGTH
        sound = read(source)
        signal[2 * LENGTH : 3 * LENGTH] = 0
        assert np.array_equal(sound, signal[: 5 * LENGTH].T) and source.lost_frames == LENGTH


@pytest.mark.parametrize("delay", [0.0005, 0.004, 0.006, 0.0095])
@pytest.mark.parametrize("named", [True, False])  # ROS 2 does not name the publisher of a message
def test_a_second_publisher_is_named_and_not_used(source: ReceivedSource, named: bool, delay: float) -> None:
    signals = noise(250 * LENGTH), noise(250 * LENGTH, seed=1)
    drivers = [Driver(source, signal) for signal in signals]
    drivers[0].send(120, publisher="/a" * named)
    drivers[1].lose(120)
    for _ in range(100):
        drivers[0].send(publisher="/a" * named)
        drivers[1].send(publisher="/b" * named, late=lambda _: delay)
    sound = read(source)
    assert source.lost_frames == 0 and abs(sound.shape[1] - 220 * LENGTH) <= LENGTH
    assert np.array_equal(sound[:, : 120 * LENGTH], signals[0][: 120 * LENGTH].T)
    left = sound[0].tobytes()
    used = [signal[175 * LENGTH : 215 * LENGTH, 0].tobytes() in left for signal in signals]
    assert used[0] if named else any(used)
    text = "a second publisher, /b, are not used" if named else "another message has their time; stop other publishers"
    assert text in source.remarks[0]


def test_another_publisher_follows_after_a_pause(source: ReceivedSource, monkeypatch: pytest.MonkeyPatch) -> None:
    signal = noise(100 * LENGTH)
    driver = Driver(source, signal)
    driver.send(20, publisher="/a", numbered=True)
    driver.lose(50)
    monkeypatch.setattr(received, "PAUSE_SECONDS", 0.0)
    driver.send(30, publisher="/b", numbered=True)
    sound = read(source)
    assert source.lost_frames == 50 * LENGTH and np.array_equal(sound[:, 70 * LENGTH :], signal[70 * LENGTH :].T)
    assert source.remarks == [f"{source.name}: the sound continues with messages of /b"]


@pytest.mark.parametrize("step", [-3600.0, -0.5])
def test_the_clock_is_set_back(source: ReceivedSource, step: float) -> None:
    signal = noise(200 * LENGTH)
    driver = Driver(source, signal)
    driver.send(120)
    driver.send(80, late=lambda _: step)
    assert np.array_equal(read(source), signal.T) and source.lost_frames == 0
    text = f"the clock of the stamps was set back by {-step:.3f} s; the sound continues"
    assert source.remarks == [f"{source.name}: {text}"]


def test_a_long_gap_and_one_that_is_too_long(source: ReceivedSource) -> None:
    signal = noise(60 * LENGTH)
    driver = Driver(source, signal)
    driver.send(20)
    driver.send(20, late=lambda _: 3000.0)
    assert read(source).shape[1] == 40 * LENGTH + 3000 * RATE == source.lost_frames + 40 * LENGTH
    driver.send(20, late=lambda _: 6700.0)
    with pytest.raises(ComponentError, match=r"a new stream begins \(its stamps jump by 3700 s\); call Acquire"):
        source.read()


def test_unnumbered_and_unbroken_stamps_of_the_time_of_publication(source: ReceivedSource) -> None:
    """Whole messages are lost, with a delay that changes by milliseconds; publishers number what they have sent."""
    for numbers in (True, False):
        source, random, sent = opened(), np.random.default_rng(2), itertools.count(1)
        signal = noise(900 * LENGTH)
        driver = Driver(source, signal)
        for count, lost in ((200, 1), (250, 4), (220, 30), (190, 0)):
            for _ in range(count):
                number = driver.number
                data = encode(signal[number * LENGTH : (number + 1) * LENGTH], "S16LE")
                stamp = BEGIN + round((number * 0.01 + 0.01 + random.exponential(0.0005)) * 1e9)
                source.receive(data, stamp, next(sent) if numbers else None)
                driver.number += 1
            driver.lose(lost)
        for begin, end in ((200, 201), (451, 455), (675, 705)):
            signal[begin * LENGTH : end * LENGTH] = 0
        assert np.array_equal(read(source), signal[: 895 * LENGTH].T), numbers


def test_a_single_wrong_stamp_changes_nothing(source: ReceivedSource) -> None:
    signal = noise(200 * LENGTH)
    Driver(source, signal).send(200, late=lambda number: {50: -1.0, 120: 7.0, 150: -0.02}.get(number, 0.0))
    assert np.array_equal(read(source), signal.T) and source.lost_frames == 0 and source.remarks == []


def test_a_wrong_rate_is_named() -> None:
    for rate, fits in ((48000, False), (8000, False), (RATE, True)):
        source = opened(OPTIONS.replace(f"rate={RATE}", f"rate={rate}"))
        Driver(source, noise(800 * LENGTH)).send(800)
        found = [text for text in source.remarks if f"expected {rate} frames per second, got 160" in text]
        assert bool(found) != fits, (rate, source.remarks)


def test_wrong_sizes_count_as_lost(source: ReceivedSource) -> None:
    signal = noise(4 * LENGTH)
    driver = Driver(source, signal)
    driver.send()
    source.receive(encode(signal[LENGTH : 2 * LENGTH], "S16LE") + b"x", BEGIN + 10**7)
    driver.lose(1)
    driver.send(2)
    signal[LENGTH : 2 * LENGTH] = 0
    assert np.array_equal(read(source), signal.T) and source.lost_frames == LENGTH
    why = "expected a multiple of 4 bytes (S16LE at 16000 Hz with 2 channels), got 641; check ?format= and ?of=; "
    assert source.remarks == [f"topic:{OPTIONS}: {why}the message counts as lost"]


INFO: dict[str, Any] = {"channels": 2, "sample_rate": RATE, "sample_format": "S16LE", "coding_format": "wave"}


@pytest.mark.parametrize(
    ("text", "info", "code", "why"),
    [
        ("", {}, "e_device", "topic: expected topic:NAME, such as topic:/audio, got an empty name"),
        ("/a?x=1", {}, "e_device", "unknown option 'x'"),
        ("/a?format=S16BE", {}, "e_device", "format: expected one of S16LE, S24LE, S32LE, F32LE, got 'S16BE'"),
        ("/a?of=65", {}, "e_device", "of: expected a whole number from 1 to 64, got '65'"),
        ("/a?channels=0,1", {}, "e_device", "channels: expected two channel numbers from 1 to 64"),
        ("/a?format=S16LE&rate=8000&of=4", {}, "e_hwparams", "expected 2 channels, got 4; choose two with ?channels"),
        ("/a", {"channels": 1}, "e_hwparams", "expected 2 channels, got 1; ?channels=1,1 uses it for both ears"),
        ("/a?channels=2,3", {}, "e_hwparams", "expected channels from 1 to 2, got 3"),
        ("/a", {"channels": 65}, "e_hwparams", "expected 1 to 64 channels, got 65"),
        ("/a", {"sample_rate": 0}, "e_hwparams", "expected 1 to 768000 Hz, got 0; choose one with ?rate="),
        ("/a", {"sample_rate": 8000}, "e_hwparams", "expected 16000 Hz, got 8000 Hz"),
        ("/a", {"sample_format": "U8"}, "e_hwparams", "expected one of S16LE, S24LE, S32LE, F32LE, got 'U8'"),
        ("/a", {"coding_format": "mp3"}, "e_device", "got 'mp3'; set the driver's format to wave, or decode"),
        ("/a?rate=16000", {"coding_format": "vorbis"}, "e_device", "expected uncoded samples, got 'vorbis'"),
        ("/a", None, "e_device", "no message in a known format has arrived; without AudioInfo, add ?format="),
        ("/a", {}, "e_device", "no message has arrived; start the driver"),
    ],
)
def test_unusable_formats(text: str, info: dict[str, Any] | None, code: str, why: str) -> None:
    with pytest.raises(ComponentError) as raised:
        source = ReceivedSource(text, RATE, 0, threading.Event())
        if info is not None:
            source.describe(**{**INFO, **info})
        source.begin(seconds=0.01)
    assert raised.value.ex == f"::bass::{code}" and why in raised.value.reason


def test_an_absent_topic() -> None:
    with pytest.raises(ComponentError, match=r"topic:/a: the topic has no publisher; start the driver"):
        opened("/a").begin("the topic has no publisher", 0.01)


@pytest.mark.parametrize(
    ("begin", "kind"), [(b"ID3\4", "MP3"), (b"OggS", "Ogg"), (b"RIFF", "a WAV file"), (b"\xff\xfb\x90\x64", "MP3")]
)
def test_coded_sound_that_is_not_described(begin: bytes, kind: str) -> None:
    source = opened()
    for number in range(3):
        source.receive(begin + bytes(4 * LENGTH), BEGIN + number * 10**7)
    with pytest.raises(ComponentError, match=f"got '{kind}'; set the driver's format to wave"):
        source.begin()
        while source.read() is not None:
            pass


def test_the_description_may_repeat_but_not_change(source: ReceivedSource) -> None:
    source = opened("/audio")
    for _ in range(2):
        source.describe(**INFO)
        source.receive(encode(noise(LENGTH), "S16LE"), BEGIN)
    source.describe(**{**INFO, "channels": 4})
    source.receive(encode(noise(LENGTH), "S16LE"), BEGIN + 10**7)
    assert np.array_equal(read(source), np.concatenate([noise(LENGTH).T] * 2, axis=1))
    with pytest.raises(ComponentError, match=r"topic:/audio: expected 2 channels, got 4; choose two with"):
        source.read()
    source = opened("/audio")
    source.describe(**INFO)
    source.describe(**{**INFO, "sample_format": "F32LE"})
    with pytest.raises(ComponentError, match=r"the format changes from S16LE at .* to F32LE .*; call Acquire"):
        source.read()


def test_a_first_message_of_a_wrong_size() -> None:
    source = opened()
    source.receive(bytes(3), BEGIN)
    with pytest.raises(ComponentError, match=r"expected a multiple of 4 bytes \(S16LE .* got 3; check \?format="):
        source.begin()


def test_chunks_and_their_times() -> None:
    signal = noise(100 * LENGTH)
    source = opened(chunk=400)
    driver = Driver(source, signal)
    driver.send(50)
    driver.lose(10)
    driver.send(40)
    signal[50 * LENGTH : 60 * LENGTH] = 0
    frames, offset = 0, time.time() - time.monotonic()
    while frames < 99 * LENGTH - 400:
        chunk = source.read()
        assert chunk is not None and chunk.samples.shape == (2, 400)
        frames += chunk.gap + 400
        assert np.array_equal(chunk.samples, signal[frames - 400 : frames].T)
        assert abs(chunk.time + offset - BEGIN * 1e-9 - frames / RATE) < 0.01
    assert source.lost_frames == 10 * LENGTH


def test_a_slow_reader_loses_sound_and_needs_no_more_memory(
    source: ReceivedSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(received, "MAX_WAITING", 10 * LENGTH)
    signal = noise(40 * LENGTH)
    driver = Driver(source, signal)
    driver.send(30)
    assert source.behind == 0.1 and np.array_equal(read(source), signal[: 10 * LENGTH].T)
    driver.send(10)
    sound = read(source)
    assert not sound[:, : 20 * LENGTH].any() and np.array_equal(sound[:, 20 * LENGTH :], signal[30 * LENGTH :].T)
    assert (source.overruns, source.lost_frames) == (1, 20 * LENGTH)


@pytest.mark.parametrize("stamped", [True, False])
def test_a_pause_is_named_and_counts_as_lost(stamped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without stamps, the length of the pause is that between the times of arrival."""
    monkeypatch.setattr(received, "PAUSE_SECONDS", 0.4)
    source = opened(patience=np.inf)
    begin = time.monotonic()
    data = encode(noise(LENGTH), "S16LE")
    source.receive(data, BEGIN * stamped)
    assert source.read() is not None
    pause = source.read()
    assert pause is not None and pause.samples.shape == (2, 0) and source.problem.startswith("no sound for ")
    assert source.remarks == [f"{source.name}: {source.problem}; waiting for its publisher"]
    source.receive(data, (BEGIN + 8 * 10**8) * stamped)  # a single one, which is held at first
    seconds = time.monotonic() - begin
    chunk = source.read()
    assert chunk is not None and np.array_equal(chunk.samples, noise(LENGTH).T)
    assert chunk.gap == 0.8 * RATE - LENGTH if stamped else 0.1 * RATE < chunk.gap <= seconds * RATE
    assert source.problem == "" and source.lost_frames == chunk.gap


def test_end_of_patience_and_stop() -> None:
    source = opened(patience=0.01)
    source.receive(encode(noise(LENGTH), "S16LE"), BEGIN)
    assert source.read() is not None
    while (chunk := source.read()) is not None:  # the pause
        assert chunk.samples.shape == (2, 0)
    stopping = threading.Event()
    source = ReceivedSource(OPTIONS, 0, 0, stopping)
    thread = threading.Thread(target=source.read)
    thread.start()
    stopping.set()
    wait_for(lambda: not thread.is_alive())
