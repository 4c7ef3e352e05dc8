"""The sound of the ROS 2 node and the numbers of frames, with scripted devices and without ROS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rosafe.audio.devices.base import PacedSource, device_error
from rosafe.interface import ComponentError
from rosafe.localization.rotations import RotationBuffer
from rosafe.ros2 import sound as sound_module
from rosafe.ros2.sound import Sound
from rosafe.tree.tree_planner import NewProcessor
from tests.harness import wait_for

RATE, CHUNK = 8000, 80


class _Device(PacedSource):
    """Chunks of ones; fails after `count` of them, or ends."""

    def __init__(self, count: int, fails: bool, stopping: threading.Event) -> None:
        super().__init__("scripted", stopping)
        self._count, self._fails = count, fails
        self._start(RATE, CHUNK, self._scripted())

    def _scripted(self) -> Iterator[tuple[int, np.ndarray]]:
        for _ in range(self._count):
            yield 0, np.ones((2, CHUNK), np.int32)
        if self._fails:
            raise device_error("scripted: unplugged")


def _read(sound: Sound, frames: int) -> np.ndarray:
    """Return all samples that arrive."""
    reader = sound.reader
    assert reader is not None
    parts: list[np.ndarray] = []
    while sum(part.shape[1] for part in parts) < frames:
        got: Any = wait_for(reader.read)
        parts.append(got[0])
        assert got[1] - 1 == reader.end_of(len(parts) - 1)
    return np.concatenate(parts, axis=1)


def test_a_lost_device_is_acquired_again_and_the_frames_between_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound_module, "RETRY_SECONDS", 0.05)
    lines: list[str] = []
    log = SimpleNamespace(info=lines.append, warning=lines.append, error=lines.append)
    opened: list[int] = []

    def open_device(device: str, rate: int, chunk: int, stopping: threading.Event) -> Any:
        opened.append(rate)
        if len(opened) == 2:
            raise device_error("scripted: still unplugged")
        return _Device(5, len(opened) == 1, stopping)

    sound = Sound(lambda: 0.0, log, lambda *_: None, open_device)
    with pytest.raises(ComponentError, match="no sound: call ~/acquire"):
        sound.open_input(_new_input(), lambda source: None)
    sound.acquire(
        "scripted", 0, CHUNK, lambda rate: None, lambda: sound.open_input(_new_input(), lambda _: cast(Any, True))
    )
    wait_for(lambda: any("the acquisition has ended" in line for line in lines))
    assert opened == [0, RATE, RATE]
    samples = _read(sound, sound.ring.frames.newest // CHUNK * CHUNK)
    assert samples[0, : 5 * CHUNK].all() and samples[0, -4 * CHUNK :].all()
    assert np.count_nonzero(samples[0] == 0) == sound.ring.counters.lost > 0.1 * RATE
    assert any("scripted: unplugged; it is acquired again" in line for line in lines)
    assert "capturing from scripted again" in lines
    sound.stop()


def test_an_acquisition_that_is_rejected_changes_nothing() -> None:
    log = SimpleNamespace(info=lambda _: None, warning=lambda _: None, error=lambda _: None)
    sound = Sound(lambda: 0.0, log, lambda *_: None, lambda device, rate, chunk, stop: _Device(10**6, False, stop))
    sound.acquire("first", 0, CHUNK, lambda rate: None, lambda: None)
    wait_for(lambda: sound.ring.frames.newest > CHUNK)

    def reject(rate: float) -> None:
        raise device_error(f"not at {rate:g} Hz")

    with pytest.raises(ComponentError, match="not at 8000 Hz"):
        sound.acquire("second", 0, CHUNK, reject, lambda: None)
    newest = sound.ring.frames.newest
    wait_for(lambda: sound.ring.frames.newest > newest)
    assert sound.device == "first" and sound.ring.counters.streams == 1
    sound.stop()
    assert sound.device == ""


def _new_input() -> NewProcessor:
    return NewProcessor("input", "input", "", {}, {"nFramesPerBlock": CHUNK})


def test_rotations_are_those_of_slerp() -> None:
    reports: list[str] = []
    buffer = RotationBuffer("map", "head", lambda line, kind: reports.append(kind))
    times = np.array([0.0, 0.5, 1.25])
    base, neck = Rotation.random(3, random_state=1), Rotation.random(3, random_state=2)
    fixed = Rotation.random(random_state=3)
    buffer.add("head", "neck", 0.0, tuple(fixed.as_quat()), static=True)
    buffer.add("neck", "base", 0.0, (0.0, 0.0, 0.0, 1.0), static=False)
    for index in (0, 2, 1):  # one is late
        for child, parent, turn in (("base", "map", base), ("/neck", "base", neck)):
            buffer.add(child, parent, times[index], tuple(-turn[index].as_quat()), static=False)
            buffer.add("arm", "base", times[index], (0.0, 0.0, 0.0, 1.0), static=False)
        assert index or buffer.rotation(0.3) is None
    assert not buffer._frames["arm"].turns, "it is not above the head"
    for moment in (0.0, 0.3, 0.5, 1.0, 1.25):
        expected = Slerp(times, base)(moment) * Slerp(times, neck)(moment) * fixed
        found = buffer.rotation(moment)
        assert found is not None
        assert (Rotation.from_quat(found) * expected.inv()).magnitude() < 1e-12
    assert buffer.rotation(1.26) is None and buffer.rotation(-0.01) is None
    buffer.add("neck", "base", 2.0, (0.0, 0.0, 0.0, 2.0), static=False)
    buffer.add("neck", "neck", 2.0, (0.0, 0.0, 0.0, 1.0), static=False)
    buffer.add("neck", "base", float("nan"), (0.0, 0.0, 0.0, 1.0), static=False)
    assert reports == ["invalid"] * 3 and buffer.rotation(1.0) is not None
    buffer.clear()
    assert buffer.rotation(1.0) is None
