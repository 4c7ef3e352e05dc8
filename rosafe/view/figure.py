"""One picture of a binaural signal: cochleagrams, level differences and cross-correlation with the source's position.

>>> shown = Representations.from_process(rosafe.process(signal, 44100))     # doctest: +SKIP
>>> save(draw(shown, "two talkers"), Path("two-talkers.png"))               # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from rosafe.view import estimates
from rosafe.view.axes import frequency_axis, image, style
from rosafe.view.representations import Representations

RATEMAP_DB = 60.0  # dynamic range of the cochleagrams
TICKS = 8  # of a frequency axis, at most
SIZE = (11.0, 10.0)  # inches
DPI = 110

# Dark enough at its top for the lines on it to stand out.
_CORRELATION_COLOURS = LinearSegmentedColormap.from_list("correlation", ["#0c1020", "#1d3557", "#3d7a94", "#86bdb5"])
_FROM_CORRELATION = "#ffffff"
_FROM_ILD = "#ff9f1c"
_TRUTH = "#e63946"


def draw(
    shown: Representations,
    title: str,
    subtitle: str = "",
    true_azimuth: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Figure:
    """The picture.

    Parameters
    ----------
    shown : Representations
        What to show; at least two frames.
    title, subtitle : str
        What it was, in large and small letters.
    true_azimuth : callable, optional
        Degrees at times in seconds, where the truth is known.

    Raises
    ------
    ValueError
        There are fewer than two frames.
    """
    if len(shown.times) < 2:
        raise ValueError(f"{len(shown.times)} frames are too few for a picture")
    with style():
        figure = Figure(figsize=SIZE, dpi=DPI)
        FigureCanvasAgg(figure)
        figure.text(0.063, 0.972, title, fontsize=16, fontweight="bold", va="baseline")
        figure.text(0.063, 0.950, subtitle, color="#666666", va="baseline")
        rows: Any = figure.subplots(
            4,
            1,
            sharex=True,
            gridspec_kw={
                "height_ratios": (1.0, 1.0, 1.0, 1.35),
                "left": 0.063,
                "right": 0.918,
                "bottom": 0.052,
                "top": 0.918,
                "hspace": 0.19,
            },
        )
        _draw_ratemaps(figure, rows[0], rows[1], shown)
        _draw_ild(figure, rows[2], shown)
        _draw_correlation(rows[3], shown, true_azimuth)
        return figure


def _extent(shown: Representations, low: float, high: float) -> tuple[float, float, float, float]:
    hop = (shown.times[-1] - shown.times[0]) / (len(shown.times) - 1)
    return shown.times[0] - hop / 2, shown.times[-1] + hop / 2, low, high


def _colour_bar(figure: Figure, shade: Any, upper: Axes, lower: Axes, label: str, **options: Any) -> None:
    """A colour bar at the right of one or of two rows."""
    top, bottom = upper.get_position(), lower.get_position()
    place = figure.add_axes((top.x1 + 0.010, bottom.y0, 0.011, top.y1 - bottom.y0))
    figure.colorbar(shade, cax=place, label=label, **options).outline.set_visible(False)


def _draw_ratemaps(figure: Figure, left: Axes, right: Axes, shown: Representations) -> None:
    loudest = max(float(shown.ratemap.max()), estimates.FLOOR)
    level = 10 * np.log10(np.maximum(shown.ratemap / loudest, 10 ** (-RATEMAP_DB / 10)))
    extent = _extent(shown, -0.5, len(shown.center_frequencies) - 0.5)
    for axes, name, data in ((left, "Left ear", level[0]), (right, "Right ear", level[1])):
        shade = image(axes, data, extent, cmap="magma", vmin=-RATEMAP_DB, vmax=0)
        axes.set_title(f"{name}: ratemap")
        frequency_axis(axes, shown.center_frequencies, TICKS)
    _colour_bar(figure, shade, left, right, "level (dB below the loudest)")


def _draw_ild(figure: Figure, axes: Axes, shown: Representations) -> None:
    reach = float(np.clip(np.ceil(np.percentile(np.abs(shown.ild), 99) / 5) * 5, 5, 40))
    extent = _extent(shown, -0.5, len(shown.center_frequencies) - 0.5)
    shade = image(axes, shown.ild, extent, cmap="RdBu_r", vmin=-reach, vmax=reach)
    axes.set_title("Interaural level difference")
    frequency_axis(axes, shown.center_frequencies, TICKS)
    _colour_bar(figure, shade, axes, axes, "dB: < 0 left, > 0 right", extend="both")


def _draw_correlation(
    axes: Axes, shown: Representations, true_azimuth: Callable[[np.ndarray], np.ndarray] | None
) -> None:
    lags = shown.lags * 1e3
    half = (lags[1] - lags[0]) / 2 if len(lags) > 1 else 0.5
    extent = _extent(shown, lags[0] - half, lags[-1] + half)
    low = float(np.percentile(shown.correlation, 2))
    image(axes, shown.correlation, extent, cmap=_CORRELATION_COLOURS, vmin=min(low, 0.99), vmax=1.0)
    axes.set_title("Interaural cross-correlation, mean over the channels, and where the source is")
    axes.set_ylabel("lag (ms)")
    axes.set_xlabel("time (s)")

    def line(azimuths: np.ndarray, **options: Any) -> None:
        axes.plot(shown.times, 1e3 * estimates.lag_of_azimuth(shown.center_frequencies, azimuths), **options)

    if true_azimuth is not None:
        line(true_azimuth(shown.times), color=_TRUTH, linewidth=4.5, label="true path")
    line(estimates.azimuth_from_ild(shown), color=_FROM_ILD, linewidth=1.9, label="from level differences")
    from_peak = estimates.azimuth_from_correlation(shown)
    line(from_peak, color=_FROM_CORRELATION, linewidth=1.2, label="from the correlation's peak")
    axes.legend(loc="best", ncols=3, labelcolor="white", facecolor="#0c1020", edgecolor="none", framealpha=0.6)
    axes.set_ylim(lags[0] - half, lags[-1] + half)
    _azimuth_axis(axes, shown.center_frequencies)


def _azimuth_axis(axes: Axes, center_frequencies: np.ndarray) -> None:
    """Azimuths at the lags that belong to them, and a line straight ahead."""
    axes.axhline(0, color="white", linewidth=0.7, alpha=0.5, linestyle=":")
    azimuths = {-90: "90° left", -45: "45°", 0: "ahead", 45: "45°", 90: "90° right"}
    lags = 1e3 * estimates.lag_of_azimuth(center_frequencies, np.array(list(azimuths), float))
    axes.secondary_yaxis("right").set_yticks(lags, list(azimuths.values()))
