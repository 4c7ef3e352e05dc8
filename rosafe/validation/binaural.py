"""Comparisons of the binaural representations with closed forms and known stimuli."""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.signal

from rosafe.declarations.reference import LITERATURE
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.validation.comparison import (
    INDEPENDENT,
    Collection,
    Curve,
    Measured,
    Origin,
    Process,
    altered,
    parameter,
    scaled,
    shifted,
)
from rosafe.validation.published import BRAASCH_DELAYS, BRAASCH_ITD
from rosafe.validation.stimuli import delayed, largest, noise

ROWS = Collection()
RATE = 16000


# tolerance: the front-end adds 2.2e-16 to the energies
@ROWS.listed(scaled("ild", 1 + 1e-5))
def level_differences(process: Process) -> Measured:
    expected = np.arange(-30.0, 31, 10)
    measured = []
    for difference in expected:
        signal = noise(4000) * np.array([[1.0], [10 ** (difference / 20)]])
        values = process(signal, RATE, {}, ["ild"])["ild"]
        measured.append(values.flat[np.argmax(np.abs(values - difference))])
    return Measured.of(expected, expected, measured, "level difference (dB)", "ILD (dB)")


# tolerance: the front-end adds 2.2e-16 to the product of the energies
@ROWS.listed(parameter("cc_wname", "hamming"))
def cross_correlation(process: Process) -> Measured:
    signal = np.stack((noise(3200, 1) + noise(3200, 2), np.roll(noise(3200, 1), 5) + noise(3200, 3)))
    result = process(signal, RATE, {"fb_nChannels": 8}, ["ihc", "crossCorrelation"])
    window, frame, lags = scipy.signal.windows.hann(320), 12, result["cc_lags"]
    reach = len(lags) // 2
    worst, curve = 0.0, None
    for channel in range(8):
        left, right = result["ihc"][:, channel, 160 * frame : 160 * frame + 320] * window
        full = scipy.signal.correlate(left, right, method="direct")[319 - reach : 320 + reach]
        expected = full / np.sqrt(np.sum(left**2) * np.sum(right**2))
        measured = result["crossCorrelation"][channel, :, frame]
        worst = max(worst, largest(measured - expected))
        curve = curve or Curve(1e3 * lags, expected, measured, "lag (ms)", "cross-correlation")
    return Measured(worst, curve)


# tolerance: parabola through three lags of 62.5 µs
@ROWS.listed(shifted("itd", 3e-6, "s"))
def time_differences(process: Process) -> Measured:
    expected = np.linspace(-600, 600, 9)
    measured, worst, source = [], 0.0, noise(RATE)
    for delay in expected:
        signal = np.stack((delayed(source, 1e-6 * delay, RATE), source))
        parameters = {"fb_lowFreqHz": 300.0, "fb_highFreqHz": 1500.0, "cc_wSizeSec": 0.1}
        channels = 1e6 * np.median(process(signal, RATE, parameters, ["itd"])["itd"], axis=-1)
        measured.append(np.median(channels))
        worst = max(worst, largest(channels - delay))
    return Measured(worst, Curve(expected, expected, measured, "delay (µs)", "ITD (µs)"))


# tolerance: 4 s of noise
@ROWS.listed(shifted("ic", -0.04))
def coherence(process: Process) -> Measured:
    expected = np.array([0.5, 0.7, 0.9, 1.0])
    measured = []
    common, other = (noise(4 * RATE, seed) for seed in (1, 2))
    filters = {"fb_lowFreqHz": 1000.0, "fb_highFreqHz": 4000.0, "fb_nChannels": 5}
    parameters = {**filters, "ihc_method": "none", "cc_wSizeSec": 1.0, "cc_hSizeSec": 0.5, "cc_maxDelaySec": 0.0005}
    for correlation in expected:
        signal = np.stack((common, correlation * common + np.sqrt(1 - correlation**2) * other))
        measured.append(process(signal, RATE, parameters, ["ic"])["ic"].mean())
    return Measured.of(expected, expected, measured, "correlation", "IC")


