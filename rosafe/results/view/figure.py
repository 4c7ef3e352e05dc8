"""A figure of a binaural signal: ratemaps, level differences, cross-correlation, and the direction of the source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from rosafe.results.view.axes import frequency_axis, image, style
from rosafe.results.view.directions import draw_posterior
from rosafe.results.view.representations import Representations

RATEMAP_DB = 60.0  # dynamic range of the ratemaps
FLOOR = 1e-14  # power; lower ones are not shown
MAX_TICKS = 8  # of a frequency axis
SIZE = (11.0, 11.5)  # inches
DPI = 110

_CORRELATION_COLOURS = LinearSegmentedColormap.from_list("correlation", ["#0c1020", "#1d3557", "#3d7a94", "#86bdb5"])
_ESTIMATE = "#ff9f1c"
_TRUTHS = ("#e63946", "#2a9d8f", "#6a4c93")  # of the first sources; the colours repeat


def draw(
    shown: Representations,
    title: str,
    subtitle: str = "",
    directions: Mapping[str, Any] | None = None,
    truth: Mapping[str, np.ndarray] | None = None,
) -> Figure:
    """Draw the figure.

    Parameters
    ----------
    shown : Representations
        At least two frames.
    title, subtitle : str
        Two headings.
    directions : mapping, optional
        Result of `rosafe.localize` with times of the same axis; without it, there is no fifth plot.
    truth : mapping, optional
        True azimuths (T,) in degrees at `directions["time"]`, by the name of the source.

    Raises
    ------
    ValueError
        There are fewer than two frames.
    """
    if len(shown.times) < 2:
        raise ValueError(f"shown: expected at least 2 frames, got {len(shown.times)}")
    with style():
        figure = Figure(figsize=SIZE, dpi=DPI)
        FigureCanvasAgg(figure)
        figure.text(0.072, 0.972, title, fontsize=16, fontweight="bold", va="baseline")
        figure.text(0.072, 0.950, subtitle, color="#666666", va="baseline")
        heights = (1.0, 1.0, 1.0, 1.0) if directions is None else (1.0, 1.0, 1.0, 1.0, 1.25)
        rows: Any = figure.subplots(
            len(heights),
            1,
            sharex=True,
            gridspec_kw={
                "height_ratios": heights,
                "left": 0.072,
                "right": 0.918,
                "bottom": 0.052,
                "top": 0.918,
                "hspace": 0.19,
            },
        )
        _draw_ratemaps(figure, rows[0], rows[1], shown)
        _draw_ild(figure, rows[2], shown)
        _draw_correlation(rows[3], shown)
        if directions is not None:
            _draw_directions(rows[4], directions, truth or {})
        rows[-1].set_xlabel("time (s)")
        rows[-1].set_xlim(*_extent(shown, 0, 0)[:2])
        return figure


def _extent(shown: Representations, low: float, high: float) -> tuple[float, float, float, float]:
    hop = (shown.times[-1] - shown.times[0]) / (len(shown.times) - 1)
    return shown.times[0] - hop / 2, shown.times[-1] + hop / 2, low, high


def _colour_bar(figure: Figure, mappable: Any, upper: Axes, lower: Axes, label: str, **options: Any) -> None:
    """Add a colour bar to the right of one or two rows."""
    top, bottom = upper.get_position(), lower.get_position()
    position = figure.add_axes((top.x1 + 0.010, bottom.y0, 0.011, top.y1 - bottom.y0))
    figure.colorbar(mappable, cax=position, label=label, **options).outline.set_visible(False)


def _draw_ratemaps(figure: Figure, left: Axes, right: Axes, shown: Representations) -> None:
    loudest = max(float(shown.ratemap.max()), FLOOR)
    level = 10 * np.log10(np.maximum(shown.ratemap / loudest, 10 ** (-RATEMAP_DB / 10)))
    extent = _extent(shown, -0.5, len(shown.center_frequencies) - 0.5)
    for axes, name, data in ((left, "Left ear", level[0]), (right, "Right ear", level[1])):
        mappable = image(axes, data, extent, cmap="magma", vmin=-RATEMAP_DB, vmax=0)
        axes.set_title(f"{name}: ratemap")
        frequency_axis(axes, shown.center_frequencies, MAX_TICKS)
    _colour_bar(figure, mappable, left, right, "level (dB below the loudest)")


def _draw_ild(figure: Figure, axes: Axes, shown: Representations) -> None:
    limit = float(np.clip(np.ceil(np.percentile(np.abs(shown.ild), 99) / 5) * 5, 5, 40))
    extent = _extent(shown, -0.5, len(shown.center_frequencies) - 0.5)
    mappable = image(axes, shown.ild, extent, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.set_title("Interaural level difference")
    frequency_axis(axes, shown.center_frequencies, MAX_TICKS)
    _colour_bar(figure, mappable, axes, axes, "dB: < 0 left, > 0 right", extend="both")


def _draw_correlation(axes: Axes, shown: Representations) -> None:
    lags = shown.lags * 1e3
    half = (lags[1] - lags[0]) / 2 if len(lags) > 1 else 0.5
    extent = _extent(shown, lags[0] - half, lags[-1] + half)
    low = float(np.percentile(shown.correlation, 2))
    image(axes, shown.correlation, extent, cmap=_CORRELATION_COLOURS, vmin=min(low, 0.99), vmax=1.0)
    axes.set_title("Interaural cross-correlation, mean over the channels")
    axes.set_ylabel("lag (ms)")
    axes.axhline(0, color="white", linewidth=0.7, alpha=0.5, linestyle=":")


def _draw_directions(axes: Axes, directions: Mapping[str, Any], truth: Mapping[str, np.ndarray]) -> None:
    """Draw the posterior with the estimate and the truth; only the front half if all of them are there."""
    times, azimuth = directions["time"], directions["azimuth"]
    axes.set_title("Direction: posterior probability, estimate" + (" and truth" if truth else ""))
    if not len(times):
        return
    draw_posterior(axes, directions)
    for number, (name, values) in enumerate(truth.items()):
        colour = _TRUTHS[number % len(_TRUTHS)]
        axes.plot(times, values, ".", markersize=5, color=colour, label=f"true direction: {name}")
    axes.plot(times, azimuth, ".", markersize=2.5, color=_ESTIMATE, label="estimate")
    behind = any(np.nanmax(np.abs(values), initial=0.0) > 90 for values in (azimuth, *truth.values()))
    limit, step = (180, 90) if behind else (90, 45)
    axes.set_ylim(-limit, limit)
    ticks = range(-limit, limit + 1, step)
    axes.set_yticks(
        ticks, [f"{abs(tick)}\u00b0 {'left' if tick > 0 else 'right'}" if tick else "ahead" for tick in ticks]
    )
    axes.legend(loc="best", ncols=1 + len(truth))
