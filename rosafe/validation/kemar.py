"""Comparisons with the manikin KEMAR: interaural differences computed directly from its measured impulse responses."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.signal

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.sofa import HorizontalResponses, read_sofa
from rosafe.validation.comparison import KEMAR, Collection, Curve, Measured, Process, scaled, shifted
from rosafe.validation.stimuli import largest, noise

ROWS = Collection()
AZIMUTHS = np.array([-90, -60, -30, -10, 10, 30, 60, 90])  # degrees, left positive
FFT = 1 << 13  # points of a spectrum
FINER = 8  # lags per sample of a direct delay: 2.8 µs


@lru_cache(maxsize=1)
def head() -> HorizontalResponses:
    """Return the responses in the horizontal plane."""
    return read_sofa(KEMAR)


def response(azimuth: float) -> FloatArray:
    """Return the impulse responses of both ears, (2, N)."""
    return np.asarray(head().responses[int(np.argmin(np.abs(head().azimuths - azimuth)))])


def weights(centre: float, frequencies: FloatArray) -> FloatArray:
    """Return the squared magnitude of a gammatone filter of order 4 and 1.018 ERB."""
    width = 1.018 * (24.7 + 0.108 * centre)
    return (1 + ((frequencies - centre) / width) ** 2) ** -4.0


def direct_ild(azimuth: float, centres: FloatArray) -> FloatArray:
    """Return the level differences (right over left, dB) of the responses behind gammatone filters."""
    spectra = np.abs(np.fft.rfft(response(azimuth), FFT)) ** 2
    frequencies = np.fft.rfftfreq(FFT, 1 / head().sample_rate)
    powers = np.array([spectra @ weights(centre, frequencies) for centre in centres])
    return 10 * np.log10(powers[:, 1] / powers[:, 0])


def direct_itd(azimuth: float, centres: FloatArray) -> FloatArray:
    """Return the time differences (s, positive if the left ear is late): peaks of weighted cross-spectra."""
    left, right = np.fft.rfft(response(azimuth), FFT)
    frequencies = np.fft.rfftfreq(FFT, 1 / head().sample_rate)
    found = []
    for centre in centres:
        correlation = np.fft.irfft(left * right.conj() * weights(centre, frequencies), FINER * FFT)
        reach = round(0.0011 * FINER * head().sample_rate)
        lags = np.arange(-reach, reach + 1)
        found.append(lags[np.argmax(correlation[lags])] / (FINER * head().sample_rate))
    return np.array(found)


def rendered(azimuth: float, seconds: float = 0.5) -> FloatArray:
    """Return white noise from a direction, (2, N)."""
    source = noise(round(seconds * head().sample_rate), 7)
    return scipy.signal.fftconvolve(response(azimuth), source[np.newaxis], axes=-1)[:, : len(source)]


@ROWS.listed(shifted("ild", 0.3, "dB"))
def head_ild(process: Process) -> Measured:
    rows = []
    for azimuth in AZIMUTHS:
        parameters = {"ild_wSizeSec": 0.4, "ild_wname": "hann", "ihc_method": "none"}
        result = process(rendered(float(azimuth)), head().sample_rate, parameters, ["ild"])
        centres = result["fb_cfHz"]
        rows.append((direct_ild(float(azimuth), centres), result["ild"][:, -1]))
    expected, measured = (np.array(column) for column in zip(*rows, strict=True))
    error = float(np.sqrt(np.mean((measured - expected) ** 2)))
    return Measured(error, Curve(centres, expected[-1], measured[-1], "centre frequency (Hz)", "ILD at 90° (dB)", True))


@ROWS.listed(shifted("itd", 15e-6, "s"))
def head_itd(process: Process) -> Measured:
    rows = []
    for azimuth in AZIMUTHS:
        parameters = {"cc_wSizeSec": 0.25, "ihc_method": "none", "fb_lowFreqHz": 200.0, "fb_highFreqHz": 1200.0}
        result = process(rendered(float(azimuth)), head().sample_rate, parameters, ["itd"])
        rows.append((direct_itd(float(azimuth), result["fb_cfHz"]), np.median(result["itd"], axis=-1)))
    expected, measured = (1e6 * np.array(column) for column in zip(*rows, strict=True))
    curve = Curve(AZIMUTHS, expected.mean(-1), measured.mean(-1), "azimuth (degrees)", "mean ITD (µs)")
    return Measured(largest(measured - expected), curve)


SPHERE_DELAY = 0.0875 / 343.0  # s; radius over speed of sound


def _sphere(process: Process, channels: tuple[float, float], formula: FloatArray) -> Measured:
    """Compare the mean ITD of KEMAR with a formula for a sphere, relative to its value at 90 degrees."""
    measured = []
    for azimuth in AZIMUTHS:
        parameters = {"fb_lowFreqHz": channels[0], "fb_highFreqHz": channels[1], "cc_maxDelaySec": 0.0013}
        result = process(rendered(float(azimuth)), head().sample_rate, parameters, ["itd"])
        measured.append(float(np.median(result["itd"])))
    expected = -1e6 * SPHERE_DELAY * formula  # a source on the left leads at the left ear
    found = 1e6 * np.array(measured)
    curve = Curve(AZIMUTHS, expected, found, "azimuth (degrees)", "ITD (µs)")
    return Measured(largest(found - expected) / largest(expected), curve)


# tolerance: a head is not a sphere
@ROWS.listed(scaled("itd", 0.75))
def low_frequencies(process: Process) -> Measured:
    return _sphere(process, (200.0, 500.0), 3 * np.sin(np.radians(AZIMUTHS)))


@ROWS.listed(scaled("itd", 0.75))
def high_frequencies(process: Process) -> Measured:
    angles = np.radians(AZIMUTHS)
    return _sphere(process, (3000.0, 6000.0), angles + np.sin(angles))
