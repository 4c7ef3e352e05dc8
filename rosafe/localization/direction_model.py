"""A direction model: how likely the interaural cues of each channel are for each direction, learned from sound.

T. May, S. van de Par and A. Kohlrausch (2011), "A probabilistic model for robust localization based on a binaural
auditory front-end", IEEE Trans. Audio Speech Lang. Process. 19, 1-13, learn the joint distribution of ITD and ILD
of each channel in several conditions. Here ITD and ILD are independent histograms, conditional on the interaural
coherence and on the level of the channel above its floor in the window. Both depend on the noise and
reverberation in a frame and determine how much its cues count.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles, cues
from rosafe.localization.cues import (
    CLASSES,
    COHERENCE_CLASSES,
    ILD_BINS,
    ITD_BINS,
    LEVEL_CLASSES,
    LEVEL_STEP,
    Cues,
    floors,
    level_class,
)
from rosafe.localization.sofa import MAX_RATE, MIN_RATE
from rosafe.results.readers import open_npz
from rosafe.results.result_metadata import MAX_TEXT, from_json
from rosafe.system.output import new_file
from rosafe.system.terminal import printable

FORMAT = "rosafe direction model 1"
WINDOW = 100  # frames for which a floor is estimated while learning
_SMOOTHING = 0.75  # bins, along ITD and ILD
_CLASS_SMOOTHING = 0.5  # classes
_PRIOR_COUNT = 10.0  # frames that the distribution over all directions counts for
MAX_GAIN_DB = 1000.0
MAX_LOG_RATIO = 100.0


class DirectionModel:
    """Log-likelihood ratios of cues for directions, relative to the mean over all directions.

    A model does not change; copies by `copy` are the model itself, which takes tens of megabytes.

    Attributes
    ----------
    azimuths : ndarray, (A,)
        Degrees in head coordinates.
    sample_rate : float
        Of the sound, Hz.
    parameters : dict
        Of the representations, by the names of docs/parameters.md.
    is_sphere : bool
        Whether front and back are equal.
    level_gain_db : float
        Level of a sound in dB full scale less that of the ratemap summed over ears and channels.
    itd_table, ild_table : ndarray of float32, (rows + 1, A)
        See `rosafe.localization.cues`; the last row is zero.
    """

    def __init__(self, description: Mapping[str, Any], itd_table: np.ndarray, ild_table: np.ndarray) -> None:
        self.azimuths = angles.grid()
        self.sample_rate = float(description["sample_rate"])
        self.parameters = dict(description["parameters"])
        self.head = str(description["head"])
        self.is_sphere = bool(description["is_sphere"])
        self.level_gain_db = float(description["level_gain_db"])
        # Half precision, as in files, so that a learned and a loaded model give the same numbers.
        self.itd_table = np.asarray(itd_table, np.float16).astype(np.float32, order="C")
        self.ild_table = np.asarray(ild_table, np.float16).astype(np.float32, order="C")
        self._tables = kernels.EvidenceTables(
            self.itd_table, self.ild_table, ITD_BINS, ILD_BINS, LEVEL_CLASSES, LEVEL_STEP
        )

    def __copy__(self) -> DirectionModel:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> DirectionModel:
        return self

    @property
    def channels(self) -> int:
        """The number of channels."""
        return (len(self.itd_table) - 1) // (CLASSES * ITD_BINS)

    def rows(self, cues: Cues, floor: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the rows (F, C) of both tables."""
        levels = level_class(cues.level, floor)
        itd_row = np.where(cues.valid, cues.itd_row + levels * ITD_BINS, len(self.itd_table) - 1)
        ild_row = np.where(cues.valid, cues.ild_row + levels * ILD_BINS, len(self.ild_table) - 1)
        return itd_row, ild_row

    def terms(self, itd_row: NDArray[np.intp], ild_row: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return log-likelihood ratios (F, C, A) for the rows (F, C) of `rows`."""
        return self.itd_table[itd_row] + self.ild_table[ild_row]

    def add_evidence(
        self,
        sums: FloatArray,
        cues: Cues,
        floor: FloatArray,
        frames: NDArray[np.intp],
        channels: NDArray[np.bool_],
        factor: float = 1.0,
    ) -> None:
        """Add `terms` of some frames (n,) for some channels (C,), times `factor`, to `sums` (C, A).

        Sums are exact: the tables have half precision.
        """
        if kernels.compiled():
            self._tables.add(sums, cues, floor, frames, channels, factor)
        else:
            itd_row, ild_row = (rows[:, channels] for rows in self.rows(cues.select(frames), floor))
            itd = self.itd_table[itd_row].sum(axis=0, dtype=np.float64)
            sums[channels] += factor * (itd + self.ild_table[ild_row].sum(axis=0, dtype=np.float64))

    def unit_evidence(self, cues: Cues, floor: FloatArray, frames: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return `terms` (U, A) of each channel with cues of some frames (n,)."""
        valid = cues.valid[frames]
        if kernels.compiled():
            return self._tables.units(cues, floor, frames, int(np.count_nonzero(valid)))
        itd_row, ild_row = self.rows(cues.select(frames), floor)
        return self.terms(itd_row[valid], ild_row[valid])

    # --- files ---

    def save(self, path: str | Path, replace: bool = True) -> None:
        """Write the model as one file (an npz archive with tables in half precision)."""
        description = {
            "format": FORMAT,
            "sample_rate": self.sample_rate,
            "parameters": self.parameters,
            "head": self.head,
            "is_sphere": self.is_sphere,
            "level_gain_db": self.level_gain_db,
        }
        with new_file(path, replace) as descriptor, open(descriptor, "wb", closefd=False) as file:
            np.savez(
                file,
                description=np.array(json.dumps(description)),
                itd_table=self.itd_table.astype(np.float16),
                ild_table=self.ild_table.astype(np.float16),
            )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> DirectionModel:
        """Read a model.

        Raises
        ------
        ValueError
            The file is missing, damaged or no model: one line that names it.
        """
        name = printable(os.fspath(path))
        try:
            with open_npz(Path(os.path.expanduser(path))) as (members, read):
                missing = {"description", "itd_table", "ild_table"} - members.keys()
                if missing:
                    raise ValueError(f"it lacks {', '.join(sorted(missing))}")
                if members["description"].file_size > MAX_TEXT:
                    raise ValueError(f"description: expected at most {MAX_TEXT} bytes")
                description = _checked_description(from_json(str(read(members["description"], ()))))
                rows = description.pop("channels") * CLASSES
                tables = [
                    _checked_table(read(members[table], (rows * bins + 1, len(angles.grid()))), table)
                    for table, bins in (("itd_table", ITD_BINS), ("ild_table", ILD_BINS))
                ]
            return cls(description, *tables)
        except FileNotFoundError:
            raise ValueError(f"{name}: expected a learned model, got a missing file") from None
        except (OSError, ValueError) as problem:
            reason = getattr(problem, "strerror", None) or str(problem)
            raise ValueError(
                f"{name}: expected a model of rosafe head learn, got another or a damaged file: "
                f"{printable(reason)[:300]}; learn it again"
            ) from None


def _checked_description(found: Any) -> dict[str, Any]:
    """Return the description in a file with the number of `channels`; ValueError unless learning could write it."""
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f"expected the format {FORMAT!r}")
    for key, fits in _DESCRIPTION.items():
        if key not in found or not fits(found[key]):
            raise ValueError(f"{key}: expected another value, got {short_repr(found.get(key))}")
    parameters = found["parameters"]
    described = cues.describe(found["sample_rate"], parameters)
    effective = cues.model_parameters(described)
    if missing := sorted(effective.keys() - parameters.keys()):
        raise ValueError(f"parameters: expected {missing[0]}, got none")
    for key, value in parameters.items():
        if value != effective.get(key) and key not in _OF_CHANNELS:
            raise ValueError(f"{key}: expected {short_repr(effective.get(key))}, got {short_repr(value)}")
    return {**found, "channels": len(described["fb_cfHz"])}


