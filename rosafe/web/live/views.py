"""The views that pages have subscribed to, shared by all pages, with the last seconds of each."""

from __future__ import annotations

import itertools
import struct
import threading
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rosafe.audio.files.levels import LevelMeter
from rosafe.interface import KINDS
from rosafe.ros1.client.errors import too_many
from rosafe.ros1.client.port_reader import Frames, PortSubscription
from rosafe.ros1.client.tree_snapshot import TreeSnapshot
from rosafe.web.live import directions
from rosafe.web.live.audio import Audio
from rosafe.web.live.plot_data import MAX_COLUMN_RATE, PlotLayout, quantize

HISTORY_SECONDS = 12.0  # sent to a page when it subscribes
MAX_VIEWS = 256  # of all pages
CHANGE_SECONDS = 3.0  # in which messages of a changed tree may arrive before the new tree is known

QUANTISED, FLOAT = 0, 1
MAX_COLUMN = 2**53  # the largest integer that JavaScript represents exactly
# number of the view, columns, numbers in a column, first column, end (s), minimum and maximum, form, stride
PIECE = struct.Struct("<IHHQdffBB6x")

_numbers = itertools.count(1)


@dataclass(frozen=True)
class Key:
    """Identifies a view: the plot of a processor, the directions of the localizer, or the levels."""

    what: str  # picture, directions, levels
    name: str = ""
    part: int = 0
    row: int = -1


