"""References for accuracy.py: the formulas of the papers, computed sample by sample in 80-bit floating point.

This module uses neither the code nor the algorithms of `rosafe`: filters are difference equations in Python, and
correlations are direct sums. If numpy's long double has only 64 bits (not x86), these references are no more accurate
than `rosafe` itself.
"""

from __future__ import annotations

import functools
import math
import pickle
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Long = np.longdouble
LongArray = NDArray[Any]  # of np.longdouble
PI = Long("3.14159265358979323846264338327950288")
EPSILON = Long("2.2204e-16")

Function = TypeVar("Function", bound=Callable[..., Any])


def cached(function: Function) -> Function:
    """Cache all results, which are slow to compute and are used for both the kernels and numpy."""
    results: dict[bytes, Any] = {}

    @functools.wraps(function)
    def wrapper(*arguments: Any, **keywords: Any) -> Any:
        key = pickle.dumps((arguments, keywords))
        if key not in results:
            results[key] = function(*arguments, **keywords)
        return results[key]

    return cast(Function, wrapper)


# --- filters ----------------------------------------------------------------------------------------------------

Section = tuple[Any, Any, Any, Any, Any]  # b0, b1, b2, a1, a2


def difference_equation(section: Section, x: LongArray) -> LongArray:
    """y[n] = b0 x[n] + b1 x[n-1] + b2 x[n-2] - a1 y[n-1] - a2 y[n-2] for (..., N), with zero initial state."""
    b0, b1, b2, a1, a2 = section
    y = np.zeros_like(x)
    x1 = x2 = y1 = y2 = np.zeros(x.shape[:-1], Long)
    for n in range(x.shape[-1]):
        y[..., n] = b0 * x[..., n] + b1 * x1 + b2 * x2 - a1 * y1 - a2 * y2
        x1, x2, y1, y2 = x[..., n], x1, y[..., n], y1
    return y


