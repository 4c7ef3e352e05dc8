"""Music, and recordings of speech."""

from __future__ import annotations

from pathlib import Path

import numpy as np

RATE = 16000
RECORDINGS = Path("/usr/share/sounds/alsa")  # of Debian's alsa-utils


def music(seconds: float, seed: int, rate: int = RATE) -> np.ndarray:
    """Return chords of plucked strings, some with a beat."""
    random = np.random.default_rng(seed)
    sound = np.zeros(int(seconds * rate))
    begin = 0
    while begin < len(sound):
        root = 220 * 2 ** (random.integers(-12, 18) / 12)
        time = np.arange(min(int(1.2 * rate), len(sound) - begin)) / rate
        for step in random.choice([0, 3, 4, 7, 12], 3, replace=False):
            for harmonic in range(1, 7):
                phase = 2 * np.pi * root * 2 ** (step / 12) * harmonic * time
                sound[begin : begin + len(time)] += np.sin(phase) * np.exp(-time * (2 + harmonic)) / harmonic
        if random.random() < 0.5:
            beat = random.standard_normal(min(int(0.08 * rate), len(time)))
            sound[begin : begin + len(beat)] += 3 * beat * np.exp(-np.arange(len(beat)) / (0.015 * rate))
        begin += int(random.uniform(0.15, 0.5) * rate)
    return sound
