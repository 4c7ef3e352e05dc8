"""Results as text: the table of ports, the path of the source, levels. ASCII only, for any terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

RULER = 41  # characters from 90 degrees left to 90 degrees right; odd, so that one of them is 0 degrees
SILENCE_DB = -120.0


@dataclass(frozen=True)
class PortRow:
    """The messages received from one port.

    Attributes
    ----------
    topic, type : str
        Names on the ROS graph.
    message_rate : float
        Messages per second as they arrived; NaN for fewer than two.
    frames : int
        Frames received.
    frame_rate : int
        Frames per second, from the metadata of the messages.
    lost : int
        Frames missing between the received ones.
    """

    topic: str
    type: str
    message_rate: float
    frames: int
    frame_rate: int
    lost: int


def port_table(rows: Sequence[PortRow]) -> str:
    """Return the table of ports, one line for each."""
    head = ("port", "type", "msg/s", "frames", "frames/s", "lost")
    cells = [
        (row.topic, row.type, f"{row.message_rate:.2f}", str(row.frames), str(row.frame_rate), str(row.lost))
        for row in rows
    ]
    widths = [max(len(line[column]) for line in (head, *cells)) for column in range(len(head))]
    return "\n".join(
        "  ".join(
            text.ljust(width) if column < 2 else text.rjust(width)
            for column, (text, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in (head, tuple("-" * width for width in widths), *cells)
    )


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


def level_db(samples: np.ndarray) -> float:
    """Return the level (dB) of samples with full scale 1.0; at least `SILENCE_DB`."""
    power = float(np.mean(np.square(samples))) if len(samples) else 0.0
    return max(SILENCE_DB, 10 * np.log10(power)) if power > 0 else SILENCE_DB
