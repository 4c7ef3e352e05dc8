"""Streams of sources from the nodes of ROS 1 and ROS 2, compared with the truth and those of `rosafe.localize`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.signal
import soundfile

import rosafe
from tests.localization.conftest import MUSIC, RATE, TALKER
from tests.localization.test_enhancement import si_sdr


class Part(NamedTuple):
    """A message of a stream; the azimuth is in degrees, the stamp in s."""

    id: int
    azimuth: float
    stamp: float
    first_sample: int
    samples: Sequence[int]


def joined(parts: list[Part], id_: int) -> np.ndarray:
    """Return the samples of a source, whose parts must follow one another, with the times of their numbers."""
    own = [part for part in parts if part.id == id_]
    for before, after in itertools.pairwise(own):
        assert after.first_sample == before.first_sample + len(before.samples)
        assert abs(after.stamp - before.stamp - len(before.samples) / RATE) < 2e-3
    return np.concatenate([part.samples for part in own])


def ids_of_file(
    parts: list[Part], take: tuple[Path, np.ndarray], model: Path, undisturbed: bool = True
) -> dict[float, int]:
    """Check that talker and music have the streams that they have offline; return their ids by azimuth.

    If nothing else was requested meanwhile, the ends of the streams are equal.
    """
    sound, rate = soundfile.read(take[0])
    tracks = rosafe.localize(sound, rate, str(model), streams=True)["tracks"]
    ids = {}
    for azimuth, truth in zip((TALKER, MUSIC), take[1], strict=True):
        id_ = ids[azimuth] = [part.id for part in parts if abs(part.azimuth - azimuth) < 8][-1]
        stream = joined(parts, id_) / 2.0**15
        offline = next(one for one in tracks if abs(np.median(one["azimuth"]) - azimuth) < 8)
        expected = offline["stream"] / 2.0**15
        late = int(scipy.signal.correlate(expected, stream[RATE:], "valid").argmax()) - RATE
        assert late >= 0, "the localizer found the source in the sound that it had, which begins later"
        live, same = stream[RATE : len(expected) - late], expected[late:][RATE : len(stream)]
        assert np.sum((live - same) ** 2) < 0.03 * np.sum(same**2)
        last = slice(-2 * RATE, None)
        near = np.sum((live - same)[last] ** 2) < 1e-3 * np.sum(same[last] ** 2)
        assert near or not undisturbed, "the filters forget when they began"
        begin = round(offline["stream_time"] * RATE) + late
        reference, mixture = (ears[:, begin : begin + len(stream)] for ears in (truth, take[1].sum(axis=0)))
        heard = np.stack((stream, stream))[:, : reference.shape[1]]
        assert np.max(si_sdr(heard, reference) - si_sdr(mixture, reference).mean()) > 6
    return ids
