"""The steady noise of each channel, which is not a source: fans, motors.

The noise level of a channel is the minimum of its level in the last two seconds, as in R. Martin (2001), "Noise power
spectral density estimation based on optimal smoothing and minimum statistics", IEEE Trans. Speech Audio Process. 9,
504-512. A frame of a channel is noise if its level is less than `MARGIN_DB` above, the criterion of I. Cohen and
B. Berdugo (2002), "Noise estimation by minima controlled recursive averaging for robust speech enhancement", IEEE
Signal Process. Lett. 9, 12-15. A level stored before (`rosafe localize --calibrate-noise`) also holds for noise
that is not steady, as that of a motor that is switched on and off.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.mixture import MIN_SALIENCE, Candidate
from rosafe.localization.tracker import GATE, Tracker
from rosafe.system.input import open_regular
from rosafe.system.output import write_whole
from rosafe.system.terminal import printable

MEMORY = 20  # levels of 0.1 s, of which the minimum is the noise level
MARGIN_DB = 8.0  # of a frame above the minimum: the level of 20 ms of noise varies by some dB
FORMAT = "rosafe noise level 1"
_MAX_BYTES = 100_000


class SteadyNoise:
    """The noise level of each channel, and the directions that are noise.

    Parameters
    ----------
    channels : int
        Number of channels.

    Attributes
    ----------
    stored : ndarray, (C,)
        Levels in dB as of `update`, from a calibration; the noise level is not below.
    warm_up : int
        Number of levels from which on the noise level is known. By default the sound at the beginning of a recording
        may be a source; with fewer levels, sound that is steady from the beginning on is noise.
    azimuths : list of float
        Directions that the last `remove_from` has removed, degrees.
    """

    def __init__(self, channels: int) -> None:
        self.stored = np.full(channels, -np.inf)
        self.warm_up = MEMORY
        self.azimuths: list[float] = []
        self._levels: deque[FloatArray] = deque(maxlen=MEMORY)
        self._tracker = Tracker(keep=False)  # of all candidates: shows which ones move

    def update(self, level: FloatArray) -> None:
        """Add the lowest mean level (C,) of 0.1 s, of those that end in the last 0.1 s, in dB."""
        self._levels.append(level)

    def reset(self, keep_levels: bool = False) -> None:
        """Forget all directions and, unless `keep_levels`, all levels except stored ones."""
        self._tracker = Tracker(keep=False)
        if not keep_levels:
            self._levels.clear()

    @property
    def level(self) -> FloatArray:
        """The noise level (C,) in dB: -inf without a calibration until two seconds of sound are known."""
        if len(self._levels) < self.warm_up:
            return self.stored
        return np.maximum(np.array(self._levels).min(axis=0), self.stored)

    @property
    def threshold(self) -> FloatArray:
        """The level (C,) in dB that sound must exceed in a frame."""
        return self.level + MARGIN_DB

    def remove_from(self, candidates: Sequence[Candidate], time: float, yaw: float) -> list[Candidate]:
        """Return the candidates without those that are not above the noise and do not move; see `Tracker.update`."""
        self._tracker.update(candidates, time, yaw)
        kept = [one for one in candidates if one.salience >= MIN_SALIENCE or self._moves(one.azimuth)]
        self.azimuths = [one.azimuth for one in candidates if one not in kept]
        return kept

    def _moves(self, azimuth: float) -> bool:
        """Return whether a source that moves is near a direction."""
        return any(
            track.id and abs(float(angles.difference(azimuth, track.state[0]))) <= GATE and track.moves
            for track in self._tracker.tracks
        )


@dataclass(frozen=True)
class NoiseCalibration:
    """A stored noise level.

    Attributes
    ----------
    sample_rate : float
        Hz.
    parameters : mapping
        Of the representations.
    level_db : ndarray, (C,)
        Level of the ratemap in dB.
    """

    sample_rate: float
    parameters: Mapping[str, Any]
    level_db: FloatArray

    def save(self, path: str | Path) -> None:
        """Write it as a JSON file, whose folder is created."""
        values = {
            "format": FORMAT,
            "sample_rate": self.sample_rate,
            "parameters": dict(self.parameters),
            "level_db": [round(float(level), 2) for level in self.level_db],
        }
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, (json.dumps(values, indent=1) + "\n").encode())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> NoiseCalibration:
        """Read a file of `save`.

        Raises
        ------
        ValueError
            The file is missing, damaged or of another kind: one line that names it.
        """
        name = printable(os.fspath(path))
        try:
            with open_regular(Path(path)) as file:
                values = json.loads(file.read(_MAX_BYTES))
            if values["format"] != FORMAT:
                raise ValueError(f"format {short_repr(values['format'])}")
            levels = np.asarray(values["level_db"], np.float64)
            if levels.ndim != 1 or not len(levels) or not np.isfinite(levels).all():
                raise ValueError("level_db: expected a list of finite numbers")
            return cls(float(values["sample_rate"]), dict(values["parameters"]), levels)
        except FileNotFoundError:
            raise ValueError(
                f"{name}: expected a stored noise level, got a missing file; check the path, or create it with "
                "rosafe localize --calibrate-noise"
            ) from None
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as problem:
            raise ValueError(
                f"{name}: expected a file of rosafe localize --calibrate-noise, got another or a damaged one: "
                f"{short_repr(str(problem))}"
            ) from None

    def check(self, sample_rate: float, parameters: Mapping[str, Any]) -> None:
        """Raise ValueError if it was measured with another sample rate or with other parameters."""
        if self.sample_rate != sample_rate:
            raise ValueError(
                f"sample_rate: expected {self.sample_rate:g} Hz as in the calibration, got {sample_rate:g}"
            )
        for name, value in parameters.items():
            if self.parameters.get(name) != value:
                raise ValueError(
                    f"{name}: expected {short_repr(self.parameters.get(name))} as in the calibration, "
                    f"got {short_repr(value)}"
                )


def measured_level(levels: FloatArray) -> FloatArray:
    """Return the level (C,) to be stored for noise with these levels (F, C) of frames in dB: the mean power."""
    return np.asarray(10 * np.log10(np.mean(10 ** (levels / 10), axis=0)))
