"""A direction model: how likely the interaural cues of each channel are for each direction, learned from sound.

T. May, S. van de Par and A. Kohlrausch (2011), "A probabilistic model for robust localization based on a binaural
auditory front-end", IEEE Trans. Audio Speech Lang. Process. 19, 1-13, learn the joint distribution of ITD and ILD
of each channel in several conditions. Here ITD and ILD are independent histograms, conditional on the interaural
coherence and on the level of the channel above its floor in the window. Both depend on the noise and
reverberation in a frame and determine how much its cues count. Neighbouring frames and channels, and both cues, are not
independent: each counts with a weight.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp import kernels
from rosafe.dsp.erb import erb_rate
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

FORMAT = "rosafe direction model 3"
WINDOW = 100  # frames for which a floor is estimated while learning
_SMOOTHING = 0.75  # bins, along ITD and ILD
_CLASS_SMOOTHING = 0.5  # classes
# Weights of ITD and ILD in the first coherence classes and in the others, at `_WEIGHT_HZ`. They maximize the posterior
# of the right direction in 2,000 windows of 0.5 and 1 s: training sounds of KEMAR, with and without rooms, not counted.
# They are for sums over many units of one source. Each unit alone has them with the exponent `UNIT_WEIGHT`.
_COHERENT = 2  # classes
_WEIGHT_HZ = np.array([80, 198, 361, 587, 899, 1330, 1926, 2750, 3890, 5464, 7641])
_WEIGHTS = np.array(
    [
        [[0.04, 0.07, 0.15, 0.64, 1.43, 2.41, 4.51, 3.88, 2.24, 1.5, 1.23],
         [0.08, 0.08, 0.08, 0.13, 0.17, 0.42, 0.69, 1.61, 2.78, 0.35, 0.56]],
        [[0.11, 0.28, 0.32, 0.22, 0.24, 0.39, 0.92, 2.72, 6.35, 11.78, 11.28],
         [0.12, 0.12, 0.09, 0.06, 0.05, 0.05, 0.03, 0.03, 0.09, 0.17, 0.19]],
    ]
)  # fmt: skip
UNIT_WEIGHT = 0.15
_PRIOR_COUNT = 10.0  # frames that the distribution over all directions counts for
HUM_PART = 16.0  # frames of hum for each one of sound
HUM_CLASSES = 4  # of coherence, in which hum is counted: independent noise is below
MAX_GAIN_DB = 1000.0
MAX_LOG_RATIO = 100.0


class DirectionModel:
    """Log-likelihood ratios of cues for directions, relative to the mean over all directions.

    For single units, as those of a mixture, they are relative to reverberation without its direct sound. Sound without
    a room has other tables: means of these and of those that are learned from sounds without a room only. The latter
    alone take front for back more often.

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
    max_itd : float
        Limit of the histogram of the ITD, s.
    level_gain_db : float
        Level of a sound in dB full scale less that of the ratemap summed over ears and channels.
    itd_table, ild_table : ndarray of float32, (rows + 1, A)
        See `rosafe.localization.cues`; the last row is zero.
    rooms : EvidenceTables
        For units of any sound, relative to reverberation.
    dry, dry_or_late : EvidenceTables
        For units of sound without a room; the second ones are relative to reverberation.

    Parameters
    ----------
    description : mapping
        The attributes above without the directions and the tables.
    itd_table, ild_table, dry_itd_table, dry_ild_table : ndarray, (rows + 1, A + 1)
        The tables with a last column for reverberation.
    """

    def __init__(self, description: Mapping[str, Any], *tables: np.ndarray) -> None:
        self.azimuths = angles.grid()
        self.sample_rate = float(description["sample_rate"])
        self.parameters = dict(description["parameters"])
        self.head = str(description["head"])
        self.is_sphere = bool(description["is_sphere"])
        self.max_itd = float(description["max_itd"])
        self.level_gain_db = float(description["level_gain_db"])
        # Half precision, as in files, so that a learned and a loaded model give the same numbers.
        itd, ild, dry_itd, dry_ild = (np.asarray(table, np.float16) for table in tables)
        self.rooms = _evidence_tables(itd, ild)
        self.itd_table, self.ild_table = self.rooms[:2]
        self.dry_or_late = _evidence_tables(dry_itd, dry_ild)
        late = {name: getattr(self.rooms, name) / np.float32(2) for name in ("late_itd", "late_ild")}
        self.dry = self.dry_or_late._replace(**late)  # without that of the dry part

    def __copy__(self) -> DirectionModel:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> DirectionModel:
        return self

    @property
    def channels(self) -> int:
        """The number of channels."""
        return (len(self.itd_table) - 1) // (CLASSES * ITD_BINS)

    @functools.cached_property
    def _cue_weights(self) -> FloatArray:
        return _weights(self.parameters["fb_cfHz"])

    def rows(self, cues: Cues, floor: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the rows (F, C) of both tables."""
        levels = level_class(cues.level, floor)
        itd_row = np.where(cues.valid, cues.itd_row + levels * ITD_BINS, len(self.itd_table) - 1)
        ild_row = np.where(cues.valid, cues.ild_row + levels * ILD_BINS, len(self.ild_table) - 1)
        return itd_row, ild_row

    def unweighted_terms(self, itd_row: NDArray[np.intp], ild_row: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return log-likelihood ratios (F, C, A) for the rows (F, C) of `rows`, without the weights of sums."""
        itd, ild = self._cue_weights
        return _unweighted(self.itd_table, itd_row, itd, ITD_BINS) + _unweighted(self.ild_table, ild_row, ild, ILD_BINS)

    def add_evidence(
        self,
        sums: FloatArray,
        tables: kernels.EvidenceTables,
        cues: Cues,
        floor: FloatArray,
        frames: NDArray[np.intp],
        channels: NDArray[np.bool_],
        factor: float = 1.0,
    ) -> None:
        """Add the log-likelihood ratios of some frames (n,) for some channels (C,), times `factor`, to `sums` (C, A).

        Sums are exact: the model's `tables` have half precision.
        """
        if kernels.compiled():
            tables.add(sums, cues, floor, frames, channels, factor)
        else:
            itd_row, ild_row = (rows[:, channels] for rows in self.rows(cues.select(frames), floor))
            itd = tables.itd[itd_row].sum(axis=0, dtype=np.float64)
            sums[channels] += factor * (itd + tables.ild[ild_row].sum(axis=0, dtype=np.float64))

    def unit_evidence(
        self,
        tables: kernels.EvidenceTables,
        cues: Cues,
        floor: FloatArray,
        frames: NDArray[np.intp],
        exponent: float = 1.0,
    ) -> NDArray[np.float32]:
        """Return the evidence (U, A) of each channel with cues of some frames (n,) by one of the model's `tables`.

        The weights get an exponent: 0 for ratios without weights.
        """
        valid = cues.valid[frames]
        factors = (self._cue_weights ** (exponent - 1)).astype(np.float32)
        if kernels.compiled():
            return tables.units(cues, floor, frames, int(np.count_nonzero(valid)), factors)
        found = np.zeros((int(np.count_nonzero(valid)), len(self.azimuths)), np.float32)
        for table, late, rows, factor, bins in zip(
            (tables.itd, tables.ild),
            (tables.late_itd, tables.late_ild),
            self.rows(cues.select(frames), floor),
            factors,
            (ITD_BINS, ILD_BINS),
            strict=True,
        ):
            row = rows[valid]
            of_row = factor.ravel()[row // (LEVEL_CLASSES * bins)]
            found += of_row[:, np.newaxis] * (table[row] - late[row, np.newaxis])
        return found

    # --- files ---

    def save(self, path: str | Path, replace: bool = True) -> None:
        """Write the model as one file (an npz archive with tables in half precision)."""
        description = {
            "format": FORMAT,
            "sample_rate": self.sample_rate,
            "parameters": self.parameters,
            "head": self.head,
            "is_sphere": self.is_sphere,
            "max_itd": self.max_itd,
            "level_gain_db": self.level_gain_db,
        }
        with new_file(path, replace) as descriptor, open(descriptor, "wb", closefd=False) as file:
            np.savez(
                file,
                description=np.array(json.dumps(description)),
                **{name: table.astype(np.float16) for name, table in zip(TABLES, self._columns(), strict=True)},
            )

    def _columns(self) -> list[np.ndarray]:
        """Return the tables with the columns of reverberation."""
        return [
            np.column_stack(pair)
            for one in (self.rooms, self.dry_or_late)
            for pair in ((one.itd, one.late_itd), (one.ild, one.late_ild))
        ]

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> DirectionModel:
        """Read a model. The one that was read last is kept, and returned while its file does not change.

        Raises
        ------
        ValueError
            The file is missing, damaged or no model: one line that names it.
        """
        name = printable(os.fspath(path))
        try:
            file = Path(os.path.expanduser(path))
            state = os.stat(file)
            return _read(file, (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns))
        except FileNotFoundError:
            raise ValueError(
                f"{name}: expected a learned model, got a missing file; check the path, or create it with "
                "rosafe head learn"
            ) from None
        except (OSError, ValueError) as problem:
            reason = getattr(problem, "strerror", None) or str(problem)
            raise ValueError(
                f"{name}: expected a model of rosafe head learn, got another or a damaged file: "
                f"{printable(reason)[:300]}; learn it again"
            ) from None


@functools.lru_cache(maxsize=1)  # reading takes longer than the localization of some seconds of sound
def _read(path: Path, version: tuple[int, ...]) -> DirectionModel:
    with open_npz(path) as (members, read):
        missing = {"description", *TABLES} - members.keys()
        if missing:
            raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        if members["description"].file_size > MAX_TEXT:
            raise ValueError(f"description: expected at most {MAX_TEXT} bytes")
        description = _checked_description(from_json(str(read(members["description"], ()))))
        rows = description.pop("channels") * CLASSES
        tables = [
            _checked_table(read(members[table], (rows * bins + 1, len(angles.grid()) + 1)), table)
            for table, bins in TABLES.items()
        ]
    return DirectionModel(description, *tables)


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


def _evidence_tables(itd: NDArray[np.float16], ild: NDArray[np.float16]) -> kernels.EvidenceTables:
    first, second, late_first, late_second = (
        table[:, part].astype(np.float32, order="C") for part in (slice(None, -1), -1) for table in (itd, ild)
    )
    return kernels.EvidenceTables(first, second, late_first, late_second, ITD_BINS, ILD_BINS, LEVEL_CLASSES, LEVEL_STEP)


TABLES = {"itd_table": ITD_BINS, "ild_table": ILD_BINS, "dry_itd_table": ITD_BINS, "dry_ild_table": ILD_BINS}
_OF_CHANNELS = ("fb_lowFreqHz", "fb_highFreqHz", "fb_nERBs")  # without effect, as fb_cfHz is given
_DESCRIPTION: dict[str, Callable[[Any], bool]] = {
    "sample_rate": lambda found: is_number(found) and MIN_RATE <= found <= MAX_RATE,
    "parameters": lambda found: isinstance(found, dict),
    "head": lambda found: isinstance(found, str),
    "is_sphere": lambda found: isinstance(found, bool),
    "max_itd": lambda found: is_number(found) and 0 < found <= 1,
    "level_gain_db": lambda found: is_number(found) and abs(found) <= MAX_GAIN_DB,
}


def _checked_table(table: np.ndarray, name: str) -> np.ndarray:
    """Return a table of a file; ValueError unless learning could write it."""
    if table.dtype != np.float16:
        raise ValueError(f"{name}: expected numbers of type float16, got {table.dtype}")
    # Magnitudes have the order of their bits, which numpy compares 50 times as fast as numbers of half precision.
    limit = np.float16(MAX_LOG_RATIO).view(np.int16)
    positive, negative = table.view(np.int16).max(), table.view(np.uint16).max() & 0x7FFF
    if positive > limit or negative > limit or table[-1].any():
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
        # of sounds without a room, and in rooms
        self.itd = np.zeros((2, directions, *self._shape, ITD_BINS), np.float32)
        self.ild = np.zeros((2, directions, *self._shape, ILD_BINS), np.float32)
        self._hum_itd, self._late_itd = np.zeros((2, 1, *self._shape, ITD_BINS), np.float32)
        self._hum_ild, self._late_ild = np.zeros((2, 1, *self._shape, ILD_BINS), np.float32)

    def add(self, direction: int | None, cues: Cues, in_room: bool = False) -> None:
        """Count the cues of successive frames from one direction; of reverberation if it is None.

        Floors are those of windows of `WINDOW` frames.
        """
        late = direction is None
        place = int(in_room), direction
        itd, ild = (self._late_itd[0], self._late_ild[0]) if late else (self.itd[place], self.ild[place])
        for begin in range(0, max(1, len(cues.level) - WINDOW // 2), WINDOW):
            part = cues.select(slice(begin, begin + WINDOW))
            self._count(itd, ild, part, part.valid)

    def add_hum(self, cues: Cues) -> None:
        """Count the coherent cues of frames of mains hum: in other frames and channels, noise is louder."""
        heard = cues.valid & (cues.itd_row // (LEVEL_CLASSES * ITD_BINS) % COHERENCE_CLASSES < HUM_CLASSES)
        self._count(self._hum_itd, self._hum_ild, cues, heard)

    @staticmethod
    def _count(itd: np.ndarray, ild: np.ndarray, cues: Cues, units: NDArray[np.bool_]) -> None:
        levels = level_class(cues.level, floors(cues.level))
        for counts, rows, bins in ((itd, cues.itd_row, ITD_BINS), (ild, cues.ild_row, ILD_BINS)):
            flat = counts.reshape(-1)
            flat += np.bincount((rows + levels * bins)[units], minlength=flat.size).astype(np.float32)

    def mirror(self, source: NDArray[np.intp]) -> None:
        """Add to each direction d the counts of direction `source[d]` with the ears exchanged."""
        self.itd += self.itd[:, source][..., ::-1]
        self.ild += self.ild[:, source][..., ::-1]
        self._late_itd += self._late_itd[..., ::-1]
        self._late_ild += self._late_ild[..., ::-1]

    def tables(self, frequencies: FloatArray) -> list[np.ndarray]:
        """Return the tables of `DirectionModel`; `frequencies` (C,) in Hz."""
        itd, ild = _weights(frequencies)
        of_itd, of_ild = (self._late_itd, self._hum_itd, itd), (self._late_ild, self._hum_ild, ild)
        counts = self.itd.sum(axis=0), self.ild.sum(axis=0), self.itd[0], self.ild[0]

        def table(number: int) -> np.ndarray:
            late, hum, weights = (of_itd, of_ild)[number % 2]
            return _log_ratios(np.concatenate((counts[number], late)), hum, weights)

        with ThreadPoolExecutor(2) as workers:
            tables = list(workers.map(table, range(len(counts))))
        return [*tables[:2], (tables[0] + tables[2]) / 2, (tables[1] + tables[3]) / 2]


def _weights(frequencies: FloatArray) -> FloatArray:
    """Return the weights (2, C, K) of ITD and ILD for channels and coherence classes."""
    places = erb_rate(np.asarray(frequencies)), erb_rate(_WEIGHT_HZ)
    cues_of = [[np.exp(np.interp(*places, np.log(one))) for one in cue] for cue in _WEIGHTS]  # (2, 2, C)
    return np.repeat(np.moveaxis(np.array(cues_of), 1, 2), (_COHERENT, COHERENCE_CLASSES - _COHERENT), axis=2)


def _unweighted(
    table: NDArray[np.float32], row: NDArray[np.intp], weights: FloatArray, bins: int
) -> NDArray[np.float32]:
    """Return the rows of a table divided by the `weights` (C, K) that they were multiplied by; the last row is zero."""
    of_row = np.append(weights.ravel(), 1.0)[row // (LEVEL_CLASSES * bins)]
    return np.asarray(table[row] / of_row[..., np.newaxis].astype(np.float32))


def _log_ratios(counts: np.ndarray, hum: np.ndarray, weights: FloatArray) -> np.ndarray:
    """Return log(p(bin | direction) / p(bin)) of counts (A + 1, C, K, S, bins) as (C * K * S * bins + 1, A + 1).

    The last counts are those of reverberation, which p(bin) does not contain.
    The ratio is weighted with the probability that the cues are not those of hum, which has counts (1, C, K, S, bins).
    The logarithms are multiplied by the `weights` (C, K), but not beyond what a file may contain.
    """
    smooth, hum = _smoothed(counts), _smoothed(hum)[0]
    mean = smooth[:-1].sum(axis=0) + 1e-4
    hum = HUM_PART * hum * (mean.sum() / max(float(hum.sum()), 1.0))
    sound = mean / (mean + hum)
    mean /= mean.sum(axis=-1, keepdims=True)
    total = smooth.sum(axis=-1, keepdims=True) + _PRIOR_COUNT
    smooth += _PRIOR_COUNT * mean
    smooth /= total
    smooth /= mean
    smooth -= 1.0
    smooth *= sound
    smooth += 1.0
    table = np.zeros((mean.size + 1, len(counts)), np.float32)
    np.log(smooth, out=smooth)
    smooth *= weights[..., np.newaxis, np.newaxis].astype(np.float32)
    table[:-1] = np.clip(smooth.reshape(len(counts), -1).T, -MAX_LOG_RATIO, MAX_LOG_RATIO)
    return table


def _smoothed(counts: np.ndarray) -> np.ndarray:
    for axis, width in ((2, _CLASS_SMOOTHING), (3, _CLASS_SMOOTHING), (4, _SMOOTHING)):
        counts = gaussian_filter1d(counts, width, axis=axis, mode="nearest")
    return counts
