"""Interaural cues of frames, quantized for the tables of a direction model; the representations that they come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray, as_numbers
from rosafe.interface.arguments import check_parameters
from rosafe.localization.sphere import SPEED_OF_SOUND
from rosafe.processing.stream import Stream
from rosafe.representations import STAGES

KINDS = ("itd", "ild", "ic", "ratemap")  # the representations that localization needs
# Sound is amplified by 140 dB: the representations add a small constant to energies, which would matter at low levels.
# The high-pass removes a constant offset of the microphones and most of mains hum; see `rosafe.localization.hum`.
PARAMETERS = {"pp_bLevelScaling": True, "pp_refSPLdB": -40.0, "pp_bRemoveDC": True, "pp_cutoffHzDC": 150.0}
ITD_BINS, MAX_ITD = 67, 1.1e-3  # of the histogram from -MAX_ITD to MAX_ITD, s, for a head
ILD_BINS, MAX_ILD = 61, 30.0  # dB
COHERENCE_CLASSES = 6
COHERENCE_RANGE = 2.6  # decades of 1 - coherence below 1
LEVEL_CLASSES, LEVEL_STEP = 8, 2.0  # level of a channel above its floor in the window, dB
MAX_CHANNELS = 128  # of a model
CLASSES = COHERENCE_CLASSES * LEVEL_CLASSES
FLOOR_QUANTILE = 0.02  # of the levels in a window: the floor
MAX_VALUE = 1e100  # of a feature: sums of larger ones overflow
MIN_LEVEL = -150.0  # dB, of the ratemap of a sound with full scale 1; channels below have no cues
RANGE_DB = 60.0  # a channel that is weaker than the strongest one by more contains only its skirt: no cues


def describe(sample_rate: float, parameters: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the description, as of `Stream.describe`, of the representations for localization.

    ValueError if the frames of the representations have different hops or windows, or if there are too many channels.
    """
    described = Stream(sample_rate, {**PARAMETERS, **check_parameters(parameters)}, list(KINDS)).describe()
    values = described["parameters"]
    for name in ("wSizeSec", "hSizeSec"):
        if len({values[f"{prefix}_{name}"] for prefix in ("cc", "ild", "rm")}) > 1:
            raise ValueError(f"parameters: expected equal values of cc_{name}, ild_{name} and rm_{name}")
    if values["rm_scaling"] != "power":
        raise ValueError(f"rm_scaling: expected 'power' for localization, got {values['rm_scaling']!r}")
    if len(described["fb_cfHz"]) > MAX_CHANNELS:
        raise ValueError(
            f"fb_nChannels: expected at most {MAX_CHANNELS} for localization, got {len(described['fb_cfHz'])}"
        )
    return described


def model_parameters(described: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that a model depends on: all but the normalization of integer input."""
    values = described["parameters"]
    for stage in STAGES.values():  # such that they can be given again: a list of channels has an fb_nERBs of 0
        values = stage.request_values(values)
    return {name: value for name, value in values.items() if not name.startswith("in_")}


class Cues(NamedTuple):
    """Cues of F frames; all arrays are (F, C)."""

    itd_row: NDArray[np.intp]  # row of the ITD table for level class 0
    ild_row: NDArray[np.intp]  # the same of the ILD table
    level: FloatArray  # dB, both ears
    valid: NDArray[np.bool_]  # level and coherence suffice

    def select(self, frames: Any) -> Cues:
        """Return the cues of some frames."""
        return Cues(self.itd_row[frames], self.ild_row[frames], self.level[frames], self.valid[frames])


def scaling_db(parameters: Mapping[str, Any]) -> float:
    """Return the gain in dB with which the representations are computed."""
    return float(100.0 - parameters["pp_refSPLdB"]) if parameters["pp_bLevelScaling"] else 0.0


def max_itd(spacing: float | None) -> float:
    """Return the limit in s of the histogram of the ITD for microphones with a spacing in m; None for a head."""
    return MAX_ITD if spacing is None else 1.25 * spacing / SPEED_OF_SOUND + 1e-4


def quantize(features: Mapping[str, Any], gain_db: float, max_itd: float) -> Cues:
    """Quantize the representations `itd`, `ild`, `ic` (C, F) and `ratemap` (2, C, F); see `scaling_db`, `max_itd`."""
    itd, ild, coherence, ratemap = (np.asarray(features[kind], np.float64) for kind in KINDS)
    minimum = MIN_LEVEL + gain_db
    level = 10 * np.log10(np.maximum(ratemap[0] + ratemap[1], 10 ** ((minimum - 10) / 10)))
    least = np.maximum(minimum, level.max(axis=0) - RANGE_DB)
    decades = np.log10(np.maximum(1 - coherence, 1e-9)) + COHERENCE_RANGE
    coherence_class = _bin(decades / COHERENCE_RANGE, COHERENCE_CLASSES)
    first = (np.arange(len(itd))[:, np.newaxis] * COHERENCE_CLASSES + coherence_class) * LEVEL_CLASSES
    return Cues(
        np.ascontiguousarray((first * ITD_BINS + _bin((itd / max_itd + 1) / 2, ITD_BINS)).T),
        np.ascontiguousarray((first * ILD_BINS + _bin((ild / MAX_ILD + 1) / 2, ILD_BINS)).T),
        np.ascontiguousarray(level.T),
        np.ascontiguousarray(((level > least) & (coherence > 0)).T),
    )


def _bin(values: FloatArray, count: int) -> NDArray[np.intp]:
    """Return the bin of values from 0 to 1; those outside belong to the first or the last one."""
    return np.minimum(np.maximum(np.floor(values * count), 0), count - 1).astype(np.intp)


def floors(levels: FloatArray) -> FloatArray:
    """Return the floor (C,) of the levels (F, C) of a window in dB."""
    rank = int(FLOOR_QUANTILE * len(levels))
    return np.asarray(np.partition(levels, rank, axis=0)[rank])


def level_class(level: FloatArray, floor: FloatArray) -> NDArray[np.intp]:
    """Return the class of levels (..., C) above a floor (C,)."""
    steps = np.floor((level - floor) / LEVEL_STEP)
    return np.minimum(np.maximum(steps, 0), LEVEL_CLASSES - 1).astype(np.intp)


def check_features(features: Mapping[str, Any], channels: int) -> dict[str, FloatArray]:
    """Return the features that localization needs as float64; ValueError if one is missing or has another shape."""
    if not isinstance(features, Mapping):
        raise ValueError(f"features: expected a mapping with {', '.join(KINDS)}, got {type(features).__name__}")
    missing = [kind for kind in KINDS if kind not in features]
    if missing:
        raise ValueError(f"features: expected {', '.join(KINDS)}, got none for {', '.join(missing)}")
    arrays = {kind: as_numbers(f"features[{kind!r}]", features[kind]) for kind in KINDS}
    frames = arrays["itd"].shape[-1] if arrays["itd"].ndim else -1
    for kind, array in arrays.items():
        shape = (2, channels, frames) if kind == "ratemap" else (channels, frames)
        if array.shape != shape:
            raise ValueError(f"features[{kind!r}]: expected shape {shape}, got {short_repr(array.shape)}")
        if not (np.abs(array) <= MAX_VALUE).all():
            raise ValueError(
                f"features[{kind!r}]: expected finite numbers up to {MAX_VALUE:g}, got larger ones, infinity or NaN"
            )
    return arrays
