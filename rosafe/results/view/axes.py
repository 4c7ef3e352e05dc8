"""Helpers shared by all plots: style, images over time, frequency axes, and saving."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.system.missing import require
from rosafe.system.output import new_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelcolor": "#333333",
    "text.color": "#222222",
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "axes.edgecolor": "#999999",
}


@contextmanager
def style() -> Iterator[None]:
    """Use the style of rosAFE instead of the user's; suppress warnings about values too large for an axis."""
    with require("matplotlib.style", "plots").context(["default", _STYLE]), np.errstate(all="ignore"):
        yield


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    stream = io.BytesIO()
    with style():  # some settings apply when the figure is saved
        figure.savefig(stream, format="png", metadata={"Software": "rosAFE"})
    return stream.getvalue()


def save(figure: Figure, path: Path, replace: bool = True) -> None:
    """Save a figure as PNG; an existing file is replaced if `replace`. Raise OutputError if it cannot be written."""
    with new_file(path, replace) as descriptor, open(descriptor, "wb", closefd=False) as file:
        file.write(png(figure))


def image(axes: Axes, data: np.ndarray, extent: tuple[float, float, float, float], **options: Any) -> Any:
    """Draw an array (rows, columns), first row at the bottom, between left, right, bottom and top of `extent`."""
    return axes.imshow(data, extent=extent, origin="lower", aspect="auto", interpolation="nearest", **options)


def frequency_axis(
    axes: Axes, frequencies: np.ndarray, max_ticks: int, name: str = "centre frequency (Hz)", axis: str = "y"
) -> None:
    """Label an axis on which the channels are equidistant (the ERB scale) with the frequencies of some channels."""
    count = len(frequencies)
    ticks = np.unique(np.linspace(0, count - 1, min(count, max_ticks)).round().astype(int))
    labels = [f"{frequencies[tick]:.0f}" if frequencies[tick] >= 10 else f"{frequencies[tick]:.2g}" for tick in ticks]
    axes.set(**{f"{axis}ticks": ticks, f"{axis}ticklabels": labels, f"{axis}label": name})
