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
from rosafe.localization.localizer import UPDATE_SECONDS
from tests.localization.conftest import MUSIC, RATE, TALKER
from tests.localization.test_enhancement import si_sdr

HOP = RATE // 100  # samples between two frames


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

    If nothing else was requested meanwhile, the ends of the streams are equal: the filters forget when they began. The
    tracks of the node are updated at other times of the sound, therefore some delays of the sound are tried.
    """
    sound, rate = soundfile.read(take[0])
    delays = range(0, round(UPDATE_SECONDS * RATE), 4 * HOP) if undisturbed else (0,)
    of_files = [
        rosafe.localize(np.pad(sound, ((delay, 0), (0, 0))), rate, str(model), streams=True)["tracks"]
        for delay in delays
    ]
    ids = {}
    for azimuth, truth in zip((TALKER, MUSIC), take[1], strict=True):
        id_ = ids[azimuth] = [part.id for part in parts if abs(part.azimuth - azimuth) < 8][-1]
        stream = joined(parts, id_) / 2.0**15
        errors = []
        for delay, tracks in zip(delays, of_files, strict=True):
            offline = next(one for one in tracks if abs(np.median(one["azimuth"]) - azimuth) < 8)
            expected = offline["stream"] / 2.0**15
            late = int(scipy.signal.correlate(expected, stream[RATE:], "valid").argmax()) - RATE
            assert late >= 0, "the localizer found the source in the sound that it had, which begins later"
            live, same = stream[RATE : len(expected) - late], expected[late:][RATE : len(stream)]
            errors.append(
                [
                    np.sum((live - same)[part] ** 2) / np.sum(same[part] ** 2)
                    for part in (slice(None), slice(-2 * RATE, None))
                ]
            )
            begin = round(offline["stream_time"] * RATE) + late - delay
        whole, end = np.min(errors, axis=0)
        assert whole < 0.03 and (end < 1e-3 or not undisturbed), errors
        reference, mixture = (ears[:, begin : begin + len(stream)] for ears in (truth, take[1].sum(axis=0)))
        heard = np.stack((stream, stream))[:, : reference.shape[1]]
        assert np.max(si_sdr(heard, reference) - si_sdr(mixture, reference).mean()) > 6
    return ids
