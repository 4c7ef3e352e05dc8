"""Learn a direction model: from a head, with synthetic sounds in diffuse noise and in rooms, or from recordings.

Multi-condition training follows T. May, S. van de Par and A. Kohlrausch (2011) and N. Ma, T. May and G. J. Brown
(2017), "Exploiting deep neural networks and head movements for robust binaural localization of multiple sources in
reverberant environments", IEEE/ACM Trans. Audio Speech Lang. Process. 25, 2444-2453.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
import scipy.signal

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles, cues
from rosafe.localization.direction_model import DirectionModel, Histograms
from rosafe.localization.head import Head
from rosafe.localization.hum import hum_sounds
from rosafe.localization.rooms import reverberation, surround
from rosafe.processing.process import process

SNR_DB = (30.0, 20.0, 12.0, 6.0, 2.0, -2.0, -6.0)  # of sounds without a room
ROOM_SNR_DB = (40.0, 30.0, 30.0, 20.0, 20.0, 12.0, 6.0)  # of sounds in rooms
ROOMS = 48
RT60 = 0.15, 1.0  # s, of the rooms
DRR_DB = -8.0, 10.0  # direct-to-reverberant ratio of the rooms
# Noise without modulation, whose level is near its floor although nothing disturbs it: a small part of the sounds, as
# most sounds near their floor are disturbed.
STEADY_SNR_DB = 40.0
STEADY_PART, MIN_STEADY_SECONDS = 0.1, 0.1  # of the length of another sound; at least
SOUND_SECONDS = 1600.0  # of all directions and SNRs together
LATE_PART = 0.06  # of this length: reverberation without its direct sound
MIN_LATE_SECONDS = 0.5  # in each room
NOISE_SECONDS = 12.0
NOISE_SOURCES = 36
_SKIP_SECONDS = 0.05  # at the beginning of a sound, until the filters have settled
_MODULATION_RATE = 100.0  # Hz, of the sampled envelopes
_LEVEL = 0.05  # RMS of the training sounds
Progress = Callable[[float], None]


class Sound(NamedTuple):
    """Both ears (2, n), azimuth (degrees; None: reverberation without direct sound), and whether it is in a room."""

    ears: FloatArray
    azimuth: float | None
    reverberant: bool


def learn_head(
    head: Head, sample_rate: float, parameters: Mapping[str, Any] | None = None, progress: Progress | None = None
) -> DirectionModel:
    """Learn the model of a head.

    Parameters
    ----------
    head : Head
        The head.
    sample_rate : float
        Of the sounds to localize, Hz.
    parameters : mapping, optional
        Of the representations, as of `rosafe.process`.
    progress : callable, optional
        Called with the part that is done, from 0 to 1.
    """
    head.check_delay(cues.describe(sample_rate, parameters)["parameters"]["cc_maxDelaySec"])
    filters = head.filters(sample_rate)
    directions = angles.grid()
    symmetric = head.is_symmetric()
    if symmetric:
        directions = directions[directions >= 0]
    if head.front_back_equal:
        directions = directions[directions <= 90]
    random = np.random.default_rng(1)
    noises = _noise_pool(lambda azimuth: filters.response(azimuth), sample_rate, random)
    rooms = room_pool(surround(head, sample_rate), sample_rate, random)
    seconds = SOUND_SECONDS / (len(directions) * len(SNR_DB + ROOM_SNR_DB))
    length = scipy.fft.next_fast_len(round((seconds + _SKIP_SECONDS) * sample_rate), real=True)
    steady_length = max(round(STEADY_PART * length), round(MIN_STEADY_SECONDS * sample_rate))

    def sounds() -> Iterator[Sound]:
        for number, azimuth in enumerate(directions):
            direct = filters.response(float(azimuth))
            for index, snr in enumerate((*SNR_DB, *ROOM_SNR_DB, STEADY_SNR_DB)):
                steady = index == len(SNR_DB + ROOM_SNR_DB)
                dry = (
                    random.standard_normal(length)
                    if steady
                    else _training_sound(number + index, length, sample_rate, random)
                )
                sound = scipy.signal.oaconvolve(dry[np.newaxis], direct, axes=-1)[:, :length]
                reverberant = not steady and index >= len(SNR_DB)
                if reverberant:
                    sound = in_room(sound, dry, rooms[random.integers(ROOMS)])
                noise = noises[(number + index) % 2]
                count = min(length, steady_length) if steady else length
                begin = random.integers(noise.shape[1] - count)
                noisy = sound[:, :count] + noise[:, begin : begin + count] * 10 ** (-snr / 20)
                yield Sound(noisy, float(azimuth), reverberant)
            if progress:
                progress((number + 1) / (len(directions) + 2))
        late_length = round(max(MIN_LATE_SECONDS, LATE_PART * SOUND_SECONDS / ROOMS) * sample_rate)
        for number, room in enumerate(rooms):
            yield Sound(late_sound(_training_sound(number, late_length, sample_rate, random), room), None, True)

    grid = angles.grid()
    histograms, description = count(sounds(), sample_rate, parameters, grid, head.key, cues.max_itd(head.spacing))
    if head.front_back_equal:
        behind = np.abs(grid) > 90
        source = _indices(grid, np.where(grid >= 0, 180 - grid, -180 - grid))
        for counts in (histograms.itd, histograms.ild):
            counts[:, behind] = counts[:, source[behind]]
    if symmetric:
        histograms.mirror(_indices(grid, -grid))
        poles = _indices(grid, np.array([0.0, 180.0]))
        for counts in (histograms.itd, histograms.ild):
            counts[:, poles] = counts[:, poles].sum(axis=1, keepdims=True)
    return DirectionModel(
        {**description, "is_sphere": head.front_back_equal}, *histograms.tables(description["parameters"]["fb_cfHz"])
    )


def count(
    sounds: Iterable[Sound],
    sample_rate: float,
    parameters: Mapping[str, Any] | None,
    azimuths: FloatArray,
    key: str,
    max_itd: float = cues.MAX_ITD,
) -> tuple[Histograms, dict[str, Any]]:
    """Count the cues of sounds with a power of 1 before the head, from one of `azimuths` each.

    Returns the histograms and the description of the model.
    """
    described = cues.describe(sample_rate, parameters)
    values = cues.model_parameters(described)
    histograms = Histograms(len(described["fb_cfHz"]), len(azimuths))
    skip = int(np.ceil(_SKIP_SECONDS * described["itd_frameRate"]))
    powers = np.zeros(2)  # of the sounds, and of their ratemaps
    for sound, azimuth, reverberant in _ahead(sounds):
        scaled = sound * _LEVEL
        features = process(scaled, sample_rate, parameters=values, outputs=list(cues.KINDS))
        quantized = cues.quantize(features, cues.scaling_db(values), max_itd)
        late = azimuth is None
        direction = None if late else int(np.abs(angles.difference(azimuths, azimuth)).argmin())
        histograms.add(direction, quantized.select(slice(skip, None)), reverberant)
        if late:
            continue
        powers += np.mean(scaled**2), features["ratemap"].sum(axis=(0, 1)).mean()
    for hum in hum_sounds(sample_rate):
        features = process(hum * _LEVEL, sample_rate, parameters=values, outputs=list(cues.KINDS))
        histograms.add_hum(cues.quantize(features, cues.scaling_db(values), max_itd).select(slice(skip, None)))
    return histograms, {
        "sample_rate": sample_rate,
        "parameters": values,
        "head": key,
        "max_itd": max_itd,
        "level_gain_db": float(10 * np.log10(powers[0] / powers[1])),
    }


def _ahead(sounds: Iterable[Sound]) -> Iterator[Sound]:
    """Yield sounds, of which another thread computes the next one in the meantime."""
    source = iter(sounds)
    with ThreadPoolExecutor(1) as worker:
        following = worker.submit(next, source, None)
        while (sound := following.result()) is not None:
            following = worker.submit(next, source, None)
            yield sound


def _indices(grid: FloatArray, azimuths: FloatArray) -> np.ndarray:
    return np.abs(angles.difference(grid, azimuths[:, np.newaxis])).argmin(axis=1)


# --- sounds ---


def room_pool(responses: FloatArray, sample_rate: float, random: np.random.Generator) -> list[tuple[FloatArray, float]]:
    """Return the reverberation (2, n) of rooms and its energy relative to the direct sound.

    `responses` (D, 2, N) are those of directions around the head.
    """
    pool = []
    for _ in range(ROOMS):
        rt60, drr_db = float(np.exp(random.uniform(*np.log(RT60)))), random.uniform(*DRR_DB)
        pool.append((reverberation(responses, sample_rate, rt60, drr_db, random), 10 ** (-drr_db / 10)))
    return pool


def in_room(direct: FloatArray, dry: FloatArray, room: tuple[FloatArray, float]) -> FloatArray:
    """Return the direct sound (2, n) of both ears with the reverberation that a `dry` sound (n,) has in a room."""
    return np.asarray(direct + late_sound(dry, room) * np.sqrt(room[1] * np.mean(direct**2)))


def late_sound(dry: FloatArray, room: tuple[FloatArray, float]) -> FloatArray:
    """Return the reverberation (2, n) of a `dry` sound (n,) in a room without the direct sound, with an RMS of 1."""
    late = scipy.signal.oaconvolve(dry[np.newaxis], room[0], axes=-1)[:, : len(dry)]
    return np.asarray(late / max(float(np.sqrt(np.mean(late**2))), 1e-150))


def _noise_pool(
    response: Callable[[float], FloatArray], sample_rate: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return diffuse noise (2, n) with a power of 1 before the head: white, and with a spectrum like speech."""
    azimuths = np.arange(NOISE_SOURCES) * 360 / NOISE_SOURCES
    first = response(0.0)
    count = round(NOISE_SECONDS * sample_rate)
    size = scipy.fft.next_fast_len(count + first.shape[1], real=True)
    spectrum = np.zeros((2, size // 2 + 1), complex)
    for azimuth in azimuths:
        source = np.fft.rfft(random.standard_normal(count) / np.sqrt(NOISE_SOURCES), size)
        spectrum += source * np.fft.rfft(response(float(angles.wrap(azimuth))), size)
    shape = _speech_shape(np.fft.rfftfreq(size, 1 / sample_rate))
    return np.fft.irfft(spectrum, size)[:, :count], np.fft.irfft(spectrum * shape, size)[:, :count]


def _speech_shape(frequencies: FloatArray) -> FloatArray:
    """Return gains of a long-term spectrum like that of speech: flat to 500 Hz, then 6 dB/octave; mean power 1."""
    gain = 1 / np.sqrt(1 + (frequencies / 500.0) ** 2)
    return np.asarray(gain / np.sqrt(np.mean(gain**2)))


def _training_sound(number: int, count: int, sample_rate: float, random: np.random.Generator) -> FloatArray:
    """Return a sound with an RMS of 1: noise with a random envelope, or voiced and unvoiced sounds in turn."""
    if number % 2:
        sound = random.standard_normal(count) * _envelope(count, sample_rate, 8.0, 9.0, random)
    else:
        frequencies = np.fft.rfftfreq(count, 1 / sample_rate)
        voiced = _shaped(_pulses(count, sample_rate, random), (1 + (frequencies / 800.0) ** 2) ** -0.4)
        unvoiced = _shaped(random.standard_normal(count), (1 + (frequencies / 500.0) ** 2) ** -0.25)
        sound = voiced * _envelope(count, sample_rate, 4.0, 12.0, random)
        sound += 0.6 * unvoiced * _envelope(count, sample_rate, 4.0, 12.0, random)
    return np.asarray(sound / np.sqrt(np.mean(sound**2)))


def _shaped(sound: FloatArray, gains: FloatArray) -> FloatArray:
    shaped = np.fft.irfft(np.fft.rfft(sound) * gains, len(sound))
    return np.asarray(shaped / np.std(shaped))


def _pulses(count: int, sample_rate: float, random: np.random.Generator) -> FloatArray:
    """Return pulses with a gliding rate between 70 and 300 Hz."""
    times = np.arange(count) / sample_rate
    glide = 0.3 * np.sin(2 * np.pi * random.uniform(0.3, 1.0) * times + random.uniform(0, 2 * np.pi))
    phase = np.cumsum(random.uniform(90, 240) * 2**glide) / sample_rate
    return np.diff(np.floor(phase), prepend=0.0)


def _envelope(
    count: int, sample_rate: float, cutoff: float, deviation: float, random: np.random.Generator
) -> FloatArray:
    """Return a random envelope: levels low-pass filtered at `cutoff` Hz with a standard deviation in dB."""
    points = int(count / sample_rate * _MODULATION_RATE) + 2
    levels = scipy.signal.lfilter(*scipy.signal.butter(2, cutoff, fs=_MODULATION_RATE), random.standard_normal(points))
    levels *= deviation / max(float(np.std(levels)), 1e-9)
    times = np.arange(count) * (_MODULATION_RATE / sample_rate)
    return 10 ** (np.interp(times, np.arange(points), levels) / 20)
