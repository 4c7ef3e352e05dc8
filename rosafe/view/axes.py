"""What all pictures share: their style, images over time, axes of channels, and how they are written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.missing import require
from rosafe.output import new_file

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
    """The pictures' own settings, whatever the user's are; numbers that are too large for an axis are no warning."""
    with require("matplotlib.style", "pictures").context(["default", _STYLE]), np.errstate(all="ignore"):
        yield


def save(figure: Figure, path: Path, replace: bool = True) -> None:
    """Write the picture as PNG, in the place of one that is there if `replace`; OutputError where that cannot be."""
    with (
        new_file(path, replace) as descriptor,
        os.fdopen(descriptor, "wb", closefd=False) as stream,
        style(),  # some settings matter only now
    ):
        figure.savefig(stream, format="png", metadata={"Software": "rosAFE"})


def image(axes: Axes, data: np.ndarray, extent: tuple[float, float, float, float], **options: Any) -> Any:
    """Rows from below, (rows, columns), between left, right, bottom and top of `extent`."""
    return axes.imshow(data, extent=extent, origin="lower", aspect="auto", interpolation="nearest", **options)


def frequency_axis(
    axes: Axes, frequencies: np.ndarray, most: int, name: str = "centre frequency (Hz)", axis: str = "y"
) -> None:
    """Channels at even distances, which is the ear's scale; at most so many labels, which are real frequencies."""
    count = len(frequencies)
    ticks = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    labels = [f"{frequencies[tick]:.0f}" if frequencies[tick] >= 10 else f"{frequencies[tick]:.2g}" for tick in ticks]
    axes.set(**{f"{axis}ticks": ticks, f"{axis}ticklabels": labels, f"{axis}label": name})
