"""Comparisons of the periphery: input, preProc, gammatone and DRNL filters, hair cells, adaptation, efferent reflex."""

from __future__ import annotations

import io
from dataclasses import dataclass
from fractions import Fraction
from math import pi, sqrt

import numpy as np
import scipy.signal

from rosafe.validation.comparison import Collection, Curve, Disturbance, Measured, Process, altered, parameter, scaled
from rosafe.validation.published import AMT_BURST, BURST_TIMES
from rosafe.validation.stimuli import THROUGH, both, fundamental, gain_db, impulse, largest, through, tone

ROWS = Collection()


# --- input and preProc -------------------------------------------------------------------------------------------


# tolerance: libsndfile divides by 2**31, the original by 2**31 - 1
@ROWS.listed(parameter("in_normalizeValue", 2**31 + 30))
def pcm_scale(process: Process) -> float:
    import soundfile

    samples = np.random.default_rng(1).integers(-(2**31), 2**31, (2, 500), dtype=np.int32)
    file = io.BytesIO()
    soundfile.write(file, samples.T, 16000, "PCM_32", format="WAV")
    file.seek(0)
    decoded, _ = soundfile.read(file, dtype="float64")
    result = process(samples, 16000, {"in_doNormalize": True}, ["input"])
    return largest(result["input"] - decoded.T)


@ROWS.listed(parameter("pp_cutoffHzDC", 100.0001))
def dc_removal(process: Process) -> Measured:
    rate, cutoff = 16000.0, 100.0
    frequencies = np.geomspace(20, 7000, 60)
    parameters = {"pp_bRemoveDC": True, "pp_cutoffHzDC": cutoff}
    output = process(both(impulse(16000)), rate, parameters, ["preProc"])["preProc"][0]
    ratio = np.tan(pi * cutoff / rate) / np.tan(pi * frequencies / rate)
    expected, measured = -10 * np.log10(1 + ratio**8), gain_db(output, frequencies, rate)
    return Measured.of(frequencies, expected, measured, "frequency (Hz)", "gain (dB)", True)


@ROWS.listed(parameter("pp_refSPLdB", 94.00001))
def level_scale(process: Process) -> float:
    signal = both(tone(1000, 16000, 0.1, sqrt(2)))
    output = process(signal, 16000, {"pp_bLevelScaling": True, "pp_refSPLdB": 94.0}, ["preProc"])["preProc"]
    return abs(20 * np.log10(np.sqrt(np.mean(output[0] ** 2))) - 6.0)


@ROWS.listed(parameter("pp_coefPreEmphasis", 0.97000001))
def pre_emphasis(process: Process) -> float:
    frequencies = np.geomspace(20, 7000, 60)
    output = process(both(impulse(64)), 16000, {"pp_bPreEmphasis": True}, ["preProc"])["preProc"][0]
    expected = 20 * np.log10(np.abs(1 - 0.97 * np.exp(-2j * pi * frequencies / 16000)))
    return largest(gain_db(output, frequencies, 16000) - expected)


@ROWS.listed(altered("a gain of each ear of its own", "preProc", lambda x: x / np.std(x, axis=-1, keepdims=True)))
def gain_control(process: Process) -> float:
    signal = tone(500, 16000, 1.0, 0.03) * np.array([[1.0], [0.5]])
    parameters = {"pp_bNormalizeRMS": True, "pp_intTimeSecRMS": 0.05}
    output = process(signal, 16000, parameters, ["preProc"])["preProc"][:, -8000:]
    levels = 10 * np.log10(np.mean(output**2, axis=-1))
    return largest(levels - [0, 20 * np.log10(0.5)])


# Peak-to-peak displacement of the stapes in µm at 104 dB SPL, at frequencies in Hz
STAPES_FREQUENCIES = np.array([400.0, 600, 800, 1000, 1200, 1600, 2000, 2600, 3000, 4000, 5000, 6000])
STAPES = np.array([0.19953, 0.22909, 0.21878, 0.15136, 0.1, 0.05754, 0.03311, 0.0182, 0.01259, 0.007, 0.005, 0.003])


