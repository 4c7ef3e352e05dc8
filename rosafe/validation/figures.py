"""Pictures of the comparisons, reference values as lines and measured values as dots; and the published figures."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.results.view.axes import save, style
from rosafe.system.output import write_whole
from rosafe.validation import published
from rosafe.validation.binaural import lateral_itd
from rosafe.validation.comparison import Process
from rosafe.validation.periphery import Drnl, burst_response, drnl_measured, jepsen_drnl
from rosafe.validation.report import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 3
_DPI = 70
_MAX_DOTS = 60  # of a curve


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write a picture of all results that have a curve; an existing file is replaced.

    Raises
    ------
    rosafe.system.output.OutputError
        The file cannot be written.
    """
    _draw([row for row in rows if row.curve is not None], _panel, path)


def _draw(shown: Sequence[Any], panel: Callable[[Axes, Any], None], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style():
        height = 2.6 * -(-len(shown) // _COLUMNS)
        figure = Figure(figsize=(4.4 * _COLUMNS, height), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        for place, one in enumerate(shown):
            panel(figure.add_subplot(-(-len(shown) // _COLUMNS), _COLUMNS, place + 1), one)
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


# --- published figures -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Panel:
    """Published values (dots) and values of rosAFE (lines) over a common axis.

    `curves` are further values of rosAFE or of a publication, as (name, values).
    """

    title: str
    x: Any
    published: Any
    curves: tuple[tuple[str, Any], ...]
    logarithmic: bool = False


@dataclass(frozen=True)
class Published:
    """A figure: heading, source and short name of the published values, labels and remark, as in figures.json; panels.

    `name` is that of its file.
    """

    name: str
    heading: str
    source: str
    short: str
    labels: tuple[str, str]
    remark: str
    panels: Sequence[Panel]


def published_figures(process: Process) -> list[Published]:
    """Compute all figures with a function like `process`."""
    texts = json.loads(Path(__file__).with_name("figures.json").read_text("utf-8"))
    panels = {"precedence": _precedence(process), "drnl": _drnl(process), "adaptation": _adaptation(process)}
    return [Published(f"figures-{name}", **texts[name], panels=panels[name]) for name in texts]


def _precedence(process: Process) -> list[Panel]:
    panels = []
    for level, expected in published.BRAASCH_ITD.items():
        curves = []
        for window in (0.02, 0.05):
            found = [lateral_itd(process, float(delay), level, window) for delay in published.BRAASCH_DELAYS]
            curves.append((f"rosAFE, {1e3 * window:g} ms", np.array(found)))
        title = f"lag of {level:+d} dB" if level else "lag of equal level"
        panels.append(Panel(title, published.BRAASCH_DELAYS, np.array(expected), tuple(curves)))
    return panels


def _drnl(process: Process) -> list[Panel]:
    rate, velocities = 44100.0, 10 ** np.arange(-10, -4.4, 0.5)
    panels = []
    for frequency, (centre, width, gain, best, narrow, slope, scale) in published.LOPEZPOVEDA_TABLE_2.items():
        sections = ((3, 4), (3, 0), (3, 3))
        listener = Drnl((centre, width, centre), gain, (best, narrow, best), slope, scale, 0.25, sections)
        curves = (
            ("rosAFE", drnl_measured(process, velocities, frequency, rate)),
            ("Jepsen et al. (2008), closed form", jepsen_drnl(frequency).output(velocities, frequency, rate)),
        )
        expected = listener.output(velocities, frequency, rate)
        panels.append(Panel(f"{frequency} Hz", 20 * np.log10(velocities), expected, curves))
    return panels


def _adaptation(process: Process) -> list[Panel]:
    panels, times = [], published.BURST_TIMES[1:]
    for level, values in published.AMT_BURST.items():
        curves = (("rosAFE", burst_response(process, level, 10.0, times)),)
        panels.append(Panel(f"{level} dB SPL", times, np.array(values[1:]), curves, True))
    return panels


def write_published(folder: Path, process: Process) -> list[Path]:
    """Write figures.md and a picture of each figure into a folder, and return their paths.

    Raises
    ------
    rosafe.system.output.OutputError
        A file cannot be written.
    """
    figures = published_figures(process)
    paths = []
    for figure in figures:
        paths.append(folder / f"{figure.name}.png")
        _draw([(figure, panel) for panel in figure.panels], _published_panel, paths[-1])
    page = folder / "figures.md"
    write_whole(page, published_markdown(figures).encode())
    return [page, *paths]


def _published_panel(axes: Axes, pair: tuple[Published, Panel]) -> None:
    figure, panel = pair
    for number, (name, values) in enumerate(panel.curves):
        axes.plot(panel.x, values, ("-", "--")[number], color=("#b3202c", "#888888")[number], linewidth=1.2, label=name)
    axes.plot(panel.x, panel.published, ".", color="black", markersize=6, label=figure.short)
    if panel.logarithmic:
        axes.set_xscale("log")
    axes.set_xlabel(figure.labels[0])
    axes.set_ylabel(figure.labels[1])
    axes.set_title(panel.title, fontsize=8.5)
    axes.legend(fontsize=7.5, frameon=False)


def published_markdown(figures: Sequence[Published]) -> str:
    """Return the page."""
    lines = [Path(__file__).with_name("figures_head.md").read_text("utf-8")]
    for figure in figures:
        lines += [f"## {figure.heading}\n", f"![{figure.heading}]({figure.name}.png)\n"]
        lines += [f"Published values: {figure.source}\n", f"{figure.remark}\n"]
        lines += [
            f"| panel | values | {figure.labels[0]}: {', '.join(f'{x:.4g}' for x in figure.panels[0].x)} |",
            "|---|---|---|",
        ]
        for panel in figure.panels:
            series = ((figure.short, panel.published), *(one for one in panel.curves if one[0].startswith("rosAFE")))
            lines += [
                f"| {panel.title} | {name} | {', '.join(f'{value:.3g}' for value in values)} |"
                for name, values in series
            ]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"
