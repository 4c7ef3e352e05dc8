"""Threads leave kernels one by one (gil_handoff.c); a thread outside of kernels blocks no other; results are equal."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from rosafe.dsp import kernels
from rosafe.representations.haircell import InnerHairCell
from rosafe.representations.ild import Ild

THREADS, BLOCKS, PATIENCE = 6, 40, 60.0


def ild(seed: int, blocks: int = BLOCKS) -> np.ndarray:
    """Return the ILD of noise by a separate stage: two kernels for each block."""
    random, hair_cell, stage = np.random.default_rng(seed), InnerHairCell(44100.0), Ild(44100.0)
    levels = [stage.process(hair_cell.process(random.standard_normal((2, 3, 441)))) for _ in range(blocks)]
    return np.concatenate(levels, axis=-1)


@pytest.fixture(autouse=True)
def here() -> None:
    if not kernels.compiled():
        pytest.skip("no kernels here")


def test_concurrent_threads_get_the_same_results_as_single_ones() -> None:
    with ThreadPoolExecutor(THREADS) as pool:
        together = list(pool.map(ild, range(THREADS)))
    for seed, levels in enumerate(together):
        np.testing.assert_array_equal(levels, ild(seed))


@pytest.fixture
def away() -> Iterator[list[threading.Thread]]:
    """Start threads that have left a kernel and do something else for a long time; one of them has ended."""
    out, go = threading.Barrier(4), threading.Event()

    def leave(then: bool) -> None:
        ild(0, 1)
        out.wait(PATIENCE)
        if then:
            go.wait(PATIENCE)
            ild(0, 1)

    threads = [threading.Thread(target=leave, args=(then,)) for then in (True, False, True)]
    for thread in threads:
        thread.start()
    out.wait(PATIENCE)
    yield threads
    go.set()
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()


def test_no_thread_waits_for_one_that_is_away(away: list[threading.Thread]) -> None:
    expected = ild(5)
    with ThreadPoolExecutor(2) as pool:
        for levels in pool.map(ild, [5, 5, 5]):
            np.testing.assert_array_equal(levels, expected)


def test_a_forked_process_does_not_wait_for_threads_that_it_does_not_have(away: list[threading.Thread]) -> None:
    expected = ild(7)
    with get_context("fork").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply_async(ild, (7,)).get(PATIENCE), expected)