def butterworth(order: int, cutoff: float, rate: float, high: bool = False) -> list[Section]:
    """Butterworth filter: poles exp(j pi (2k + order - 1) / 2 order), bilinear transform with prewarping."""
    warped = np.tan(PI * Long(cutoff) / Long(rate))
    sections: list[Section] = []
    for pair in range(order // 2):
        damping = 2 * np.sin(PI * (2 * pair + 1) / (2 * order))
        norm = 1 + damping * warped + warped**2
        ends, middle = (1 / norm, -2 / norm) if high else (warped**2 / norm, 2 * warped**2 / norm)
        sections.append((ends, middle, ends, 2 * (warped**2 - 1) / norm, (1 - damping * warped + warped**2) / norm))
    if order % 2:
        gain = 1 / (1 + warped) if high else warped / (1 + warped)
        sections.append((gain, -gain if high else gain, Long(0), (warped - 1) / (warped + 1), Long(0)))
    return sections


@cached
def run(sections: list[Section], x: LongArray) -> LongArray:
    """Filter `x` (..., N) with all sections."""
    for section in sections:
        x = difference_equation(section, x)
    return x


def leaky(tau: Any, x: LongArray, start: Any = 0) -> LongArray:
    """u[n] = r u[n-1] + (1 - r) x[n], r = exp(-1 / tau), tau in samples, u[-1] = start."""
    r = np.exp(-1 / Long(tau))
    u, last = np.zeros_like(x), start
    for n in range(x.shape[-1]):
        u[..., n] = last = r * last + (1 - r) * x[..., n]
    return u


# --- pre-processing ---------------------------------------------------------------------------------------------


@cached
def gain_control(x: LongArray, rate: float, seconds: float) -> LongArray:
    """Gain control of (2, N) as one block, with sound in both ears from its beginning."""
    tau = seconds * rate
    span = min(x.shape[-1], math.floor(tau + 0.5))
    powers = [leaky(Long(seconds) * Long(rate), ear**2, np.mean(ear[:span] ** 2)) for ear in x]
    return x / (np.sqrt(np.maximum(*powers)) + Long("1e-8"))


def fourier(x: Any, sign: int) -> NDArray[np.clongdouble]:
    """Return the sum of x[n] exp(sign 2 pi j k n / N) over n, for all k."""
    size = len(x)
    turns = np.outer(np.arange(size), np.arange(size)) % size
    angles = 2 * PI * np.arange(size) / size
    circle = np.cos(angles) + sign * np.clongdouble(1j) * np.sin(angles)
    return circle[turns] @ np.asarray(x, np.clongdouble)


def frequency_sampling(frequencies: Any, amplitudes: Any) -> LongArray:
    """Linear-phase filter of 513 taps: amplitudes on 513 points up to the last frequency, Hamming window."""
    grid = np.arange(513) * Long(frequencies[-1]) / 512
    at = np.clip(np.searchsorted(frequencies, grid, side="right") - 1, 0, len(frequencies) - 2)
    f, a = np.asarray(frequencies, Long), np.asarray(amplitudes, Long)
    response = a[at] + (a[at + 1] - a[at]) * (grid - f[at]) / (f[at + 1] - f[at])
    n = np.arange(513)
    taps = np.zeros(513, Long)
    for k, amplitude in enumerate(response):
        taps += (1 if k in (0, 512) else 2) * amplitude * np.cos(2 * PI * k * (n - 256) / 1024) / 1024
    return taps * (Long("0.54") - Long("0.46") * np.cos(2 * PI * n / 512))


@cached
def jepsen(impedance: Any, rate: float) -> LongArray:
    """Middle-ear filter of Jepsen et al. from their table of (Hz, impedance)."""
    below = [(f, 1 / Long(z)) for f, z in impedance if f < rate / 2]
    taps = frequency_sampling(*zip((0, 0), *below, (rate / 2, 0), strict=True))
    return taps / np.abs(fourier(taps, -1)).max() * Long("1e-8") * Long(10) ** (Long(104) / 20)


@cached
def lopezpoveda(displacement: Any, velocity: Any, rate: float) -> LongArray:
    """Middle-ear filter of Lopez-Poveda and Meddis from tables of (Hz, µm) and (Hz, m/s); minimum phase."""
    scale = Long("1e-6") * 2 * PI * np.sqrt(Long(2)) / Long(10) ** (Long(104) / 20)
    points = sorted([(f, d * f * scale) for f, d in displacement] + [(f, Long(v)) for f, v in velocity])
    if rate <= 20000:
        points = [point for point in points if point[0] < rate / 2]
    else:
        while points[-1][0] + 1000 <= rate / 2:
            points.append((points[-1][0] + 1000, points[-1][1] / Long("1.1")))
    f, v = points[-1]
    if f != rate / 2:
        points.append((rate / 2, v / (1 + (rate / 2 - f) * Long("0.1") / 1000)))
    taps = frequency_sampling(*zip((0, 0), *points, strict=True)) / Long("20e-6")
    magnitude = np.abs(fourier(taps, -1))
    causal = np.r_[1, np.full(256, 2), np.zeros(256)]  # spectral weights of an analytic signal
    phase = -(fourier(fourier(np.log(magnitude), -1) * causal, 1) / 513).imag
    return (fourier(magnitude * (np.cos(phase) + 1j * np.sin(phase)), 1) / 513).real


# --- filterbanks ------------------------------------------------------------------------------------------------


@cached
def gammatone(x: LongArray, rate: float, frequencies: Any, order: int, width: float) -> tuple[LongArray, LongArray]:
    """Return output and envelope, (2, C, N), of cascades of complex one-pole filters."""
    f = np.asarray(frequencies, Long)
    beta = 2 * PI * Long(width) * (Long("24.7") + Long("0.108") * f) / Long(rate)
    theta = 2 * PI * f / Long(rate)
    pole = np.exp(-beta) * (np.cos(theta) - np.clongdouble(1j) * np.sin(theta))
    gain = -np.expm1(-beta)
    analytic = np.zeros((2, len(f), x.shape[-1]), np.clongdouble)
    states = np.zeros((order, 2, len(f)), np.clongdouble)
    for n in range(x.shape[-1]):
        value: Any = x[:, n, np.newaxis]
        for state in states:
            state[...] = value = gain * value + pole * state
        analytic[..., n] = value
    return 2 * analytic.real, 2 * np.hypot(analytic.real, analytic.imag)


@cached
def drnl(x: LongArray, rate: float, frequency: float) -> LongArray:
    """One DRNL channel, (2, N) to (2, N), by table III of Lopez-Poveda and Meddis as used in CASP."""
    log = np.log10(Long(frequency))

    def power(intercept: str, slope: str, at: Any = log) -> Any:
        return Long(10) ** (Long(intercept) + Long(slope) * at)

    def resonator(centre: Any, bandwidth: Any) -> list[Section]:
        theta, phi = 2 * PI * centre / Long(rate), 2 * PI * bandwidth / Long(rate)
        alpha, beta = -np.exp(-phi) * np.cos(theta), np.exp(-2 * phi)
        delay = np.cos(theta) - np.clongdouble(1j) * np.sin(theta)
        gain = np.abs((1 + 2 * alpha * delay + beta * delay**2) / (1 + alpha * delay))
        return [(gain, gain * alpha, Long(0), 2 * alpha, beta)] * 2

    linear = resonator(power("-0.06762", "1.01679"), power("0.03728", "0.75"))
    linear += butterworth(2, power("-0.06762", "1.01"), rate) * 4
    centre, fitted = power("-0.05252", "1.01650"), log if frequency <= 1000 else np.log10(Long(1500))
    narrow = resonator(centre, power("-0.03193", "0.70"))
    y = run(narrow, x)
    straight = power("1.40298", "0.81916", fitted) * np.abs(y)
    bent = power("1.61912", "-0.81867", fitted) * np.abs(y) ** power("-0.60206", "0")
    nonlinear = run(narrow + butterworth(2, power("-0.05252", "1.01"), rate), np.sign(y) * np.minimum(straight, bent))
    return run(linear, x * power("4.20405", "-0.47909")) + nonlinear


# --- hair cells and framed stages --------------------------------------------------------------------------------


@cached
def hair_cell(method: str, x: LongArray, envelope: LongArray, rate: float) -> LongArray:
    """(2, C, N) to (2, C, N)."""
    half = np.maximum(x, 0)
    if method == "bernstein":
        compressed = np.where(envelope > 0, np.where(envelope > 0, envelope, 1) ** Long("-0.77") * x, 0)
        return run(butterworth(2, 425, rate), np.maximum(compressed, 0) ** 2)
    return {
        "none": lambda: x,
        "halfwave": lambda: half,
        "fullwave": lambda: np.abs(x),
        "square": lambda: x**2,
        "hilbert": lambda: envelope,
        "joergensen": lambda: run(butterworth(1, 150, rate), envelope),
        "dau": lambda: run(butterworth(2, 1000, rate), half),
        "dau1996": lambda: run(butterworth(1, 1000, rate), half),
        "breebart": lambda: run(butterworth(1, 2000, rate) * 5, half),
    }[method]()


def window(name: str, size: int) -> LongArray:
    """Return the symmetric window."""
    i = np.arange(size).astype(Long)
    turn = 2 * PI * i / (size - 1)
    rising = np.minimum(i, i[::-1])
    triangle = (2 * rising + 1) / size if size % 2 == 0 else 2 * (rising + 1) / (size + 1)
    return {
        "hann": (1 - np.cos(turn)) / 2,
        "hanning": (1 - np.cos(2 * PI * (i + 1) / (size + 1))) / 2,
        "hamming": Long("0.54") - Long("0.46") * np.cos(turn),
        "blackman": Long("0.42") - Long("0.5") * np.cos(turn) + Long("0.08") * np.cos(2 * turn),
        "triang": triangle,
        "sqrt_win": np.sqrt(triangle),
    }[name]


def frames(x: LongArray, shape: LongArray, hop: int) -> LongArray:
    """Return windowed frames (..., F, w), each cut separately."""
    starts = range(0, x.shape[-1] - len(shape) + 1, hop)
    return np.stack([shape * x[..., start : start + len(shape)] for start in starts], axis=-2)


@cached
def level_difference(x: LongArray, shape: LongArray, hop: int) -> LongArray:
    """(2, C, N) to (C, F) in dB."""
    left, right = np.mean(frames(x, shape, hop) ** 2, axis=-1)
    return 10 * np.log10((right + EPSILON) / (left + EPSILON))


@cached
def ratemap(x: LongArray, shape: LongArray, hop: int, rate: float, decay: float, power: bool) -> LongArray:
    """(2, C, N) to (2, C, F)."""
    cut = frames(leaky(Long(rate) * Long(decay), x), shape, hop)
    return np.mean(cut**2 if power else cut, axis=-1)


@cached
def correlation(x: LongArray, shape: LongArray, hop: int, reach: int) -> LongArray:
    """(2, C, N) to (C, 2 reach + 1, F), each lag a sum of products."""
    left, right = frames(x, shape, hop)
    size = len(shape)
    result = np.zeros((left.shape[0], 2 * reach + 1, left.shape[1]), Long)
    for lag in range(-min(reach, size - 1), min(reach, size - 1) + 1):
        later, earlier = left[..., max(lag, 0) : size + min(lag, 0)], right[..., max(-lag, 0) : size - max(lag, 0)]
        result[:, reach + lag] = np.sum(later * earlier, axis=-1)
    energies = np.sum(left**2, axis=-1) * np.sum(right**2, axis=-1)
    return result / np.sqrt(energies + EPSILON)[:, np.newaxis]
