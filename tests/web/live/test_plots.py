"""The reduction of the frames of a port to the columns of a plot, and their encoding as bytes; losses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rospy

from rosafe.interface import KINDS, format_value
from rosafe.ros1.client.port_reader import Frames
from rosafe.ros1.client.tree_snapshot import ProcessorInfo, TreeSnapshot
from rosafe.web.live import image_topics
from rosafe.web.live.client import BrowserConnection, parse_keys
from rosafe.web.live.health import Health
from rosafe.web.live.plot_data import PlotLayout, quantize
from rosafe.web.live.views import FLOAT, PIECE, QUANTISED, Hub, Key, View, _Columns

FREQUENCIES = [100.0, 200.0, 400.0]
RNG = np.random.default_rng(3)


def processor(kind: str, rate: float, shape: tuple[int, ...], **values: str) -> ProcessorInfo:
    parent = KINDS[kind].parent
    return ProcessorInfo(kind, kind, parent, f"/rosAFE/{kind}", rate, shape, values)


def tree(*processors: ProcessorInfo) -> TreeSnapshot:
    filterbank = processor("gammatone", 44100, (2, 3), fb_cfHz=format_value(FREQUENCIES))
    return TreeSnapshot([filterbank, processor("ihc", 44100, (2, 3)), *processors])


def test_a_ratemap_is_shown_in_decibels() -> None:
    one = processor("ratemap", 100, (2, 3), rm_scaling="power")
    layout = PlotLayout(tree(one), one, 0, -1)
    left, right = RNG.random((2, 3, 7))
    assert np.allclose(layout.columns(np.stack((left, right))), 10 * np.log10(np.concatenate([left, right])), atol=1e-4)
    description = layout.describe()
    assert (description["along"], description["rows"], description["ears"], description["unit"]) == (
        FREQUENCIES,
        3,
        2,
        "dB",
    )
    silent = layout.columns(np.zeros((2, 3, 1)))
    assert np.allclose(silent, -200)


def test_magnitudes_have_twice_the_decibels_of_powers() -> None:
    one = processor("ratemap", 100, (2, 3), rm_scaling="magnitude")
    values = RNG.random((3, 4))
    assert np.allclose(
        PlotLayout(tree(one), one, 0, -1).columns(np.stack([values] * 2))[:3], 20 * np.log10(values), atol=1e-4
    )


def test_a_signal_is_shown_by_minimum_and_maximum() -> None:
    one = processor("input", 44100, (2,))
    layout = PlotLayout(TreeSnapshot([one]), one, 0, -1)
    assert (layout.group, layout.rate) == (441, 100)
    sound = RNG.normal(size=(2, 4410))
    columns = layout.columns(sound)
    for ear in range(2):
        assert np.allclose(columns[2 * ear], sound[ear].reshape(10, 441).min(axis=1), atol=1e-6)
        assert np.allclose(columns[2 * ear + 1], sound[ear].reshape(10, 441).max(axis=1), atol=1e-6)


@pytest.mark.parametrize(("rate", "group"), [(99.5, 1), (100, 1), (100.5, 2), (150, 2), (250, 3), (16000, 160)])
def test_frames_are_grouped_so_that_a_plot_gets_at_most_100_columns_per_second(rate: float, group: int) -> None:
    one = processor("ratemap", rate, (2, 3))
    layout = PlotLayout(tree(one), one, 0, -1)
    assert (layout.group, layout.rate) == (group, rate / group)
    assert layout.rate <= 100


def test_levels_of_a_filterbank_are_of_the_mean_power() -> None:
    one = processor("gammatone", 44100, (2, 3), fb_cfHz=format_value(FREQUENCIES))
    signal = RNG.normal(size=(3, 882))
    columns = PlotLayout(TreeSnapshot([one]), one, 0, -1).columns(np.stack((signal, signal)))
    power = (signal.reshape(3, 2, 441) ** 2).mean(axis=2)
    assert np.allclose(columns[:3], 10 * np.log10(power), atol=1e-4)


@pytest.mark.parametrize("row", [-1, 0, 2])
def test_correlations_of_one_channel_or_the_mean_of_all(row: int) -> None:
    lags = [-1e-3, 0.0, 1e-3, 2e-3]
    one = processor("crossCorrelation", 100, (3, 4), cc_lags=format_value(lags))
    layout = PlotLayout(tree(one), one, 0, row)
    curves = RNG.random((3, 4, 5))
    expected = curves.mean(axis=0) if row < 0 else curves[row]
    assert np.allclose(layout.columns(curves), expected, atol=1e-6)
    assert layout.describe()["along"] == lags and layout.describe()["choices"] == FREQUENCIES


def test_pitch_is_a_line_with_gaps() -> None:
    one = processor("pitch", 100, (2, 3))
    layout = PlotLayout(TreeSnapshot([one]), one, 0, 2)
    values = np.array([[1.0, np.nan], [3, 4], [5, 6]])
    assert layout.describe()["choices"] == ["pitch", "rawPitch", "confidence"]
    assert np.array_equal(layout.columns(np.stack((values, values + 1))), [[5, 6], [6, 7]])


def test_rows_are_averaged_if_there_are_many() -> None:
    one = processor("gabor", 100, (2, 300))
    layout = PlotLayout(TreeSnapshot([one]), one, 0, -1)
    values = RNG.random((300, 2))
    assert layout.rows == 100
    assert np.allclose(
        layout.columns(np.stack((values, values)))[:100], values.reshape(100, 3, 2).mean(axis=1), atol=1e-6
    )


def test_each_kind_can_be_plotted() -> None:
    for kind, representation in KINDS.items():
        sizes = {"ear": 2, "channel": 3, "lag": 5, "filter": 4, "feature": max(1, len(representation.features))}
        largest = max(representation.parts, key=lambda part: len(part.axes))
        one = processor(kind, 100, tuple(sizes[axis] for axis in largest.axes if axis != "time"))
        for index, part in enumerate(representation.parts):
            layout = PlotLayout(TreeSnapshot([one]), one, index, -1)
            frames = np.ones((*(sizes[axis] for axis in part.axes if axis != "time"), 4))
            assert layout.columns(frames).shape == (layout.size, 4), (kind, part)


def test_the_quantization_error_is_at_most_half_a_step() -> None:
    columns = RNG.normal(size=(6, 40)).astype(np.float32)
    columns[2, 5] = np.nan
    low, high, data = quantize(columns)
    steps = np.frombuffer(data, np.uint8).reshape(40, 6).T
    assert steps[2, 5] == 255 and np.sum(steps == 255) == 1
    found = low + steps * (high - low) / 254
    assert np.nanmax(np.abs(np.where(steps == 255, np.nan, found) - columns)) <= 0.5001 * (high - low) / 254
    assert set(quantize(np.full((2, 2), np.nan))[2]) == {255}
    assert quantize(np.full((2, 2), 7.0))[:2] == (7.0, 7.0)


# --- views ---


def piece(
    view: View, first: int, stride: int = 1, max_columns: int = 10_000
) -> tuple[int, tuple[Any, ...], np.ndarray]:
    after, data = view.piece(first, stride, max_columns)
    head = PIECE.unpack_from(data)
    return after, head, np.frombuffer(data, "<f4", head[1] * head[2], PIECE.size).reshape(head[1], head[2]).T


def test_a_view_keeps_the_last_seconds_and_marks_gaps() -> None:
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
    view.append(0, series[:, :7], 0.07)  # the audio has restarted
    after, head, columns = piece(view, 0)
    assert (after, head[3], head[1]) == (7, 0, 7)


@pytest.mark.parametrize("rate", [100, 250, 1000])
def test_each_frame_is_in_one_column(rate: int) -> None:
    """Frames arrive in any number; those of an incomplete column wait, and those beside a loss are left out."""
    one = processor("ratemap", rate, (2, 3), rm_scaling="power")
    layout = PlotLayout(tree(one), one, 0, -1)
    view = View(layout.size, layout.rate, FLOAT)
    columns, group = _Columns(layout, view, 44100.0), layout.group
    values = 10.0 ** RNG.random((2, 3, 700))
    at = 5
    for count in (1, 1, 2, 5, 7, 20, 40, 1, 100, 300):
        lost = 31 if count == 40 else 0
        at, data = at + lost + count, values[..., at + lost : at + lost + count]
        columns.append(Frames(data, at - count, lost, False, None, "ratemap", (), rate, (data,), 441 * at))
    first = -(-5 // group)
    found = view.newest(at // group - first)
    mean = values[..., : at // group * group].reshape(2, 3, -1, group).mean(axis=-1)
    expected = 10 * np.log10(mean)[..., first:].reshape(6, -1)
    gap = np.isnan(found[0])
    assert 31 // group <= gap.sum() <= 31 // group + 2
    np.testing.assert_allclose(found[:, ~gap], expected[:, ~gap], atol=1e-4)
    assert view.end == pytest.approx(441 * at / 44100 - at % group / rate)


def test_stride_and_maximum_of_columns() -> None:
    view = View(1, 100.0, FLOAT)
    view.append(0, np.arange(101, dtype=np.float32)[np.newaxis], 1.01)
    after, head, columns = piece(view, 1, stride=4, max_columns=3)
    assert (after, head[3], head[8], head[4]) == (16, 4, 4, pytest.approx(0.16))
    assert np.array_equal(columns[0], [4, 8, 12])
    assert view.piece(100, 4, 9)[1] == b""  # fewer than four columns are left


@pytest.mark.parametrize("start", [2**32 - 5, 2**32, 2**40 + 1, 2**53 - 100])
def test_column_numbers_beyond_32_bits(start: int) -> None:
    """They are exact up to 2^53, the largest exact integer in JavaScript; above it, an error is raised."""
    view = View(1, 100.0, FLOAT)
    numbers = np.arange(10, dtype=np.float32)
    for first in range(start, start + 100, 10):
        view.append(first, numbers[np.newaxis] + (first - start), (first + 10) / 100)
    after, head, columns = piece(view, start + 3, stride=1, max_columns=5)
    assert (after, head[3]) == (start + 8, start + 3)
    assert np.array_equal(columns[0], [3, 4, 5, 6, 7])
    view.append(2**53 - 1, numbers[np.newaxis, :2], 0.0)
    with pytest.raises(ValueError, match=f"got {2**53 - 1}"):
        view.piece(2**53 - 1, 1, 10)


# --- the connection of one page ---


class SlowSocket:
    """A socket and its transport whose send buffer stays full until the test empties it."""

    def __init__(self) -> None:
        self.unsent_bytes = 10**6
        self.sent: list[bytes] = []
        self.closed = False

    def get_write_buffer_size(self) -> int:
        return self.unsent_bytes

    def abort(self) -> None:
        self.closed = True

    async def send_bytes(self, data: bytes) -> None:
        self.sent.append(data)

    async def send_str(self, text: str) -> None:
        self.sent.append(text.encode())


def test_a_slow_client_gets_the_newest_columns_and_no_backlog() -> None:
    import asyncio

    view = View(1, 100.0, FLOAT)

    class OneView:
        def subscribe(self, key: Key) -> View:
            return view

        def unsubscribe(self, key: Key, view: View) -> None:
            pass

    async def scenario() -> list[bytes]:
        connection: Any = SlowSocket()
        hub: Any = OneView()
        client = BrowserConnection(hub, {}, lambda: None)
        client._socket = connection
        await client._subscribe([Key("picture", "one")], resend=False)
        sender = asyncio.create_task(client._send(connection))
        for first in range(0, 1000, 10):
            view.append(first, np.zeros((1, 10), np.float32), first / 100)
            client.wake()
            client.send_latest("status", {"number": first})
            await asyncio.sleep(0)
        assert not connection.sent
        connection.unsent_bytes = 0
        async with asyncio.timeout(20):
            while not any(data[:1] == b"\2" for data in connection.sent):
                await asyncio.sleep(0.01)
        sender.cancel()
        return list(connection.sent)

    sent = asyncio.run(scenario())
    texts = [data for data in sent if data[:1] == b"{"]
    assert len(texts) == 2 and b"990" in b"".join(texts)  # the views, and only the newest status
    message = next(data for data in sent if data[:1] == b"\2")
    _, columns, _, first, *_ = PIECE.unpack_from(message, 8)
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
def test_malformed_keys_are_rejected(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="keys"):
        parse_keys(given)


def test_the_formats_are_those_of_the_protocol() -> None:
    assert (QUANTISED, FLOAT, PIECE.size) == (0, 1, 40)


def test_images_wait_for_an_output_that_is_not_available(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its frame rate is unknown before the audio starts."""
    monkeypatch.setattr(rospy, "Publisher", lambda *_, **__: SimpleNamespace(get_num_connections=lambda: 1))
    hub = Hub("/bass", "/localizer", lambda: None)
    hub.tree = tree(processor("ratemap", 0.0, (2, 3)))
    image_topics.Images(hub).publish()


def test_images_have_high_frequencies_on_top_and_missing_values_are_black() -> None:
    columns = np.array([[0.0, np.nan], [-60.0, 0.0]])
    image = image_topics.draw_image(columns, {"level": True, "rows": 2, "ears": 1})
    bright = [[bool(image[row, column].min() > 150) for column in range(2)] for row in (0, -1)]
    assert bright == [[False, True], [True, False]]
    assert image[-1, 1].tolist() == [0, 0, 0]


def test_losses_are_those_since_the_previous_message() -> None:
    health: Any = Health("/rosAFE", "/bass", "/localizer")
    health._subscriber = object()
    for lost in ("3", "5", "5", "1"):  # the last one after a restart
        entry = SimpleNamespace(key="lost", value=lost)
        health._receive(SimpleNamespace(status=[SimpleNamespace(name="rosAFE: audio", values=[entry])]))
    assert [one["what"] for one in health.status()["losses"]] == ["2 audio frames were lost between bass and rosAFE"]