# tolerance: the filter interpolates between the measured points
@ROWS.listed(scaled("preProc", 1.1))
def middle_ear(process: Process) -> Measured:
    rate = 44100.0
    parameters = {"pp_bMiddleEarFiltering": True, "pp_middleEarModel": "lopezpoveda", "pp_bUnityComp": False}
    output = process(both(impulse(4096)), rate, parameters, ["preProc"])["preProc"][0]
    velocity = STAPES * 1e-6 * 2 * pi * STAPES_FREQUENCIES / (20e-6 * 10 ** (104 / 20))
    expected = 20 * np.log10(velocity * sqrt(2))  # convention of the front-end: per amplitude, input in 20 µPa
    measured = gain_db(output, STAPES_FREQUENCIES, rate)
    return Measured.of(STAPES_FREQUENCIES, expected, measured, "frequency (Hz)", "gain (dB)", True)


# --- filterbanks -------------------------------------------------------------------------------------------------


# tolerance: 21.4 log10 of the publication is rounded: 9.294 in place of 9.265 ln
@ROWS.listed(parameter("fb_nERBs", 1.01))
def erb_spacing(process: Process) -> Measured:
    frequencies = process(np.zeros((2, 10)), 44100, {"fb_nERBs": 1.0}, ["gammatone"])["fb_cfHz"]
    numbers = 21.4 * np.log10(4.37 * frequencies / 1000 + 1)
    spacing = np.diff(numbers)
    return Measured.of(frequencies[1:], np.ones(len(spacing)), spacing, "centre frequency (Hz)", "spacing (ERB)", True)


@ROWS.listed(parameter("fb_bwERBs", 1.03))
def bandwidths(process: Process) -> Measured:
    rate, centres = 44100.0, np.geomspace(100, 8000, 12)
    response = process(both(impulse(44100)), rate, {"fb_cfHz": list(centres)}, ["gammatone"])["gammatone"][0]
    spectra = np.abs(np.fft.rfft(response)) ** 2
    measured = spectra.sum(-1) / spectra.max(-1) * rate / response.shape[-1]
    expected = 24.7 * (4.37 * centres / 1000 + 1)
    return Measured(
        largest(measured / expected - 1),
        Curve(centres, expected, measured, "centre frequency (Hz)", "bandwidth (Hz)", True),
    )


@ROWS.listed(parameter("fb_bwERBs", 1.018 * (1 + 1e-9)))
def impulse_responses(process: Process) -> float:
    rate, count = 44100.0, 8000
    result = process(both(impulse(count)), rate, {}, ["gammatone"])
    centres, k = result["fb_cfHz"][:, None], np.arange(count)
    decay = 2 * pi * 1.018 * (24.7 + 0.108 * centres) / rate
    envelope = 2 * (1 - np.exp(-decay)) ** 4 * (k + 1) * (k + 2) * (k + 3) / 6 * np.exp(-decay * k)
    expected = envelope * np.cos(2 * pi * centres / rate * k)
    return largest((result["gammatone"][0] - expected) / np.abs(expected).max(-1, keepdims=True))


@ROWS.listed(parameter("fb_bwERBs", 1.02))
def gammatone_function(process: Process) -> Measured:
    rate, centre = 44100.0, 1000.0
    response = process(both(impulse(1500)), rate, {"fb_cfHz": [centre]}, ["gammatone"])["gammatone"][0, 0]
    width = 1.018 * (24.7 + 0.108 * centre)
    # the cascade of four one-pole filters corresponds to t**3 at (k + 2) samples
    k = np.arange(1500)
    wave = ((k + 2) / rate) ** 3 * np.exp(-2 * pi * width * k / rate) * np.cos(2 * pi * centre * k / rate)
    wave *= np.abs(response).max() / np.abs(wave).max()
    r = np.corrcoef(response, wave)[0, 1]
    return Measured(
        1 - float(r), Curve(1e3 * k[:700] / rate, wave[:700], response[:700], "time (ms)", "impulse response")
    )


def power_law(intercept: float, slope: float, frequency: float) -> float:
    """Return a parameter of DRNL for a channel, as regression over the logarithm of its frequency."""
    return float(10 ** (intercept + slope * np.log10(frequency)))


