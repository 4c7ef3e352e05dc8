"""Windows and histories against plain concatenation, for blocks of any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block
from rosafe.tree.history import History
from rosafe.tree.sliding_window import MAX_PIECES, SlidingWindow, WindowView, frames_in

ROWS = st.sampled_from([(2,), (2, 3), (3,), (2, 5)])
SIZES = st.lists(st.one_of(st.integers(0, 5), st.integers(0, 60)), max_size=3 * MAX_PIECES)


def numbered(rows: tuple[int, ...], sizes: list[int]) -> list[NDArray[np.float64]]:
    """Blocks of these lengths, in which no two numbers are alike."""
    count = sum(sizes) * int(np.prod(rows))
    whole = np.arange(1.0, count + 1.0).reshape(*rows, sum(sizes))
    return np.split(whole, np.cumsum(sizes)[:-1], axis=-1) if sizes else []


@settings(deadline=None)
@given(ROWS, st.integers(0, 80), SIZES)
@example((2,), 2 * MAX_PIECES + 50, [1] * (3 * MAX_PIECES))
@example((2, 3), 2 * MAX_PIECES + 7, [2, 1, 0] * MAX_PIECES)
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
@given(ROWS, st.integers(0, 80), st.lists(st.one_of(st.sampled_from("ab"), st.integers(0, 40)), max_size=40))
@example((2,), 2 * MAX_PIECES + 50, ["a", *[1] * (2 * MAX_PIECES), "a", *[1] * MAX_PIECES, "b", *[1] * 30])
def test_a_history_is_what_came_since_it_was_taken(
    rows: tuple[int, ...], capacity: int, steps: list[int | str]
) -> None:
    """Each reader (a word) has a memory of its own, and the second part goes with the first."""
    signal = SignalFormat.sound(100.0)
    history = History([rows, (7,)], signal, capacity / 100)
    sizes = [step for step in steps if isinstance(step, int)]
    blocks = zip(numbered(rows, sizes), numbered((7,), sizes), strict=True)
    came = [np.zeros((*rows, 0)), np.zeros((7, 0))]
    read: dict[str, int] = {}
    taken = []
    for step in [*steps, "a", "b"]:
        if isinstance(step, str):
            end = came[0].shape[-1]
            first = max(read.get(step, 0), end - capacity)
            taken.append((history.read_new(step), [part[..., first:] for part in came], end))
            read[step] = end
        else:
            parts = next(blocks)
            end = came[0].shape[-1] + step
            history.append(Block(0, parts, end, signal))
            came = [np.concatenate(pair, axis=-1) for pair in zip(came, parts, strict=True)]
    for (views, next_index, its_signal), expected, end in taken:
        assert (next_index, its_signal) == (end, signal)
        for view, part in zip(views, expected, strict=True):
            assert view.shape == part.shape
            assert len(view.pieces) <= MAX_PIECES
            np.testing.assert_array_equal(view.array(), part)


def test_a_history_grows_and_shrinks_with_its_seconds() -> None:
    signal = SignalFormat.sound(10.0)
    history = History([(2,)], signal, 0.5)
    whole = np.arange(40.0).reshape(2, 20)
    for first, seconds in ((0, 1.0), (10, 2.0), (15, 0.3)):
        history.append(Block(0, (whole[:, first : first + 5],), first + 5, signal))
        history.seconds = seconds
    history.append(Block(0, (whole[:, 18:19],), 19, signal))
    (view,) = history.read_new("x").parts
    np.testing.assert_array_equal(view.array(), whole[:, [18, 19, 18]])


def test_a_history_begins_anew_with_other_rows_or_another_rate() -> None:
    signal = SignalFormat.sound(10.0)
    history = History([(2,)], signal, 1.0)
    for rows, of in (
        ((2,), signal),
        ((3,), signal),
        ((3,), SignalFormat.sound(20.0)),
        ((3,), SignalFormat(10.0, 20.0, lags=5)),
    ):
        history.append(Block(0, (np.ones((*rows, 2)),), 0, of))
    (view,), _, last = history.read_new("x")
    assert (view.shape, last.lags) == ((3, 4), 5)


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
    signal = SignalFormat.sound(100.0)
    window, history = SlidingWindow((2,), 25), History([(2,)], signal, 0.25)
    window.append(block)
    history.append(Block(0, (block,), 10, signal))
    assert window.view().pieces[-1] is block
    assert history.read_new("x").parts[0].pieces[-1] is block


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
