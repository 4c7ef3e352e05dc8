"""Reverberation of moving sources around a turning head, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.rectangular_room import RoomReflections

STEP = 3.0  # degrees by which source or head move until the image sources are computed again


class Reverberation:
    """The reflections of all sources of a scene in a room.

    The image sources of each source follow its direction and that of the head: two responses are cross-faded over a
    block. All sources share the tail.

    Parameters
    ----------
    reflections : RoomReflections
        Of the room at the head.
    distances : list of float
        Of the sources, m.
    block : int
        Frames of a block.
    """

    def __init__(self, reflections: RoomReflections, distances: list[float], block: int) -> None:
        self._reflections = reflections
        self._distances = distances
        self._late = _Convolver(reflections.tail, block)
        self._early: dict[int, tuple[_View, _Convolver]] = {}  # by source
        self._input = np.zeros(block)  # of the tail

    def add(self, number: int, samples: FloatArray, azimuths: FloatArray, yaws: FloatArray) -> FloatArray:
        """Return the image sources (2, n) in the next block for a block of one source; see also `tail`.

        Parameters
        ----------
        number : int
            Of the source; each is given at most once for each block.
        samples : ndarray, (n,)
            Its sound.
        azimuths, yaws : ndarray
            Directions of source and head in the world, degrees, from the beginning of the block to its end.
        """
        distance = self._distances[number]
        if number in self._early:
            view, convolver = self._early[number]
        else:
            view, early = self._view(azimuths[0], distance, yaws[0])
            convolver = _Convolver(early, len(samples))
        following, response = view, None
        rests = azimuths[0] == azimuths[-1] and yaws[0] == yaws[-1]
        if view.difference(azimuths[-1], yaws[-1]) > (0.0 if rests else STEP):
            following, response = self._view(azimuths[-1], distance, yaws[-1])
        self._early[number] = following, convolver
        fade = np.arange(len(samples)) / len(samples)
        self._input += samples * (view.tail_gain + fade * (following.tail_gain - view.tail_gain))
        return convolver.process(samples, response)

    def tail(self) -> FloatArray:
        """Return the tail (2, n) of all sources in the block whose sources have been added."""
        tail = self._late.process(self._input)
        self._input = np.zeros_like(self._input)
        return tail

    def _view(self, azimuth: float, distance: float, yaw: float) -> tuple[_View, FloatArray]:
        early, tail_gain = self._reflections.of_source(azimuth, distance, yaw)
        return _View(azimuth, yaw, tail_gain), early


@dataclass(frozen=True)
class _View:
    """Directions (degrees, in the world) for which reflections were computed, and the gain of the tail."""

    azimuth: float
    yaw: float
    tail_gain: float

    def difference(self, azimuth: float, yaw: float) -> float:
        """Return by how many degrees source or head have moved."""
        return max(abs(angles.difference(azimuth, self.azimuth)), abs(angles.difference(yaw, self.yaw)))


class _Convolver:
    """Convolves blocks of `block` samples with a response (2, N), which may be replaced by one of equal length.

    Uniformly partitioned overlap-save: T. G. Stockham (1966), "High-speed convolution and correlation", Proc. Spring
    Joint Computer Conference, 229-233.
    """

    def __init__(self, response: FloatArray, block: int) -> None:
        self._block = block
        self._response = self._spectra(response)
        self._inputs = np.zeros((len(self._response), block + 1), complex)  # newest blocks, newer before older
        self._newest = 0
        self._last = np.zeros(block)

    def _spectra(self, response: FloatArray) -> np.ndarray:
        """Return the spectra (P, 2, block + 1) of the parts of a response."""
        parts = -(-response.shape[1] // self._block)
        padded = np.zeros((2, parts * self._block))
        padded[:, : response.shape[1]] = response
        return scipy.fft.rfft(padded.reshape(2, parts, self._block).swapaxes(0, 1), 2 * self._block)

    def process(self, samples: FloatArray, following: FloatArray | None = None) -> FloatArray:
        """Return the next block (2, n); with a `following` response, a cross-fade leads to it."""
        self._newest = (self._newest - 1) % len(self._inputs)
        self._inputs[self._newest] = scipy.fft.rfft(np.concatenate((self._last, samples)))
        self._last = samples
        result = self._convolved()
        if following is not None:
            self._response = self._spectra(following)
            result += np.arange(self._block) / self._block * (self._convolved() - result)
        return result

    def _convolved(self) -> FloatArray:
        newer = len(self._inputs) - self._newest
        total = np.einsum("pf,pef->ef", self._inputs[self._newest :], self._response[:newer])
        total += np.einsum("pf,pef->ef", self._inputs[: self._newest], self._response[newer:])
        return np.asarray(scipy.fft.irfft(total, 2 * self._block)[:, self._block :])