def transfer(
    frequency: float, rate: float, centre: float, width: float, cutoff: float, counts: tuple[int, int]
) -> complex:
    """Return the response to a tone of some sections of a gammatone filter and of a Butterworth low-pass."""
    alpha, decay = -np.exp(-2 * pi * width / rate) * np.cos(2 * pi * centre / rate), np.exp(-2 * pi * width / rate)
    filters = ([1, alpha], [1, 2 * alpha, decay**2])
    tones = 2 * pi * np.array([frequency, centre]) / rate
    section, peak = scipy.signal.freqz(*filters, worN=tones)[1]
    low = scipy.signal.freqz(*scipy.signal.butter(2, cutoff, fs=rate), worN=tones)[1][0]
    return complex((section / abs(peak)) ** counts[0] * low ** counts[1])


@dataclass(frozen=True)
class Drnl:
    """Parameters of a DRNL channel; `linear` and `compressive` are centre, width and cutoff of the filters in Hz.

    `sections` are the numbers of gammatone and low-pass sections in the linear path, before and after the compression.
    """

    linear: tuple[float, float, float]
    gain: float
    compressive: tuple[float, float, float]
    slope: float  # a
    scale: float  # b
    exponent: float  # c
    sections: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]

    def output(self, velocities: np.ndarray, frequency: float, rate: float) -> np.ndarray:
        """Return the level of the response to tones of these peak velocities, in dB, by closed forms of both paths."""
        direct, before, after = (
            transfer(frequency, rate, *filters, counts)
            for filters, counts in zip((self.linear, self.compressive, self.compressive), self.sections, strict=True)
        )
        wave = np.cos(2 * pi * (np.arange(4096) + 0.5) / 4096)
        driven = velocities[:, np.newaxis] * abs(before) * np.abs(wave)
        stick = np.sign(wave) * np.minimum(self.slope * driven, self.scale * driven**self.exponent)
        bent = 2 * np.mean(stick * wave, axis=-1)  # the fundamental
        return 20 * np.log10(np.abs(bent * before / abs(before) * after + velocities * self.gain * direct))


def jepsen_drnl(frequency: float) -> Drnl:
    """Return the parameters of Jepsen et al. (2008) of a channel."""
    fit = frequency if frequency <= 1000 else 1500.0
    centre, cutoff = power_law(-0.06762, 1.01679, frequency), power_law(-0.06762, 1.01, frequency)
    best, after = power_law(-0.05252, 1.0165, frequency), power_law(-0.05252, 1.01, frequency)
    return Drnl(
        (centre, power_law(0.03728, 0.75, frequency), cutoff),
        power_law(4.20405, -0.47909, frequency),
        (best, power_law(-0.03193, 0.7, frequency), after),
        power_law(1.40298, 0.81916, fit),
        power_law(1.61912, -0.81867, fit),
        10**-0.60206,
        ((2, 4), (2, 0), (2, 1)),
    )


def drnl_measured(process: Process, velocities: np.ndarray, frequency: float, rate: float) -> np.ndarray:
    """Return the level of the response of the channel at a frequency to tones of these velocities, in dB."""
    levels = []
    for velocity in velocities:
        signal = both(tone(frequency, rate, 0.1, velocity))
        output = process(signal, rate, {"fb_type": "drnl", "fb_cfHz": [frequency]}, ["gammatone"])["gammatone"]
        levels.append(20 * np.log10(abs(fundamental(output[0, 0], frequency, rate))))
    return np.array(levels)


@ROWS.listed(
    altered("output with the exponent 1.001", "gammatone", lambda values: np.sign(values) * np.abs(values) ** 1.001)
)
def drnl_growth(process: Process) -> Measured:
    rate, velocities, worst = 44100.0, 10 ** np.arange(-10, -4.4, 0.5), 0.0
    for frequency in (250.0, 500.0, 1000.0, 2000.0, 8000.0, 4000.0):
        expected = jepsen_drnl(frequency).output(velocities, frequency, rate)
        measured = drnl_measured(process, velocities, frequency, rate)
        worst = max(worst, largest(measured - expected))
    curve = Curve(20 * np.log10(velocities), expected, measured, "input at 4 kHz (dB re 1 m/s)", "output (dB)")
    return Measured(worst, curve)


# --- hair cells --------------------------------------------------------------------------------------------------


