#!/usr/bin/python3
"""Draws docs/representations.png: two seconds of the built-in scene in every representation."""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rosafe
from rosafe.bass.sources.scene import Scene
from rosafe.representations.registry import own
from rosafe.view.axes import save, style

RATE, SECONDS, COLUMNS = 44100, 2, 3


def main() -> None:
    sound = Scene(RATE, seconds=SECONDS).frames(RATE * SECONDS)
    kinds = {kind: stage.REPRESENTATION for kind, stage in own().items()}
    result = {**rosafe.process(sound, RATE, outputs=list(kinds)), "sample_rate": RATE}
    names = [name for kind in kinds.values() for name in kind.outputs]
    rows = -(-len(names) // COLUMNS)
    with style():
        figure = Figure(figsize=(5.2 * COLUMNS, 2.1 * rows), dpi=75, layout="constrained")
        grid = figure.add_gridspec(rows, COLUMNS)
        for name, place in zip(names, grid, strict=False):
            rosafe.plot(result, name, figure.add_subplot(place))
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
