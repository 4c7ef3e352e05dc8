"""The other fourteen representations in plain numpy and scipy, at their defaults, on a whole signal at once.

This is the reference for the speed of these representations, as benchmarks/yardstick.py for the default chain.
Processing the whole signal at once is the fastest case, since no state is kept between blocks. The functions support
the defaults only and check no arguments. Precedence uses the numpy equivalent of its kernels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from unittest import mock

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, ndimage, signal, sparse

from rosafe.dsp import kernels
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.windows import window
from rosafe.representations import STAGES
from rosafe.representations.gabor import CONTEXT_FRAMES, patterns
from rosafe.representations.spectralfeatures import FEATURES, Spectra

FloatArray = NDArray[np.float64]
Plain = Callable[[FloatArray, SignalFormat], FloatArray]

SILENCE = 1e-200
BATCH = 128  # frames of one channel per transform, which fit into the cache


def _level(rates: FloatArray) -> FloatArray:
    return 10 * np.log10(np.maximum(rates, SILENCE))


def _peak(correlations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lag and height of the vertex of the parabola through the maximum of (C, L, F) and its neighbours."""
    lags = correlations.shape[1]
    index = correlations.argmax(axis=1)
    inner = np.clip(index, 1, lags - 2)[:, np.newaxis]
    before, value, after = (np.take_along_axis(correlations, inner + step, axis=1)[:, 0] for step in (-1, 0, 1))
    bend = before - 2 * value + after
    top = np.divide((before - after) / 2, bend, out=np.zeros_like(value), where=(inner[:, 0] == index) & (bend < 0))
    highest = np.take_along_axis(correlations, index[:, np.newaxis], axis=1)[:, 0]
    return index - lags // 2 + top, highest - (before - after) / 4 * top


