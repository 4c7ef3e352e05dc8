"""Synthesis filters for the gammatone filterbank: from its channels back to a waveform.

V. Hohmann (2002), "Frequency analysis and synthesis using a gammatone filterbank", Acta Acust. united Acust. 88,
433-442, delays the channels, turns their phases and adds them. Here each channel passes the time-reversed filter, and
the sum is equalized, which is the least-squares solution (the dual frame): H. Bölcskei, F. Hlawatsch and H. G.
Feichtinger (1998), "Frame-theoretic analysis of oversampled filter banks", IEEE Trans. Signal Process. 46, 3256-3268.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from .erb import bandwidth
from .numeric_limits import FloatArray

ComplexArray = NDArray[np.complex128]
EDGE = 0.003  # part of the total power response, relative to that at the centre frequencies
_SHARPNESS = 8  # of the transition at EDGE; an even power, so that the equalizer is smooth and its response short
_TAIL = 1e-9  # part of the envelope of an impulse response that is neglected
MAX_LENGTH = 2**17  # samples of an impulse response; longer ones, of extremely narrow filters, are truncated
_BAND = (
    1.2,
    0.8,
)  # relative to the lowest and highest centre frequency: the range in which causal synthesis is optimized
PAST_SECONDS = 0.004  # of a causal filter beyond its delay
_ITERATIONS = 30
_END_SECONDS = 0.03  # before an abrupt end: the sound that is estimated together with the outputs after it
_MAX_END = 2048  # the same in samples
_END_ROUNDS = 2
_END_LOADING = 1e-10  # relative to the power response: the least noise that is assumed
_LOADING = 1e-4  # relative to the power response: keeps the filters near those that have only been cut
_OUTSIDE = 1e-3  # weight of frequencies outside the range


def response_length(sample_rate: float, frequencies: FloatArray, order: int, width: float) -> int:
    """Return the length of the impulse responses of a `GammatoneBank` in samples, without their negligible ends."""
    decay = 2 * np.pi * width * float(bandwidth(np.min(frequencies))) / sample_rate
    return int(min(MAX_LENGTH, np.ceil(scipy.special.gammainccinv(order, _TAIL) / decay)))


def responses(size: int, sample_rate: float, frequencies: FloatArray, order: int, width: float) -> ComplexArray:
    """Return the frequency responses (C, size // 2 + 1) of a `GammatoneBank` at the frequencies of a real FFT."""
    bins = 2 * np.pi * np.arange(size // 2 + 1) / size
    found = np.empty((len(frequencies), len(bins)), np.complex128)
    for row, frequency in zip(found, frequencies, strict=True):
        decay = 2 * np.pi * width * float(bandwidth(frequency)) / sample_rate
        turn = 2 * np.pi * frequency / sample_rate
        gain = -np.expm1(-decay)
        row[:] = sum((gain / -np.expm1(-decay - 1j * (bins + sign * turn))) ** order for sign in (1, -1))
    return found


def synthesis_responses(analysis: ComplexArray, frequencies: FloatArray, sample_rate: float) -> ComplexArray:
    """Return the frequency responses (C, K) of zero-phase synthesis: conj(H_c) / sum(abs(H)**2).

    With the `analysis` responses H (C, K), the sum over the channels of synthesis times analysis is 1, except at
    frequencies at which the sum of abs(H)**2 is below `EDGE` times that at the centre `frequencies` (Hz).
    """
    power = _power(analysis)
    edge = EDGE * _level(power, frequencies, sample_rate)
    ratio = power / edge
    filters = analysis.conj()
    filters /= edge * (1 + ratio**_SHARPNESS) ** (1 / _SHARPNESS)
    return filters


def _power(analysis: ComplexArray) -> FloatArray:
    """Return the power response of all channels together, without large temporary arrays."""
    return np.asarray(sum(row.real**2 + row.imag**2 for row in analysis))


def _level(power: FloatArray, frequencies: FloatArray, sample_rate: float) -> float:
    """Return the typical power response at the centre frequencies (Hz), at least 1, as of one channel."""
    bins = np.rint(frequencies * (2 * (len(power) - 1) / sample_rate)).astype(int)
    return max(1.0, float(np.median(power[bins])))


def end_samples(sample_rate: float) -> int:
    """Return how many samples before an abrupt end `outputs_after_end` estimates."""
    return min(_MAX_END, round(_END_SECONDS * sample_rate))


def outputs_after_end(
    channels: FloatArray, analysis: ComplexArray, synthesis: ComplexArray, size: int, length: int, unknown: int
) -> FloatArray:
    """Estimate the outputs of causal filters after the end of a sound from those before it.

    The last samples of the sound are the least-squares solution, given the outputs until the end; the filters then give
    the outputs after it. The sound before these samples is synthesized, in the second round with the outputs of the
    first one. The solution assumes noise with the power of its own residual, so that outputs that belong to no
    sound are not amplified.

    Parameters
    ----------
    channels : ndarray, (ears, C, W)
        The last outputs.
    analysis, synthesis : ndarray, (C, size // 2 + 1)
        Frequency responses; see `synthesis_responses`.
    size : int
        Samples of a Fourier transform: the outputs, with zeros before and after them.
    length, unknown : int
        Samples of the outputs after the end, and of the sound before it that is estimated.

    Returns
    -------
    ndarray, (ears, C, length)
    """
    ears, count, width = channels.shape
    end = (size + width) // 2
    solved, after = slice(end - unknown, end), slice(end, end + length)
    whole = [scipy.fft.irfft(row, size) for row in analysis]
    level = float(sum(np.sum(row**2) for row in whole))
    impulses = np.stack([row[:unknown] for row in whole])
    gram = impulses.T @ impulses  # between impulses at two distances from the end
    for row in range(1, unknown):
        gram[row, 1:] += gram[row - 1, :-1]
    transforms = scipy.fft.rfft(impulses, 2 * unknown).conj()
    tail = np.zeros((ears, count, length))
    padded = np.zeros((ears, size))
    for _ in range(_END_ROUNDS):
        total = np.zeros((ears, size // 2 + 1), np.complex128)
        for channel, response in enumerate(synthesis):
            padded[:, end - width : end], padded[:, after] = channels[:, channel], tail[:, channel]
            total += response * scipy.fft.rfft(padded)
        sound = scipy.fft.irfft(total, size)
        sound[:, end - unknown :] = 0
        spectrum = scipy.fft.rfft(sound)
        products, power = np.zeros((ears, unknown)), 0.0
        for channel, response in enumerate(analysis):
            rest = channels[:, channel, width - unknown :] - scipy.fft.irfft(response * spectrum, size)[:, solved]
            products += scipy.fft.irfft(transforms[channel] * scipy.fft.rfft(rest, 2 * unknown))[:, :unknown]
            power += float(np.sum(rest**2))
        if not power:
            break
        products = products[:, ::-1].T  # by the distance from the end
        loading = _END_LOADING
        for _ in range(2):  # the second time with the noise that the first solution leaves
            factors = scipy.linalg.cho_factor(gram + loading * level * np.eye(unknown))
            solution = scipy.linalg.cho_solve(factors, products)
            loading = max(loading, (1 - float(np.sum(solution * products)) / power) / count)
        sound[:, solved] = solution[::-1].T
        spectrum = scipy.fft.rfft(sound)
        for channel, response in enumerate(analysis):
            tail[:, channel] = scipy.fft.irfft(response * spectrum, size)[:, after]
    return tail


def causal_synthesis(
    sample_rate: float, frequencies: FloatArray, order: int, width: float, delay: int
) -> tuple[FloatArray, float]:
    """Design causal synthesis filters: the synthesis of `synthesis_responses`, delayed, cut and optimized.

    Least squares by conjugate gradients, weighted like the long-term spectrum of speech between 1.2 times the lowest
    and 0.8 times the highest frequency, beginning with the filters that have only been cut.

    Parameters
    ----------
    sample_rate, frequencies, order, width
        As of `GammatoneBank`.
    delay : int
        Of analysis and synthesis together, in samples.

    Returns
    -------
    filters : ndarray, (C, L)
        Impulse responses.
    error_db : float
        Power of the error relative to the signal, with the weights of the design.
    """
    length = response_length(sample_rate, frequencies, order, width)
    taps = delay + 1 + round(PAST_SECONDS * sample_rate)
    size = scipy.fft.next_fast_len(2 * (length + taps), real=True)
    analysis = responses(size, sample_rate, frequencies, order, width)
    bins = np.fft.rfftfreq(size, 1 / sample_rate)
    target = np.exp(-2j * np.pi * bins * delay / sample_rate)
    speech = 1 / (1 + (bins / 500.0) ** 2)  # power: flat to 500 Hz, then -6 dB/octave
    inside = (bins >= _BAND[0] * frequencies.min()) & (bins <= _BAND[1] * frequencies.max())
    loading = _LOADING * _level(_power(analysis), frequencies, sample_rate)
    weights = inside * np.sqrt(speech) + _OUTSIDE

    def total(filters: FloatArray) -> ComplexArray:
        return np.asarray(np.sum(analysis * scipy.fft.rfft(filters, size), axis=0))

    def adjoint(spectrum: ComplexArray) -> FloatArray:
        return np.asarray(scipy.fft.irfft(analysis.conj() * (weights * spectrum), size)[:, :taps])

    ideal = synthesis_responses(analysis, frequencies, sample_rate)
    filters = np.ascontiguousarray(scipy.fft.irfft(ideal * target, size)[:, :taps])
    rest = adjoint(target - total(filters))  # residual of the normal equations, relative to the filters that were cut
    direction, norm = rest.copy(), float(np.sum(rest**2))
    for _ in range(_ITERATIONS):
        product = adjoint(total(direction)) + loading * direction
        step = norm / float(np.sum(direction * product))
        filters += step * direction
        rest -= step * product
        before, norm = norm, float(np.sum(rest**2))
        direction = rest + norm / before * direction
    power_of_error = np.abs(total(filters) - target) ** 2
    shape = speech * (inside if inside.any() else 1)
    return filters, float(10 * np.log10(np.sum(shape * power_of_error) / np.sum(shape)))
