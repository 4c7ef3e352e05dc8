"""Music, recordings of speech, and voices that cross."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal
import soundfile

from rosafe.localization.head import Head

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


def crossing(ears: np.ndarray, path: Path) -> np.ndarray:
    """Write a recording in which the first voice of `take` moves past the second one, which stays.

    Return the ears of both voices, (2, 2, N).
    """
    dry = [np.resize(voice[side, 800:], 7 * RATE) for side, voice in enumerate(ears)]
    head = Head.sphere()
    truths = head.render(dry[0], RATE, np.linspace(-50, 70, len(dry[0]))), head.render(dry[1], RATE, 10.0)
    soundfile.write(path, (truths[0] + truths[1]).T, RATE, subtype="PCM_32")
    return np.stack(truths)


def assert_crossed(parts: list[tuple[int, float, int, Any]], truths: np.ndarray) -> None:
    """Check that the streams of `crossing` keep their voices, without gaps.

    Parts are ids, times (s) and numbers of their first samples, and samples.
    """
    ids = [id_ for id_, *_ in parts]
    longest = sorted(set(ids), key=ids.count)[-2:]
    begin = min(time for _, time, *_ in parts)
    orders = []
    for first, last in ((1.0, 2.5), (4.5, 6.0)):  # before and after they cross
        likeness = np.empty((2, 2))
        for row, wanted in enumerate(longest):
            own = [part[2:] for part in parts if part[0] == wanted and first < part[1] - begin < last]
            assert all(after[0] == before[0] + len(before[1]) for before, after in itertools.pairwise(own))
            sound = np.concatenate([samples for _, samples in own]).astype(float)
            for column, truth in enumerate(truths):
                found = [np.abs(scipy.signal.correlate(ear, sound, "valid")).max() for ear in truth]
                energy = [np.sqrt(np.mean(ear**2) * len(sound) * np.sum(sound**2)) for ear in truth]
                likeness[row, column] = np.max(np.array(found) / energy)
        orders.append(likeness.argmax(axis=1).tolist())
    assert orders[0] == orders[1] and sorted(orders[0]) == [0, 1], orders
