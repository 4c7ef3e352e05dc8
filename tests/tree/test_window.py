"""Sliding windows and histories, compared with concatenation, for blocks of any size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block
from rosafe.tree.history import MAX_PIECES, MIN_PIECE_BYTES, History, SlidingWindow, WindowView, frames_in

ROWS = st.sampled_from([(2,), (2, 3), (3,), (2, 5)])
SIZES = st.lists(st.one_of(st.integers(0, 5), st.integers(0, 60)), max_size=3 * MAX_PIECES)


def numbered(rows: tuple[int, ...], sizes: list[int]) -> list[NDArray[np.float64]]:
    """Return blocks of these lengths, in which all numbers differ."""
    count = sum(sizes) * int(np.prod(rows))
    whole = np.arange(1.0, count + 1.0).reshape(*rows, sum(sizes))
    return np.split(whole, np.cumsum(sizes)[:-1], axis=-1) if sizes else []


@given(ROWS, st.integers(0, 80), SIZES)
@example((2,), 2 * MAX_PIECES + 50, [1] * (3 * MAX_PIECES))
@example((2, 3), 2 * MAX_PIECES + 7, [2, 1, 0] * MAX_PIECES)
@example((2, 3), 50, [1, 1, 1, 200, 1] * 40)
def test_a_window_is_the_newest_frames_after_zeros(rows: tuple[int, ...], frames: int, sizes: list[int]) -> None:
    window = SlidingWindow(rows, frames)
    model = np.zeros((*rows, frames))
    seen: list[tuple[WindowView, NDArray[np.float64]]] = [(window.padded_view(frames), model)]
    for block in numbered(rows, sizes):
        window.append(block)
        model = np.concatenate((model, block), axis=-1)[..., block.shape[-1] :]
        seen.append((window.padded_view(frames), model))
    for view, expected in seen:  # the content of a view has not changed
        assert view.shape == expected.shape == (*rows, frames)
        assert view.frames == frames
        assert len(view.pieces) <= MAX_PIECES
        np.testing.assert_array_equal(view.array(), expected)


@given(ROWS, st.integers(0, 80), st.lists(st.one_of(st.sampled_from("ab"), st.integers(0, 40)), max_size=40))
@example((2,), 2 * MAX_PIECES + 50, ["a", *[1] * (2 * MAX_PIECES), "a", *[1] * MAX_PIECES, "b", *[1] * 30])
def test_a_history_returns_the_output_since_the_last_call(
    rows: tuple[int, ...], capacity: int, steps: list[int | str]
) -> None:
    """Each reader (a string) has its own position, which is the same for both parts."""
    signal = SignalFormat.sound(100.0)
    history = History([rows, (7,)], signal, capacity / 100)
    sizes = [step for step in steps if isinstance(step, int)]
    blocks = zip(numbered(rows, sizes), numbered((7,), sizes), strict=True)
    appended = [np.zeros((*rows, 0)), np.zeros((7, 0))]
    read: dict[str, int] = {}
    slices = []
    for step in [*steps, "a", "b"]:
        if isinstance(step, str):
            end = appended[0].shape[-1]
            first = max(read.get(step, 0), end - capacity)
            slices.append((history.read_new(step), [part[..., first:] for part in appended], end))
            read[step] = end
        else:
            parts = next(blocks)
            end = appended[0].shape[-1] + step
            history.append(Block(0, parts, end, signal))
            appended = [np.concatenate(pair, axis=-1) for pair in zip(appended, parts, strict=True)]
    for (views, next_index, its_signal), expected, end in slices:
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


def test_a_history_is_cleared_by_another_shape_or_another_rate() -> None:
    signal = SignalFormat.sound(10.0)
    history = History([(2,)], signal, 1.0)
    for rows, signal_format in (
        ((2,), signal),
        ((3,), signal),
        ((3,), SignalFormat.sound(20.0)),
        ((3,), SignalFormat(10.0, 20.0, lags=5)),
    ):
        history.append(Block(0, (np.ones((*rows, 2)),), 0, signal_format))
    (view,), _, last = history.read_new("x")
    assert (view.shape, last.lags) == ((3, 4), 5)


@given(st.integers(1, 40), SIZES)
def test_views_of_a_part_and_of_exchanged_rows(frames: int, sizes: list[int]) -> None:
    window = SlidingWindow((2, 3), frames)
    for block in numbered((2, 3), sizes):
        window.append(block)
    view = window.padded_view(frames)
    whole = view.array()
    for row in (0, 1):
        np.testing.assert_array_equal(view.select(row).array(), whole[row])
        assert view.select(row).shape == (3, frames)
    np.testing.assert_array_equal(view.swap_rows().array(), whole.swapaxes(0, 1))
    target = np.full((2, 3, frames), np.nan)
    view.copy_to(target)
    np.testing.assert_array_equal(target, whole)


def test_blocks_are_not_copied() -> None:
    block = np.ones((2, MIN_PIECE_BYTES // 16))
    signal = SignalFormat.sound(100.0)
    window, history = SlidingWindow((2,), 25), History([(2,)], signal, 0.25)
    window.append(block)
    history.append(Block(0, (block,), 10, signal))
    assert window.view().pieces[-1] is block
    assert history.read_new("x").parts[0].pieces[-1] is block


@given(ROWS, st.integers(1, 3000), SIZES)
@example((2,), 2000, [1] * 600)
@example((64,), 44100, [220] * 400)  # 1 s of sound in blocks of 5 ms
@example((2, 32), 100, [1, 0] * 300)  # level differences of such blocks
def test_each_sample_is_copied_at_most_once(rows: tuple[int, ...], frames: int, sizes: list[int]) -> None:
    """Short blocks are joined once, for history and port together, so that a window has few pieces."""
    history = History([rows], SignalFormat.sound(float(frames)), 0.5, port_seconds=1.0)
    buffers: dict[int, NDArray[np.float64]] = {}  # the largest part of each buffer that was a piece
    arrived = 0
    for block in numbered(rows, sizes):
        arrived += block.nbytes
        history.append(Block(0, (block,), 0, SignalFormat.sound(float(frames))))
        (view,) = history.port_window().parts
        for piece in view.pieces:
            if piece.base is not block.base and piece.strides[0]:  # neither a block nor padding
                key = id(piece.base)
                buffers[key] = max(piece, buffers.get(key, piece), key=lambda part: part.nbytes)
    copied = sum(part.nbytes for part in buffers.values())
    assert copied <= arrived
    assert len(view.pieces if sizes else ()) <= 2 * MAX_PIECES


def test_the_port_and_readers_share_the_blocks() -> None:
    signal = SignalFormat.sound(100.0)
    history = History([(2,)], signal, 0.1, port_seconds=0.3)
    blocks = numbered((2,), [10] * 5)
    for number, block in enumerate(blocks):
        history.append(Block(number, (block,), 10 * (number + 1), signal))
    (port,), index, _ = history.port_window()
    (new,), _, _ = history.read_new("reader")
    np.testing.assert_array_equal(port.array(), np.concatenate(blocks[-3:], axis=-1))
    np.testing.assert_array_equal(new.array(), blocks[-1])
    assert index == 50


def test_the_port_window_is_the_same_object_until_a_frame_is_appended() -> None:
    """Short blocks complete no frame; `derived` then still holds the results for this window."""
    signal = SignalFormat.sound(100.0)
    history = History([(2,)], signal, 0.1, port_seconds=0.3)

    def window(number: int, frames: int, seconds: float = 0.3) -> Any:
        history.port_seconds = seconds
        history.append(Block(number, (np.full((2, frames), float(number)),), 10 * number, signal))
        return history.port_window()

    first, second, third = window(1, 5), window(2, 0), window(3, 5)
    assert first.parts is second.parts
    assert (first.next_index, second.next_index) == (10, 20)
    assert first.parts[0].select(1) is second.parts[0].select(1)
    np.testing.assert_array_equal(third.parts[0].array()[1, -11:], [0.0] + [1.0] * 5 + [3.0] * 5)
    assert window(4, 0, 0.2).parts[0].frames == 20, "the port's length was changed"
    changed = SignalFormat.sound(200.0)
    history.append(Block(5, (np.ones((2, 0)),), 50, changed))
    assert (history.port_window().parts[0].frames, history.port_window().signal) == (40, changed)


def test_an_empty_window_costs_no_memory() -> None:
    """A port of ten minutes exists before the first block."""
    view = SlidingWindow((2, 31), 0).padded_view(600 * 44100)
    assert view.shape == (2, 31, 26_460_000)
    padding = next(piece for piece in view.pieces if piece.shape[-1])
    assert padding.strides[:-1] == (0, 0), (
        "all rows share one row of zeros, whose pages the system has not allocated yet"
    )


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
def test_frames_in_seconds(seconds: float, rate: float, frames: int) -> None:
    assert frames_in(seconds, rate) == frames
