"""Cost of `rosafe.Stream` compared with calls of its stages, for blocks of 10 ms of the default chain."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from tests.representations.chain import Chain, cut

RATE, FRAMES, TURNS = 44100, 441, 2000


def main() -> None:
    """Measure both in turn and print the medians."""
    blocks = cut(0.1 * np.random.default_rng(1).standard_normal((2, 100 * FRAMES)), FRAMES)
    stream, stages = rosafe.Stream(RATE), Chain(float(RATE), CORE_REPRESENTATIONS, {"in_doNormalize": False})
    seconds: dict[Any, list[float]] = {stream: [], stages: []}
    for turn in range(TURNS):
        for variant, durations in seconds.items():
            begun = time.perf_counter()
            variant.process(blocks[turn % len(blocks)])
            durations.append(time.perf_counter() - begun)
    whole, bare = (1e6 * float(np.median(durations)) for durations in seconds.values())
    print(f"10 ms of sound at {RATE} Hz: Stream {whole:.0f} us, stages by hand {bare:.0f} us, ratio {whole / bare:.2f}")


if __name__ == "__main__":
    main()
