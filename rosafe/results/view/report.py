"""Results as text: the table of ports and the path of the source. ASCII only, for any terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

RULER = 41  # characters from 90 degrees left to 90 degrees right; odd, so that one of them is 0 degrees


def port_table(rows: Sequence[tuple[str, str, float, int, int, int]]) -> str:
    """Return the table of ports, with topic, type, messages/s, frames, frames/s and lost frames of each."""
    cells: list[tuple[str, ...]] = [("port", "type", "msg/s", "frames", "frames/s", "lost")]
    cells += [(topic, kind, f"{pace:.2f}", *map(str, counts)) for topic, kind, pace, *counts in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, tuple("-" * width for width in widths))
    form = "  ".join(f"{{:{'<' if column < 2 else '>'}{width}}}" for column, width in enumerate(widths))
    return "\n".join(form.format(*line) for line in cells)


def side(azimuth: float) -> str:
    """Return an azimuth (degrees, left positive) as text of 12 characters, for example ``41 deg right``."""
    if not np.isfinite(azimuth):
        return "no source".rjust(12)
    whole = round(float(azimuth))
    text = f"{abs(whole)} deg {'left' if whole > 0 else 'right'}" if whole else "ahead"
    return text.rjust(12)


def ruler(marks: Mapping[str, float]) -> str:
    """Return a line from left to right with a letter at each azimuth (degrees, left positive); X if two coincide."""
    line = ["-"] * RULER
    line[RULER // 2] = "+"
    for letter, azimuth in marks.items():
        if np.isfinite(azimuth):
            place = round((90 - float(np.clip(azimuth, -90, 90))) / 180 * (RULER - 1))
            line[place] = letter if line[place] in "-+" else "X"
    return "|" + "".join(line) + "|"


def path_table(times: np.ndarray, series: Mapping[str, np.ndarray], every: float = 0.5) -> str:
    """Return the path of the source: one line per `every` seconds with the median azimuths.

    Parameters
    ----------
    times : ndarray, (F,)
        Seconds.
    series : mapping
        Azimuths (F,) in degrees, left positive, by name; NaN where there is no source. The first letters of the names
        mark them on the ruler.
    """
    scale = "left".ljust(RULER // 2 - 1) + "ahead" + "right".rjust(RULER // 2 - 1)
    lines = [f"   time   {scale}   " + "  ".join(name.rjust(12) for name in series)]
    steps = np.floor(times / every).astype(int)
    for step in np.unique(steps):
        inside = steps == step
        medians = {name: _median(values[inside]) for name, values in series.items()}
        marks = {name[0].upper(): azimuth for name, azimuth in medians.items()}
        texts = "  ".join(side(azimuth) for azimuth in medians.values())
        lines.append(f"{step * every:6.2f} s  {ruler(marks)}  {texts}")
    return "\n".join(lines)


def _median(values: np.ndarray) -> float:
    valid = values[np.isfinite(values)]
    return float(np.median(valid)) if len(valid) else float("nan")