_OF_CHANNELS = ("fb_lowFreqHz", "fb_highFreqHz", "fb_nERBs")  # without effect, as fb_cfHz is given
_DESCRIPTION: dict[str, Callable[[Any], bool]] = {
    "sample_rate": lambda found: is_number(found) and MIN_RATE <= found <= MAX_RATE,
    "parameters": lambda found: isinstance(found, dict),
    "head": lambda found: isinstance(found, str),
    "is_sphere": lambda found: isinstance(found, bool),
    "level_gain_db": lambda found: is_number(found) and abs(found) <= MAX_GAIN_DB,
}


def _checked_table(table: np.ndarray, name: str) -> np.ndarray:
    """Return a table of a file; ValueError unless learning could write it."""
    if table.dtype != np.float16:
        raise ValueError(f"{name}: expected numbers of type float16, got {table.dtype}")
    if not (np.abs(table) <= MAX_LOG_RATIO).all() or table[-1].any():
        raise ValueError(f"{name}: expected log-likelihood ratios up to {MAX_LOG_RATIO:g}, and 0 in the last row")
    return table


class Histograms:
    """Counts of cues for the directions of the grid, from which a model is made.

    Parameters
    ----------
    channels : int
        Number of channels.
    directions : int
        Number of directions.
    """

    def __init__(self, channels: int, directions: int) -> None:
        self._shape = channels, COHERENCE_CLASSES, LEVEL_CLASSES
        self.itd = np.zeros((directions, *self._shape, ITD_BINS), np.float32)
        self.ild = np.zeros((directions, *self._shape, ILD_BINS), np.float32)

    def add(self, direction: int, cues: Cues) -> None:
        """Count the cues of successive frames from one direction; floors are those of windows of `WINDOW` frames."""
        for begin in range(0, max(1, len(cues.level) - WINDOW // 2), WINDOW):
            part = cues.select(slice(begin, begin + WINDOW))
            levels = level_class(part.level, floors(part.level))
            for counts, rows, bins in ((self.itd, part.itd_row, ITD_BINS), (self.ild, part.ild_row, ILD_BINS)):
                flat = counts[direction].reshape(-1)
                flat += np.bincount((rows + levels * bins)[part.valid], minlength=flat.size).astype(np.float32)

    def mirror(self, source: NDArray[np.intp]) -> None:
        """Add to each direction d the counts of direction `source[d]` with the ears exchanged."""
        self.itd += self.itd[source][..., ::-1]
        self.ild += self.ild[source][..., ::-1]

    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the tables of log-likelihood ratios for ITD and ILD."""
        return _log_ratios(self.itd), _log_ratios(self.ild)


def _log_ratios(counts: np.ndarray) -> np.ndarray:
    """Return log(p(bin | direction) / p(bin)) of counts (A, C, K, S, bins) as (C * K * S * bins + 1, A)."""
    smooth = counts
    for axis, width in ((2, _CLASS_SMOOTHING), (3, _CLASS_SMOOTHING), (4, _SMOOTHING)):
        smooth = gaussian_filter1d(smooth, width, axis=axis, mode="nearest")
    mean = smooth.sum(axis=0) + 1e-4
    mean /= mean.sum(axis=-1, keepdims=True)
    total = smooth.sum(axis=-1, keepdims=True) + _PRIOR_COUNT
    smooth += _PRIOR_COUNT * mean
    smooth /= total
    smooth /= mean
    table = np.zeros((mean.size + 1, len(counts)), np.float32)
    np.log(smooth.reshape(len(counts), -1).T, out=table[:-1])
    return table
