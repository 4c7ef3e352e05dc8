"""`rosafe.plot`: plots any representation, also of plugins, using the axes and units of its declaration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.results.view.axes import frequency_axis, image, style
from rosafe.results.view.coordinates import EARS, axis_coordinates, check_result, frame_times
from rosafe.system.missing import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RANGE_DB = 60.0  # of levels, below the loudest
MAX_FREQUENCY = 1000.0  # Hz; the upper limit of the background of a frequency, such as the pitch
MAX_COLUMNS = 1500  # of an image
WIDE_MARKS = 400  # frames up to which marks have their full width
MAX_TICKS = 6
MAX_VALUE = 1e100  # that can be plotted

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
    """Plot representations over time.

    Channels are labelled with their centre frequencies, lags in ms, filters with their modulation frequencies; colour
    bars have units. Correlations are means over the channels, unless `at` or `channel` is given. Modulation
    spectrograms are shown for one moment, the loudest. Pitch is plotted over the ratemap, and onset and offset maps
    over the strengths, if these are in `result`.

    Parameters
    ----------
    result : mapping
        A result of `rosafe.process`, or of `rosafe.load` for a file of `rosafe process`.
    outputs : sequence of str, optional
        Names of outputs in `result`; `precedence` stands for its three parts. All by default.
    ax : matplotlib.axes.Axes, optional
        Axes for one output; of two ears the left one, unless `ear` is given. By default a new figure of pyplot.
    ear : str, optional
        ``left`` or ``right``. Both by default.
    at : float, optional
        Seconds; outputs with channels and lags or filters are plotted at the frame nearest to this time.
    channel : float, optional
        Hz; these outputs are plotted over time for the channel nearest to this frequency.
    sample_rate : float, optional
        Hz, for outputs without frames if `result` has neither `sample_rate` nor lags.

    Returns
    -------
    matplotlib.figure.Figure
        A new figure, or that of `ax`.

    Raises
    ------
    ValueError
        An output is missing, `ax` is given for several outputs, `ear` is not valid, or the sample rate is unknown.
    """
    names = _output_names(result, outputs)
    if ear not in (None, *EARS):
        raise ValueError(f"ear: expected one of {', '.join(EARS)}, got {ear!r}")
    options = {"at": at, "channel": channel, "sample_rate": sample_rate}
    if ax is None:
        figure: Figure = require("matplotlib.pyplot", "rosafe.plot").figure()
        return draw(figure, result, names, ear, **options)
    if len(names) != 1:
        raise ValueError(f"ax: expected one output, got {', '.join(names)}; choose one with outputs")
    if not hasattr(ax, "get_xlim"):  # for example an array of axes
        raise ValueError(f"ax: expected matplotlib Axes, got {type(ax).__name__}")
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
    """Plot into a figure and set its size; the ears are side by side, in two columns."""
    panels = [_Panel(result, name, **options) for name in _output_names(result, outputs)]
    single = ear is not None or all(panel.ears < 2 for panel in panels)
    if not single:  # outputs with two ears first, so that each has a row
        panels.sort(key=lambda panel: not panel.ears)
    first = EARS.index(ear or EARS[0])
    cells = [
        (panel, index) for panel in panels for index in ([first] if single or not panel.ears else range(panel.ears))
    ]
    columns = 1 if single else 2
    with style():
        figure.set_size_inches(8.0 if single else 13.0, 0.3 + 2.1 * -(-len(cells) // columns))
        figure.set_layout_engine("constrained")
        grid = figure.add_gridspec(-(-len(cells) // columns), columns)
        for place, (panel, index) in zip(grid, cells, strict=False):
            panel.draw(figure.add_subplot(place), index)
    return figure


def _output_names(result: Mapping[str, Any], outputs: Sequence[str] | str | None) -> list[str]:
    """Return the names of the requested outputs in `result`, without duplicates, in the given order."""
    check_result(result)
    available = [name for name in _OUTPUTS if name in result]
    if outputs is None:
        outputs = available
    if not isinstance(outputs, Iterable):
        raise ValueError(f"outputs: expected a sequence of names, got {outputs!r}")
    names: dict[str, None] = {}
    for name in [outputs] if isinstance(outputs, str) else outputs:
        parts = list(KINDS[name].outputs) if name in KINDS else [name]
        if not set(parts) <= set(available):
            raise ValueError(
                f"outputs: expected outputs of the result ({', '.join(available) or 'none'}), got {name!r}"
            )
        names.update(dict.fromkeys(parts))
    if not names:
        raise ValueError("outputs: expected at least one output of the result, got none")
    return list(names)


class _Panel:
    """The plot of one output: its values, coordinates and drawing style."""

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
            raise ValueError(f"{name}: expected numbers between -{MAX_VALUE:g} and {MAX_VALUE:g}")
        if self.data.ndim != len(self.axes):
            raise ValueError(
                f"{name}: expected the axes {', '.join(self.axes)}, got an array of shape {self.data.shape}"
            )
        self.note = ""  # for the title: the selection or mean along further axes
        self.ears = self.data.shape[0] if "ear" in self.axes else 0

    # --- coordinates ---

    @cached_property
    def times(self) -> np.ndarray:
        """Centre of each frame (s)."""
        return frame_times(self.result, self.kind, self.data.shape[-1], self.sample_rate)

    def along(self, axis: str) -> np.ndarray:
        """Return the coordinates along an axis: frequencies (Hz), lags (ms) or names."""
        values = axis_coordinates(self.result, self.kind, axis, self.data.shape[self.axes.index(axis)])
        return 1e3 * values if axis == "lag" and values.dtype.kind == "f" else values

    @property
    def _decibels(self) -> float:
        parameters = self.result.get("parameters")  # a text if numpy.load has read the file
        return self.kind.decibels(parameters if isinstance(parameters, Mapping) else {})

    # --- drawing ---

    def draw(self, axes: Axes, ear: int) -> None:
        """Draw the output, of one ear if there are two."""
        title = self.name if self.ears < 2 else f"{self.name}, {EARS[ear]} ear"
        ear = min(ear, max(self.ears - 1, 0))
        self.note = ""
        if self.data.size == 0:
            axes.text(0.5, 0.5, "no frames", ha="center", va="center", transform=axes.transAxes)
            axes.set(xticks=[], yticks=[])
        elif self.kind.background and self.axes == ("ear", "feature", "time"):
            self._draw_frequency(axes, ear)
        elif self.background is not None and self.axes == ("ear", "channel", "time"):
            self._draw_marks(axes, ear)
        elif len(self.axes) == 1 + bool(self.ears):
            self._draw_line(axes, ear)
        else:
            self._draw_image(axes, ear)
        axes.set_title(title + self.note)

    @cached_property
    def background(self) -> _Panel | None:
        """The panel that is drawn behind this one, if the result contains it."""
        name = self.kind.background
        return _Panel(self.result, name) if np.size(self.result.get(name, ())) else None

    def _draw_line(self, axes: Axes, ear: int) -> None:
        data = self.data[ear] if self.ears else self.data
        times, group = self.times, self._group
        if group > 2:  # minimum and maximum of each column look the same as all samples
            starts = np.arange(0, len(data), group)
            times = np.repeat(times[starts], 2)
            data = np.stack([np.minimum.reduceat(data, starts), np.maximum.reduceat(data, starts)], -1).ravel()
        axes.plot(times, data, linewidth=0.7, color="#1d3557")
        axes.set(xlabel="time (s)", ylabel=self.unit or "amplitude", xlim=(self.times[0], self.times[-1] + 1e-9))

    def _draw_frequency(self, axes: Axes, ear: int) -> None:
        """Draw the first feature (Hz) as points over the channels of the background."""
        values = self.data[ear, 0]
        if self.background is None:
            axes.plot(self.times, values, ".", color="#e63946", markersize=4)
            axes.set(xlabel="time (s)", ylabel=f"{self.along('feature')[0]} (Hz)")
            return
        self.background._draw_image(axes, ear)
        frequencies = self.background.along("channel")
        order = np.argsort(frequencies)
        height = np.interp(values, frequencies[order], order, left=np.nan, right=np.nan)
        axes.plot(self.times, height, ".", color="#00e5ff", markersize=self._mark_size(4.0, 1.0))
        top = int(np.searchsorted(frequencies, MAX_FREQUENCY))
        if np.array_equal(order, np.arange(len(order))) and top > 1:
            frequency_axis(axes, frequencies[:top], MAX_TICKS)
            axes.set_ylim(-0.5, top - 0.5)
        self.note = f" over the {self.background.name}"

    def _draw_marks(self, axes: Axes, ear: int) -> None:
        assert self.background is not None
        self.background._draw_image(axes, ear, cmap="Greys")
        channels, frames = np.nonzero(self.data[ear])
        width = self._mark_size(3.5, 0.1)
        axes.plot(self.times[frames], channels, "|", color="#e63946", markersize=3.5, markeredgewidth=width)
        self.note = f" over {self.background.name}"

    def _mark_size(self, points: float, min_points: float) -> float:
        """Return the width of a mark; it is smaller in long signals, so that marks do not overlap."""
        return max(min_points, min(points, points * WIDE_MARKS / self.data.shape[-1]))

    def _draw_image(self, axes: Axes, ear: int, **options: Any) -> None:
        data, (vertical, horizontal), self.note = self._plane
        data, label, limits = self._colours
        shown = data[ear] if self.ears else data
        left, right = self._axis(axes, horizontal, "x")
        bottom, top = self._axis(axes, vertical, "y")
        mappable = image(axes, shown, (left, right, bottom, top), **{**limits, **options})
        if horizontal == "time" and len(self.times) > 1:
            axes.set_xlim(left, self.times[-1] + (self.times[1] - self.times[0]) / 2)
        below, above = np.min(data) < limits["vmin"], np.max(data) > limits["vmax"]
        extend = ("both" if above else "min") if below else ("max" if above else "neither")
        axes.figure.colorbar(mappable, ax=axes, label=label, extend=extend, pad=0.015, aspect=14)

    @cached_property
    def _plane(self) -> tuple[np.ndarray, tuple[str, str], str]:
        """The values as ((ears,) rows, columns), the names of these two axes, and a note on the other axes."""
        note = ""
        data, axes = self.data, [axis for axis in self.axes if axis != "ear"]
        first = data.ndim - len(axes)
        if len(axes) > 2:
            moment = self.at
            if self.channel is not None and "channel" in axes:
                frequencies = self.along("channel")
                nearest = int(np.abs(frequencies - self.channel).argmin())
                data = np.take(data, nearest, axis=first + axes.index("channel"))
                axes.remove("channel")
                note = f", channel of {frequencies[nearest]:.0f} Hz"
            elif moment is None and self.channel is None and "filter" in axes:
                moment = float(self.times[np.abs(data).sum(axis=tuple(range(data.ndim - 1))).argmax()])
            if moment is not None and not note:
                frame = int(np.abs(self.times - moment).argmin())
                data = data[..., frame]
                axes.remove("time")
                note = f", at {self.times[frame]:.2f} s"
        while len(axes) > 2:
            data = data.mean(axis=first)
            note += f", mean over the {axes.pop(0)}s"
        return self._reduced(data) if axes[-1] == "time" else data, (axes[0], axes[1]), note

    def _reduced(self, data: np.ndarray) -> np.ndarray:
        """Return at most `MAX_COLUMNS` columns: means of frames, or maxima of samples."""
        if self._group == 1:
            return data
        starts = np.arange(0, data.shape[-1], self._group)
        if f"{self.kind.kind}_frameRate" in self.result:
            return np.asarray(np.add.reduceat(data, starts, axis=-1) / np.diff([*starts, data.shape[-1]]))
        return np.maximum.reduceat(np.abs(data) if self._decibels else data, starts, axis=-1)

    @property
    def _group(self) -> int:
        """Frames in a column of an image."""
        return -(-self.data.shape[-1] // MAX_COLUMNS)

    @cached_property
    def _colours(self) -> tuple[np.ndarray, str, dict[str, Any]]:
        """The values shown by colours, the label of the colour bar, and the limits, which are those of both ears."""
        data, axes, _ = self._plane
        if self._decibels:
            size = np.abs(data)
            loudest = float(size.max()) or 1.0  # 1.0: silence
            level = self._decibels * np.log10(np.maximum(size, 1e-200) / loudest)
            return np.maximum(level, -RANGE_DB), "dB re loudest", {"cmap": "magma", "vmin": -RANGE_DB, "vmax": 0.0}
        if "feature" in axes and self.along("feature").dtype.kind == "U":  # the features have different units
            whole = np.moveaxis(data, 0, -1) if self.ears else data[..., np.newaxis]
            low, high = np.percentile(whole, (1, 99), axis=(1, 2), keepdims=True)
            scaled = np.clip((whole - low) / np.where(high > low, high - low, 1.0), 0, 1)
            data = np.moveaxis(scaled, -1, 0) if self.ears else scaled[..., 0]
            return data, "relative to the range of the feature", {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0}
        unit, data = ("ms", 1e3 * data) if self.unit == "s" else (self.unit, data)
        low, high = np.percentile(data, (1, 99))
        signed = not self.ears and self.unit  # differences between the ears
        if signed or -low > 0.25 * high:
            limit = float(np.percentile(np.abs(data), 99)) or 1.0
            return data, unit, {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
        return data, unit, {"cmap": "viridis", "vmin": float(low), "vmax": float(high) if high > low else low + 1.0}

    def _axis(self, axes: Axes, axis: str, which: str) -> tuple[float, float]:
        """Label an axis and return its limits."""
        if axis == "time":
            axes.set_xlabel("time (s)")
            step = self.times[1] - self.times[0] if len(self.times) > 1 else 2 * self.times[0] or 1.0
            start = self.times[0] - step / 2
            columns = -(-len(self.times) // self._group)
            return float(start), float(start + columns * self._group * step)
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
            frequency_axis(axes, values, MAX_TICKS, _AXIS_NAMES[axis], which)
        return -0.5, len(values) - 0.5
