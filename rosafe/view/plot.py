"""`rosafe.plot`: draws any representation from what its declaration says of its axes and units, plugins too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.missing import require
from rosafe.view.axes import frequency_axis, image, style
from rosafe.view.coordinates import EARS, along, check_result, frame_times
from rosafe.view.levels import LEVELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RANGE_DB = 60.0  # of levels, below the loudest
UNDER = {"pitch": "ratemap", "onsetMap": "onsetStrength", "offsetMap": "offsetStrength"}  # what lies under them
PITCH_TOP = 1000.0  # Hz; the ratemap under the pitch ends there
COLUMNS = 1500  # of an image, at most
MARKED = 400  # frames, up to which marks are as wide as they can be
TICKS = 6
MAX_VALUE = 1e100  # numbers that can be drawn

_OUTPUTS = {name: (kind, part) for kind in KINDS.values() for name, part in kind.outputs.items()}
_AXIS_NAMES = {
    "channel": "centre frequency (Hz)",
    "filter": "modulation frequency (Hz)",
    "lag": "lag (ms)",
    "feature": "feature",
}


def plot(
    result: Mapping[str, Any],
    outputs: Sequence[str] | str | None = None,
    ax: Axes | None = None,
    *,
    ear: str | None = None,
    at: float | None = None,
    channel: float | None = None,
    sample_rate: float | None = None,
) -> Figure:
    """Draw representations over time.

    Channels lie at their centre frequencies, lags in ms, filters at their modulation frequencies; colours have units.
    Correlations are means over the channels, unless `at` or `channel` says otherwise; modulation spectrograms are shown
    for one moment, the loudest. Pitch lies over the ratemap, and maps lie over strengths, where those are in `result`.

    Parameters
    ----------
    result : mapping
        What `rosafe.process` returned, or the arrays of a file that `rosafe process` wrote.
    outputs : sequence of str, optional
        Which of them, by the names in `result`; `precedence` stands for its three parts. All by default.
    ax : matplotlib.axes.Axes, optional
        Where to draw, then one output, and of two ears the left one unless `ear` says otherwise. A new figure of pyplot
        by default.
    ear : str, optional
        ``left`` or ``right``. Both by default.
    at : float, optional
        Seconds: outputs of channels and lags, or filters, are drawn for the frame nearest to this.
    channel : float, optional
        Hz: they are drawn for the channel nearest to this, over time.
    sample_rate : float, optional
        Hz, for outputs without frames, where `result` has neither `sample_rate` nor lags to tell it.

    Returns
    -------
    matplotlib.figure.Figure
        A new one, or that of `ax`.

    Raises
    ------
    ValueError
        An output is not there, or several are for one `ax`; another `ear`; the sample rate is not known.
    """
    names = _chosen(result, outputs)
    if ear not in (None, *EARS):
        raise ValueError(f"ear: {ear!r} is not one of {', '.join(EARS)}")
    options = {"at": at, "channel": channel, "sample_rate": sample_rate}
    if ax is None:
        figure: Figure = require("matplotlib.pyplot", "rosafe.plot").figure()
        return draw(figure, result, names, ear, **options)
    if len(names) != 1:
        raise ValueError(f"ax: it takes one output, and there are {', '.join(names)}; choose one with outputs")
    if not hasattr(ax, "get_xlim"):  # such as all axes of a figure
        raise ValueError(f"ax: {type(ax).__name__} is not matplotlib's Axes")
    with style():
        _Panel(result, names[0], **options).draw(ax, EARS.index(ear or EARS[0]))
    return ax.figure


def draw(
    figure: Figure,
    result: Mapping[str, Any],
    outputs: Sequence[str] | str | None = None,
    ear: str | None = None,
    **options: float | None,
) -> Figure:
    """As `plot`, into a figure, whose size becomes what that needs: two columns, both ears side by side."""
    panels = [_Panel(result, name, **options) for name in _chosen(result, outputs)]
    one = ear is not None or all(panel.ears < 2 for panel in panels)
    if not one:  # no gaps beside those of both ears together
        panels.sort(key=lambda panel: not panel.ears)
    cells: list[tuple[_Panel, int]] = []
    for panel in panels:
        if one or not panel.ears:
            cells.append((panel, EARS.index(ear or EARS[0])))
        else:  # the ears in one row
            cells += [(panel, index) for index in range(panel.ears)]
    columns = 1 if one else 2
    with style():
        figure.set_size_inches(8.0 if one else 13.0, 0.3 + 2.1 * -(-len(cells) // columns))
        figure.set_layout_engine("constrained")
        grid = figure.add_gridspec(-(-len(cells) // columns), columns)
        for place, (panel, index) in zip(grid, cells, strict=False):
            panel.draw(figure.add_subplot(place), index)
    return figure


def _chosen(result: Mapping[str, Any], outputs: Sequence[str] | str | None) -> list[str]:
    """The names in `result` of what is to be drawn, each once, in the order asked for."""
    check_result(result)
    there = [name for name in _OUTPUTS if name in result]
    if outputs is None:
        outputs = there
    if not isinstance(outputs, Iterable):
        raise ValueError(f"outputs: {outputs!r} is not a sequence of names")
    names: dict[str, None] = {}
    for wanted in [outputs] if isinstance(outputs, str) else outputs:
        parts = list(KINDS[wanted].outputs) if wanted in KINDS else [wanted]
        if not set(parts) <= set(there):
            raise ValueError(f"there is no output {wanted!r} in the result; there are: {', '.join(there) or 'none'}")
        names.update(dict.fromkeys(parts))
    if not names:
        raise ValueError("the result holds no output that can be drawn")
    return list(names)


class _Panel:
    """One output: its numbers, what lies along its axes, and how it is drawn for one ear."""

    def __init__(
        self,
        result: Mapping[str, Any],
        name: str,
        at: float | None = None,
        channel: float | None = None,
        sample_rate: float | None = None,
    ) -> None:
        self.result, self.name, self.at, self.channel, self.sample_rate = result, name, at, channel, sample_rate
        self.kind, part = _OUTPUTS[name]
        self.axes, self.unit = part.axes, part.unit
        self.data = np.asarray(result[name], np.float64)
        if np.any(np.isfinite(self.data) & (np.abs(self.data) > MAX_VALUE)):
            raise ValueError(f"{name}: expected numbers between -{MAX_VALUE:g} and {MAX_VALUE:g} to draw")
        if self.data.ndim != len(self.axes):
            raise ValueError(f"{name} has shape {self.data.shape}, wanted are the axes {', '.join(self.axes)}")
        self.note = ""  # what was chosen of more than two axes
        self.ears = self.data.shape[0] if "ear" in self.axes else 0

    # --- what lies along the axes ---

    @cached_property
    def times(self) -> np.ndarray:
        """The middle of each frame (s)."""
        return frame_times(self.result, self.kind, self.data.shape[-1], self.sample_rate)

    def along(self, axis: str) -> np.ndarray:
        """What lies along an axis: frequencies (Hz), lags (ms) or words."""
        values = along(self.result, self.kind, axis, self.data.shape[self.axes.index(axis)])
        return 1e3 * values if axis == "lag" and values.dtype.kind == "f" else values

    # --- drawing ---

    def draw(self, axes: Axes, ear: int) -> None:
        """Draw the numbers, of one ear where there are two."""
        what = self.name if self.ears < 2 else f"{self.name}, {EARS[ear]} ear"
        ear = min(ear, max(self.ears - 1, 0))
        self.note = ""
        if self.data.size == 0:
            axes.text(0.5, 0.5, "no frames", ha="center", va="center", transform=axes.transAxes)
            axes.set(xticks=[], yticks=[])
        elif self.kind.kind == "pitch":
            self._draw_pitch(axes, ear)
        elif self.under is not None and self.axes == ("ear", "channel", "time"):
            self._draw_marks(axes, ear)
        elif len(self.axes) == 1 + bool(self.ears):
            self._draw_line(axes, ear)
        else:
            self._draw_image(axes, ear)
        axes.set_title(what + self.note)

    @cached_property
    def under(self) -> _Panel | None:
        """What lies under it, where that is there."""
        name = UNDER.get(self.kind.kind)
        if name is None or not np.size(self.result.get(name, ())):
            return None
        return _Panel(self.result, name)

    def _draw_line(self, axes: Axes, ear: int) -> None:
        data = self.data[ear] if self.ears else self.data
        times, group = self.times, -(-len(data) // COLUMNS)
        if group > 2:  # the least and the greatest of each column look the same as all of them
            starts = np.arange(0, len(data), group)
            times = np.repeat(times[starts], 2)
            data = np.stack([np.minimum.reduceat(data, starts), np.maximum.reduceat(data, starts)], -1).ravel()
        axes.plot(times, data, linewidth=0.7, color="#1d3557")
        axes.set(xlabel="time (s)", ylabel=self.unit or "amplitude", xlim=(self.times[0], self.times[-1] + 1e-9))

    def _draw_pitch(self, axes: Axes, ear: int) -> None:
        pitch = self.data[ear, 0]
        if self.under is None:
            axes.plot(self.times, pitch, ".", color="#e63946", markersize=4)
            axes.set(xlabel="time (s)", ylabel="pitch (Hz)")
            return
        self.under._draw_image(axes, ear)
        frequencies = self.under.along("channel")
        order = np.argsort(frequencies)
        height = np.interp(pitch, frequencies[order], order, left=np.nan, right=np.nan)
        axes.plot(self.times, height, ".", color="#00e5ff", markersize=self._narrowed(4.0, 1.0))
        top = int(np.searchsorted(frequencies, PITCH_TOP))
        if np.array_equal(order, np.arange(len(order))) and top > 1:
            frequency_axis(axes, frequencies[:top], TICKS)
            axes.set_ylim(-0.5, top - 0.5)
        self.note = " over the ratemap"

    def _draw_marks(self, axes: Axes, ear: int) -> None:
        assert self.under is not None
        self.under._draw_image(axes, ear, cmap="Greys")
        channels, frames = np.nonzero(self.data[ear])
        width = self._narrowed(3.5, 0.1)
        axes.plot(self.times[frames], channels, "|", color="#e63946", markersize=3.5, markeredgewidth=width)
        self.note = f" over {self.under.name}"

    def _narrowed(self, points: float, least: float) -> float:
        """The width of a mark, so that the marks of a long sound do not hide each other."""
        return max(least, min(points, points * MARKED / self.data.shape[-1]))

    def _draw_image(self, axes: Axes, ear: int, **options: Any) -> None:
        data, (upright, across), self.note = self._plane
        data, label, limits = self._coloured
        shown = data[ear] if self.ears else data
        left, right = self._axis(axes, across, "x")
        bottom, top = self._axis(axes, upright, "y")
        shade = image(axes, shown, (left, right, bottom, top), **{**limits, **options})
        if across == "time" and len(self.times) > 1:
            axes.set_xlim(left, self.times[-1] + (self.times[1] - self.times[0]) / 2)
        below, above = np.min(data) < limits["vmin"], np.max(data) > limits["vmax"]
        extend = ("both" if above else "min") if below else ("max" if above else "neither")
        axes.figure.colorbar(shade, ax=axes, label=label, extend=extend, pad=0.015, aspect=14)

    @cached_property
    def _plane(self) -> tuple[np.ndarray, tuple[str, str], str]:
        """The numbers as (ears,) rows and columns, the names of these two axes, and what became of the others."""
        note = ""
        data, axes = self.data, [axis for axis in self.axes if axis != "ear"]
        first = data.ndim - len(axes)
        moment = self.at
        if len(axes) > 2 and "filter" in axes and moment is None and self.channel is None:
            moment = float(self.times[np.abs(data).sum(axis=tuple(range(data.ndim - 1))).argmax()])
        if len(axes) > 2 and self.channel is not None and "channel" in axes:
            frequencies = self.along("channel")
            nearest = int(np.abs(frequencies - self.channel).argmin())
            data = np.take(data, nearest, axis=first + axes.index("channel"))
            axes.remove("channel")
            note = f", channel of {frequencies[nearest]:.0f} Hz"
        elif len(axes) > 2 and moment is not None:
            frame = int(np.abs(self.times - moment).argmin())
            data = data[..., frame]
            axes.remove("time")
            note = f", at {self.times[frame]:.2f} s"
        while len(axes) > 2:
            data = data.mean(axis=first)
            note += f", mean over the {axes.pop(0)}s"
        if axes[-1] == "time" and data.shape[-1] > COLUMNS:
            starts = np.arange(0, data.shape[-1], self._group)
            if f"{self.kind.kind}_frameRate" in self.result:
                counts = np.diff([*starts, data.shape[-1]])
                data = np.add.reduceat(data, starts, axis=-1) / counts
            else:  # samples: what is greatest shows
                whole = np.abs(data) if self.kind.kind in LEVELS else data
                data = np.maximum.reduceat(whole, starts, axis=-1)
        return data, (axes[0], axes[1]), note

    @property
    def _group(self) -> int:
        """How many frames make a column."""
        return -(-self.data.shape[-1] // COLUMNS)

    @cached_property
    def _coloured(self) -> tuple[np.ndarray, str, dict[str, Any]]:
        """What the colours show, the label of their bar, and their limits, which are those of both ears."""
        data, axes, _ = self._plane
        if self.kind.kind in LEVELS:
            size = np.abs(data)
            loudest = float(size.max()) or 1.0  # silence is not loud
            level = LEVELS[self.kind.kind] * np.log10(np.maximum(size, 1e-200) / loudest)
            return np.maximum(level, -RANGE_DB), "dB re loudest", {"cmap": "magma", "vmin": -RANGE_DB, "vmax": 0.0}
        if "feature" in axes and self.along("feature").dtype.kind == "U":  # of different units
            whole = np.moveaxis(data, 0, -1) if self.ears else data[..., np.newaxis]
            low, high = np.percentile(whole, (1, 99), axis=(1, 2), keepdims=True)
            scaled = np.clip((whole - low) / np.where(high > low, high - low, 1.0), 0, 1)
            data = np.moveaxis(scaled, -1, 0) if self.ears else scaled[..., 0]
            return data, "part of its range", {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0}
        unit, data = ("ms", 1e3 * data) if self.unit == "s" else (self.unit, data)
        low, high = np.percentile(data, (1, 99))
        signed = not self.ears and self.unit  # differences of the ears
        if signed or -low > 0.25 * high:
            reach = float(np.percentile(np.abs(data), 99)) or 1.0
            return data, unit, {"cmap": "RdBu_r", "vmin": -reach, "vmax": reach}
        return data, unit, {"cmap": "viridis", "vmin": float(low), "vmax": float(high) if high > low else low + 1.0}

    def _axis(self, axes: Axes, axis: str, which: str) -> tuple[float, float]:
        """Label one axis; returns its ends."""
        if axis == "time":
            axes.set_xlabel("time (s)")
            step = self.times[1] - self.times[0] if len(self.times) > 1 else 2 * self.times[0] or 1.0
            begin = self.times[0] - step / 2
            columns = -(-len(self.times) // self._group)
            return float(begin), float(begin + columns * self._group * step)
        values = self.along(axis)
        if axis == "lag" and len(values) > 1:
            half = (values[1] - values[0]) / 2
            axes.set(**{f"{which}label": _AXIS_NAMES[axis]})
            return float(values[0] - half), float(values[-1] + half)
        if values.dtype.kind == "U":
            axes.set(**{f"{which}ticks": np.arange(len(values)), f"{which}ticklabels": values})
            axes.tick_params(which, labelsize="x-small")
        elif np.array_equal(values, np.arange(len(values))):
            axes.set(**{f"{which}label": axis})
        else:
            frequency_axis(axes, values, TICKS, _AXIS_NAMES[axis], which)
        return -0.5, len(values) - 0.5
