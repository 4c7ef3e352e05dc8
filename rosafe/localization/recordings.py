"""Learn a direction model from recordings of sources at known directions."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import scipy.signal

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles, training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head import checked_rate
from rosafe.localization.horizontal_plane import MAX_GAP
from rosafe.localization.results import read_recordings
from rosafe.localization.rooms import DIRECTIONS
from rosafe.localization.training import Progress
from rosafe.processing.sounds import open_sound
from rosafe.system.terminal import printable
from rosafe.tree.sizes import refuse_over_available

MAX_SECONDS = 60.0  # of sound that is used for a direction
MAX_FRAMES = 2**22  # of a direction
MIN_SECONDS = 1.0
_REACH = 0.003  # s, of a response before and after its middle
_LATE_SECONDS = 96.0  # of reverberation
_MIXED = 24  # pieces of recordings from other directions that make a diffuse noise


def learn_recordings(
    path: str | os.PathLike[str],
    sample_rate: float | None = None,
    parameters: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> DirectionModel:
    """Learn a model from the recordings that a CSV file lists in the columns `file` and `azimuth_deg`.

    The sounds of all directions together, mixed at random, are the diffuse noise of training. Half of the sounds get
    the reverberation of a room, as those of `learn_head`: recordings need no room themselves. The evidence for
    directions of the grid between two recorded ones is interpolated.

    Parameters
    ----------
    path : str or Path
        The list.
    sample_rate : float, optional
        Sample rate of all recordings; by default that of the first one.
    parameters : mapping, optional
        Of the representations, as of `rosafe.process`.
    progress : callable, optional
        Called with the part that is done, from 0 to 1.

    Raises
    ------
    ValueError, AudioFileError
        The list or a recording cannot be used: one line.
    """
    sounds: dict[float, list[FloatArray]] = {}
    size = 0
    for file, azimuth in read_recordings(path):
        with contextlib.closing(open_sound(file)) as reader:
            sample_rate = checked_rate(sample_rate or reader.sample_rate)
            if reader.sample_rate != sample_rate:
                raise ValueError(
                    f"{printable(file)}: expected a sample rate of {sample_rate:g} Hz, got {reader.sample_rate}"
                )
            parts = sounds.setdefault(round(float(angles.wrap(azimuth)), 3), [])
            left = min(round(MAX_SECONDS * sample_rate), MAX_FRAMES) - sum(part.shape[1] for part in parts)
            frames = max(0, min(reader.frames, left))
            size += 2 * 16 * frames  # of two arrays of floats
            refuse_over_available(size, printable(os.fspath(path)), "list shorter recordings")
            parts.append(reader.read(frames) / 2.0**31)
            if reader.not_finite:
                raise ValueError(f"{printable(file)}: expected finite samples, got {reader.not_finite} others")
            if reader.remark:
                warnings.warn(reader.remark, UserWarning, stacklevel=2)
    assert sample_rate is not None
    recorded = {azimuth: _normalized(np.concatenate(parts, axis=1)) for azimuth, parts in sorted(sounds.items())}
    _check(recorded, sample_rate, printable(os.fspath(path)))
    azimuths = np.array(list(recorded))
    histograms, description = training.count(
        _sounds(recorded, sample_rate, progress), sample_rate, parameters, azimuths, f"recordings {os.fspath(path)}"
    )
    tables = histograms.tables(description["parameters"]["fb_cfHz"])
    return DirectionModel({**description, "is_sphere": False}, *(_interpolated(table, azimuths) for table in tables))


def _normalized(sound: FloatArray) -> FloatArray:
    return sound / max(float(np.sqrt(np.mean(sound**2))), 1e-12)


def _check(recorded: Mapping[float, FloatArray], sample_rate: float, name: str) -> None:
    azimuths = np.array(list(recorded))
    gap = float(np.max(np.diff(azimuths, append=azimuths[0] + 360.0)))
    if gap > MAX_GAP + 1e-6:
        raise ValueError(
            f"{name}: expected directions all around the head, at most {MAX_GAP:g} degrees apart, got {gap:g}"
        )
    for azimuth, sound in recorded.items():
        if sound.shape[1] < MIN_SECONDS * sample_rate or not np.std(sound) > 0.5:
            raise ValueError(f"{name}: expected at least {MIN_SECONDS:g} s of sound from {azimuth:g} degrees")


def _sounds(
    recorded: Mapping[float, FloatArray], sample_rate: float, progress: Progress | None
) -> Iterator[training.Sound]:
    """Return each recording at each signal-to-noise ratio, without a room and in one: a half of it each.

    Then follows the reverberation of each room.
    """
    random = np.random.default_rng(1)
    everything = list(recorded.values())
    rooms = training.room_pool(_responses(recorded, sample_rate), sample_rate, random)
    for number, (azimuth, whole) in enumerate(recorded.items()):
        for index, snr in enumerate(training.SNR_DB + training.ROOM_SNR_DB):
            half = whole.shape[1] // 2
            sound = whole[:, :half] if index % 2 else whole[:, half:]
            count = sound.shape[1]
            reverberant = index >= len(training.SNR_DB)
            if reverberant:
                sound = training.in_room(sound, _louder(sound), rooms[random.integers(len(rooms))])
            noise = np.zeros((2, count))
            for _ in range(_MIXED):
                other = everything[random.integers(len(everything))]
                noise += np.resize(np.roll(other, -int(random.integers(other.shape[1])), axis=1).T, (count, 2)).T
            yield training.Sound(sound + _normalized(noise) * 10 ** (-snr / 20), azimuth, reverberant)
        if progress:
            progress((number + 1) / (len(recorded) + 2))
    count = round(max(training.MIN_LATE_SECONDS, _LATE_SECONDS / len(rooms)) * sample_rate)
    for number, room in enumerate(rooms):
        sound = everything[number % len(everything)]
        yield training.Sound(training.late_sound(np.resize(_louder(sound), count), room), None, True)


def _louder(sound: FloatArray) -> FloatArray:
    """Return the ear with more energy."""
    return np.asarray(sound[np.sum(sound**2, axis=1).argmax()])


def _responses(recorded: Mapping[float, FloatArray], sample_rate: float) -> FloatArray:
    """Return responses (D, 2, N) of directions around the head, relative to the louder ear.

    The response of the other ear is the Wiener filter that estimates it from the louder one.
    """
    length = 2 * round(_REACH * sample_rate)
    azimuths = np.array(list(recorded))
    found = np.zeros((DIRECTIONS, 2, length))
    for number, azimuth in enumerate(np.arange(DIRECTIONS) * 360 / DIRECTIONS):
        sound = recorded[float(azimuths[np.abs(angles.difference(azimuths, azimuth)).argmin()])]
        near = int(np.sum(sound**2, axis=1).argmax())
        size = {"fs": sample_rate, "nperseg": 4 * length}
        cross = scipy.signal.csd(sound[near], sound[1 - near], **size)[1]
        power = scipy.signal.welch(sound[near], **size)[1]
        other = np.fft.irfft(cross / (power + 1e-3 * power.max()))
        found[number, near, length // 2] = 1.0
        found[number, 1 - near] = np.roll(other, length // 2)[:length] * np.hanning(length)
    return found


def _interpolated(table: np.ndarray, azimuths: FloatArray) -> np.ndarray:
    """Return a table (rows, directions of `azimuths` and reverberation) for the directions of the grid."""
    table, late = table[:, :-1], table[:, -1:]
    grid = angles.grid()
    index = np.searchsorted(azimuths, grid, side="right") - 1
    following = (index + 1) % len(azimuths)
    step = np.mod(azimuths[following] - azimuths[index], 360.0)
    part = (np.mod(grid - azimuths[index], 360.0) / np.where(step == 0, 360.0, step)).astype(np.float32)
    return np.hstack(((1 - part) * table[:, index] + part * table[:, following], late))
