"""Pictures of the comparisons: reference values as lines, measured values as dots."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rosafe.validation.report import Row
from rosafe.view.axes import save, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 3
_DPI = 70
_MAX_DOTS = 60  # of a curve


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write a picture of all results that have a curve; an existing file is replaced.

    Raises
    ------
    rosafe.output.OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [row for row in rows if row.curve is not None]
    with style():
        height = 2.6 * -(-len(shown) // _COLUMNS)
        figure = Figure(figsize=(4.4 * _COLUMNS, height), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        for place, row in enumerate(shown):
            _panel(figure.add_subplot(-(-len(shown) // _COLUMNS), _COLUMNS, place + 1), row)
    save(figure, path)


def _panel(axes: Axes, row: Row) -> None:
    curve = row.curve
    if curve is None:
        return
    x, expected, measured = (np.asarray(values) for values in (curve.x, curve.expected, curve.measured))
    dots = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MAX_DOTS)).round().astype(int))
    axes.plot(x, expected, color="#888888", linewidth=1.2, label="reference")
    axes.plot(x[dots], measured[dots], ".", color="#b3202c", markersize=4.5, label="rosAFE")
    if curve.logarithmic:
        axes.set_xscale("log")
    axes.set_xlabel(curve.x_label)
    axes.set_ylabel(curve.y_label)
    subject = f"{row.comparison.kind}: {row.comparison.subject}"
    axes.set_title(textwrap.shorten(subject, 52, placeholder=" ..."), fontsize=8.5)
    axes.legend(fontsize=7.5, frameon=False)
