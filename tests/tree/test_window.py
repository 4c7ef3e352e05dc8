"""Windows and histories against plain concatenation, for blocks of any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rosafe.tree.window import MAX_PIECES, History, SlidingWindow, WindowView, frames_in

ROWS = st.sampled_from([(2,), (2, 3), (3,), (2, 5)])
SIZES = st.lists(st.one_of(st.integers(0, 5), st.integers(0, 60)), max_size=3 * MAX_PIECES)


def numbered(rows: tuple[int, ...], sizes: list[int]) -> list[NDArray[np.float64]]:
    """Blocks of these lengths, in which no two numbers are alike."""
    count = sum(sizes) * int(np.prod(rows))
    whole = np.arange(1.0, count + 1.0).reshape(*rows, sum(sizes))
    return np.split(whole, np.cumsum(sizes)[:-1], axis=-1) if sizes else []


@settings(deadline=None)
@given(ROWS, st.integers(0, 80), SIZES)
@example((2,), 70, [1] * (2 * MAX_PIECES + 10))
def test_a_window_is_the_newest_frames_after_zeros(rows: tuple[int, ...], frames: int, sizes: list[int]) -> None:
    window = SlidingWindow(rows, frames)
    model = np.zeros((*rows, frames))
    seen: list[tuple[WindowView, NDArray[np.float64]]] = [(window.view(), model)]
    for block in numbered(rows, sizes):
        window.append(block)
        model = np.concatenate((model, block), axis=-1)[..., block.shape[-1] :]
        seen.append((window.view(), model))
    for view, expected in seen:  # what a view showed at its time it still shows
        assert view.shape == expected.shape == (*rows, frames)
        assert view.frames == frames
        assert len(view.pieces) <= MAX_PIECES
        np.testing.assert_array_equal(view.array(), expected)


@settings(deadline=None)
@given(ROWS, st.integers(0, 80), st.lists(st.one_of(st.none(), st.integers(0, 40)), max_size=3 * MAX_PIECES))
@example((2,), 70, [1] * (2 * MAX_PIECES + 10))
def test_a_history_is_what_came_since_it_was_taken(
    rows: tuple[int, ...], capacity: int, steps: list[int | None]
) -> None:
    """None stands for somebody who takes it."""
    history = History(rows, 100.0, capacity / 100)
    assert history.capacity == capacity
    blocks = iter(numbered(rows, [step for step in steps if step is not None]))
    model = np.zeros((*rows, 0))
    taken = []
    for step in [*steps, None]:
        if step is None:
            taken.append((history.take(), model))
            model = np.zeros((*rows, 0))
        else:
            block = next(blocks)
            history.append(block)
            model = np.concatenate((model, block), axis=-1)
            model = model[..., max(0, model.shape[-1] - capacity) :]
    for view, expected in taken:
        assert view.shape == expected.shape
        assert len(view.pieces) <= MAX_PIECES
        np.testing.assert_array_equal(view.array(), expected)


@settings(deadline=None)
@given(st.integers(1, 40), SIZES)
def test_views_of_a_part_and_of_exchanged_rows(frames: int, sizes: list[int]) -> None:
    window = SlidingWindow((2, 3), frames)
    for block in numbered((2, 3), sizes):
        window.append(block)
    view = window.view()
    whole = view.array()
    for row in (0, 1):
        np.testing.assert_array_equal(view.select(row).array(), whole[row])
        assert view.select(row).shape == (3, frames)
    np.testing.assert_array_equal(view.swap_rows().array(), whole.swapaxes(0, 1))
    target = np.full((2, 3, frames), np.nan)
    view.copy_to(target)
    np.testing.assert_array_equal(target, whole)


def test_blocks_are_referred_to_and_not_copied() -> None:
    block = np.ones((2, 10))
    window, history = SlidingWindow((2,), 25), History((2,), 100.0, 0.25)
    window.append(block)
    history.append(block)
    assert window.view().pieces[-1] is block
    assert history.take().pieces == (block,)


def test_an_empty_window_costs_no_memory() -> None:
    """A port of ten minutes exists before the first block."""
    view = SlidingWindow((2, 31), 600 * 44100).view()
    assert view.shape == (2, 31, 26_460_000)
    assert view.pieces[0].strides[:-1] == (0, 0), "all rows are one, of zeros that the system has not handed out yet"


@pytest.mark.parametrize(
    ("seconds", "rate", "frames"),
    [
        (1.0, 44100.0, 44100),
        (0.5, 100.0, 50),
        (0.29, 100.0, 29),  # 28.999999999999996
        (1.0, 44100 / 551, 80),
        (1.0, 80.9999, 80),
        (0.3, 0.1, 0),
        (0.0, 44100.0, 0),
        (600.0, 100.0, 60000),
    ],
)
def test_frames_in_so_many_seconds(seconds: float, rate: float, frames: int) -> None:
    assert frames_in(seconds, rate) == frames
