"""Comparisons of the representations of each ear: rates, transients, periodicity, modulation, spectral shape."""

from __future__ import annotations

from math import pi

import numpy as np
import scipy.signal
import scipy.stats

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.interface.remarks import PRESETS
from rosafe.validation.comparison import Collection, Curve, Measured, Process, altered, parameter, scaled
from rosafe.validation.stimuli import THROUGH, both, complex_tone, largest, noise, through, tone

ROWS = Collection()
RATE = 16000


# --- ratemap and transients --------------------------------------------------------------------------------------


@ROWS.listed(parameter("rm_decaySec", 0.0080001))
def ratemap_decay(process: Process) -> Measured:
    signal = np.concatenate((np.ones(1600), np.zeros(4000)))
    rates = process(through(signal), RATE, THROUGH, ["ratemap"])["ratemap"][0, 0]
    measured = 10 * np.log10(rates)[12:]
    expected = measured[0] - 20 * np.log10(np.e) * 0.01 / 0.008 * np.arange(len(measured))
    times = 0.01 * (12 + np.arange(len(measured)))
    return Measured(largest(np.diff(measured - expected)), Curve(times, expected, measured, "time (s)", "level (dB)"))


@ROWS.listed(parameter("rm_wname", "hamming"))
def ratemap_power(process: Process) -> float:
    rates = process(through(np.full(8000, 0.3)), RATE, THROUGH, ["ratemap"])["ratemap"][0, 0]
    expected = 0.3**2 * np.mean(scipy.signal.windows.hann(320) ** 2)
    return abs(rates[-1] / expected - 1)


@ROWS.listed(scaled("onsetStrength", 1 + 1e-6))
def onset_sum(process: Process) -> float:
    signal = np.repeat([0.01, 0.1], 8000)
    strengths = process(through(signal), RATE, THROUGH, ["onsetStrength"])["onsetStrength"][0, 0]
    return abs(float(strengths[30:].sum()) - 20)  # after the start of the integrator


@ROWS.listed(parameter("rm_decaySec", 0.0080001))
def offset_decay(process: Process) -> float:
    signal = np.concatenate((np.ones(1600), np.zeros(1600)))
    strengths = process(through(signal), RATE, THROUGH, ["offsetStrength"])["offsetStrength"][0, 0]
    return largest(strengths[12:] - 20 * np.log10(np.e) * 0.01 / 0.008)


# --- periodicity -------------------------------------------------------------------------------------------------


@ROWS.listed(parameter("ac_K", 2.0000001))
def autocorrelation(process: Process) -> Measured:
    signal = both(complex_tone(150, range(1, 20), RATE, 0.2) + 0.1 * noise(3200))
    result = process(signal, RATE, {"fb_nChannels": 6, "ac_clipAlpha": 0.0}, ["ihc", "autocorrelation"])
    window, frame = scipy.signal.windows.hann(320), 12
    worst, curve = 0.0, None
    for channel in range(6):
        x = result["ihc"][0, channel, 160 * frame : 160 * frame + 320] * window
        full = scipy.signal.correlate(x, x, method="direct")[319:]
        expected = (full / full[0] * 320 / (320 - np.arange(320)))[:319]
        measured = result["autocorrelation"][0, channel, :, frame]
        worst = max(worst, largest(measured - expected))
        lags = 1e3 * np.arange(200) / RATE
        curve = curve or Curve(lags, expected[:200], measured[:200], "lag (ms)", "autocorrelation")
    return Measured(worst, curve)


@ROWS.listed(parameter("ac_clipAlpha", 0.7))
def clipping(process: Process) -> float:
    signal = noise(3200)
    output = process(through(signal), RATE, THROUGH, ["autocorrelation"])["autocorrelation"][0, 0, :, 5]
    x = signal[800:1120] * scipy.signal.windows.hann(320)
    x = np.where((x >= 0.6 * x.max()) | (x <= 0.6 * x.min()), x, 0.0)
    full = scipy.signal.correlate(x, x, method="direct")[319:]
    return largest(output - (full / full[0] * 320 / (320 - np.arange(320)))[:319])


def median_pitch(process: Process, signal: FloatArray) -> float:
    """Return the median of the pitch in Hz; 1 if most frames have none."""
    pitches = process(signal, RATE, PRESETS["speech"], ["pitch"])["pitch"][0, 0]
    return float(np.median(np.nan_to_num(pitches, nan=1.0)))


