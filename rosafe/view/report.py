"""Results as text: the table of ports, where the source was, levels. ASCII only, for any terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

RULER = 41  # characters from 90 degrees left to 90 degrees right; odd, so that one is straight ahead
SILENCE_DB = -120.0


@dataclass(frozen=True)
class PortRow:
    """What came on one port.

    Attributes
    ----------
    topic, type : str
        Names on the ROS graph.
    message_rate : float
        Messages per second as they arrived; NaN for fewer than two.
    frames : int
        Frames received.
    frame_rate : int
        Frames per second, as the messages say.
    lost : int
        Frames that should have come between those that came.
    """

    topic: str
    type: str
    message_rate: float
    frames: int
    frame_rate: int
    lost: int


def port_table(rows: Sequence[PortRow]) -> str:
    """The table of ports, a line for each."""
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
    """An azimuth in words, always 12 characters: ``41 deg right``."""
    if not np.isfinite(azimuth):
        return "nobody".rjust(12)
    whole = round(float(azimuth))
    words = f"{abs(whole)} deg {'right' if whole > 0 else 'left'}" if whole else "ahead"
    return words.rjust(12)


def ruler(marks: Mapping[str, float]) -> str:
    """A line from left to right with a letter at each azimuth (degrees); X where two fall together."""
    line = ["-"] * RULER
    line[RULER // 2] = "+"
    for letter, azimuth in marks.items():
        if np.isfinite(azimuth):
            place = round((float(np.clip(azimuth, -90, 90)) + 90) / 180 * (RULER - 1))
            line[place] = letter if line[place] in "-+" else "X"
    return "|" + "".join(line) + "|"


def path_table(
    times: np.ndarray,
    from_ild: np.ndarray,
    from_correlation: np.ndarray,
    true_azimuth: np.ndarray | None = None,
    every: float = 0.5,
) -> str:
    """Where the source was: a line for every `every` seconds with the medians of the azimuths (degrees) in them.

    Parameters
    ----------
    times, from_ild, from_correlation, true_azimuth : ndarray, (F,)
        Seconds and degrees; NaN where there is no source.
    """
    scale = "left".ljust(RULER // 2 - 1) + "ahead" + "right".rjust(RULER // 2 - 1)
    series = {"levels": from_ild, "correlation": from_correlation}
    if true_azimuth is not None:
        series["truth"] = true_azimuth
    lines = [f"   time   {scale}   " + "  ".join(name.rjust(12) for name in series)]
    steps = np.floor(times / every).astype(int)
    for step in np.unique(steps):
        inside = steps == step
        medians = [_median(values[inside]) for values in series.values()]
        marks = dict(zip("IC", medians, strict=False))
        words = "  ".join(side(azimuth) for azimuth in medians)
        lines.append(f"{step * every:6.2f} s  {ruler(marks)}  {words}")
    return "\n".join(lines)


def _median(values: np.ndarray) -> float:
    heard = values[np.isfinite(values)]
    return float(np.median(heard)) if len(heard) else float("nan")


def level_db(samples: np.ndarray) -> float:
    """Level (dB) of samples with full scale 1.0; at least `SILENCE_DB`."""
    power = float(np.mean(np.square(samples))) if len(samples) else 0.0
    return max(SILENCE_DB, 10 * np.log10(power)) if power > 0 else SILENCE_DB
