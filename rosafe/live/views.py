"""The pictures that somebody looks at, shared by all who do, with the last seconds of each."""

from __future__ import annotations

import itertools
import struct
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rosafe.bass.recording.levels import LevelMeter
from rosafe.client.errors import too_many
from rosafe.interface import KINDS
from rosafe.live.plot_data import COLUMNS, PlotLayout, ProcessorInfo, TreeSnapshot, quantize
from rosafe.live.ports import Audio, PortReader
from rosafe.view.estimates import AZIMUTHS, lag_of_azimuth

HISTORY_SECONDS = 12.0  # that a page gets at once
MAX_VIEWS = 256  # of all pages
COHERENT = 0.7  # interaural coherence below which a channel tells nothing of a direction
MIN_WEIGHT = 0.5  # of all channels together, where there is a direction

QUANTISED, FLOAT = 0, 1
MAX_COLUMN = 2**53  # whole numbers that a page has
# number of the view, columns, numbers in a column, first column, end (s), least and greatest value, form, stride
PIECE = struct.Struct("<IHHQdffBB6x")

_numbers = itertools.count(1)


@dataclass(frozen=True)
class Key:
    """What a page looks at: a picture of a processor, the direction that a cross-correlation tells, or the levels."""

    what: str  # picture, direction, levels
    name: str = ""
    part: int = 0
    row: int = -1