def lead_and_lag(itd: float, level_db: float) -> FloatArray:
    """Return noise with a reflection after 4 ms: the lead with an ITD in s, the lag with the opposite one."""
    lead, echo = noise(RATE // 2, 5), 10 ** (level_db / 20) * np.roll(noise(RATE // 2, 5), round(0.004 * RATE))
    return np.stack((delayed(lead, itd, RATE) + echo, lead + delayed(echo, itd, RATE)))


# tolerance: one lag
@ROWS.listed(shifted("precedence_itd", 62.5e-6, "s"))
def first_wave_front(process: Process) -> float:
    return _lead_error(process, -3.0)


@ROWS.listed(shifted("precedence_itd", 62.5e-6, "s"))
def localization_dominance(process: Process) -> float:
    return max(_lead_error(process, level) for level in (-20.0, -10.0, -6.0))


def _lead_error(process: Process, level_db: float) -> float:
    worst = 0.0
    for itd in (0.000375, -0.000375):
        result = process(lead_and_lag(itd, level_db), RATE, {}, ["precedence"])
        channels = (result["fb_cfHz"] > 300) & (result["fb_cfHz"] < 1300)
        values = result["precedence_itd"][channels, 10:]
        worst = max(worst, abs(float(np.median(values)) - itd))
    return 1e6 * worst


@ROWS.listed(shifted("precedence_itd", 62.5e-6, "s"))
def click_pairs(process: Process) -> Measured:
    delays, itd, found = np.array([2.0, 3, 4, 5, 7]), 0.000375, []
    for delay in delays:
        result = process(_clicks(itd, 1e-3 * delay), RATE, {"rm_decaySec": 0.001}, ["precedence", "ratemap"])
        channels = (result["fb_cfHz"] > 300) & (result["fb_cfHz"] < 1300)
        levels = result["ratemap"][0].sum(0)
        frames = np.flatnonzero(levels > 0.3 * levels.max())
        found.append(float(np.median(result["precedence_itd"][channels][:, frames[frames > 10]])))
    measured, expected = 1e6 * np.array(found), np.full(len(delays), 1e6 * itd)
    return Measured.of(delays, expected, measured, "delay of the second click (ms)", "ITD (µs)")


def _clicks(itd: float, delay: float) -> FloatArray:
    """Return pairs of clicks every 0.1 s for 1 s: the first with an ITD in s, the second with the opposite one."""
    signal, shift = np.zeros((2, RATE)), round(itd * RATE)
    for begin in np.arange(0.05, 0.95, 0.1):
        first, second = round(begin * RATE), round(begin * RATE) + round(delay * RATE)
        signal[[0, 1, 1, 0], [first + shift, first, second + shift, second]] += 1.0
    return signal


# --- the published precedence model --------------------------------------------------------------------------------


BURST_RATE = 48000
SEEDS = (1, 2, 3)
LEAD_ITD = 0.3  # ms; the lag has the opposite one


def lead_lag(delay: float, level: float, seed: int) -> FloatArray:
    """Return noise from 100 to 900 Hz of 200 ms with ramps of 20 ms, and its lag, (2, N).

    Parameters
    ----------
    delay : float
        Of the lag in ms.
    level : float
        Of the lag relative to the lead in dB.
    seed : int
        Of the noise.
    """
    count, ramp = 9600, np.sin(np.pi / 2 * np.arange(960) / 959) ** 2
    bins, random = np.fft.rfftfreq(count, 1 / BURST_RATE), np.random.default_rng(seed)
    spectrum = random.standard_normal(len(bins)) + 1j * random.standard_normal(len(bins))
    burst = np.fft.irfft(np.where((bins >= 100) & (bins <= 900), spectrum, 0), count)
    burst /= np.abs(burst).max()
    burst[:960] *= ramp
    burst[-960:] *= ramp[::-1]
    itd, late = round(LEAD_ITD * BURST_RATE / 1000), round(delay * BURST_RATE / 1000)
    sound = np.zeros((2, count + late + itd))
    for ear, begin, gain in (
        (0, itd, 1.0),
        (1, 0, 1.0),
        (0, late, 10 ** (level / 20)),
        (1, late + itd, 10 ** (level / 20)),
    ):
        sound[ear, begin : begin + count] += gain * burst
    return sound


def lateral_itd(process: Process, delay: float, level: float, window: float) -> float:
    """Return the ITD of the published decision device in ms, mean of three noises.

    It is the centroid of those parts of the correlation, summed over channels and frames, that exceed half of its
    maximum.
    """
    found = []
    parameters = {"fb_lowFreqHz": 100.0, "fb_highFreqHz": 1400.0, "prec_wSizeSec": window, "prec_hSizeSec": window / 2}
    for seed in SEEDS:
        padding = round((window + 0.01) * BURST_RATE)
        sound = np.pad(lead_lag(delay, level, seed), ((0, 0), (0, padding)))
        result = process(sound, BURST_RATE, parameters, ["precedence"])
        total = result["precedence_cc"].sum((0, 2))
        total -= total.min()
        total[total < total.max() / 2] = 0
        found.append(1e3 * float(np.sum(result["prec_lags"] * total) / total.sum()))
    return float(np.mean(found))


def against_model(process: Process, level: int, window: float) -> Measured:
    """Compare the ITD for all delays with the published model."""
    expected = 1e3 * np.array(BRAASCH_ITD[level])
    measured = [1e3 * lateral_itd(process, float(delay), level, window) for delay in BRAASCH_DELAYS]
    return Measured.of(BRAASCH_DELAYS, expected, measured, "delay of the lag (ms)", "ITD (µs)")


MODEL = Origin(
    "transcription of the author's program, computed with GNU Octave (docs/figures.md)", LITERATURE["braasch2013"]
)
CENTROID = "largest difference of the centroid of the correlation, over delays of 1 to 8 ms"
for _level, _window, _tolerance in ((-6, 0.02, 100.0), (-3, 0.05, 100.0)):
    ROWS.add(
        "precedence",
        f"noise of 200 ms and its lag of {_level} dB from the other side after 1 to 8 ms, ITDs of 0.3 and -0.3 ms",
        MODEL,
        "µs",
        _tolerance,
        altered("correlation shifted by 10 lags", "precedence_cc", lambda values: np.roll(values, 10, axis=1)),
        evidence=INDEPENDENT,
        criterion=CENTROID,
    )(partial(against_model, level=_level, window=_window))
for _level, _window in ((-3, 0.02), (0, 0.02), (0, 0.05), (4, 0.05)):
    _words = "equal level" if not _level else f"{_level:+d} dB"
    ROWS.limitation(
        "precedence",
        f"noise of 200 ms and its lag of {_words} from the other side after 1 to 8 ms, windows of {1e3 * _window:g} ms",
        MODEL,
        "µs",
        criterion=CENTROID,
    )(partial(against_model, level=_level, window=_window))