def hair_cell_gain(process: Process, method: str, frequencies: np.ndarray, rate: float) -> np.ndarray:
    """Return the gain in dB of the low-pass of a hair cell for the fundamental of rectified tones."""
    gains = []
    for frequency in frequencies:
        signal = both(tone(frequency, rate, 0.2))
        parameters = {"fb_cfHz": [float(frequency)]}
        output = process(signal, rate, {**parameters, "ihc_method": method}, ["ihc"])["ihc"][0, 0]
        plain = process(signal, rate, {**parameters, "ihc_method": "halfwave"}, ["ihc"])["ihc"][0, 0]
        gains.append(abs(fundamental(output, frequency, rate)) / abs(fundamental(plain, frequency, rate)))
    return 20 * np.log10(gains)


def lowpass_row(process: Process, method: str, order: int) -> Measured:
    """Compare with a Butterworth low-pass at 1 kHz."""
    rate, frequencies = 40000.0, np.array([250.0, 500, 1000, 2000, 4000])
    measured = hair_cell_gain(process, method, frequencies, rate)
    ratio = np.tan(pi * frequencies / rate) / np.tan(pi * 1000 / rate)
    expected = -10 * np.log10(1 + ratio ** (2 * order))
    return Measured.of(frequencies, expected, measured, "frequency (Hz)", "gain (dB)", True)


def other_cutoff(factor: float) -> Disturbance:
    """Return a disturbance of the cutoff of a hair cell, by computing at another sample rate."""

    def change(process: Process) -> Process:
        return lambda signal, rate, values, outputs: process(signal, rate * factor, values, outputs)

    return Disturbance(f"cutoff divided by {factor:g}", change)


@ROWS.listed(other_cutoff(1.001))
def dau_lowpass(process: Process) -> Measured:
    return lowpass_row(process, "dau", 2)


@ROWS.listed(other_cutoff(1.001))
def dau1996_lowpass(process: Process) -> Measured:
    return lowpass_row(process, "dau1996", 1)


# tolerance: rounded in the publication
@ROWS.listed(other_cutoff(1.01))
def breebaart_cutoff(process: Process) -> float:
    frequencies = np.array([740.0, 760, 770, 780, 800])
    gains = hair_cell_gain(process, "breebart", frequencies, 192000.0)
    return abs(float(np.interp(10 * np.log10(2), -gains, frequencies)) - 770.0)


@ROWS.listed(altered("output with the exponent 1.001", "ihc", lambda values: values**1.001))
def bernstein_growth(process: Process) -> Measured:
    levels = np.arange(-60.0, 1, 10)
    parameters = {"fb_cfHz": [4000.0], "ihc_method": "bernstein"}
    outputs = []
    for level in levels:
        output = process(both(tone(4000, 32000, 0.1, 10 ** (level / 20))), 32000, parameters, ["ihc"])["ihc"][0, 0]
        outputs.append(20 * np.log10(np.mean(output[-800:])))
    measured = np.array(outputs) - outputs[-1]
    return Measured.of(levels, 2 * 0.23 * levels, measured, "input (dB)", "output (dB)")


