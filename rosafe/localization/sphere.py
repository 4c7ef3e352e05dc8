"""Impulse responses of the sphere of `rosafe.sound.head`."""

from __future__ import annotations

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.sound.head import HEAD_TIME, ear_delay, shadow_gain

_LENGTH_SECONDS = 0.005  # of an impulse response; its shadow decays within 1 ms
_MARGIN_SECONDS = 0.001  # before the earliest arrival, for the onset of the band-limited impulse


def ear_incidence(azimuths: FloatArray) -> FloatArray:
    """Return the incidence (A, 2) in rad at the left and the right ear for `azimuths` (A,) in degrees."""
    lateral = np.sin(np.radians(azimuths))
    return np.stack((np.arccos(lateral), np.arccos(-lateral)), axis=1)


def sphere_responses(azimuths: FloatArray, sample_rate: float) -> FloatArray:
    """Return the impulse responses (A, 2, N) of the sphere for `azimuths` (A,) in degrees.

    The responses are band-limited: a raised cosine from 0.45 of the sample rate on avoids ringing.
    """
    length = 2 * int(np.ceil(_LENGTH_SECONDS * sample_rate / 2))
    frequencies = np.fft.rfftfreq(length, 1 / sample_rate)
    incidence = ear_incidence(azimuths)[..., np.newaxis]
    ratio = 0.5j * 2 * np.pi * frequencies * HEAD_TIME
    delay = ear_delay(incidence) + HEAD_TIME + _MARGIN_SECONDS
    spectrum = (1 + shadow_gain(incidence) * ratio) / (1 + ratio) * np.exp(-2j * np.pi * frequencies * delay)
    edge = np.clip((frequencies / sample_rate - 0.45) / 0.05, 0.0, 1.0)
    return np.asarray(np.fft.irfft(spectrum * (0.5 + 0.5 * np.cos(np.pi * edge)), length))
