"""Buffers of very large blocks are reused, but never while a view exists."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from rosafe.dsp import buffer_pool

ROWS, LONG = (2, 3), 2**20  # 48 MiB


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffer_pool, "_idle", {})


def place(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_a_buffer_is_reused_after_its_last_view() -> None:
    block = buffer_pool.empty((*ROWS, LONG))
    assert (block.shape, block.dtype, block.flags.c_contiguous, block.flags.writeable) == (
        (2, 3, LONG),
        float,
        True,
        True,
    )
    where, view = place(block), block[0].T[1:]
    del block
    other = buffer_pool.empty((*ROWS, LONG))
    assert place(other) != where
    del view
    again = buffer_pool.empty((*ROWS[::-1], LONG))
    assert place(again) == where
    assert place(buffer_pool.empty((*ROWS, LONG))) != where, "two arrays have the same memory"


def test_few_buffers_are_kept() -> None:
    blocks = [buffer_pool.empty((*ROWS, LONG + extra)) for extra in (0, 0, 0, 0, 1, 2, 3)]
    while blocks:
        blocks.pop(0)
    assert {size: len(kept) for size, kept in buffer_pool._idle.items()} == {6 * (LONG + 2): 1, 6 * (LONG + 3): 1}
    blocks = [buffer_pool.empty((*ROWS, LONG)) for _ in range(4)]
    blocks.clear()
    assert {size: len(kept) for size, kept in buffer_pool._idle.items()} == {
        6 * (LONG + 3): 1,
        6 * LONG: buffer_pool.MAX_IDLE_PER_SIZE,
    }
    for shape in ((2, 100), (2**9, 2**17), (0,), ()):
        assert buffer_pool.empty(shape).shape == shape
    assert len(buffer_pool._idle) == buffer_pool.MAX_SIZES


def test_trim_frees_idle_buffers() -> None:
    used = buffer_pool.empty((*ROWS, LONG))
    used[:] = 1.0
    buffer_pool.empty((*ROWS, LONG))
    assert len(buffer_pool._idle) == 1
    buffer_pool.trim()
    assert not buffer_pool._idle and (used == 1.0).all()


def test_many_threads() -> None:
    def work(seed: int) -> None:
        for round_ in range(30):
            block = buffer_pool.empty((*ROWS, LONG))
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
        buffer_pool.empty((*ROWS, LONG))
    buffer_pool._PooledArray.__new__(buffer_pool._PooledArray)  # simulates a lack of memory for its attributes
    assert capfd.readouterr().err == ""
