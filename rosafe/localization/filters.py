"""Filters of a head at one sample rate: interpolation between directions, and rendering of moving sources.

Responses are aligned before they are interpolated: the delay of each ear (the lag of the maximum of the
cross-correlation of a response with its minimum-phase version) is removed, interpolated separately and added again.
J. Nam, J. S. Abel and J. O. Smith III (2008), "A method for estimating interaural time difference for binaural
synthesis", 125th AES Convention.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles

HOP = 256  # frames between two directions of a moving source, at most; rendering fades from one to the next
_BATCH = 64  # hops that are filtered at a time, to bound memory
_UPSAMPLING = 8  # of the lag of the maximum


class HeadFilters:
    """The filters of a head.

    Parameters
    ----------
    azimuths : ndarray, (A,)
        Degrees, ascending in (-180, 180].
    responses : ndarray, (A, 2, N)
        Impulse responses of the left and the right ear at the sample rate of the sound.
    delays : ndarray, (A, 2), optional
        Delays in samples by which the responses are aligned; `onset_delays` by default.
    front_only : bool
        Whether the azimuths cover the front half only; directions behind are then replaced by their front images.

    Attributes
    ----------
    size : int
        Length of the transforms: a hop and a response fit in.
    """

    def __init__(
        self,
        azimuths: FloatArray,
        responses: FloatArray,
        delays: FloatArray | None = None,
        front_only: bool = False,
    ) -> None:
        self.azimuths = azimuths
        self.responses = responses
        self.size = scipy.fft.next_fast_len(HOP + responses.shape[2], real=True)
        self._front_only = front_only
        if delays is None:
            delays = np.array([onset_delays(pair) for pair in responses])  # all at once needs much memory
        self._delays = delays
        self._phase = -2j * np.pi * np.fft.rfftfreq(self.size, 1.0)
        self._aligned = np.fft.rfft(responses, self.size) * np.exp(-self._phase * self._delays[..., np.newaxis])

    @property
    def length(self) -> int:
        """Length of the impulse responses in samples."""
        return self.responses.shape[2]

    def at(self, azimuths: FloatArray) -> np.ndarray:
        """Return the spectra (K, 2, size // 2 + 1) for `azimuths` (K,) in degrees."""
        if self._front_only:
            azimuths = np.clip(angles.lateral(azimuths), self.azimuths[0], self.azimuths[-1])
        index = np.searchsorted(self.azimuths, azimuths, side="right") - 1  # -1: between the last and the first
        following = (index + 1) % len(self.azimuths)
        start = self.azimuths[index]
        step = np.mod(self.azimuths[following] - start, 360.0)
        part = (np.mod(azimuths - start, 360.0) / step)[:, np.newaxis]
        delays = (1 - part) * self._delays[index] + part * self._delays[following]
        part = part[..., np.newaxis]
        aligned = (1 - part) * self._aligned[index] + part * self._aligned[following]
        return np.asarray(aligned * np.exp(self._phase * delays[..., np.newaxis]))

    def response(self, azimuth: float) -> FloatArray:
        """Return the impulse response (2, N) for one azimuth in degrees."""
        if self._front_only:
            azimuth = float(angles.lateral(azimuth))
        exact = np.flatnonzero(self.azimuths == azimuth)
        if len(exact):
            return np.asarray(self.responses[exact[0]])
        return np.asarray(np.fft.irfft(self.at(np.array([azimuth]))[0], self.size)[:, : self.length])


class SourceRenderer:
    """Filters one source that may move, block by block.

    Every `HOP` frames a new direction is used; between two such moments the outputs of both filters are cross-faded
    linearly. The output depends on the position of these moments only, not on the length of blocks, which must be
    multiples of `HOP`.
    """

    def __init__(self, filters: HeadFilters) -> None:
        self._filters = filters
        self._tail = np.zeros((2, filters.size))

    def process(self, samples: FloatArray, azimuths: FloatArray) -> FloatArray:
        """Return both ears (2, n) of the next `samples` (n,); `azimuths` (n / HOP + 1,) are those at the hops."""
        out = np.empty((2, len(samples)))
        for begin in range(0, len(samples) // HOP, _BATCH):
            end = min(begin + _BATCH, len(samples) // HOP)
            part = slice(begin * HOP, end * HOP)
            out[:, part] = self._batch(samples[part].reshape(-1, HOP), azimuths[begin : end + 1])
        return out

    def _batch(self, hops: FloatArray, azimuths: FloatArray) -> FloatArray:
        size, filters = self._filters.size, self._filters
        if np.all(azimuths == azimuths[0]):
            spectra = np.fft.rfft(hops, size)[:, np.newaxis] * filters.at(azimuths[:1])
        else:
            at = filters.at(azimuths)
            rise = np.arange(HOP) / HOP
            spectra = np.fft.rfft(hops * (1 - rise), size)[:, np.newaxis] * at[:-1]
            spectra += np.fft.rfft(hops * rise, size)[:, np.newaxis] * at[1:]
        pieces = np.fft.irfft(spectra, size)  # (K, 2, size)
        total = np.zeros((2, len(hops) * HOP + size))
        total[:, :size] = self._tail
        for index, piece in enumerate(pieces):
            total[:, index * HOP : index * HOP + size] += piece
        self._tail = total[:, len(hops) * HOP :].copy()
        return total[:, : len(hops) * HOP]


def onset_delays(responses: FloatArray) -> FloatArray:
    """Return the delays (..., ) in samples of impulse responses (..., N) relative to their minimum-phase versions."""
    size = scipy.fft.next_fast_len(4 * responses.shape[-1], real=True)
    spectrum = np.fft.rfft(responses, size)
    magnitude = np.abs(spectrum)
    magnitude = np.maximum(magnitude, 1e-5 * magnitude.max(axis=-1, keepdims=True))
    cepstrum = np.fft.irfft(np.log(magnitude), size)
    fold = np.zeros(size)
    fold[0] = 1.0
    fold[1 : (size + 1) // 2] = 2.0
    if size % 2 == 0:
        fold[size // 2] = 1.0
    minimum = np.exp(np.fft.rfft(cepstrum * fold, size))
    padded = np.zeros((*spectrum.shape[:-1], size * _UPSAMPLING // 2 + 1), complex)
    padded[..., : spectrum.shape[-1]] = spectrum * np.conj(minimum)
    correlation = np.fft.irfft(padded, size * _UPSAMPLING)
    reach = responses.shape[-1] * _UPSAMPLING
    return np.asarray(correlation[..., :reach].argmax(axis=-1) / _UPSAMPLING)
