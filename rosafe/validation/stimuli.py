"""Test sounds of the validation, and tools to evaluate responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.signal

from rosafe.dsp.numeric_limits import FloatArray

# Parameters with which hair cells output twice the signal: a filter without memory (exp(-30) at 16 kHz)
THROUGH = {"fb_cfHz": [7000.0], "fb_nGamma": 1, "fb_bwERBs": 100.0, "ihc_method": "none"}

TALKERS = ("/usr/share/sounds/alsa/Front_Center.wav", "/usr/share/sounds/alsa/Rear_Right.wav")  # recorded words


def talker(number: int) -> FloatArray:
    """Return 1.2 s of a recorded voice (N,) at 16 kHz, with a standard deviation of 0.02."""
    import soundfile

    sound, rate = soundfile.read(TALKERS[number])
    sound = scipy.signal.resample_poly(sound, 16000, rate)[:19200]
    return np.asarray(0.02 * sound / np.std(sound))


def both(signal: Any) -> FloatArray:
    """Return the same signal at both ears, (2, N)."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(signal, float), (2, len(signal))))


def through(signal: Any) -> FloatArray:
    """Return the signal at both ears, so that hair cells with the parameters `THROUGH` output it at 16 kHz."""
    return both(signal) / 2


def tone(frequency: float, rate: float, seconds: float, amplitude: float = 1.0) -> FloatArray:
    """Return a cosine (N,)."""
    return amplitude * np.cos(2 * np.pi * frequency * np.arange(round(seconds * rate)) / rate)


def noise(count: int, seed: int = 1) -> FloatArray:
    """Return white Gaussian noise (N,) with a standard deviation of 0.1."""
    return 0.1 * np.random.default_rng(seed).standard_normal(count)


def complex_tone(f0: float, harmonics: Any, rate: float, seconds: float) -> FloatArray:
    """Return the sum of harmonics (N,) in cosine phase."""
    return np.sum([tone(f0 * number, rate, seconds, 0.1) for number in harmonics], axis=0)


def impulse(count: int) -> FloatArray:
    """Return a unit impulse (N,)."""
    return np.eye(1, count)[0]


def gain_db(response: FloatArray, frequencies: Any, rate: float) -> FloatArray:
    """Return the level of an impulse response (N,) at some frequencies, in dB."""
    _, transfer = scipy.signal.freqz(response, worN=2 * np.pi * np.asarray(frequencies, float) / rate)
    return 20 * np.log10(np.abs(transfer))


def fundamental(samples: FloatArray, frequency: float, rate: float) -> complex:
    """Return the complex amplitude of a tone in the second half of the samples (N,)."""
    count = len(samples) // 2
    period = rate / frequency
    count = round(round(count / period) * period)  # whole periods
    phases = np.exp(-2j * np.pi * frequency * np.arange(len(samples) - count, len(samples)) / rate)
    return complex(2 * np.mean(samples[-count:] * phases))


def delayed(signal: FloatArray, seconds: float, rate: float) -> FloatArray:
    """Delay a periodic signal (N,) by any time."""
    bins = np.fft.rfftfreq(len(signal), 1 / rate)
    return np.fft.irfft(np.fft.rfft(signal) * np.exp(-2j * np.pi * bins * seconds), len(signal))


def largest(difference: Any) -> float:
    """Return the largest magnitude."""
    return float(np.max(np.abs(difference)))
