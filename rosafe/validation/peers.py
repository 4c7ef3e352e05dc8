"""Comparisons with other toolboxes: gammatone, pyfar, librosa, python-auditory-toolbox. They are skipped if missing."""

from __future__ import annotations

import importlib
from collections.abc import Iterable

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.interface.remarks import PRESETS
from rosafe.validation.comparison import Collection, Curve, Measured, Process, parameter, scaled
from rosafe.validation.stimuli import both, complex_tone, largest, noise

ROWS = Collection()
RATE = 44100
SECONDS = 0.25


def decorrelation(ours: FloatArray, theirs: FloatArray) -> float:
    """Return the largest 1 - r of the channels (C, N)."""
    return max(1 - float(np.corrcoef(*pair)[0, 1]) for pair in zip(ours, theirs, strict=True))


def channels(process: Process, signal: FloatArray, centres: Iterable[float], bandwidth: float) -> FloatArray:
    """Return the output (C, N) of the filters at these centre frequencies (Hz), with a bandwidth in ERB."""
    parameters = {"fb_cfHz": [float(one) for one in centres], "fb_bwERBs": bandwidth}
    output: FloatArray = process(both(signal), RATE, parameters, ["gammatone"])["gammatone"]
    return output[0]


# tolerance: filters with four zeros
@ROWS.listed(parameter("fb_bwERBs", 1.025))
def slaney_filters(process: Process) -> float:
    filters = importlib.import_module("gammatone.filters")
    centres, signal = np.geomspace(100, 8000, 12), noise(round(SECONDS * RATE))
    theirs = filters.erb_filterbank(signal, filters.make_erb_filters(RATE, centres))
    return decorrelation(channels(process, signal, centres, 1.019), theirs)


@ROWS.listed(parameter("fb_bwERBs", 1.023))
def hohmann_filters(process: Process) -> float:
    pyfar = importlib.import_module("pyfar")
    signal = noise(round(SECONDS * RATE))
    bank = pyfar.dsp.filter.GammatoneBands([100, 8000], sampling_rate=RATE)
    real, _ = bank.process(pyfar.Signal(signal, RATE))
    ours = channels(process, signal, bank.frequencies, 1.0186)
    return decorrelation(ours, real.time.reshape(ours.shape))


@ROWS.listed(scaled("pitch", 1.03))
def pyin(process: Process) -> Measured:
    librosa = importlib.import_module("librosa")
    rate, times = 16000, np.arange(12000) / 16000
    phase = 2 * np.pi * np.cumsum(110 * 2 ** (times / 0.75)) / rate
    signal = 0.1 * np.sum([np.cos(number * phase) for number in range(1, 15)], axis=0)
    theirs, _, _ = librosa.pyin(signal, fmin=70, fmax=400, sr=rate, frame_length=1024, hop_length=160)
    result = process(both(signal), rate, PRESETS["speech"], ["pitch"])
    there = np.interp(result["pitch_time"], librosa.times_like(theirs, sr=rate, hop_length=160), theirs)
    cents = 1200 * np.log2(np.nan_to_num(result["pitch"][0, 0], nan=1.0) / there)
    inner = slice(5, -5)
    curve = Curve(result["pitch_time"][inner], there[inner], result["pitch"][0, 0][inner], "time (s)", "pitch (Hz)")
    return Measured(float(np.mean(np.abs(cents[inner]) > 50)), curve)


@ROWS.listed(scaled("spectralFeatures", 1.00001))
def librosa_features(process: Process) -> float:
    librosa = importlib.import_module("librosa")
    words = ["centroid", "spread"]
    result = process(both(noise(8000)), 16000, {"sf_requests": words}, ["ratemap", "spectralFeatures"])
    rates, frequencies = result["ratemap"][0], result["fb_cfHz"]
    shape = np.broadcast_to(frequencies[:, np.newaxis], rates.shape)
    centroid = librosa.feature.spectral_centroid(S=rates, freq=shape)[0]
    spread = librosa.feature.spectral_bandwidth(S=rates, freq=shape)[0]
    expected = np.stack((centroid, spread)) / frequencies.max()
    return largest((result["spectralFeatures"][0] / expected - 1)[:, 3:])


# tolerance: the window of the toolbox is periodic
@ROWS.listed(parameter("ac_K", 2.02))
def correlogram(process: Process) -> Measured:
    auditory_toolbox = importlib.import_module("python_auditory_toolbox.auditory_toolbox")
    signal = both(complex_tone(160, range(1, 20), 16000, 0.2))
    parameters = {"fb_nChannels": 8, "ac_clipAlpha": 0.0, "ac_wname": "hamming", "ac_wSizeSec": 0.032}
    result = process(signal, 16000, parameters, ["ihc", "autocorrelation"])
    frame, size = 8, 512
    theirs = auditory_toolbox.CorrelogramFrame(result["ihc"][0], 200, 160 * frame, size)
    ours = result["autocorrelation"][0, :, :200, frame] * (size - np.arange(200)) / size
    expected = theirs / theirs[:, :1]  # each row is divided by the root of its first value
    curve = Curve(1e3 * np.arange(200) / 16000, expected[0], np.maximum(ours[0], 0), "lag (ms)", "autocorrelation")
    return Measured(largest(np.maximum(ours, 0) - expected), curve)


@ROWS.listed(parameter("fb_bwERBs", 1.025))
def toolbox_filters(process: Process) -> float:
    auditory_toolbox = importlib.import_module("python_auditory_toolbox.auditory_toolbox")
    signal = noise(round(SECONDS * RATE))
    theirs = auditory_toolbox.ErbFilterBank(signal, auditory_toolbox.MakeErbFilters(RATE, 10, 100))
    return decorrelation(channels(process, signal, auditory_toolbox.ErbSpace(100, RATE / 2, 10), 1.019), theirs)
