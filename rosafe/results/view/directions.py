"""Draw the result of `rosafe.localize`: the posterior over time, with the tracks of sources."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.results.view.axes import image, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_COLUMNS = 2000  # of the image; longer sounds are drawn with maxima of several windows
_RANGE = 3.0  # decades of probability that are shown


def draw(figure: Figure, result: Mapping[str, Any], title: str = "") -> Figure:
    """Draw posterior and tracks.

    Parameters
    ----------
    figure : matplotlib Figure
        An empty figure; it is returned.
    result : mapping
        Result of `rosafe.localize`.
    title : str
        Above the picture.
    """
    with style():
        figure.set_size_inches(10, 4.5)
        axes = figure.subplots()
        drawn, begin, end = draw_posterior(axes, result)
        for track in result["tracks"]:
            present = track["probability"] > 0.5
            line = np.where(present, track["azimuth"], np.nan)
            jumps = np.flatnonzero(np.abs(np.diff(line)) > 180)
            line = np.insert(line, jumps + 1, np.nan)
            axes.plot(np.insert(track["time"], jumps + 1, np.nan), line, linewidth=2, label=f"source {track['id']}")
        if 0 < len(result["tracks"]) <= 10:
            axes.legend(loc="upper right", fontsize=8)
        axes.set(xlim=(begin, end), ylim=(-180, 180), xlabel="time (s)", ylabel="azimuth (degrees, left is positive)")
        axes.set_yticks(range(-180, 181, 45))
        axes.set_title(title)
        bar = figure.colorbar(drawn, ax=axes, ticks=[-3, -2, -1, 0], pad=0.02)
        bar.ax.set_yticklabels(["0.001", "0.01", "0.1", "1"])
        bar.set_label("posterior probability")
        figure.tight_layout()
    return figure


def draw_posterior(axes: Axes, result: Mapping[str, Any]) -> tuple[Any, float, float]:
    """Draw the posterior over time and azimuth, logarithmically; return the image, and its first and last time."""
    times, azimuths = result["time"], result["azimuths"]
    begin, end = (float(times[0]), float(times[-1])) if len(times) else (0.0, 1.0)
    end = end if end > begin else begin + 0.01
    shown = np.log10(np.maximum(_columns(result["posterior"]), 10**-_RANGE)).T
    half = (azimuths[1] - azimuths[0]) / 2
    extent = (begin, end, azimuths[0] - half, azimuths[-1] + half)
    return image(axes, shown, extent, cmap="Greys", vmin=-_RANGE, vmax=0), begin, end


def _columns(posterior: np.ndarray) -> np.ndarray:
    """Return at most `MAX_COLUMNS` rows of (T, A): the maxima of successive ones."""
    if len(posterior) <= MAX_COLUMNS:
        return posterior if len(posterior) else np.zeros((1, posterior.shape[1]))
    starts = np.linspace(0, len(posterior), MAX_COLUMNS, endpoint=False).astype(int)
    return np.maximum.reduceat(posterior, starts, axis=0)
