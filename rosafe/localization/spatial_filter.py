"""Separation of one source from two ears: a spatial filter for each frequency, and the way to spectra and back.

The filter has the minimum variance without distortion of the source (MVDR): M. Souden, J. Benesty and S. Affes (2010),
"On optimal frequency-domain multichannel linear filtering for noise reduction", IEEE Trans. Audio Speech Lang. Process.
18, 260-276. Masks give the covariances, as in J. Heymann, L. Drude and R. Haeb-Umbach (2016), "Neural network based
spectral mask estimation for acoustic beamforming", Proc. ICASSP, 196-200.
"""

from __future__ import annotations

import numpy as np

from rosafe.dsp.erb import erb_rate
from rosafe.dsp.gammatone_synthesis import ComplexArray
from rosafe.dsp.numeric_limits import FloatArray

HOP = 160  # samples of a frame
SIZE = 3 * HOP  # of a Fourier transform
BINS = SIZE // 2 + 1
KEPT = 0.986  # weight of the past in covariances, for each frame: 0.7 s
_LOADING = 0.015  # of the noise, relative to the power of both ears
_UNFILTERED = 0.05  # of the ear, so that the filter is that of the ear without a dominant direction
_TINY = 1e-200
# Its square, shifted by HOP, adds to 1.
_WINDOW = np.sin(np.pi * (np.arange(SIZE) + 0.5) / SIZE) * np.sqrt(2 * HOP / SIZE)


def spectrum(sound: FloatArray) -> ComplexArray:
    """Return the transforms (2, BINS) of SIZE samples of both ears."""
    return np.asarray(np.fft.rfft(sound * _WINDOW))


def overlap(transform: ComplexArray) -> FloatArray:
    """Return the SIZE samples of a transform (BINS,), to be added to those of its neighbours."""
    return np.asarray(np.fft.irfft(transform, SIZE) * _WINDOW)


def bin_weights(frequencies: FloatArray, sample_rate: float) -> FloatArray:
    """Return the matrix (C, BINS) from values of channels to bins: linear interpolation along the ERB scale."""
    places = erb_rate(np.fft.rfftfreq(SIZE, 1 / sample_rate)), erb_rate(np.asarray(frequencies))
    return np.array([np.interp(*places, one) for one in np.eye(len(frequencies))])


def covariance(frame: ComplexArray) -> ComplexArray:
    """Return the covariance (2, 2, BINS) of one frame (2, BINS)."""
    return np.asarray(frame[:, np.newaxis] * frame.conj())


def separate(frame: ComplexArray, wanted: ComplexArray, total: ComplexArray, left: float) -> ComplexArray:
    """Return the sound of a source at an ear.

    Parameters
    ----------
    frame : ndarray, (2, BINS)
        Of both ears.
    wanted, total : ndarray, (2, 2, BINS)
        Covariances of the source and of all sound.
    left : float
        1 for the left ear, 0 for the right one; a value between them is between both.

    Returns
    -------
    ndarray, (BINS,)

    Notes
    -----
    With the covariances S of the source and N of the rest, N^-1 S has the eigenvalues g1 >= g2. S - g2 N has rank 1,
    as that of a source in one direction; its filter is (N^-1 S - g2 I) e / (g1 - g2), e being the ear. The determinant
    of N cancels.
    """
    noise = total - wanted
    power = (noise[0, 0] + noise[1, 1] + _LOADING * (total[0, 0] + total[1, 1])).real
    ratio = power * wanted - (noise[:, :, np.newaxis] * wanted).sum(axis=1)
    trace = (ratio[0, 0] + ratio[1, 1]).real
    product = (ratio[0, 0] * ratio[1, 1] - ratio[0, 1] * ratio[1, 0]).real
    root = np.sqrt(np.maximum(trace**2 / 4 - product, 0.0))
    rest = _UNFILTERED * trace + _TINY
    ear = np.array([[left], [1.0 - left]])
    weights = left * ratio[:, 0] + (1.0 - left) * ratio[:, 1] + (rest - trace / 2 + root) * ear
    return np.asarray((weights.conj() * frame).sum(axis=0) / (2 * root + rest))