# tolerance: pitch is found at whole lags
@ROWS.listed(altered("one lag more", "pitch", lambda values: 1 / (1 / values + 1 / RATE)))
def pitch_of_complexes(process: Process) -> Measured:
    expected = np.array([100.0, 123, 160, 199, 240, 311, 390])
    measured = []
    for f0 in expected:
        signal = both(complex_tone(f0, range(1, int(5000 / f0)), RATE, 0.3))
        measured.append(median_pitch(process, signal))
    periods = RATE / np.array(measured) - RATE / expected
    return Measured(largest(periods), Curve(expected, expected, measured, "fundamental (Hz)", "pitch (Hz)"))


@ROWS.listed(altered("one lag more", "pitch", lambda values: 1 / (1 / values + 1 / RATE)))
def missing_fundamental(process: Process) -> float:
    worst = 0.0
    for f0 in (125.0, 200.0, 250.0):
        signal = both(complex_tone(f0, range(3, 7), RATE, 0.3))
        worst = max(worst, abs(RATE / median_pitch(process, signal) - RATE / f0))
    return worst


# --- modulation and spectral shape -------------------------------------------------------------------------------


@ROWS.listed(parameter("ams_cfHz", [4.0, 64.5]))
def modulation_filter(process: Process) -> Measured:
    centre, rate = 64.0, RATE / 4
    frequencies = np.array([16.0, 32, 40, 64, 104, 128, 256])
    parameters = {**THROUGH, "ams_cfHz": [4.0, centre], "ams_wSizeSec": 0.5, "ams_hSizeSec": 0.25}
    measured = []
    for frequency in frequencies:
        signal = through(tone(frequency, RATE, 2.0))
        output = process(signal, RATE, parameters, ["amsFeatures"])["amsFeatures"][0, 0, 1, -1]
        measured.append(20 * np.log10(output * pi / 2))
    edges = np.tan(pi * centre * (np.sqrt(1.25) + np.array([-0.5, 0.5])) / rate)
    warped = np.tan(pi * frequencies / rate)
    expected = -10 * np.log10(1 + ((warped**2 - edges.prod()) / (warped * (edges[1] - edges[0]))) ** 2)
    return Measured.of(frequencies, expected, measured, "modulation frequency (Hz)", "gain (dB)", True)


@ROWS.listed(
    altered("each filter exchanged for its neighbour", "amsFeatures", lambda values: np.roll(values, 1, axis=2))
)
def modulation_frequency(process: Process) -> float:
    worst, centres = 0.0, [4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0]
    for frequency in (8.0, 32.0, 128.0):
        signal = both((1 + tone(frequency, RATE, 2.0)) * noise(2 * RATE))
        features = process(signal, RATE, {"ams_cfHz": centres}, ["amsFeatures"])["amsFeatures"][0]
        levels = features[10:].mean((0, 2)) / np.sqrt(centres)  # noise has a level proportional to the bandwidth
        found = centres[1 + int(np.argmax(levels[1:]))]  # the first filter is a low-pass
        worst = max(worst, abs(float(np.log2(found / frequency))))
    return worst


# tolerance: small constants in the denominators
@ROWS.listed(scaled("spectralFeatures", 1.00001))
def spectral_shape(process: Process) -> float:
    words = ["centroid", "spread", "crest", "flatness", "skewness", "kurtosis"]
    result = process(both(noise(8000)), RATE, {"sf_requests": words}, ["ratemap", "spectralFeatures"])
    rates, frequencies = result["ratemap"][0], result["fb_cfHz"]
    worst = 0.0
    for frame in range(5, rates.shape[1]):
        x = rates[:, frame]
        centroid = np.average(frequencies, weights=x)
        spread = np.sqrt(np.average((frequencies - centroid) ** 2, weights=x))
        count = len(x)
        ratio = np.sqrt(count / (count - 1))  # the front-end normalises with the unbiased deviation
        expected = [
            centroid / frequencies[-1],
            spread / frequencies[-1],
            x.max() / x.mean(),
            scipy.stats.gmean(x) / x.mean(),
            scipy.stats.skew(x) / ratio**3,
            scipy.stats.kurtosis(x, fisher=False) / ratio**4 - 3,
        ]
        worst = max(worst, largest((result["spectralFeatures"][0, :, frame] - expected) / np.abs(expected)))
    return worst


