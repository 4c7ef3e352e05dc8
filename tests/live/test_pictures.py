"""From a port's frames to the columns of a picture, and to bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.interface import KINDS, format_value
from rosafe.live.client import BrowserConnection, _keys
from rosafe.live.plot_data import PlotLayout, ProcessorInfo, TreeSnapshot, quantize
from rosafe.live.views import FLOAT, PIECE, QUANTISED, Key, View

FREQUENCIES = [100.0, 200.0, 400.0]
RNG = np.random.default_rng(3)


def processor(kind: str, rate: float, shape: tuple[int, ...], **values: str) -> ProcessorInfo:
    parent = KINDS[kind].parent
    return ProcessorInfo(kind, kind, parent, f"/rosAFE/{kind}", rate, shape, values)


def tree(*processors: ProcessorInfo) -> TreeSnapshot:
    filterbank = processor("gammatone", 44100, (2, 3), fb_cfHz=format_value(FREQUENCIES))
    return TreeSnapshot([filterbank, processor("ihc", 44100, (2, 3)), *processors])


def test_a_cochleagram_is_in_decibels() -> None:
    one = processor("ratemap", 100, (2, 3), rm_scaling="power")
    picture = PlotLayout(tree(one), one, 0, -1)
    left, right = RNG.random((2, 3, 7))
    assert np.allclose(picture.columns([left, right]), 10 * np.log10(np.concatenate([left, right])), atol=1e-4)
    told = picture.describe()
    assert (told["along"], told["rows"], told["ears"], told["unit"]) == (FREQUENCIES, 3, 2, "dB")
    silent = picture.columns([np.zeros((3, 1))] * 2)
    assert np.allclose(silent, -200)


def test_a_magnitude_has_twice_the_decibels() -> None:
    one = processor("ratemap", 100, (2, 3), rm_scaling="magnitude")
    values = RNG.random((3, 4))
    assert np.allclose(PlotLayout(tree(one), one, 0, -1).columns([values] * 2)[:3], 20 * np.log10(values), atol=1e-4)


def test_a_signal_is_an_envelope() -> None:
    one = processor("input", 44100, (2,))
    picture = PlotLayout(TreeSnapshot([one]), one, 0, -1)
    assert (picture.group, picture.rate) == (441, 100)
    sound = RNG.normal(size=(2, 4410))
    columns = picture.columns(list(sound))
    for ear in range(2):
        assert np.allclose(columns[2 * ear], sound[ear].reshape(10, 441).min(axis=1), atol=1e-6)
        assert np.allclose(columns[2 * ear + 1], sound[ear].reshape(10, 441).max(axis=1), atol=1e-6)


def test_levels_of_a_filterbank_are_those_of_the_mean_power() -> None:
    one = processor("gammatone", 44100, (2, 3), fb_cfHz=format_value(FREQUENCIES))
    signal = RNG.normal(size=(3, 882))
    columns = PlotLayout(TreeSnapshot([one]), one, 0, -1).columns([signal, signal])
    power = (signal.reshape(3, 2, 441) ** 2).mean(axis=2)
    assert np.allclose(columns[:3], 10 * np.log10(power), atol=1e-4)


@pytest.mark.parametrize("row", [-1, 0, 2])
def test_correlations_of_one_channel_or_of_all(row: int) -> None:
    lags = [-1e-3, 0.0, 1e-3, 2e-3]
    one = processor("crossCorrelation", 100, (3, 4), cc_lags=format_value(lags))
    picture = PlotLayout(tree(one), one, 0, row)
    curves = RNG.random((4, 3, 5))  # as on the wire
    wanted = curves.mean(axis=1) if row < 0 else curves[:, row]
    assert np.allclose(picture.columns([curves]), wanted, atol=1e-6)
    assert picture.describe()["along"] == lags and picture.describe()["choices"] == FREQUENCIES


def test_pitch_is_a_line_that_may_have_gaps() -> None:
    one = processor("pitch", 100, (2, 3))
    picture = PlotLayout(TreeSnapshot([one]), one, 0, 2)
    values = np.array([[1.0, np.nan], [3, 4], [5, 6]])
    assert picture.describe()["choices"] == ["pitch", "rawPitch", "confidence"]
    assert np.array_equal(picture.columns([values, values + 1]), [[5, 6], [6, 7]])


def test_many_rows_are_drawn_together() -> None:
    one = processor("gabor", 100, (2, 300))
    picture = PlotLayout(TreeSnapshot([one]), one, 0, -1)
    values = RNG.random((300, 2))
    assert picture.rows == 100
    assert np.allclose(picture.columns([values, values])[:100], values.reshape(100, 3, 2).mean(axis=1), atol=1e-6)


def test_each_kind_has_a_picture() -> None:
    for kind, representation in KINDS.items():
        sizes = {"ear": 2, "channel": 3, "lag": 5, "filter": 4, "feature": max(1, len(representation.features))}
        largest = max(representation.parts, key=lambda part: len(part.axes))
        one = processor(kind, 100, tuple(sizes[axis] for axis in largest.axes if axis != "time"))
        for index, part in enumerate(representation.parts):
            picture = PlotLayout(TreeSnapshot([one]), one, index, -1)
            rows = [sizes[axis] for axis in part.axes if axis not in ("ear", "time")]
            array = np.ones((*rows[1:], *rows[:1], 4))  # the second axis outermost
            assert picture.columns([array] * picture.ears).shape == (picture.size, 4), (kind, part)


def test_bytes_are_within_half_a_step() -> None:
    columns = RNG.normal(size=(6, 40)).astype(np.float32)
    columns[2, 5] = np.nan
    low, high, data = quantize(columns)
    steps = np.frombuffer(data, np.uint8).reshape(40, 6).T
    assert steps[2, 5] == 255 and np.sum(steps == 255) == 1
    found = low + steps * (high - low) / 254
    assert np.nanmax(np.abs(np.where(steps == 255, np.nan, found) - columns)) <= 0.5001 * (high - low) / 254
    assert set(quantize(np.full((2, 2), np.nan))[2]) == {255}
    assert quantize(np.full((2, 2), 7.0))[:2] == (7.0, 7.0)


# --- the newest seconds ---


def piece(view: View, first: int, stride: int = 1, most: int = 10_000) -> tuple[int, tuple[Any, ...], np.ndarray]:
    after, data = view.piece(first, stride, most)
    head = PIECE.unpack_from(data)
    return after, head, np.frombuffer(data, "<f4", head[1] * head[2], PIECE.size).reshape(head[1], head[2]).T


def test_a_view_keeps_the_newest_seconds_and_shows_gaps() -> None:
    view = View(2, 100.0, FLOAT)
    series = np.arange(6000, dtype=np.float32).reshape(3000, 2).T
    for first in range(0, 3000, 30):
        view.append(first, series[:, first : first + 30], (first + 30) / 100)
    after, head, columns = piece(view, 0)
    assert after == 3000 and head[3] == 3000 - view.capacity and head[4] == 30.0
    assert np.array_equal(columns, series[:, -view.capacity :])
    view.append(3010, series[:, :5], 30.15)
    _, head, columns = piece(view, 3000)
    assert head[1] == 15 and np.isnan(columns[:, :10]).all() and np.array_equal(columns[:, 10:], series[:, :5])
    view.append(0, series[:, :7], 0.07)  # the sound began anew
    after, head, columns = piece(view, 0)
    assert (after, head[3], head[1]) == (7, 0, 7)


def test_every_so_manyth_column_and_no_more_than_asked_for() -> None:
    view = View(1, 100.0, FLOAT)
    view.append(0, np.arange(101, dtype=np.float32)[np.newaxis], 1.01)
    after, head, columns = piece(view, 1, stride=4, most=3)
    assert (after, head[3], head[8], head[4]) == (16, 4, 4, pytest.approx(0.16))
    assert np.array_equal(columns[0], [4, 8, 12])
    assert view.piece(100, 4, 9)[1] == b""  # not a whole one yet


@pytest.mark.parametrize("start", [2**32 - 5, 2**32, 2**40 + 1, 2**53 - 100])
def test_column_numbers_beyond_32_bits(start: int) -> None:
    """They are exact up to 2^53, the largest whole number of a page; beyond, there is an error and no other number."""
    view = View(1, 100.0, FLOAT)
    numbers = np.arange(10, dtype=np.float32)
    for first in range(start, start + 100, 10):
        view.append(first, numbers[np.newaxis] + (first - start), (first + 10) / 100)
    after, head, columns = piece(view, start + 3, stride=1, most=5)
    assert (after, head[3]) == (start + 8, start + 3)
    assert np.array_equal(columns[0], [3, 4, 5, 6, 7])
    view.append(2**53 - 1, numbers[np.newaxis, :2], 0.0)
    with pytest.raises(ValueError, match=f"got {2**53 - 1}"):
        view.piece(2**53 - 1, 1, 10)


# --- one page ---


class Deaf:
    """A client that takes nothing until it is told to; counts what it is sent."""

    def __init__(self) -> None:
        self.waiting = 10**6
        self.sent: list[bytes] = []
        self.closed = False

    def get_write_buffer_size(self) -> int:
        return self.waiting

    def abort(self) -> None:
        self.closed = True

    async def send_bytes(self, data: bytes) -> None:
        self.sent.append(data)

    async def send_str(self, text: str) -> None:
        self.sent.append(text.encode())


def test_a_slow_client_gets_the_newest_columns_and_keeps_nothing_waiting() -> None:
    import asyncio

    view = View(1, 100.0, FLOAT)

    class OneView:
        def subscribe(self, key: Key) -> tuple[View, dict[str, Any]]:
            return view, {}

        def unsubscribe(self, key: Key, left: View) -> None:
            pass

    async def scenario() -> list[bytes]:
        deaf: Any = Deaf()
        hub: Any = OneView()
        client = BrowserConnection(hub, {}, lambda: None)
        client._socket = deaf
        await client._subscribe([Key("picture", "one")], anew=False)
        sender = asyncio.create_task(client._send(deaf))
        for first in range(0, 1000, 10):
            view.append(first, np.zeros((1, 10), np.float32), first / 100)
            client.wake()
            client.tell("status", {"number": first})
            await asyncio.sleep(0)
        assert not deaf.sent
        deaf.waiting = 0
        async with asyncio.timeout(20):
            while not any(data[:1] == b"\2" for data in deaf.sent):
                await asyncio.sleep(0.01)
        sender.cancel()
        return list(deaf.sent)

    sent = asyncio.run(scenario())
    texts = [data for data in sent if data[:1] == b"{"]
    assert len(texts) == 2 and b"990" in b"".join(texts)  # the views, and the newest status alone
    picture = next(data for data in sent if data[:1] == b"\2")
    _, columns, _, first, *_ = PIECE.unpack_from(picture, 8)
    assert (first, columns) == (900, 100)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"keys": [{}]},
        {"keys": [1]},
        {"keys": [{"what": "picture", "name": 3}]},
        {"keys": [{"what": "picture", "name": "a", "part": True}]},
        {"keys": [{"what": "picture", "name": "a", "row": 10**9}]},
        {"keys": [{"what": "levels"}] * 17},
    ],
)
def test_nonsense_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="keys"):
        _keys(given)


def test_forms_are_those_of_the_protocol() -> None:
    assert (QUANTISED, FLOAT, PIECE.size) == (0, 1, 40)
