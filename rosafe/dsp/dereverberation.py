"""Dereverberation of two ears while the sound arrives: the late sound is predicted from the past and subtracted.

T. Yoshioka and T. Nakatani (2012), "Generalization of multi-channel linear prediction methods for blind MIMO impulse
response shortening", IEEE Trans. Audio Speech Lang. Process. 20, 2707-2720, with recursive least squares (A. Jukić,
T. van Waterschoot and S. Doclo, 2017, "Adaptive speech dereverberation using constrained sparse multichannel linear
prediction", IEEE Signal Process. Lett. 24, 101-105). The prediction is linear and equal for all sources, so that
interaural differences of the direct sound remain.
"""

from __future__ import annotations

import numpy as np

from rosafe.dsp.copies import OwnState
from rosafe.dsp.gammatone_synthesis import ComplexArray
from rosafe.dsp.numeric_limits import FloatArray

_DELAY = 2  # frames from the sound that is predicted back to the newest one that predicts it
_TAPS = 4  # frames that predict it
_KEPT = 0.997  # weight of the past, for each frame
# Of the inverse covariance, at first and at most: a smaller value distorts first words less, and learns more slowly.
_START = 0.005
_MAX_LATE = 0.5  # amplitude that is subtracted, at most, relative to that of the sound: tones are predicted, too
_SILENCE = 1e-9  # power of a frame and bin of sound with full scale 1, below which nothing is learned


class Dereverberator(OwnState):
    """Subtracts late reverberation from successive Fourier transforms of both ears.

    Parameters
    ----------
    bins : int
        Number of frequencies, K.
    """

    def __init__(self, bins: int) -> None:
        size = 2 * _TAPS
        self._past = np.zeros((bins, _DELAY + _TAPS, 2), np.complex128)  # the newest frame first
        self._powers = np.zeros((_DELAY, bins))  # of both ears, likewise
        self._prediction = np.zeros((bins, 2, size), np.complex128)
        self._inverse = np.tile(
            _START * np.eye(size, dtype=np.complex128), (bins, 1, 1)
        )  # of the covariance of the past

    def process(self, spectrum: ComplexArray) -> ComplexArray:
        """Return the next frame (2, K) without late reverberation."""
        self._past = np.concatenate((spectrum.T[:, np.newaxis], self._past[:, :-1]), axis=1)
        self._powers = np.concatenate((_power(spectrum)[np.newaxis], self._powers[:-1]))
        past = self._past[:, _DELAY:].reshape(len(self._past), -1, 1)
        late = self._prediction @ past
        early = spectrum.T[..., np.newaxis] - late
        power = self._powers.mean(axis=0)[:, np.newaxis, np.newaxis] / 2 + _SILENCE
        projected = self._inverse @ past
        energy = np.maximum(np.sum(past.conj() * projected, axis=1, keepdims=True).real, 0.0)
        gain = projected / (_KEPT * power + energy)
        self._prediction += early * gain.conj().transpose(0, 2, 1)
        self._inverse -= gain * projected.conj().transpose(0, 2, 1)
        # without sound, or with a tone only, it would grow without a limit
        size = np.einsum("kii->k", self._inverse).real / self._inverse.shape[1]
        self._inverse *= (1 / np.maximum(size / _START, _KEPT))[:, np.newaxis, np.newaxis]
        predicted = late[..., 0].T
        part = _MAX_LATE * np.sqrt(self._powers[0] / np.maximum(_power(predicted), 1e-300))
        return np.asarray(spectrum - np.minimum(part, 1.0) * predicted)


def _power(spectrum: ComplexArray) -> FloatArray:
    """Return the power (K,) of both ears together."""
    return np.asarray((spectrum.real**2 + spectrum.imag**2).sum(axis=0))