def itd(correlations: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(C, L, F) to (C, F)."""
    lag, height = _peak(correlations)
    return np.where(height > 0, lag, 0) / input_format.sample_rate  # 0 in silence


def ic(correlations: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(C, L, F) to (C, F)."""
    return _peak(correlations)[1]


def onset_strength(rates: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, C, F)."""
    levels = _level(rates)
    return np.clip(np.diff(levels, axis=-1, prepend=levels[..., :1]), 0, 30)


def offset_strength(rates: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, C, F)."""
    levels = _level(rates)
    return np.clip(-np.diff(levels, axis=-1, prepend=levels[..., :1]), 0, 30)


def moc(rates: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, C, F)."""
    levels = np.clip(2 * _level(rates), -180, -93.821837)
    return np.clip(np.polyval((-0.00012411, -0.051322, -6.3528, -206.11), levels), 0, 40)


def adaptation(samples: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, N) to (2, C, N): all five loops in one operation, each one sample ahead of the next loop."""
    taus, least = np.array((0.005, 0.05, 0.129, 0.253, 0.5)), 1e-5
    count, rows, number = len(taus), samples.shape[0] * samples.shape[1], samples.shape[-1]
    rest = least ** (0.5 ** np.arange(1, count + 1))
    a = np.exp(-1 / (taus * input_format.sample_rate))[:, np.newaxis]
    m = ((1 - rest**2) * 10 - 1)[:, np.newaxis]
    state = np.repeat(rest[:, np.newaxis], rows, axis=1)
    x = np.maximum(samples, least).reshape(rows, number).T.copy()
    output = np.empty((number + count, rows))
    passed = np.repeat(
        np.concatenate(([least], rest))[:, np.newaxis], rows, axis=1
    )  # at rest, each loop outputs its rest value
    for step in range(number + count - 1):
        passed[0] = x[min(step, number - 1)]
        v = passed[:-1] / state
        over = np.maximum(v, 1) - 1
        v -= over
        v += m * np.tanh(over / m)
        busy = slice(max(0, step - number + 1), min(count, step + 1))
        state[busy] = a[busy] * state[busy] + ((1 - a) * v)[busy]
        passed[1:] = v
        output[step] = v[-1]
    return ((output[count - 1 : number + count - 1].T - rest[-1]) * (100 / (1 - rest[-1]))).reshape(samples.shape)


def _frames(samples: FloatArray, size: int, hop: int) -> FloatArray:
    return sliding_window_view(samples, size, axis=-1)[..., ::hop, :]


def autocorrelation(samples: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, N) to (2, C, L, F)."""
    half, hop = round(input_format.sample_rate / 100), round(input_format.sample_rate / 100)
    size = 2 * half
    frames, weights = _frames(samples, size, hop), window("hann", size)
    points = 1 << (2 * size - 2).bit_length()
    output = np.empty((*samples.shape[:2], size - 1, frames.shape[2]))
    unbiased = size / (size - np.arange(size - 1))
    for ear, channel in np.ndindex(*samples.shape[:2]):
        for first in range(0, frames.shape[2], BATCH):
            part = frames[ear, channel, first : first + BATCH] * weights
            high, low = np.abs(part.max(axis=-1, keepdims=True)), np.abs(part.min(axis=-1, keepdims=True))
            part *= (part >= 0.6 * high) | (part <= -0.6 * low)
            part /= np.maximum(np.maximum(high, low), 1e-300)  # avoids underflow of the squares of faint sound
            spectrum = fft.rfft(part, points)
            lags = fft.irfft(spectrum.real**2 + spectrum.imag**2, points)[:, : size - 1]
            lags *= unbiased / np.maximum(lags[:, :1], 1e-300)
            output[ear, channel, :, first : first + BATCH] = lags.T
    return output


def spectral_features(rates: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, 14, F)."""
    rates = np.maximum(rates, 0).swapaxes(0, 1)
    extended = np.concatenate((rates[..., :1], rates), axis=-1)
    spectra = Spectra(np.ascontiguousarray(extended), np.array(input_format.center_frequencies), 1500.0, 0.8)
    return np.stack([feature(spectra) for feature in FEATURES.values()], axis=1)


def ams_features(samples: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, N) to (2, C, M, F): filters over all rows, then weighted means over frames."""
    stage = STAGES["amsFeatures"](input_format)
    values = stage.parameters
    rate = input_format.sample_rate / values["ams_dsRatio"]
    downsampled = np.ascontiguousarray(samples[..., :: values["ams_dsRatio"]])
    size = 2 * round(values["ams_wSizeSec"] * rate / 2)
    hop = round(size / (values["ams_wSizeSec"] / values["ams_hSizeSec"]))
    weights = window(values["ams_wname"], size) / size
    centres = stage.derived["ams_cfHz"] if "ams_cfHz" in stage.derived else values["ams_cfHz"]
    edge = math.sqrt(1.25) + 0.5
    outputs = []
    for number, centre in enumerate(centres):
        band = centre if number == 0 else (centre / edge, centre * edge)
        b, a = signal.butter(1, band, "lowpass" if number == 0 else "bandpass", fs=rate)
        output = np.abs(signal.lfilter(b, a, downsampled))
        outputs.append(np.einsum("ecfi,i->ecf", _frames(output, size, hop), weights))
    return np.stack(outputs, axis=2)


def pitch(correlations: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, L, F) to (2, 3, F - 1)."""
    rate = input_format.sample_rate
    first, last = math.ceil(rate / 400), math.floor(rate / 80)
    summary = correlations[:, :, first : last + 1].mean(axis=1)
    inner = summary[:, 1:-1]
    peaks = np.where((inner > summary[:, :-2]) & (inner >= summary[:, 2:]), inner, 0)
    confidence = peaks.max(axis=1)
    raw = np.where(confidence > 0, rate / (peaks.argmax(axis=1) + 1 + first), 0)
    reach = max(1, round(5 * input_format.rate))
    greatest = ndimage.maximum_filter1d(confidence, reach, axis=1, mode="constant", origin=(reach - 1) // 2)
    chosen = np.where(confidence < 0.7 * greatest, 0, raw)
    median = ndimage.median_filter(np.pad(chosen, ((0, 0), (1, 1))), (1, 3))[:, 1:-1]
    return np.stack((np.where(median > 0, median, np.nan), raw, confidence), axis=1)[..., :-1]


def precedence(samples: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, N) to the ITDs (C, F)."""
    with mock.patch.object(kernels, "compiled", lambda: False):
        return STAGES["precedence"](input_format).process(samples)[0]


def transient_map(strengths: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, C, F)."""
    distance, min_channels = round(0.03 * input_format.rate), 5
    strong = np.where(strengths < 3, 0, strengths)
    inner = strong[..., 1:-1]
    peaks = np.pad((inner > strong[..., :-2]) & (inner >= strong[..., 2:]), ((0, 0), (0, 0), (1, 1)))
    kept = np.zeros(strengths.shape)
    for ear, channel in np.ndindex(*strengths.shape[:2]):
        candidates = np.flatnonzero(peaks[ear, channel])
        free = np.ones(strengths.shape[-1] + 2 * distance, bool)
        for index in candidates[np.argsort(-strong[ear, channel, candidates], kind="stable")]:
            if free[index + distance]:
                kept[ear, channel, index] = 1
                free[index + 1 : index + 2 * distance] = False
    for ear in range(2):
        labels, count = ndimage.label(kept[ear], np.ones((3, 3)))
        kept[ear] *= (np.bincount(labels.ravel(), minlength=count + 1) >= min_channels)[labels]
    return kept


def gabor(rates: FloatArray, input_format: SignalFormat) -> FloatArray:
    """(2, C, F) to (2, G, F - 19): a sparse matrix product over windows of frames, then running sums."""
    channels, span = rates.shape[1], 2 * CONTEXT_FRAMES + 1
    bank = patterns(channels)
    history = round(5 * input_format.rate)
    largest = ndimage.maximum_filter1d(rates.max(axis=1), history, axis=1, mode="constant", origin=(history - 1) // 2)
    levels = 10 * np.log10(np.maximum(rates, 0) + 1e-8 * largest[:, np.newaxis] + 2.2204e-16)
    columns = [
        ((first + np.arange(number))[:, np.newaxis] * span + CONTEXT_FRAMES + np.arange(-reach, reach + 1)).ravel()
        for first, number, reach, _ in bank.places.tolist()
    ]
    begins = np.append(bank.places[:, 3], len(bank.weights))
    matrix = sparse.csr_matrix((bank.weights, np.concatenate(columns), begins), (len(bank.places), channels * span))
    output = []
    for ear in levels:
        padded = np.concatenate((np.repeat(ear[:, :1], CONTEXT_FRAMES, axis=1), ear), axis=1)
        frames = sliding_window_view(padded, span, axis=-1)  # (C, F - 19, 39)
        y = matrix @ frames.swapaxes(1, 2).reshape(channels * span, -1)
        count = np.arange(1, y.shape[1] + 1)
        centred = y - y[:, :1]
        mean, square = np.cumsum(centred, axis=1) / count, np.cumsum(centred**2, axis=1) / count
        sigma = np.sqrt(np.maximum(square - mean**2, 0))
        z = np.divide(centred - mean, sigma, out=np.zeros_like(y), where=sigma > 1e-9 * (1 + np.abs(mean + y[:, :1])))
        output.append(z)
    return np.stack(output)


PLAIN: Mapping[str, Plain] = {
    "adaptation": adaptation,
    "autocorrelation": autocorrelation,
    "amsFeatures": ams_features,
    "precedence": precedence,
    "itd": itd,
    "ic": ic,
    "onsetStrength": onset_strength,
    "offsetStrength": offset_strength,
    "spectralFeatures": spectral_features,
    "pitch": pitch,
    "onsetMap": transient_map,
    "offsetMap": transient_map,
    "gabor": gabor,
    "moc": moc,
}
