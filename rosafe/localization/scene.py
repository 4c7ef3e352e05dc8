"""Binaural scenes with known truth: sources around a head that may rotate, in diffuse noise.

All samples are computed in blocks of `BLOCK` frames, whatever lengths are requested, and all random numbers come from
the seed of the scene: the same scene has the same samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.fft

from rosafe.dsp.copies import OwnState
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.filters import HOP, HeadFilters, SourceRenderer
from rosafe.localization.head import Head
from rosafe.localization.rectangular_room import RectangularRoom, RoomReflections
from rosafe.localization.reverberation import Reverberation
from rosafe.localization.scene_signals import SourceSignal, uniform

BLOCK = 16 * HOP  # frames that are computed at a time
NOISE_SOURCES = 36  # independent sources of the diffuse noise, at equal distances around the head
DEFAULT_DISTANCE = 1.5  # m
TRUTH_SECONDS = 0.01  # between two lines of a truth file
TRUTH_HEADER = "time_s,head_yaw_deg,name,azimuth_deg"


@dataclass(frozen=True)
class Course:
    """An angle over time: linear between points, the shorter way round; held before the first and after the last.

    Attributes
    ----------
    times : tuple of float
        s, ascending.
    values : tuple of float
        Degrees.
    """

    times: tuple[float, ...] = (0.0,)
    values: tuple[float, ...] = (0.0,)

    def at(self, times: FloatArray) -> FloatArray:
        """Return the angles at `times` (s) in degrees; they may exceed 180 degrees."""
        return np.interp(times, np.array(self.times), angles.unwrap(np.array(self.values, np.float64)))


@dataclass(frozen=True)
class SourceDescription:
    """One source.

    Attributes
    ----------
    name : str
        Unique in its scene.
    signal : SourceSignal
        The sound with an RMS of 1.
    azimuth : Course
        In world coordinates.
    level_db : float
        RMS in dB full scale, before the head.
    start, end : float
        When it sounds, s.
    distance : float
        From the head, m. It changes the reflections only: `level_db` is the level of the direct sound at the head.
    """

    name: str
    signal: SourceSignal
    azimuth: Course = field(default_factory=Course)
    level_db: float = -30.0
    start: float = 0.0
    end: float = float("inf")
    distance: float = DEFAULT_DISTANCE

    def end_at(self, sample_rate: float) -> float:
        """Return when it ends (s): a sound without a loop ends before `end`."""
        return min(self.end, self.start + self.signal.frames / sample_rate)


@dataclass(frozen=True)
class SceneDescription:
    """A description of a scene.

    Attributes
    ----------
    sample_rate : int
        Hz.
    sources : tuple of SourceDescription
        All sources.
    head : Head
        The head that receives them.
    head_yaw : Course
        Direction of the head in world coordinates.
    snr_db : float or None
        Power of all sources, by their levels, relative to that of the diffuse noise, before the head; None without
        noise.
    duration : float or None
        s; None without an end.
    seed : int
        Of all random numbers.
    room : RectangularRoom or None
        The room around them; None without reflections.
    """

    sample_rate: int
    sources: tuple[SourceDescription, ...]
    head: Head
    head_yaw: Course = field(default_factory=Course)
    snr_db: float | None = None
    duration: float | None = None
    seed: int = 0
    room: RectangularRoom | None = None

    def __post_init__(self) -> None:
        """Raise ValueError if a source is outside the room, or behind a head that covers the front half only."""
        if self.room is not None and self.room.drr_db is None:
            for source in self.sources:
                values = source.azimuth.at(np.array(source.azimuth.times))
                course = np.arange(values.min(), min(values.max(), values.min() + 360) + 1)
                if source.distance > (largest := self.room.largest_distance(course)):
                    raise ValueError(
                        f"{source.name}: distance: expected at most {largest:g} m in this room, "
                        f"got {source.distance:g}; set the distance of the source, or a larger room"
                    )
        for source in self.sources if self.head.front_only else ():
            times = np.unique((*source.azimuth.times, *self.head_yaw.times))
            relative = source.azimuth.at(times) - self.head_yaw.at(times)
            self.head.check_azimuths(relative)
            if np.ptp(np.floor((relative + 91.0) / 360.0)):  # 0 from -90 to 90, 1 from 270 to 450
                raise ValueError(
                    f"{source.name}: expected directions in front of the head, got a course behind it; add points"
                )

    def truth(self, time: float) -> Truth:
        """Return yaw and directions at a time (s)."""
        yaw = float(self.head_yaw.at(np.array([time]))[0])
        sounding = [s for s in self.sources if s.start <= time < s.end_at(self.sample_rate)]
        azimuths = [float(s.azimuth.at(np.array([time]))[0]) - yaw for s in sounding]
        names = tuple(source.name for source in sounding)
        return Truth(float(angles.wrap(yaw)), names, tuple(float(angles.wrap(azimuth)) for azimuth in azimuths))


class Truth(NamedTuple):
    """The state of a scene at one moment; angles in degrees."""

    head_yaw: float  # in world coordinates
    names: tuple[str, ...]  # of the sources that sound
    azimuths: tuple[float, ...]  # theirs, relative to the head


def truth_csv(truth: Callable[[float], Truth], seconds: float) -> str:
    """Return the text of a truth file, a line every 10 ms for each source that sounds; `truth` takes a time in s."""
    lines = [TRUTH_HEADER]
    for number in range(int(np.ceil(seconds / TRUTH_SECONDS - 1e-9))):
        now = truth(number * TRUTH_SECONDS)
        for name, azimuth in zip(now.names, now.azimuths, strict=True):
            lines.append(f"{number * TRUTH_SECONDS:.2f},{now.head_yaw:.3f},{name},{azimuth:.3f}")
    return "\n".join(lines) + "\n"


class SceneRenderer(OwnState):
    """The samples of a scene, in order."""

    def __init__(self, scene: SceneDescription) -> None:
        self.scene = scene
        filters = scene.head.filters(scene.sample_rate)
        self._sources = [(source, SourceRenderer(filters)) for source in scene.sources]
        self._noise = None if scene.snr_db is None else _noise_of(scene, filters)
        self._reverberation = None
        if scene.room is not None:
            distances = [DEFAULT_DISTANCE if scene.room.drr_db is not None else s.distance for s in scene.sources]
            reflections = RoomReflections(scene.room, filters, scene.sample_rate, scene.seed)
            self._reverberation = Reverberation(reflections, distances, BLOCK)
        self._frame = 0  # the first one of the next block
        self._rest = np.zeros((2, 0))

    def frames(self, count: int) -> FloatArray:
        """Return the next `count` frames (2, count), full scale 1."""
        parts = [self._rest[:, :count]]
        self._rest = self._rest[:, count:]
        missing = count - parts[0].shape[1]
        while missing > 0:
            block = self._next_block()
            parts.append(block[:, :missing])
            self._rest = block[:, missing:]
            missing -= parts[-1].shape[1]
        return np.concatenate(parts, axis=1)

    def _next_block(self) -> FloatArray:
        rate = self.scene.sample_rate
        first, self._frame = self._frame, self._frame + BLOCK
        hops = (first + np.arange(0, BLOCK + 1, HOP)) / rate
        yaw = self.scene.head_yaw.at(hops)
        total = np.zeros((2, BLOCK)) if self._noise is None else self._noise.block()
        for number, (source, renderer) in enumerate(self._sources):
            begin = round(source.start * rate)
            end = min(begin + source.signal.frames, source.end * rate)
            if first + BLOCK <= begin or first >= end + 2 * rate:  # silent, the tail of the last response included
                continue
            samples = np.zeros(BLOCK)
            inside = slice(max(0, begin - first), max(0, min(BLOCK, round(min(end, first + BLOCK)) - first)))
            count = inside.stop - inside.start
            if count > 0:
                samples[inside] = source.signal.samples(max(0, first - begin), count) * 10 ** (source.level_db / 20)
            azimuths = source.azimuth.at(hops)
            total += renderer.process(samples, angles.wrap(azimuths - yaw))
            if self._reverberation:
                total += self._reverberation.add(number, samples, azimuths, yaw)
        if self._reverberation:
            total += self._reverberation.tail()
        return total


def _noise_of(scene: SceneDescription, filters: HeadFilters) -> DiffuseNoise:
    power = sum(10 ** (source.level_db / 10) for source in scene.sources) * 10 ** (-(scene.snr_db or 0.0) / 10)
    return DiffuseNoise(filters, power, scene.seed)


class DiffuseNoise:
    """White noise from all around: independent sources of equal power at equal distances.

    Parameters
    ----------
    filters : HeadFilters
        Of the head.
    power : float
        Of all sources together, before the head.
    seed : int
        Of the random numbers.
    """

    def __init__(self, filters: HeadFilters, power: float, seed: int) -> None:
        azimuths = angles.wrap(np.arange(NOISE_SOURCES) * 360.0 / NOISE_SOURCES)
        responses = np.stack([filters.response(float(azimuth)) for azimuth in azimuths])
        self._size = scipy.fft.next_fast_len(BLOCK + responses.shape[2], real=True)
        self._spectra = np.fft.rfft(responses, self._size)
        self._gain = np.sqrt(3.0 * power / NOISE_SOURCES)  # the variance of uniform noise from -1 to 1 is 1/3
        self._random = np.random.PCG64([seed, 1])
        self._tail = np.zeros((2, self._size))

    def block(self) -> FloatArray:
        """Return the next `BLOCK` frames (2, BLOCK)."""
        samples = self._gain * uniform(self._random, NOISE_SOURCES * BLOCK).reshape(NOISE_SOURCES, BLOCK)
        spectra = np.fft.rfft(samples, self._size)
        total = np.fft.irfft(np.einsum("sf,sef->ef", spectra, self._spectra), self._size)
        total += self._tail
        self._tail = np.zeros_like(total)
        self._tail[:, : self._size - BLOCK] = total[:, BLOCK:]
        return np.asarray(total[:, :BLOCK])
