"""Plot docs/representations.png: all representations of two seconds of the built-in scene."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rosafe
from rosafe.audio.devices.scene import Scene
from rosafe.representations.registry import builtin_stages
from rosafe.results.view.axes import style

RATE, SECONDS, COLUMNS = 44100, 2, 3
PARAMETERS = {"ac_wSizeSec": 0.03, "pi_confThres": 0.4}  # suitable for the low voice and the noise


def main() -> None:
    sound = Scene(RATE, seconds=SECONDS).frames(RATE * SECONDS)
    kinds = {kind: stage.REPRESENTATION for kind, stage in builtin_stages().items()}
    result = {**rosafe.process(sound, RATE, parameters=PARAMETERS, outputs=list(kinds)), "sample_rate": RATE}
    names = [name for kind in kinds.values() for name in kind.outputs]
    rows = -(-len(names) // COLUMNS)
    with style():
        figure = Figure(figsize=(5.2 * COLUMNS, 2.1 * rows), dpi=80, layout="constrained")
        grid = figure.add_gridspec(rows, COLUMNS)
        for name, cell in zip(names, grid, strict=False):
            rosafe.plot(result, name, figure.add_subplot(cell))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # a third of the bytes
    picture.save(Path(__file__).with_suffix(".png"), optimize=True)


if __name__ == "__main__":
    main()
