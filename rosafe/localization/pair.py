"""Impulse responses of two omnidirectional microphones without a head between them, for plane waves."""

from __future__ import annotations

import numpy as np
import scipy.fft

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.filters import HeadFilters
from rosafe.localization.sphere import RINGING, SPEED_OF_SOUND, band_limit, directions

MIN_SPACING, MAX_SPACING = 0.01, 1.0  # m
PREFIX = "pair:"  # of the name of a pair, before its spacing in m


def pair_delays(spacing: float, azimuths: FloatArray) -> FloatArray:
    """Return the delays (A, 2) in s of the left and the right microphone relative to the middle between them."""
    lead = spacing / 2 / SPEED_OF_SOUND * np.sin(np.radians(angles.lateral(azimuths)))
    return np.stack((-lead, lead), axis=1)


def pair_filters(spacing: float, sample_rate: float) -> HeadFilters:
    """Return the filters of microphones at 90 and -90 degrees with a spacing in m, for all directions."""
    azimuths = directions()
    delays = pair_delays(spacing, azimuths) * sample_rate
    delays += np.ceil(delays.max()) + RINGING
    length = int(2 * delays.max())
    frequencies = np.fft.rfftfreq(scipy.fft.next_fast_len(2 * length, real=True), 1.0)
    spectra = band_limit(frequencies) * np.exp(-2j * np.pi * frequencies * delays[..., np.newaxis])
    return HeadFilters(azimuths, np.fft.irfft(spectra)[..., :length], delays)