class View:
    """One picture's newest columns. Filled on rospy's threads, read on the loop's.

    Columns are numbered from the beginning of the audio; `beginning` counts how often that began anew.
    """

    def __init__(self, size: int, rate: float, form: int) -> None:
        self.number = next(_numbers)
        self.size, self.rate, self.form = size, rate, form
        self.capacity = max(8, round(HISTORY_SECONDS * rate))
        self.users = 0
        self.beginning = 0
        self.next = 0  # the column after the newest one
        self.oldest = 0
        self.end = 0.0  # s of the audio
        self._ring = np.full((size, self.capacity), np.nan, np.float32)
        self._lock = threading.Lock()
        self._told: tuple[Hashable, bytes] = ((), b"")

    def append(self, first: int, columns: np.ndarray, end: float) -> None:
        """Columns (size, n) from number `first` on; what lies between them and the newest one was lost."""
        columns = columns[:, -self.capacity :]
        after = first + columns.shape[1]
        with self._lock:
            if not self.oldest <= self.next <= first or first - self.next > self.capacity:
                self.beginning += 1
                self.next = self.oldest = first
            for column in range(self.next, first):
                self._ring[:, column % self.capacity] = np.nan
            self._ring[:, self._places(first, after)] = columns
            self.next, self.end = after, end
            self.oldest = max(self.oldest, after - self.capacity)

    def _places(self, first: int, after: int, stride: int = 1) -> np.ndarray:
        """Where columns are in the ring; their numbers may be larger than those of numpy."""
        return np.arange(first % self.capacity, first % self.capacity + after - first, stride) % self.capacity

    def newest(self, count: int) -> np.ndarray:
        """The newest columns, float32 (size, count); NaN where there is nothing."""
        columns = np.full((self.size, count), np.nan, np.float32)
        with self._lock:
            first = max(self.oldest, self.next - count)
            if self.next > first:
                columns[:, -(self.next - first) :] = self._ring[:, self._places(first, self.next)]
        return columns

    def piece(self, first: int, stride: int, most: int) -> tuple[int, bytes]:
        """Which column comes next, and the bytes of those from `first` on, at most so many: every `stride`-th one."""
        with self._lock:
            first = max(first, self.oldest)
            first += -first % stride
            count = min(most, (self.next - first) // stride)
            if count <= 0:
                return first, b""
            end = self.end - (self.next - first - count * stride) / self.rate
            key = (first, stride, count, self.beginning)
            if self._told[0] != key:
                columns = self._ring[:, self._places(first, first + count * stride, stride)]
                low = high = 0.0
                if self.form == QUANTISED:
                    low, high, data = quantize(columns)
                else:
                    data = np.ascontiguousarray(columns.T, "<f4").tobytes()
                if first + count * stride > MAX_COLUMN:
                    raise ValueError(f"expected columns up to number {MAX_COLUMN}, got {first}")
                head = PIECE.pack(self.number, count, self.size, first, end, low, high, self.form, stride)
                self._told = key, head + data + bytes(-len(data) % 8)
            return first + count * stride, self._told[1]


class _SharedSubscription:
    """A port and the pictures that are made of it."""

    def __init__(self, port: PortReader) -> None:
        self.port = port
        self.callbacks: dict[Key, Callable[[PortReader, Any], None]] = {}


class Hub:
    """All views. Its methods may block on the master for a moment: call them on a thread.

    Parameters
    ----------
    audio_topic : str
        Of bass.
    news : callable
        Called on rospy's threads where a view has new columns.
    """

    def __init__(self, audio_topic: str, news: Callable[[], None]) -> None:
        self.tree = TreeSnapshot()
        self.audio: Audio | None = None
        self.latencies: dict[str, float] = {}  # s, by topic: from the capture of the newest frame until it was here
        self.clipped_at = 0.0  # s of the audio
        self._audio_topic = audio_topic
        self._news = news
        self._views: dict[Key, View] = {}
        self._told: dict[Key, dict[str, Any]] = {}
        self._watched: dict[str, _SharedSubscription] = {}
        self._needs: dict[Key, list[str]] = {}  # topics
        self._lock = threading.RLock()
        self._closed = False

    def close(self) -> None:
        """Let go of all ports, for good: who is still on the way to look at one finds none."""
        with self._lock:
            self._closed = True
            for key in list(self._views):
                del self._views[key], self._told[key]
                self._let_go(key)

    # --- who looks at what ---

    def subscribe(self, key: Key) -> tuple[View, dict[str, Any]]:
        """The view for `key` and its description, one user more; ValueError where there is no such thing."""
        with self._lock:
            if key not in self._views:
                if self._closed:
                    raise ValueError("the page ends")
                if len(self._views) >= MAX_VIEWS:
                    raise too_many(f"{MAX_VIEWS} pictures are shown already")
                self._begin(key)
            self._views[key].users += 1
            return self._views[key], self._told[key]

    def unsubscribe(self, key: Key, left: View) -> None:
        """One user of a view less; a port that nobody looks at any more is not subscribed."""
        with self._lock:
            view = self._views.get(key)
            if view is not left:  # the tree has changed, and with it all views of `key`
                return
            view.users -= 1
            if view.users <= 0:
                del self._views[key], self._told[key]
                self._let_go(key)

    def shows(self, key: Key, view: View) -> bool:
        """Whether `view` is that of `key` still."""
        with self._lock:
            return self._views.get(key) is view

    def _let_go(self, key: Key) -> None:
        if key.what == "levels" and self.audio is not None:
            self.audio.close()
            self.audio = None
        for topic in self._needs.pop(key, ()):
            watched = self._watched[topic]
            watched.callbacks.pop(key, None)
            if not watched.callbacks:
                watched.port.close()
                del self._watched[topic]
                self.latencies.pop(topic, None)

    def _begin(self, key: Key) -> None:
        if key.what == "levels":
            view = View(6, 20.0, FLOAT)
            self._views[key], self._told[key] = view, {"mode": "levels", "rows": 3, "ears": 2, "rate": view.rate}
            self.audio = Audio(self._audio_topic, _Meter(view, self._news))
            return
        processor = self.tree.processors.get(key.name)
        if processor is None or not self.tree.sample_rate:
            raise ValueError(f"there is no processor {key.name!r}")
        if processor.kind not in KINDS:
            raise ValueError(f"{processor.name} is a {processor.kind}, of a plugin that is not known here")
        if not processor.rate or len(processor.shape) < max(len(part.axes) for part in KINDS[processor.kind].parts) - 1:
            raise ValueError(f"{processor.name}: the shape and rate of its frames are not known")
        if key.what == "direction":
            self._begin_direction(key, processor)
        else:
            picture = PlotLayout(self.tree, processor, key.part, key.row)
            view = View(picture.size, picture.rate, QUANTISED if picture.mode == "heat" else FLOAT)
            self._views[key], self._told[key] = view, picture.describe()
            self._watch(key, processor, _PlotWriter(picture, view, self._news))

    def _begin_direction(self, key: Key, processor: ProcessorInfo) -> None:
        if processor.kind != "crossCorrelation":
            raise ValueError(f"{processor.name} tells no direction")
        itd, ic = (self.tree.child(processor.name, kind) for kind in ("itd", "ic"))
        source = itd or processor
        view = View(1, source.rate, FLOAT)
        track = _DirectionTracker(
            view, self._lags(processor), weighted=itd is not None and ic is not None, news=self._news
        )
        frequencies = self.tree.coordinates(processor, "channel", processor.shape[0]) or []
        azimuths = AZIMUTHS[::15]
        self._views[key] = view
        self._told[key] = {
            "mode": "direction",
            "name": key.name,
            "from": [p.name for p in (itd, ic) if p is not None and itd is not None],
            "ears": 1,
            "rows": 1,
            "rate": view.rate,
            "azimuths": azimuths.tolist() if frequencies else [],
            "lags": lag_of_azimuth(np.array(frequencies), azimuths).tolist() if frequencies else [],
        }
        self._watch(key, source, track.itd if itd else track.peak)
        if itd and ic:
            self._watch(key, ic, track.ic)

    def _lags(self, processor: ProcessorInfo) -> np.ndarray:
        return np.array(self.tree.coordinates(processor, "lag", processor.shape[1]) or [0.0])

    def _watch(self, key: Key, processor: ProcessorInfo, take: Callable[[PortReader, Any], None]) -> None:
        topic = processor.topic
        if topic not in self._watched:
            port = PortReader(processor, processor.output_shape(), self.tree.sample_rate, self._dispatch)
            self._watched[topic] = _SharedSubscription(port)
        self._watched[topic].callbacks[key] = take
        self._needs.setdefault(key, []).append(topic)

    def _dispatch(self, port: PortReader, message: Any) -> None:
        with self._lock:  # a port's first message may come while its first taker is still on the way
            watched, audio = self._watched.get(port.topic), self.audio
            if watched is None or watched.port is not port:
                return
            takers = list(watched.callbacks.values())
        captured = audio.captured_at(port.index) if audio is not None else None
        if captured is not None:
            self.latencies[port.topic] = time.time() - captured
        for take in takers:
            take(port, message)

    # --- changes of the tree ---

    def on_tree_changed(self, tree: TreeSnapshot) -> set[Key]:
        """Go over to what the tree has become; the keys whose views are others now, or gone."""
        with self._lock:
            before, self.tree = self.tree, tree
            changed = set()
            for key in list(self._views):
                if key.what != "levels" and self._affected_views(key, before) != self._affected_views(key, tree):
                    changed.add(key)
                    del self._views[key], self._told[key]
                    self._let_go(key)
            return changed

    def _affected_views(self, key: Key, tree: TreeSnapshot) -> list[Any]:
        """All that a view of `key` depends on."""
        one = tree.processors.get(key.name)
        told: list[Any] = [tree.sample_rate]
        if one is not None and key.what == "direction":
            told += [tree.child(one.name, "itd"), tree.child(one.name, "ic")]
        while one is not None:
            told.append((one, dict(one.values)))
            one = tree.processors.get(one.parent)
        return told

    @property
    def problems(self) -> dict[str, str]:
        """Why messages of late were ignored, by topic."""
        audio = self.audio
        topics = [*([audio] if audio else []), *(watched.port for watched in list(self._watched.values()))]
        return {one.topic: problem for one in topics if (problem := one.problem)}

    @property
    def lost(self) -> int:
        """Frames of ports that did not come here."""
        return sum(watched.port.lost for watched in list(self._watched.values()))


class _PlotWriter:
    """Makes a picture's columns of a port's messages."""

    def __init__(self, picture: PlotLayout, view: View, news: Callable[[], None]) -> None:
        self._picture, self._view, self._news = picture, view, news

    def __call__(self, port: PortReader, message: Any) -> None:
        picture, view = self._picture, self._view
        arrays = [getattr(message, field) for field in picture.fields]
        frames = arrays[0].shape[-1]
        group = picture.group
        after = port.newest // group
        # from the first column that is not there yet, as far as the window has all of its frames
        first = -(-(port.newest - port.fresh - (group - 1)) // group) if port.fresh < frames else 0
        if view.next and 0 <= view.next <= after:
            first = view.next
        first = max(first, -(-(port.newest - frames) // group), 0)
        if after <= first:
            return
        start = frames - (port.newest - first * group)
        cut = [array[..., start : start + (after - first) * group] for array in arrays]
        view.append(first, picture.columns(cut), port.end - (port.newest - after * group) / port.rate)
        self._news()


class _Meter:
    """Makes the columns of the level meters: peak and RMS (dBFS) and clipped samples of each ear."""

    def __init__(self, view: View, news: Callable[[], None]) -> None:
        self._view, self._news = view, news

    def __call__(self, samples: np.ndarray, lost: int, end: float) -> None:
        levels = LevelMeter()
        levels.add(samples)
        column = [
            number for ear in range(2) for number in (levels.peak(ear), levels.rms(ear), float(levels.clipped[ear]))
        ]
        view = self._view
        view.append(view.next, np.array(column, np.float32)[:, np.newaxis], end)
        self._news()


class _DirectionTracker:
    """The lag of the source in each frame: the mean of the channels' ITDs, weighted by their coherence.

    Without ITDs, the place of the cross-correlation's peak.
    """

    def __init__(self, view: View, lags: np.ndarray, weighted: bool, news: Callable[[], None]) -> None:
        self._view, self._lags, self._news = view, lags, news
        self._weighted = weighted
        self._lock = threading.Lock()
        self._waiting: dict[str, tuple[int, int, np.ndarray, float]] = {}

    def itd(self, port: PortReader, message: Any) -> None:
        """A message of itd."""
        self._together("itd", port, message)

    def ic(self, port: PortReader, message: Any) -> None:
        """A message of ic."""
        self._together("ic", port, message)

    def _together(self, which: str, port: PortReader, message: Any) -> None:
        """Take one of the two; what both tell of is used, also of blocks that came in another order."""
        with self._lock:
            self._waiting[which] = (port.index, port.newest, message.left, port.end)
            itd, ic = self._waiting.get("itd"), self._waiting.get("ic")
            if itd is None or (self._weighted and (ic is None or ic[0] != itd[0])):
                return
            _, newest, lags, end = itd
            count = min(self._missing(newest, port), lags.shape[-1], lags.shape[-1] if ic is None else ic[2].shape[-1])
            if count == 0:
                return
            lags = lags[:, -count:]
            weights = np.ones(lags.shape)
            if ic is not None and self._weighted:
                weights = np.maximum(ic[2][:, -count:] - COHERENT, 0.0) / (1.0 - COHERENT)
            total = weights.sum(axis=0)
            heard = total > MIN_WEIGHT
            lag = np.divide((weights * lags).sum(axis=0), total, out=np.full(total.shape, np.nan), where=heard)
            self._put(newest, lag, end)

    def _missing(self, newest: int, port: PortReader) -> int:
        """How many frames up to the newest one the view does not have."""
        following = self._view.next if 0 < self._view.next <= newest else newest - port.fresh
        return newest - following

    def peak(self, port: PortReader, message: Any) -> None:
        """A message of the cross-correlation."""
        count = min(self._missing(port.newest, port), message.left.shape[-1])
        if count == 0:
            return
        curves = message.left[..., -count:].mean(axis=1)
        place = curves.argmax(axis=0)
        flat = curves.max(axis=0) - curves.min(axis=0) < 1e-9
        inside = (place > 0) & (place < len(curves) - 1)
        frames = np.arange(curves.shape[1])
        step = inside.astype(int)
        before, at, after = (curves[place + shift * step, frames] for shift in (-1, 0, 1))
        bend = before - 2 * at + after
        offset = np.divide(0.5 * (before - after), bend, out=np.zeros(bend.shape), where=inside & (bend < 0))
        width = self._lags[1] - self._lags[0] if len(self._lags) > 1 else 0.0
        with self._lock:
            self._put(port.newest, np.where(flat, np.nan, self._lags[place] + offset * width), port.end)

    def _put(self, newest: int, lag: np.ndarray, end: float) -> None:
        self._view.append(newest - len(lag), lag[np.newaxis].astype(np.float32), end)
        self._news()


assert COLUMNS * HISTORY_SECONDS < 2**16  # columns of a piece
