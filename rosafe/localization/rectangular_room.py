"""Reflections of a rectangular room at a head: image sources, and a diffuse tail behind them.

J. B. Allen and D. A. Berkley (1979), "Image method for efficiently simulating small-room acoustics", J. Acoust. Soc.
Am. 65, 943-950. The walls reflect equally at all frequencies and angles; sources radiate equally to all sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
import scipy.signal

from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.filters import HeadFilters
from rosafe.localization.scene_signals import uniform
from rosafe.localization.sphere import SPEED_OF_SOUND

# Limits of the values in scenes: memory and time are bounded, and formulas hold
MIN_SIDE, MAX_SIDE = 1.0, 30.0  # m
MIN_RT60, MAX_RT60 = 0.05, 5.0  # s
MIN_DRR, MAX_DRR = -20.0, 40.0  # dB
MARGIN = 0.05  # m; sources and head are at least this far from the walls
ABSORPTION = 0.99  # of the walls, at most
IMAGES = 2000  # about; behind them begins the tail
MAX_REACH = 60.0  # m, of the way of an image
MAX_DECAY = 0.35  # of the reverberation time; later, images decay more slowly than at first
HIGH_PASS = 40.0  # Hz; images with positive amplitudes add up near 0 Hz, as Allen and Berkley describe
JITTER = 0.08  # m, by which ways differ from the exact ones at most: no real room is exactly symmetric
TAPS = 32  # of the interpolation of fractional delays
TAIL_DIRECTIONS = 36


@dataclass(frozen=True)
class RectangularRoom:
    """A room whose axes are those of the world (ahead, left, up), and the position of the head.

    Attributes
    ----------
    size : tuple of 3 floats
        Sides in m.
    rt60 : float
        Reverberation time in s.
    position : tuple of 3 floats, optional
        Of the head, in m from the corner that is behind, right and below; the middle by default. Sources have its
        height.
    drr_db : float, optional
        Energy of the direct sound of each source over all the rest, both ears together, in dB; by default it follows
        from the distance.

    Raises
    ------
    ValueError
        The room cannot have the reverberation time, or the head is outside.
    """

    size: tuple[float, ...]
    rt60: float
    position: tuple[float, ...] | None = None
    drr_db: float | None = None

    @classmethod
    def drawn(cls, rt60: float, drr_db: float, seed: int) -> RectangularRoom:
        """Return a room with random sides of 4 to 7, 3.5 to 6 and 2.5 to 3.2 m, and the head in its middle."""
        sides = np.array([5.5, 4.75, 2.85]) + np.array([1.5, 1.25, 0.35]) * uniform(np.random.PCG64([seed, 1 << 21]), 3)
        return cls(tuple(sides.tolist()), rt60, None, drr_db)

    def __post_init__(self) -> None:
        """Check the values together; each alone is within the limits above."""
        if len(self.size) != 3:
            raise ValueError(f"size: expected three sides in m, got {short_repr(self.size)}")
        surface = 2 * sum(self.volume / side for side in self.size)
        shortest = np.ceil(-16.1 * self.volume / (np.log(1 - ABSORPTION) * surface)) / 100  # Eyring's formula, s
        if self.rt60 < shortest:
            raise ValueError(f"rt60: expected at least {shortest:g} s in a room of this size, got {self.rt60:g}")
        inside = (MARGIN <= at <= side - MARGIN for at, side in zip(self.head, self.size, strict=True))
        if not all(inside):
            raise ValueError(f"position: expected a place inside the room, got {short_repr(self.position)}")

    @property
    def volume(self) -> float:
        """In cubic metres."""
        return float(np.prod(self.size))

    @property
    def head(self) -> tuple[float, ...]:
        """The position of the head."""
        return tuple(side / 2 for side in self.size) if self.position is None else self.position

    def largest_distance(self, azimuths: FloatArray) -> float:
        """Return how far (m, full cm) a source may be from the head at all `azimuths` (degrees, in the world)."""
        ways = np.stack((np.cos(np.radians(azimuths)), np.sin(np.radians(azimuths))), axis=1)
        head, size = np.array(self.head[:2]), np.array(self.size[:2])
        free = np.where(ways > 0, size - MARGIN - head, head - MARGIN)
        return float(np.floor(100 * np.min(free / np.maximum(np.abs(ways), 1e-9)) + 1e-6)) / 100


class RoomReflections:
    """The reflections of a rectangular room at a head.

    Parameters
    ----------
    room : RectangularRoom
        The room. Its walls reflect so much that the images in the farther half have the energy of a diffuse field
        with the room's reverberation time: 4 pi / V per metre of the way at first, relative to a direct sound at 1 m.
        (The formulas of Sabine and Eyring give other values: sound between distant walls decays more slowly.)
    filters : HeadFilters
        Of the head, at the sample rate.
    sample_rate : float
        Hz.
    seed : int
        Of the random numbers of jitter and tail.

    Attributes
    ----------
    reflection : float
        Ratio of the pressures at a wall.

    Notes
    -----
    A head has responses of the horizontal plane. An image above or below it takes the response with its lateral angle
    (that to the median plane), in front or behind: differences of time and level between the ears depend on this angle
    mainly, and for a sphere on nothing else. Directions are rounded to 5 degrees, those of the direct sound are not.
    """

    def __init__(self, room: RectangularRoom, filters: HeadFilters, sample_rate: float, seed: int = 0) -> None:
        self._room = room
        self._filters = filters
        self._rate = sample_rate
        self._seed = seed
        dense = float(np.cbrt(0.75 * IMAGES * room.volume / np.pi))  # m
        self._reach = min(dense, MAX_REACH, MAX_DECAY * room.rt60 * SPEED_OF_SOUND)
        self._lattice = _Lattice(room, self._reach + max(room.size))
        self.reflection = self._solve()
        self._jitter = JITTER * uniform(np.random.PCG64([seed, 1 << 20]), len(self._lattice.orders))
        ring = np.stack([filters.response(float(azimuth)) for azimuth in angles.grid()])
        self._early = int((self._reach + JITTER) / SPEED_OF_SOUND * sample_rate) + TAPS  # frames, before the head
        self._size = scipy.fft.next_fast_len(self._early + filters.length, real=True)
        self._spectra = scipy.fft.rfft(ring, self._size)

    def _solve(self) -> float:
        """Return the ratio of the pressures at a wall, by bisection, for sources that are spread in the room."""
        room, reach = self._room, self._reach
        sources = np.array(room.size) * (0.5 + 0.45 * uniform(np.random.PCG64(1), 48).reshape(16, 3))
        ways = np.stack([np.linalg.norm(self._lattice.offsets(source), axis=1) for source in sources])
        chosen = (ways > reach / 2) & (ways < reach)
        orders, energies = np.broadcast_to(self._lattice.orders, ways.shape)[chosen], ways[chosen] ** -2.0 / len(ways)
        decay = 6 * np.log(10) / (SPEED_OF_SOUND * room.rt60)  # per m, energy
        expected = 4 * np.pi / room.volume * (np.exp(-decay * reach / 2) - np.exp(-decay * reach)) / decay
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (middle, high) if np.sum(energies * middle ** (2.0 * orders)) < expected else (low, middle)
        return low

    def early(self, azimuth: float, distance: float, yaw: float = 0.0) -> FloatArray:
        """Return the image sources of one source (2, N); its direct sound has an amplitude of 1 and no delay.

        Parameters
        ----------
        azimuth, yaw : float
            Directions of the source and of the head in the world, degrees.
        distance : float
            Between head and source, m.
        """
        angle = np.radians(azimuth)
        offsets = self._lattice.offsets(self._room.head + distance * np.array([np.cos(angle), np.sin(angle), 0.0]))
        ways = np.linalg.norm(offsets, axis=1)
        chosen = (ways < distance + self._reach) & (self._lattice.orders > 0)
        offsets, ways, orders = offsets[chosen], ways[chosen], self._lattice.orders[chosen]
        delays = np.maximum(ways - distance + self._jitter[chosen], 0.0) * (self._rate / SPEED_OF_SOUND)
        impulses = np.zeros((len(self._spectra), self._early))
        rows = np.round(_horizontal(offsets, ways, yaw) / angles.SPACING).astype(int) + len(impulses) // 2 - 1
        _add_impulses(impulses, rows % len(impulses), delays, distance / ways * self.reflection**orders)
        spectra = np.einsum("df,def->ef", scipy.fft.rfft(impulses, self._size), self._spectra)
        band = scipy.signal.butter(2, HIGH_PASS, "highpass", fs=self._rate, output="sos")
        return np.asarray(scipy.signal.sosfilt(band, scipy.fft.irfft(spectra, self._size)))

    @cached_property
    def tail(self) -> FloatArray:
        """The diffuse tail (2, N), which depends neither on the source nor on the direction of the head.

        It begins with the direct sound, as zeros.
        """
        begin = int(self._reach / SPEED_OF_SOUND * self._rate)
        times = np.arange(begin, max(begin + 1, int(self._room.rt60 * self._rate))) / self._rate
        power = 4 * np.pi * SPEED_OF_SOUND / (self._room.volume * self._rate)  # per sample, at first
        envelope = np.sqrt(3.0 * power / TAIL_DIRECTIONS) * 10 ** (-3 * times / self._room.rt60)
        tail = np.zeros((2, begin + len(times) + self._filters.length - 1))
        lateral = np.degrees(np.arcsin((2 * np.arange(TAIL_DIRECTIONS // 2) + 1) / (TAIL_DIRECTIONS // 2) - 1))
        random = np.random.PCG64([self._seed, (1 << 20) + 1])
        for azimuth in (
            *lateral,
            *(180.0 - lateral),
        ):  # lateral angles are those of a field that is equal from all directions
            noise = envelope * uniform(random, len(times))
            response = self._filters.response(float(angles.wrap(azimuth)))
            tail[:, begin:] += scipy.signal.oaconvolve(noise[np.newaxis], response, axes=-1)
        return tail

    def of_source(self, azimuth: float, distance: float, yaw: float = 0.0) -> tuple[FloatArray, float]:
        """Return the image sources (2, N) of a source and the gain of its tail, for a direct sound as in `early`.

        They are scaled to `room.drr_db` if it is given.
        """
        early = self.early(azimuth, distance, yaw)
        tail_gain = distance * 10 ** (-3 * distance / (SPEED_OF_SOUND * self._room.rt60))
        if self._room.drr_db is not None:
            rest = np.zeros((2, max(early.shape[1], self.tail.shape[1])))
            rest[:, : early.shape[1]] = early
            rest[:, : self.tail.shape[1]] += tail_gain * self.tail
            direct = np.sum(self._filters.response(float(angles.wrap(azimuth - yaw))) ** 2)
            gain = np.sqrt(direct / np.sum(rest**2)) * 10 ** (-self._room.drr_db / 20)
            early, tail_gain = early * gain, tail_gain * gain
        return early, tail_gain


class _Lattice:
    """The image sources of a room whose ways to the head may be shorter than `reach` (m)."""

    def __init__(self, room: RectangularRoom, reach: float) -> None:
        axes = []
        for side, head in zip(room.size, room.head, strict=True):
            rooms = np.arange(-int(reach / (2 * side)) - 2, int(reach / (2 * side)) + 3)
            shift = np.concatenate((2 * side * rooms, 2 * side * rooms)) - head
            sign = np.repeat((1.0, -1.0), len(rooms))
            order = np.concatenate((2 * np.abs(rooms), np.abs(rooms) + np.abs(rooms - 1)))
            nearest = np.maximum(np.abs(shift + sign * side / 2) - side / 2, 0.0)
            axes.append((shift, sign, order, nearest))
        index = [part.ravel() for part in np.meshgrid(*(np.arange(len(axis[0])) for axis in axes), indexing="ij")]
        near = sum(axis[3][part] ** 2 for axis, part in zip(axes, index, strict=True)) < reach**2
        index = [part[near] for part in index]
        self._shift = np.stack([axis[0][part] for axis, part in zip(axes, index, strict=True)], axis=1)
        self._sign = np.stack([axis[1][part] for axis, part in zip(axes, index, strict=True)], axis=1)
        self.orders = sum(axis[2][part] for axis, part in zip(axes, index, strict=True))

    def offsets(self, source: FloatArray) -> FloatArray:
        """Return the positions (M, 3) of the images relative to the head, m, for the position of a source."""
        return np.asarray(self._shift + self._sign * source)


def _horizontal(offsets: FloatArray, ways: FloatArray, yaw: float) -> FloatArray:
    """Return the azimuths (degrees) with the lateral angles of offsets (M, 3) from a head that is turned by `yaw`."""
    cosine, sine = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    ahead = offsets[:, 0] * cosine + offsets[:, 1] * sine
    lateral = np.degrees(np.arcsin(np.clip((offsets[:, 1] * cosine - offsets[:, 0] * sine) / ways, -1.0, 1.0)))
    return np.where(ahead >= 0, lateral, 180.0 - lateral)


def _add_impulses(impulses: FloatArray, rows: np.ndarray, delays: FloatArray, gains: FloatArray) -> None:
    """Add band-limited impulses to the `rows` at fractional delays in samples: sinc functions with a Hann window."""
    first = np.floor(delays).astype(int) - TAPS // 2 + 1
    distance = first[:, np.newaxis] + np.arange(TAPS) - delays[:, np.newaxis]  # from the middle, samples
    values = gains[:, np.newaxis] * np.sinc(distance) * np.cos(np.pi * distance / (TAPS + 2)) ** 2
    places = first[:, np.newaxis] + np.arange(TAPS)
    inside = (places >= 0) & (places < impulses.shape[1])
    flat = (rows[:, np.newaxis] * impulses.shape[1] + places)[inside]
    impulses += np.bincount(flat, values[inside], impulses.size).reshape(impulses.shape)
