"""Statistical reverberation of a room through a head: sparse early reflections that become a dense, decaying late part.

Reflections arrive at random times from random directions. Their density is that of the image sources of a room with
the volume V, 4 pi c^3 t^2 / V, and their energy decays with the reverberation time: H. Kuttruff (2016), "Room
Acoustics", 6th edition, sections 4.1 and 5.1. No room is copied: each response is that of another room.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles

DIRECTIONS = 36  # from which reflections arrive
SPEED_OF_SOUND = 343.0  # m/s
_VOLUMES = (25.0, 300.0)  # m^3
_CRITICAL = 0.057  # distance (m) of equal direct and reverberant energy for V = 1 m^3 and 1 s: Kuttruff, section 5.1


def reverberation(
    responses: FloatArray, sample_rate: float, rt60: float, drr_db: float, generator: np.random.Generator
) -> FloatArray:
    """Return the response (2, samples) of a room without its direct sound, which arrives at sample 0.

    Parameters
    ----------
    responses : ndarray, (D, 2, N)
        Impulse responses of both ears for directions that surround the head evenly.
    sample_rate : float
        Of the responses, Hz.
    rt60 : float
        Reverberation time, s; the length of the response.
    drr_db : float
        Ratio of direct to reverberant energy in dB, from which the distance of the source follows: early reflections
        are denser for a distant source.
    generator : numpy.random.Generator
        Source of the volume, and of times, directions and signs of the reflections.

    Returns
    -------
    ndarray, (2, samples)
        The energy of both ears together is 1.
    """
    count = max(2, round(rt60 * sample_rate))
    volume = np.exp(generator.uniform(*np.log(_VOLUMES)))
    distance = _CRITICAL * np.sqrt(volume / rt60) * 10 ** (-drr_db / 20)
    times = np.arange(1, count + 1) / sample_rate
    density = 4 * np.pi * SPEED_OF_SOUND**3 * (times + distance / SPEED_OF_SOUND) ** 2 / volume
    probability = np.minimum(density / (sample_rate * len(responses)), 1.0)  # of a reflection in a sample
    amplitude = 10 ** (-3 * times / rt60) / np.sqrt(probability)
    size = scipy.fft.next_fast_len(count + responses.shape[2] - 1, real=True)
    spectrum = np.zeros((2, size // 2 + 1), complex)
    for response in responses:
        chance = generator.uniform(-1.0, 1.0, count)
        reflections = np.where(np.abs(chance) < probability, np.copysign(amplitude, chance), 0.0)
        spectrum += scipy.fft.rfft(reflections, size) * scipy.fft.rfft(response, size)
    late = np.concatenate((np.zeros((2, 1)), scipy.fft.irfft(spectrum, size)[:, : count - 1]), axis=1)
    return np.asarray(late / max(float(np.sqrt(np.sum(late**2))), 1e-300))


def surround(head: Any, sample_rate: float, directions: int = DIRECTIONS) -> FloatArray:
    """Return the responses (directions, 2, N) of a head for directions that surround it evenly."""
    filters = head.filters(sample_rate)
    return np.stack([filters.response(float(angles.wrap(one))) for one in np.arange(directions) * 360 / directions])