class View:
    """The newest columns of a plot. Written by the threads of rospy, read by the event loop.

    Columns are numbered from the start of the audio; `restarts` counts how often the audio has restarted.
    """

    def __init__(self, size: int, rate: float, form: int, description: Mapping[str, Any] | None = None) -> None:
        self.number = next(_numbers)
        self.description = description or {}  # for the page
        self.size, self.rate, self.form = size, rate, form
        self.capacity = max(8, round(HISTORY_SECONDS * rate))
        self.users = 0
        self.restarts = 0
        self.next = 0  # number of the column after the newest one
        self.oldest = 0
        self.end = 0.0  # s of the audio
        self._ring = np.full((size, self.capacity), np.nan, np.float32)
        self._lock = threading.Lock()
        self._last_piece: tuple[Hashable, bytes] = ((), b"")  # shared by the pages

    @property
    def column_bytes(self) -> int:
        """Bytes of a column in a message."""
        return self.size * (4 if self.form == FLOAT else 1)

    def append(self, first: int, columns: np.ndarray, end: float) -> None:
        """Append columns (size, n) from number `first` on; columns between the newest one and `first` were lost."""
        columns = columns[:, -self.capacity :]
        after = first + columns.shape[1]
        with self._lock:
            if not self.oldest <= self.next <= first or first - self.next > self.capacity:
                self.restarts += 1
                self.next = self.oldest = first
            for column in range(self.next, first):
                self._ring[:, column % self.capacity] = np.nan
            self._ring[:, self._ring_indices(first, after)] = columns
            self.next, self.end = after, end
            self.oldest = max(self.oldest, after - self.capacity)

    def _ring_indices(self, first: int, after: int, stride: int = 1) -> np.ndarray:
        """Return the indices of columns in the ring; the column numbers may exceed the integers of numpy."""
        return np.arange(first % self.capacity, first % self.capacity + after - first, stride) % self.capacity

    def newest(self, count: int) -> np.ndarray:
        """Return the newest columns, float32 (size, count); missing ones are NaN."""
        columns = np.full((self.size, count), np.nan, np.float32)
        with self._lock:
            first = max(self.oldest, self.next - count)
            if self.next > first:
                columns[:, -(self.next - first) :] = self._ring[:, self._ring_indices(first, self.next)]
        return columns

    def piece(self, first: int, stride: int, max_columns: int) -> tuple[int, bytes]:
        """Return the next column to send, and every `stride`-th column from `first` on as bytes."""
        with self._lock:
            first = max(first, self.oldest)
            first += -first % stride
            count = min(max_columns, (self.next - first) // stride)
            if count <= 0:
                return first, b""
            after = first + count * stride
            key = (first, stride, count, self.restarts)
            if self._last_piece[0] != key:
                columns = self._ring[:, self._ring_indices(first, after, stride)]
                low = high = 0.0
                if self.form == QUANTISED:
                    low, high, data = quantize(columns)
                else:
                    data = np.ascontiguousarray(columns.T, "<f4").tobytes()
                if after > MAX_COLUMN:
                    raise ValueError(f"expected columns up to number {MAX_COLUMN}, got {first}")
                end = self.end - (self.next - after) / self.rate
                header = PIECE.pack(self.number, count, self.size, first, end, low, high, self.form, stride)
                self._last_piece = key, header + data + bytes(-len(data) % 8)
            return after, self._last_piece[1]


class _Columns:
    """Appends the frames of a port to a view as columns; frames of an incomplete column wait."""

    def __init__(self, layout: PlotLayout, view: View, sample_rate: float) -> None:
        self._layout, self._view, self._sample_rate = layout, view, sample_rate
        self._rest: np.ndarray | None = None

    def append(self, frames: Frames) -> None:
        group, data = self._layout.group, frames.parts[self._layout.part]
        if self._rest is not None and not frames.lost and not frames.restarted:
            data = np.concatenate((self._rest, data), axis=-1)
        first = frames.after - data.shape[-1]
        start = -first % group
        count = max(0, (data.shape[-1] - start) // group)
        stop = start + count * group
        self._rest = data[..., stop:] if count or not start else data
        if count:
            after = (first + stop) / frames.rate
            end = frames.index / self._sample_rate - frames.after / frames.rate + after
            self._view.append((first + start) // group, self._layout.columns(data[..., start:stop]), end)


class Hub:
    """All views. Its methods may block on the master for a moment: call them on a thread.

    Parameters
    ----------
    bass, localizer : str
        Full names of the nodes that capture the audio and localize.
    on_new_columns : callable
        Called on a thread of rospy when a view has new columns.
    """

    def __init__(self, bass: str, localizer: str, on_new_columns: Callable[[], None]) -> None:
        self.tree = TreeSnapshot()
        self.audio: Audio | None = None
        self.latencies: dict[str, float] = {}  # s, by topic: from the capture of the newest frame to its arrival
        self._bass, self._localizer = bass, localizer
        self._directions: directions.DirectionTopics | None = None
        self._on_new_columns = on_new_columns
        self._views: dict[Key, View] = {}
        self._ports: dict[Key, PortSubscription] = {}
        self._lock = threading.RLock()
        self._closed = False

    def close(self) -> None:
        """Close all ports permanently. A subscription in progress is rejected."""
        with self._lock:
            self._closed = True
            for key in list(self._views):
                self._remove(key)

    # --- subscriptions of pages ---

    def subscribe(self, key: Key) -> View:
        """Return a view, and count one more user; raise ValueError if it does not exist."""
        with self._lock:
            if key not in self._views:
                if self._closed:
                    raise ValueError("the page is closing")
                if len(self._views) >= MAX_VIEWS:
                    raise too_many(f"the limit of {MAX_VIEWS} open plots is reached")
                self._begin(key)
            self._views[key].users += 1
            return self._views[key]

    def unsubscribe(self, key: Key, view: View) -> None:
        """Count one user less; without users, the view and the ports that no other view uses are closed."""
        with self._lock:
            if self.shows(key, view):  # otherwise, a change of the tree has replaced it
                view.users -= 1
                if view.users <= 0:
                    self._remove(key)

    def shows(self, key: Key, view: View) -> bool:
        """Return whether `view` is still the view of `key`."""
        with self._lock:
            return self._views.get(key) is view

    def _remove(self, key: Key) -> None:
        del self._views[key]
        if key.what == "levels" and self.audio is not None:
            self.audio.close()
            self.audio = None
        if key.what == "directions" and self._directions is not None:
            self._directions.close()
            self._directions = None
        if (port := self._ports.pop(key, None)) is not None:
            port.close()
            self.latencies.pop(port.topic, None)

    def _begin(self, key: Key) -> None:
        if key.what == "levels":
            view = View(6, 20.0, FLOAT, {"mode": "levels", "rows": 3, "ears": 2, "rate": 20.0})
            self._views[key] = view
            self.audio = Audio(f"{self._bass}/Audio", partial(self._append_levels, view))
            return
        if key.what == "directions":
            self._views[key] = view = View(directions.SIZE, directions.RATE, FLOAT, directions.description())
            use = partial(self._append, view)
            self._directions = directions.DirectionTopics(lambda: self.audio, use, self._bass, self._localizer)
            return
        processor = self.tree.processors.get(key.name)
        if processor is None or not self.tree.sample_rate:
            raise ValueError(f"unknown processor {key.name!r}")
        if processor.kind not in KINDS:
            raise ValueError(f"{processor.name}: {processor.kind} belongs to a plugin that is not installed here")
        if not processor.rate or len(processor.shape) < max(len(part.axes) for part in KINDS[processor.kind].parts) - 1:
            raise ValueError(f"{processor.name}: shape and rate of its frames are unknown")
        layout = PlotLayout(self.tree, processor, key.part, key.row)
        form = QUANTISED if layout.mode == "heat" else FLOAT
        self._views[key] = view = View(layout.size, layout.rate, form, layout.describe())
        use = partial(self._append_columns, processor.topic, _Columns(layout, view, self.tree.sample_rate))
        self._ports[key] = PortSubscription(processor.topic, use, self.tree, grace_seconds=CHANGE_SECONDS)

    def _append_columns(self, topic: str, columns: _Columns, frames: Frames) -> None:
        audio = self.audio
        captured = audio.captured_at(frames.index) if audio is not None else None
        if captured is not None:
            self.latencies[topic] = time.time() - captured
        columns.append(frames)
        self._on_new_columns()

    def _append_levels(self, view: View, samples: np.ndarray, end: float) -> None:
        """Append the levels of the audio to a view: peak and RMS (dBFS) and the clipped samples of each ear."""
        meter = LevelMeter()
        meter.add(samples)
        column = [number for ear in range(2) for number in (meter.peak(ear), meter.rms(ear), float(meter.clipped[ear]))]
        self._append(view, view.next, np.array(column, np.float32)[:, np.newaxis], end)

    def _append(self, view: View, first: int, columns: np.ndarray, end: float) -> None:
        view.append(first, columns, end)
        self._on_new_columns()

    # --- changes of the tree ---

    def on_tree_changed(self, tree: TreeSnapshot) -> set[Key]:
        """Replace the tree, close the views that are affected by its changes, and return their keys."""
        with self._lock:
            before, self.tree = self.tree, tree
            changed = {
                key
                for key in self._views
                if key.what == "picture" and _dependencies(key, before) != _dependencies(key, tree)
            }
            for key in changed:
                self._remove(key)
            return changed

    @property
    def problems(self) -> dict[str, str]:
        """Why the latest messages were ignored, by topic."""
        audio = self.audio
        topics = [*([audio] if audio else []), *list(self._ports.values())]
        return {one.topic: problem for one in topics if (problem := one.problem)}

    @property
    def lost(self) -> int:
        """Frames of ports that were not received."""
        return sum({port.topic: port.lost for port in list(self._ports.values())}.values())


def _dependencies(key: Key, tree: TreeSnapshot) -> list[Any]:
    """Return everything in the tree that determines a view."""
    processor = tree.processors.get(key.name)
    dependencies: list[Any] = [tree.sample_rate]
    return dependencies + [(ancestor, dict(ancestor.values)) for ancestor in tree.ancestors(processor)]


assert MAX_COLUMN_RATE * HISTORY_SECONDS < 2**16  # columns of a piece are a uint16
