"""The difference between two clocks, read by a thread that has to wait between two readings."""

from __future__ import annotations

import time

import pytest

from rosafe.audio.devices.base import wall_time_ns
from rosafe.system.clocks import clock_difference

AHEAD = 1.7e9  # s


class Machine:
    """Two clocks, and a thread that waits for 30 ms before the readings whose numbers are in `waits`."""

    def __init__(self, *waits: int) -> None:
        self._waits, self._readings, self._now = waits, 0, 100.0

    def monotonic(self) -> float:
        self._now += 1e-6 + 0.03 * (self._readings in self._waits)
        self._readings += 1
        return self._now

    def time(self) -> float:
        return self.monotonic() + AHEAD

    def time_ns(self) -> int:
        return round(self.time() * 1e9)


@pytest.mark.parametrize("waits", [(), (0,), (1,), (2,), (1, 3), (2, 4, 7)])
def test_a_thread_that_waits_between_readings(waits: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(*waits)
    assert clock_difference(machine.time, machine.monotonic) == pytest.approx(AHEAD, abs=2e-6, rel=0)
    machine = Machine(*waits)
    for name in ("monotonic", "time", "time_ns"):
        monkeypatch.setattr(time, name, getattr(machine, name))
    moment = wall_time_ns(99.0)
    monkeypatch.undo()
    assert moment == pytest.approx((AHEAD + 99) * 1e9, abs=2e3, rel=0)


def test_a_thread_that_always_waits() -> None:
    """With equal waits before and after it, the clock was read in the middle."""
    machine = Machine(*range(1000))
    assert clock_difference(machine.time, machine.monotonic) == pytest.approx(AHEAD, abs=2e-6, rel=0)
