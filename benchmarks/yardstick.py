"""The default chain in plain numpy and scipy, as fast as possible: the reference for the speed of `rosafe`.

It uses the fastest forms without additional compiled code: a complex `sosfilt` per channel, `lfilter` over all rows,
frame energies by a matrix product over half windows (the hop is half the window), and real FFTs of a suitable length,
in batches that fit into the cache. It supports the defaults only, for any sample rate and number of channels with a hop
of half the window, and checks no arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, signal

from rosafe.dsp.erb import bandwidth
from rosafe.representations.crosscorrelation import EPSILON

FloatArray = NDArray[np.float64]
BATCH = 64  # frames per transform

Step = Callable[[FloatArray], FloatArray]


def gammatone(sample_rate: float, frequencies: FloatArray, order: int = 4, width: float = 1.018) -> Step:
    """(2, N) to (2, C, N): a complex cascade per channel."""
    decays = 2 * np.pi * width * bandwidth(frequencies) / sample_rate
    poles = np.exp(-decays - 2j * np.pi * frequencies / sample_rate)
    cascades = np.zeros((len(frequencies), order, 6), complex)
    cascades[:, :, 0] = 1 - np.exp(-decays)[:, np.newaxis]
    cascades[:, 0, 0] *= 2
    cascades[:, :, 3] = 1
    cascades[:, :, 4] = -poles[:, np.newaxis]
    states = np.zeros((len(frequencies), order, 2, 2), complex)

    def process(block: FloatArray) -> FloatArray:
        output = np.empty((2, len(frequencies), block.shape[-1]))
        for channel, sections in enumerate(cascades):
            analytic, states[channel] = signal.sosfilt(sections, block, zi=states[channel])
            output[:, channel] = analytic.real
        return output

    return process


def hair_cell(sample_rate: float, channels: int) -> Step:
    """(2, C, N) to (2, C, N): half-wave rectification and low-pass (dau)."""
    b, a = signal.butter(2, 1000, fs=sample_rate)
    state = np.zeros((2, channels, 2))

    def process(block: FloatArray) -> FloatArray:
        nonlocal state
        output, state = signal.lfilter(b, a, np.maximum(block, 0), zi=state)
        return output

    return process


class _FrameBuffer:
    """Buffer of the samples from the start of the next frame on."""

    def __init__(self, window: FloatArray, hop: int, channels: int) -> None:
        self.size, self.hop = len(window), hop
        self.samples = np.zeros((2, channels, 0))

    def with_block(self, block: FloatArray) -> FloatArray:
        """Return the buffered samples followed by `block`."""
        samples = np.concatenate((self.samples, block), axis=-1)
        frames = max(0, (samples.shape[-1] - self.size) // self.hop + 1)
        self.samples = samples[..., frames * self.hop :]
        return samples


def _half_window_energies(samples: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the sum of the weighted squares of each frame of two halves; `weights` is (half, 2)."""
    half = len(weights)
    halves = samples.shape[-1] // half
    squares = np.square(samples[..., : halves * half]).reshape(*samples.shape[:-1], halves, half)
    sums = squares @ weights
    return sums[..., :-1, 0] + sums[..., 1:, 1]


def _weights(window: FloatArray) -> FloatArray:
    return np.ascontiguousarray(np.square(window).reshape(2, -1).T) / len(window)


def ild(window: FloatArray, channels: int) -> Step:
    """(2, C, N) to (C, F) in dB."""
    buffer = _FrameBuffer(window, len(window) // 2, channels)
    weights = _weights(window)

    def process(block: FloatArray) -> FloatArray:
        left, right = _half_window_energies(buffer.with_block(block), weights)
        return 10 * np.log10((right + EPSILON) / (left + EPSILON))

    return process


def ratemap(sample_rate: float, window: FloatArray, channels: int) -> Step:
    """(2, C, N) to (2, C, F), power."""
    buffer = _FrameBuffer(window, len(window) // 2, channels)
    weights = _weights(window)
    retention = np.exp(-1 / (sample_rate * 0.008))
    state = np.zeros((2, channels, 1))

    def process(block: FloatArray) -> FloatArray:
        nonlocal state
        integrated, state = signal.lfilter([1 - retention], [1, -retention], block, zi=state)
        return _half_window_energies(buffer.with_block(integrated), weights)

    return process


def cross_correlation(sample_rate: float, window: FloatArray, channels: int, delay: float = 0.0011) -> Step:
    """(2, C, N) to (C, L, F)."""
    buffer = _FrameBuffer(window, len(window) // 2, channels)
    reach = int(np.ceil(delay * sample_rate))
    transform = fft.next_fast_len(len(window) + reach, real=True)

    def process(block: FloatArray) -> FloatArray:
        samples = buffer.with_block(block)
        if samples.shape[-1] < buffer.size:
            return np.zeros((channels, 2 * reach + 1, 0))
        frames = sliding_window_view(samples, buffer.size, axis=-1)[..., :: buffer.hop, :]
        output = np.empty((channels, 2 * reach + 1, frames.shape[2]))
        at_once = max(1, BATCH // frames.shape[2])
        for first in range(0, channels, at_once):
            left, right = frames[:, first : first + at_once] * window
            energies = np.einsum("cfi,cfi->cf", left, left) * np.einsum("cfi,cfi->cf", right, right)
            spectrum = fft.rfft(left, transform)
            spectrum *= np.conj(fft.rfft(right, transform))
            circular = fft.irfft(spectrum, transform)
            lags = np.concatenate((circular[..., transform - reach :], circular[..., : reach + 1]), axis=-1)
            lags /= np.sqrt(energies + EPSILON)[..., np.newaxis]
            output[first : first + at_once] = lags.swapaxes(1, 2)
        return output

    return process


def chain(sample_rate: float, frequencies: FloatArray, window: FloatArray) -> dict[str, Step]:
    """Return a step for each of the seven stages, in order; `ihc` is the input of the last three."""
    channels = len(frequencies)
    steps: dict[str, Any] = {
        "input": lambda block: block / (2**31 - 1),
        "preProc": np.copy,
        "gammatone": gammatone(sample_rate, frequencies),
        "ihc": hair_cell(sample_rate, channels),
        "ild": ild(window, channels),
        "ratemap": ratemap(sample_rate, window, channels),
        "crossCorrelation": cross_correlation(sample_rate, window, channels),
    }
    return steps