@ROWS.listed(altered("envelope with the exponent 1.01", "ihc", lambda values: values**1.01))
def modulation_depth(process: Process) -> float:
    rate, centre, modulation, depth = 32000.0, 4000.0, 20.0, 0.5
    carrier, slow = tone(centre, rate, 0.5), tone(modulation, rate, 0.5)
    parameters = {"fb_cfHz": [centre], "ihc_method": "hilbert"}
    envelope = process(both((1 + depth * slow) * carrier), rate, parameters, ["ihc"])["ihc"][0, 0]
    decay = 2 * pi * 1.018 * (24.7 + 0.108 * centre) / rate
    side = abs((1 - np.exp(-decay)) / (1 - np.exp(-decay - 2j * pi * modulation / rate))) ** 4
    measured = abs(fundamental(envelope, modulation, rate)) / np.mean(envelope[len(envelope) // 2 :])
    return abs(measured / (depth * side) - 1)


# --- adaptation and efferent reflex ------------------------------------------------------------------------------


LEVELS = np.arange(0.0, 101, 20)  # dB SPL
LEAST = 1e-5  # 0 dB SPL


def model_units(values: np.ndarray) -> np.ndarray:
    """Scale the output of the last of five loops to 0 model units at 0 dB SPL and 100 at 100 dB SPL."""
    return 100 * (values - LEAST ** (1 / 32)) / (1 - LEAST ** (1 / 32))


def adapted(process: Process, seconds: float, limit: float) -> np.ndarray:
    """Return the first and the last sample of the response to constant input of each level, (levels, 2)."""
    parameters = {**THROUGH, "adpt_lim": limit}
    outputs = []
    for level in LEVELS:
        signal = through(np.full(round(16000 * seconds), 10 ** ((level - 100) / 20)))
        output = process(signal, 16000, parameters, ["adaptation"])["adaptation"][0, 0]
        outputs.append([output[0], output[-1]])
    return np.array(outputs)


@ROWS.listed(scaled("adaptation", 1.001))
def adapted_growth(process: Process) -> Measured:
    measured = adapted(process, 8.0, 0.0)[:, 1]
    expected = model_units(10 ** ((LEVELS - 100) / 20 / 32))
    return Measured.of(LEVELS, expected, measured, "level (dB SPL)", "output (MU)")


@ROWS.listed(parameter("adpt_mindB", 1e-6))
def overshoot(process: Process) -> float:
    measured = adapted(process, 0.001, 0.0)[1:, 0]
    expected = model_units(10 ** ((LEVELS - 100) / 20) / LEAST ** (31 / 32))[1:]
    return largest(measured / expected - 1)


def burst_response(process: Process, level: float, limit: float, times: np.ndarray) -> np.ndarray:
    """Return the response (T,) in model units at times (T,) in ms after the onset of 500 ms at a constant level."""
    signal = np.zeros(19200)
    signal[1600:9600] = 10 ** ((level - 100) / 20)
    output = process(through(signal), 16000, {**THROUGH, "adpt_lim": limit}, ["adaptation"])["adaptation"][0, 0]
    return np.asarray(output[1600 + np.round(16 * times).astype(int)])


# tolerance: eight digits are kept
@ROWS.listed(parameter("adpt_lim", 10.0001))
def adapted_burst(process: Process) -> Measured:
    measured = [burst_response(process, level, 10.0, BURST_TIMES) for level in AMT_BURST]
    worst = largest(np.subtract(measured, list(AMT_BURST.values())))
    times = BURST_TIMES[1:]
    return Measured(
        worst, Curve(times, AMT_BURST[60][1:], measured[1][1:], "time after onset (ms)", "output (MU)", True)
    )


@ROWS.listed(parameter("adpt_lim", 10.000001))
def limited_overshoot(process: Process) -> Measured:
    measured = adapted(process, 0.001, 10.0)[:, 0]
    values = 10 ** ((LEVELS - 100) / 20)
    for loop in range(1, 6):
        rest = LEAST ** (2.0**-loop)
        ceiling = (1 - rest**2) * 10 - 1
        values = values / rest
        limited = 1 + ceiling * (2 / (1 + np.exp(-2 * (values - 1) / ceiling)) - 1)
        values = np.where(values > 1, limited, values)
    expected = model_units(values)
    curve = Curve(LEVELS, expected, measured, "level (dB SPL)", "first output (MU)")
    return Measured(largest((measured - expected)[1:] / expected[1:]), curve)


@ROWS.listed(scaled("moc", 1 + 1e-9))
def efferent_attenuation(process: Process) -> Measured:
    levels, measured = [], []
    for level in range(-100, -39, 4):
        signal = through(np.full(2400, 10 ** (level / 20)))
        result = process(signal, 16000, {**THROUGH, "rm_scaling": "power"}, ["ratemap", "moc"])
        levels.append(20 * np.log10(result["ratemap"][0, 0, -1]))
        measured.append(result["moc"][0, 0, -1])
    expected = [_cubic(min(max(level, -180.0), -93.821837)) for level in levels]
    return Measured.of(levels, expected, measured, "20 log10 of the ratemap (dB)", "attenuation (dB)")


def _cubic(level: float) -> float:
    """Evaluate the cubic without rounding."""
    y = Fraction(level)
    factors = [Fraction(text) for text in ("-0.00012411", "-0.051322", "-6.3528", "-206.11")]
    value = sum(factor * y ** (3 - power) for power, factor in enumerate(factors))
    return float(min(max(value, Fraction(0)), Fraction(40)))
