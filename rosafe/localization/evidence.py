"""The evidence for each direction in the frames of a sliding window, in head and in world coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rosafe.dsp.kernels import EvidenceTables
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.cues import Cues, floors
from rosafe.localization.direction_model import UNIT_WEIGHT, DirectionModel
from rosafe.localization.mixture import DECISION_STEP, Surroundings, Units


class EvidenceWindow:
    """Log-likelihood ratios of the last frames, summed over channels and frames.

    The floor of a channel is that of the whole window. If a floor changes, the evidence of its channel is computed
    again for all frames of the window, so that a result depends only on the sound in the window, and on whether it
    comes from a room. If that changes, the evidence of all channels is computed again, with other tables.

    Parameters
    ----------
    model : DirectionModel
        The model.
    frames : int
        Length of the window.
    """

    def __init__(self, model: DirectionModel, frames: int) -> None:
        self.surroundings = Surroundings()
        self._model, self._tables = model, model.rooms
        self._frames = frames
        channels = model.channels
        self._cues = Cues(
            np.zeros((frames, channels), np.intp),
            np.zeros((frames, channels), np.intp),
            np.zeros((frames, channels)),
            np.zeros((frames, channels), bool),
        )
        self._powers = np.zeros((frames, channels))  # of the levels of the cues
        self._yaw = np.zeros(frames)
        self._power = np.zeros(frames)
        self._sums = np.zeros((channels, len(model.azimuths)))  # of all frames, world coordinates
        self._floor = np.full(channels, np.nan)
        self._all = np.ones(channels, bool)
        self._count = 0  # frames since the start

    @property
    def filled(self) -> int:
        """The number of frames in the window."""
        return min(self._count, self._frames)

    def extend(self, cues: Cues, power: FloatArray, yaw: FloatArray) -> None:
        """Add the cues (F, C) of frames, their power and the direction of the head (degrees) in world coordinates."""
        if len(yaw) > self._frames:
            self._count += len(yaw) - self._frames
            cues, power, yaw = cues.select(slice(-self._frames, None)), power[-self._frames :], yaw[-self._frames :]
        positions = self._count + np.arange(len(yaw))
        places = positions % self._frames
        few = 2 * len(yaw) < self.filled  # otherwise it is faster to begin again
        replaced = places[positions >= self._frames]
        if few and len(replaced):
            self._add_evidence(replaced, self._all, -1.0)
        self._count += len(yaw)
        for kept, new in zip(self._cues, cues, strict=True):
            kept[places] = new
        self._powers[places] = 10 ** (cues.level / 10)
        self._yaw[places] = yaw
        self._power[places] = power
        floor = floors(self._cues.level[: self.filled])
        same = (floor == self._floor) & few
        self._floor = floor
        if few:
            self._add_evidence(places, same)
        if not same.all():
            self._sums[~same] = 0.0
            self._add_evidence(np.arange(self.filled), ~same)

    def _add_evidence(self, frames: NDArray[np.intp], channels: NDArray[np.bool_], factor: float = 1.0) -> None:
        """Add the evidence of frames for some channels (C,), times `factor`, to the sums in world coordinates."""
        yaw = self._yaw[frames]
        if not yaw.any():
            self._model.add_evidence(self._sums, self._tables, self._cues, self._floor, frames, channels, factor)
        elif (yaw == yaw[0]).all():
            total = np.zeros_like(self._sums)
            self._model.add_evidence(total, self._tables, self._cues, self._floor, frames, channels, factor)
            self._sums[channels] += rotate(total, np.full(len(total), yaw[0]))[channels]
        else:
            itd_row, ild_row = (row[:, channels] for row in self._model.rows(self._cues.select(frames), self._floor))
            evidence = self._tables.itd[itd_row] + self._tables.ild[ild_row]
            turned = rotate(evidence.reshape(-1, evidence.shape[-1]), np.repeat(yaw, evidence.shape[1]))
            self._sums[channels] += factor * turned.reshape(evidence.shape).sum(axis=0, dtype=np.float64)

    def count_units(self) -> int:
        """Return the number of frames of all channels that have cues."""
        return int(np.count_nonzero(self._cues.valid[: self.filled]))

    def power(self) -> float:
        """Return the mean power of the frames."""
        return float(self._power[: self.filled].mean()) if self._count else 0.0

    def sums(self) -> FloatArray:
        """Return the evidence (C, A) of each channel, summed over the frames, in world coordinates."""
        return self._sums

    def lowest_level(self, frames: int) -> FloatArray:
        """Return the lowest mean level (C,) of `frames` frames in dB, of those that end in the last `frames` ones."""
        powers = self._powers[self._last(2 * frames - 1)]
        means = sliding_window_view(powers, min(frames, len(powers)), axis=0).mean(axis=-1)
        return np.asarray(10 * np.log10(means.min(axis=0)))

    def _last(self, frames: int) -> NDArray[np.intp]:
        """Return the places of the last `frames` frames, of fewer if there are fewer."""
        number = min(frames, self.filled)
        return (self._count - number + np.arange(number)) % self._frames

    def unit_evidence(
        self, frames: int, tables: EvidenceTables, exponent: float = UNIT_WEIGHT, step: int = 1
    ) -> NDArray[np.float32]:
        """Return that of the channels with cues of each `step`th of the last `frames` frames, (U, A).

        It is in world coordinates.
        """
        places = np.ascontiguousarray(self._last(frames)[::step])
        valid = self._cues.valid[places]
        evidence = self._model.unit_evidence(tables, self._cues, self._floor, places, exponent)
        yaw = self._yaw[places]
        return rotate(evidence, np.broadcast_to(yaw[:, np.newaxis], valid.shape)[valid]) if yaw.any() else evidence

    def units(self, frames: int, noise: FloatArray) -> Units:
        """Return the channels with cues of the last `frames` frames, in world coordinates; `noise` (C,) is in dB.

        Their tables are those of the surroundings, which are decided before.
        """
        model = self._model
        both = (self.unit_evidence(frames, one, step=DECISION_STEP) for one in (model.rooms, model.dry_or_late))
        self.surroundings.update(*both)
        of_sums = model.rooms if self.surroundings.room else model.dry
        if of_sums is not self._tables:
            self._tables = of_sums
            self._sums[:] = 0.0
            self._add_evidence(np.arange(self.filled), self._all)
        tables = model.dry if self.surroundings.dry else model.rooms
        places = self._last(frames)
        valid = self._cues.valid[places]
        return Units(
            self.unit_evidence(frames, tables),
            self.unit_evidence(frames, tables, 1.0),
            np.broadcast_to(np.arange(valid.shape[1]), valid.shape)[valid],
            self._powers[places][valid] / max(1, len(places)),
            (self._cues.level[places] > noise)[valid],
        )


def rotate(evidence: NDArray[Any], yaw: FloatArray) -> NDArray[Any]:
    """Return evidence (F, A) of head coordinates in world coordinates, for the yaw (F,) of the head in degrees.

    Evidence is interpolated linearly between directions of the grid.
    """
    if not yaw.any():
        return evidence
    steps = np.mod(yaw, 360.0) / angles.SPACING
    whole = np.floor(steps).astype(np.intp)
    part = (steps - whole)[:, np.newaxis].astype(evidence.dtype)
    directions = evidence.shape[-1]
    circle = np.concatenate((evidence, evidence, evidence[:, :1]), axis=1)
    turns = sliding_window_view(circle, directions + 1, axis=1)  # the direction before the first one, then all
    turned = turns[np.arange(len(yaw)), (-whole - 1) % directions]
    return np.asarray((1 - part) * turned[:, 1:] + part * turned[:, :-1])
