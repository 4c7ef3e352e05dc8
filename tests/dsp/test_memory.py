"""Memory of very large blocks is used again, but never while somebody may still look at it."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from rosafe.dsp import memory

ROWS, LONG = (2, 3), 2**20  # 48 MiB


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_idle", {})


def place(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_used_again_when_the_last_view_is_gone() -> None:
    block = memory.empty((*ROWS, LONG))
    assert (block.shape, block.dtype, block.flags.c_contiguous, block.flags.writeable) == (
        (2, 3, LONG),
        float,
        True,
        True,
    )
    where, view = place(block), block[0].T[1:]
    del block
    other = memory.empty((*ROWS, LONG))
    assert place(other) != where
    del view
    assert place(memory.empty((*ROWS[::-1], LONG))) == where


def test_little_is_kept() -> None:
    blocks = [memory.empty((*ROWS, LONG + extra)) for extra in (0, 0, 0, 0, 1, 2, 3)]
    while blocks:
        blocks.pop(0)
    assert {size: len(kept) for size, kept in memory._idle.items()} == {6 * (LONG + 2): 1, 6 * (LONG + 3): 1}
    blocks = [memory.empty((*ROWS, LONG)) for _ in range(4)]
    blocks.clear()
    assert {size: len(kept) for size, kept in memory._idle.items()} == {
        6 * (LONG + 3): 1,
        6 * LONG: memory.MAX_IDLE_PER_SIZE,
    }
    for shape in ((2, 100), (2**9, 2**17), (0,), ()):
        assert memory.empty(shape).shape == shape
    assert len(memory._idle) == memory.SIZES


def test_many_threads() -> None:
    def work(seed: int) -> None:
        for round_ in range(30):
            block = memory.empty((*ROWS, LONG))
            block[0, 0, ::4096] = seed + round_
            good.append(bool((block[0, 0, ::4096] == seed + round_).all()))

    good: list[bool] = []
    threads = [threading.Thread(target=work, args=(seed * 1000,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert good == [True] * 120


def test_a_lack_of_memory_is_one_error(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def empty(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(np, "empty", empty)
    with pytest.raises(MemoryError):
        memory.empty((*ROWS, LONG))
    memory._PooledArray.__new__(memory._PooledArray)  # as if there were no memory for its attributes
    assert capfd.readouterr().err == ""
