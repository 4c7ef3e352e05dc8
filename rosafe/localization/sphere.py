"""Impulse responses of a rigid sphere for plane waves, from the series of Duda and Martens.

R. O. Duda and W. L. Martens (1998), "Range dependence of the response of a spherical head model", J. Acoust. Soc. Am.
104, 3048-3058, equation 4 for an infinite distance of the source.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.filters import HeadFilters

HEAD_RADIUS = 0.0875  # m
SPEED_OF_SOUND = 343.0  # m/s
HEAD_TIME = HEAD_RADIUS / SPEED_OF_SOUND  # s
RINGING = 40  # samples before the earliest arrival and at the end: that of the band limit is below -60 dB there
_DECAY_SECONDS = 0.003  # from the earliest arrival until the response has decayed by 100 dB
_SPACING = 1.0  # degrees between `directions`: near the bright spot responses change fast
_BAND_EDGE = 0.45  # of the sample rate: a raised cosine from here to 0.5 limits ringing


def sphere_spectra(frequencies: FloatArray, cosines: FloatArray) -> np.ndarray:
    """Return the response at points of the surface, relative to the sound at the centre without the sphere.

    Parameters
    ----------
    frequencies : ndarray, (F,)
        In Hz, from 0.
    cosines : ndarray, (K,)
        Cosine of the angle of incidence: 1 if the point faces the source, -1 if it is behind the sphere.

    Returns
    -------
    ndarray of complex, (K, F)
        Gain and phase; a delay has a negative phase.
    """
    wavenumbers = 2 * np.pi * np.maximum(frequencies, 1e-3) * HEAD_TIME  # times the radius; the limit at 0 Hz is 1
    highest = float(wavenumbers.max(initial=0.0))
    count = int(np.ceil(highest + 6 * np.cbrt(highest))) + 12
    total = np.zeros((len(cosines), len(frequencies)), complex)
    legendre = np.zeros_like(cosines), np.ones_like(cosines)  # of orders m - 1 and m
    # Spherical Hankel functions of the second kind, of orders m - 1 and m, by upward recursion
    hankel = np.exp(-1j * wavenumbers) / wavenumbers, 1j * np.exp(-1j * wavenumbers) / wavenumbers
    with np.errstate(over="ignore", invalid="ignore"):
        for order in range(count):
            derivative = hankel[0] - (order + 1) / wavenumbers * hankel[1]
            term = (-1j, 1.0, 1j, -1.0)[order % 4] * (2 * order + 1) / derivative  # i^(m - 1)
            total += np.outer(legendre[1], np.where(np.isfinite(derivative), term, 0.0))
            factor = (2 * order + 1) / (order + 1)
            legendre = legendre[1], factor * cosines * legendre[1] - (factor - 1) * legendre[0]
            hankel = hankel[1], (2 * order + 1) / wavenumbers * hankel[1] - hankel[0]
    return np.asarray(total / wavenumbers**2)


def sphere_responses(azimuths: FloatArray, sample_rate: float) -> FloatArray:
    """Return the impulse responses (A, 2, N) of ears at 90 and -90 degrees for `azimuths` (A,) in degrees.

    An impulse would arrive at the centre of the head after `RINGING` samples and `HEAD_TIME`. Responses for azimuths
    with equal lateral angles are equal to the last bit.
    """
    length = 2 * RINGING + int(np.ceil(_DECAY_SECONDS * sample_rate))
    size = scipy.fft.next_fast_len(4 * length, real=True)  # nothing is wrapped around
    frequencies = np.fft.rfftfreq(size, 1 / sample_rate)
    lateral = np.round(angles.lateral(azimuths), 9)
    lateral, rows = np.unique((lateral, -lateral), return_inverse=True)  # of the left and the right ear
    delay = HEAD_TIME + RINGING / sample_rate
    band = band_limit(frequencies / sample_rate) * np.exp(-2j * np.pi * frequencies * delay)
    spectra = sphere_spectra(frequencies, np.sin(np.radians(lateral))) * band
    return np.fft.irfft(spectra, size)[rows.reshape(2, -1).T, :length]


def band_limit(frequencies: FloatArray) -> FloatArray:
    """Return the gains at `frequencies` (F,), relative to the sample rate, that limit the ringing of responses."""
    edge = np.clip((frequencies - _BAND_EDGE) / (0.5 - _BAND_EDGE), 0.0, 1.0)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * edge))


def directions() -> FloatArray:
    """Return the azimuths (A,) in degrees for which the responses of computed heads are stored."""
    return np.arange(-180.0 + _SPACING, 180.0 + _SPACING / 2, _SPACING)


def sphere_filters(sample_rate: float) -> HeadFilters:
    """Return the filters of the sphere for all directions."""
    azimuths = directions()
    lateral = np.radians(angles.lateral(azimuths))
    incidence = np.stack((np.pi / 2 - lateral, np.pi / 2 + lateral), axis=1)
    path = np.where(incidence < np.pi / 2, 1 - np.cos(incidence), 1 + incidence - np.pi / 2)  # Woodworth's
    delays = path * HEAD_TIME * sample_rate + RINGING
    return HeadFilters(azimuths, sphere_responses(azimuths, sample_rate), delays)
