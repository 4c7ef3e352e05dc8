"""Signals of the sources of a scene, with an RMS of 1: sound files, noise, tone and vowel."""

from __future__ import annotations

import contextlib
import math
import os
from fractions import Fraction
from typing import Protocol

import numpy as np
import scipy.signal

from rosafe.audio.files.audiofile import AudioFile, AudioFileError
from rosafe.dsp.numeric_limits import FloatArray

ENDLESS = 2**62  # frames
MAX_FILE_FRAMES = 2**25  # of one sound file
MAX_RATIO = 2**18  # terms of the ratio of two sample rates; the filter has 20 times as many coefficients
_BLOCK = 2**12  # frames of up to 1024 channels
_RAMP_SECONDS = 0.005  # at the beginning of a noise, tone or vowel
_FORMANTS = ((730.0, 90.0), (1090.0, 110.0), (2440.0, 170.0))  # Hz, of /a/: frequency and bandwidth


class SourceSignal(Protocol):
    """A signal, addressed by frame."""

    frames: int  # its length

    def samples(self, begin: int, count: int) -> FloatArray:
        """Return the frames from `begin` on; zeros behind the end."""


class FileSignal:
    """The mean of the channels of a sound file, resampled to the rate of the scene and scaled to an RMS of 1."""

    def __init__(self, path: str | os.PathLike[str], sample_rate: int, loop: bool) -> None:
        with contextlib.closing(AudioFile(os.fspath(path), clip=False)) as file:
            ratio = Fraction(sample_rate, file.sample_rate)
            if max(ratio.numerator, ratio.denominator) > MAX_RATIO:
                raise AudioFileError(
                    f"{path}: expected a sample rate whose ratio to {sample_rate} Hz has terms of at most {MAX_RATIO}, "
                    f"got {file.sample_rate} Hz; convert it: `ffmpeg -i IN -ar {sample_rate} OUT.wav`"
                )
            if file.frames * max(1.0, float(ratio)) > MAX_FILE_FRAMES:
                raise AudioFileError(
                    f"{path}: expected at most {MAX_FILE_FRAMES} frames (as stored and at {sample_rate} Hz), "
                    f"got {file.frames} at {file.sample_rate} Hz"
                )
            samples = _mean(file)
        if ratio != 1:
            samples = scipy.signal.resample_poly(samples, ratio.numerator, ratio.denominator)
        with np.errstate(over="ignore"):
            power = math.sqrt(float(np.dot(samples, samples)) / len(samples))
        if not power > 0:
            raise AudioFileError(f"{path}: expected a sound, got silence")
        if not power < math.inf:
            raise AudioFileError(f"{path}: expected samples of at most 1e150, got larger ones")
        samples /= power
        self._samples = samples.astype(np.float32)
        self.stored = len(samples)
        self.frames = ENDLESS if loop else len(samples)

    def samples(self, begin: int, count: int) -> FloatArray:
        """See `SourceSignal`; a loop repeats without a gap."""
        length = len(self._samples)
        if self.frames == ENDLESS:
            return self._samples[(begin + np.arange(count)) % length].astype(np.float64)
        part = np.zeros(count)
        available = self._samples[begin : begin + count]
        part[: len(available)] = available
        return part


def _mean(file: AudioFile) -> FloatArray:
    """Return the mean of the channels. AudioFileError if something is missing."""
    mean = np.empty(file.frames)
    for begin in range(0, file.frames, _BLOCK):
        block = file.read(min(_BLOCK, file.frames - begin))
        if begin + block.shape[1] < min(begin + _BLOCK, file.frames):
            raise AudioFileError(f"{file.path}: expected {file.frames} frames, got fewer; the file is truncated")
        np.mean(block, axis=0, out=mean[begin : begin + block.shape[1]])
    if file.not_finite:
        raise AudioFileError(f"{file.path}: expected finite samples, got {file.not_finite} others")
    if file.remark:
        raise AudioFileError(file.remark)
    return mean


class NoiseSignal:
    """White noise."""

    frames = ENDLESS

    def __init__(self, sample_rate: int, seed: int, number: int) -> None:
        self._ramp = _RAMP_SECONDS * sample_rate
        self._seed = seed, 2 + number

    def samples(self, begin: int, count: int) -> FloatArray:
        """See `SourceSignal`."""
        random = np.random.PCG64(list(self._seed))
        random.advance(begin)
        return np.sqrt(3.0) * uniform(random, count) * _ramp(begin, count, self._ramp)


class ToneSignal:
    """A pure tone."""

    frames = ENDLESS

    def __init__(self, sample_rate: int, frequency: float) -> None:
        self._ramp = _RAMP_SECONDS * sample_rate
        self._step = frequency / sample_rate

    def samples(self, begin: int, count: int) -> FloatArray:
        """See `SourceSignal`."""
        phase = np.mod((begin + np.arange(count)) * self._step, 1.0)
        return np.sqrt(2.0) * np.sin(2 * np.pi * phase) * _ramp(begin, count, self._ramp)


class VowelSignal:
    """The vowel /a/: harmonics of the fundamental frequency, 6 dB per octave down, with three formants."""

    frames = ENDLESS

    def __init__(self, sample_rate: int, frequency: float) -> None:
        self._ramp = _RAMP_SECONDS * sample_rate
        self._step = frequency / sample_rate
        harmonics = np.arange(1, max(2, int(min(8000.0, 0.45 * sample_rate) / frequency) + 1))
        tone = harmonics * frequency
        resonances = [1 / np.abs(1 - (tone / f) ** 2 + 1j * tone * width / f**2) for f, width in _FORMANTS]
        gains = np.sum(resonances, axis=0) / harmonics
        self._harmonics = harmonics
        self._gains = np.sqrt(2.0) * gains / np.sqrt(np.sum(gains**2))

    def samples(self, begin: int, count: int) -> FloatArray:
        """See `SourceSignal`."""
        phase = 2 * np.pi * np.mod((begin + np.arange(count)) * self._step, 1.0)
        total = np.zeros(count)
        for harmonic, gain in zip(self._harmonics, self._gains, strict=True):
            total += gain * np.sin(harmonic * phase)
        return total * _ramp(begin, count, self._ramp)


def _ramp(begin: int, count: int, length: float) -> FloatArray:
    """Return the gains of a linear fade-in of `length` frames."""
    if begin >= length:
        return np.ones(count)
    return np.minimum(1.0, (begin + np.arange(count)) / length)


def uniform(random: np.random.PCG64, count: int) -> FloatArray:
    """Return `count` uniform random numbers from -1 to 1, the same in every version of numpy."""
    return np.asarray((random.random_raw(count) >> np.uint64(11)) * 2.0**-52 - 1.0)