@ROWS.listed(scaled("spectralFeatures", 1.0001))
def spectral_entropy(process: Process) -> float:
    worst = 0.0
    for signal in (noise(4000), tone(1000, RATE, 0.25)):
        result = process(both(signal), RATE, {"sf_requests": ["entropy"]}, ["ratemap", "spectralFeatures"])
        rates = result["ratemap"][0]
        expected = scipy.stats.entropy(rates, base=len(rates))
        worst = max(worst, largest((result["spectralFeatures"][0, 0] - expected)[3:]))
    return worst


@ROWS.listed(parameter("fb_nChannels", 24))
def gabor_count(process: Process) -> float:
    parameters = {"fb_nChannels": 23, "fb_lowFreqHz": 124.0, "fb_highFreqHz": 3657.0, "rm_wSizeSec": 0.025}
    return abs(process(both(noise(16000)), RATE, parameters, ["gabor"])["gabor"].shape[1] - 311.0)


@ROWS.listed(
    altered("5 % of the previous frame added", "gabor", lambda values: values + 0.05 * np.roll(values, 1, axis=-1))
)
def gabor_filters(process: Process) -> Measured:
    step, modulations = 0.01, np.array([5.0, 12.0])
    times = np.arange(8 * RATE) / RATE
    level = np.cos(2 * pi * np.outer(times, modulations)).sum(-1)
    centres = np.geomspace(200, 6000, CHANNELS)
    carrier = np.sum([tone(frequency, RATE, 8.0, 0.02) for frequency in centres], axis=0)
    result = process(both(carrier * 10 ** (level / 20)), RATE, {"fb_cfHz": list(centres)}, ["ratemap", "gabor"])
    places, omegas = temporal_filters()
    last = slice(result["gabor"].shape[-1] - 200, result["gabor"].shape[-1])
    basis = np.exp(-2j * pi * step * np.outer(np.arange(200), modulations))
    weights = 0.5 + 0.5 * np.cos(2 * pi * (np.arange(CHANNELS) - CHANNELS // 2) / (3 * CHANNELS))
    incoming = np.abs(weights @ np.log10(result["ratemap"][0][:, last]) @ basis)
    outgoing = np.abs(result["gabor"][0][places, last] @ basis)
    measured = 20 * np.log10(outgoing[:, 1] / outgoing[:, 0] / (incoming[1] / incoming[0]))
    expected = np.array([_temporal_ratio(omega, 2 * pi * step * modulations) for omega in omegas])
    filters = omegas / (2 * pi * step)
    return Measured.of(filters, expected, measured, "temporal filter (Hz)", "12 Hz over 5 Hz (dB)")


CHANNELS = 23


def modulation_axis(size: float, spacing: float) -> np.ndarray:
    """Return the positive modulation frequencies of the filters along one axis, ascending, in radians."""
    width = 8 * spacing / 3.5
    frequencies = [pi / 2]
    while frequencies[0] * (1 - width / 2) / (1 + width / 2) > 3.5 * pi / size:
        frequencies.insert(0, frequencies[0] * (1 - width / 2) / (1 + width / 2))
    return np.array(frequencies)


def temporal_filters() -> tuple[list[int], np.ndarray]:
    """Return the places of the features without spectral modulation, and their temporal frequencies (radians)."""
    omegas, kappas = modulation_axis(40, 0.2), modulation_axis(3 * CHANNELS, 0.3)
    places, count = [], 0
    for omega in (0.0, *omegas):
        for kappa in (*(-kappas[::-1] if omega else ()), 0.0, *kappas):
            size = min(3.5 * pi / abs(kappa), 3 * CHANNELS) if kappa else 3 * CHANNELS
            distance = max(1, (2 * int(np.ceil(size / 2)) - 1) // 4)  # channels between the features of a filter
            if omega and not kappa:
                places.append(count)
            count += sum((channel - CHANNELS // 2) % distance == 0 for channel in range(CHANNELS))
    return places, omegas


def _temporal_ratio(omega: float, modulations: np.ndarray) -> float:
    """Return the response of a temporal Gabor filter to the second modulation over that to the first, in dB."""
    length = 3.5 * pi / omega
    u = np.arange(-19, 20)
    envelope = np.where(np.abs(u) < length / 2, 0.5 + 0.5 * np.cos(2 * pi * u / length), 0.0)
    weights = envelope * np.cos(omega * u)
    weights -= envelope * weights.sum() / envelope.sum()
    response = np.abs(np.exp(-1j * np.outer(modulations, u)) @ weights)
    return float(20 * np.log10(response[1] / response[0]))
