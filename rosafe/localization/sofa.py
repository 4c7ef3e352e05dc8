"""Read head-related impulse responses from SOFA files (AES69, convention SimpleFreeFieldHRIR), horizontal plane only.

AES69-2022, "AES standard for file exchange - Spatial acoustic data file format".
"""

from __future__ import annotations

import importlib.util
import math
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.offline.containers import open_hdf5
from rosafe.terminal import printable

CONVENTION = "SimpleFreeFieldHRIR"
MAX_RESPONSES = 100_000
MAX_LENGTH = 16384  # samples of an impulse response
MAX_DIRECTIONS = 720  # in the horizontal plane
MAX_NUMBERS = 1 << 23  # in the responses of the horizontal plane
MIN_PEAK, MAX_PEAK = 1e-6, 1e6  # of a response
MIN_RATE, MAX_RATE = 8000.0, 768_000.0  # Hz
MAX_ELEVATION = 2.5  # degrees; measurements up to here belong to the horizontal plane
MAX_DISTANCE = 0.1  # relative deviation from the distance of the other measurements
MERGED = 0.25  # degrees; measurements whose azimuths differ by less have the same direction
MAX_GAP = 30.0  # degrees between neighbouring directions
MIN_LEVEL = 3.0  # dB by which one ear is louder at the sides; less, as of microphones without a head, decides nothing
_SIDE = 0.7  # sine of the lateral angle from which a source is at a side


class HorizontalResponses(NamedTuple):
    """The measurements of a SOFA file in the horizontal plane."""

    azimuths: FloatArray  # (A,) degrees, ascending in (-180, 180]
    responses: FloatArray  # (A, 2, N): left and right ear
    sample_rate: float  # Hz
    front_only: bool  # whether they cover the front half only


def read_sofa(path: str | os.PathLike[str], mirror: bool | None = None) -> HorizontalResponses:
    """Read the impulse responses of the horizontal plane.

    The horizontal plane is that of the head: `ListenerView` and `ListenerUp`. In each direction the measurement nearest
    to it is used. If the file has several distances, the one with most directions is used.

    Parameters
    ----------
    path : str or Path
        A SOFA file with the convention SimpleFreeFieldHRIR.
    mirror : bool, optional
        Whether the labels of the file are corrected: its ears are exchanged if it has the right ear first, otherwise
        its azimuths are negated. By default this is done, with a warning, if the ear that faces the source is clearly
        the quieter one.

    Returns
    -------
    HorizontalResponses
        Responses with `Data.Delay` applied. Ears are assigned by `ReceiverPosition` (positive y is left).

    Raises
    ------
    ValueError
        The file is missing, unreadable, no SOFA file or unsuitable. One line that names the file.
    """
    name = printable(os.fspath(path))
    if not importlib.util.find_spec("h5py"):  # the child process imports it
        raise ValueError(f"{name}: reading SOFA files needs h5py; install it with scripts/install")
    try:
        with open_hdf5(Path(path).expanduser()) as content:
            return _SofaReader(name, content).horizontal(mirror)
    except FileNotFoundError:
        raise ValueError(f"{name}: expected a SOFA file, got a missing file") from None
    except ValueError as problem:
        if str(problem).startswith(f"{name}: "):
            raise
        raise ValueError(
            f"{name}: expected a SOFA file, got another or a damaged one: {_first_line(problem)}"
        ) from None
    except OSError as problem:
        raise ValueError(f"{name}: {problem.strerror or _first_line(problem)}") from None


def _first_line(problem: BaseException) -> str:
    return printable((str(problem).splitlines() or [type(problem).__name__])[0])


class _SofaReader:
    """Checks and converts the content of one open file."""

    def __init__(self, name: str, content: Any) -> None:
        self._name = name
        self._content = content

    def _expect(self, condition: bool, expected: str, got: object) -> None:
        if not condition:
            raise ValueError(f"{self._name}: expected {expected}, got {got}")

    def _warn(self, text: str) -> None:
        warnings.warn(f"{self._name}: {text}", UserWarning, stacklevel=5)  # the caller of Head.from_sofa

    def _text(self, attributes: Any, key: str) -> str:
        value = attributes.get(key, b"")
        if isinstance(value, np.ndarray):
            value = value.flat[0] if value.size else b""
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)

    def _variable(self, key: str) -> Any:
        """Return a dataset of real numbers."""
        self._expect(key in self._content, f"the variable {key}", "none")
        data = self._content[key]
        kind = data.dtype.kind if hasattr(data, "dtype") else ""
        self._expect(bool(kind) and kind in "fiu", f"real numbers in {key}", "something else")
        return data

    def _array(self, key: str, *dimensions: int) -> FloatArray:
        """Return all numbers of a variable with one of these numbers of dimensions."""
        data = self._variable(key)
        shape = data.shape
        self._expect(
            len(shape) in dimensions and 0 < math.prod(shape) <= 3 * MAX_RESPONSES,
            f"{key} with {' or '.join(map(str, dimensions))} dimensions and up to {3 * MAX_RESPONSES} numbers",
            f"shape {shape}",
        )
        values = np.asarray(data[()], np.float64)
        self._expect(bool(np.isfinite(values).all()), f"finite numbers in {key}", "NaN or infinity")
        return values

    def horizontal(self, mirror: bool | None) -> HorizontalResponses:
        convention = self._text(self._content.attrs, "SOFAConventions")
        self._expect(
            convention == CONVENTION,
            f"the SOFA convention {CONVENTION}",
            short_repr(convention) if convention else "none",
        )
        data = self._variable("Data.IR")
        shape = data.shape
        self._expect(
            len(shape) == 3 and shape[1] == 2 and 0 < shape[0] <= MAX_RESPONSES and 16 <= shape[2] <= MAX_LENGTH,
            f"Data.IR of shape (M, 2, N), M up to {MAX_RESPONSES}, N from 16 to {MAX_LENGTH}",
            f"shape {shape}",
        )
        rows, azimuths, front_only = self._horizontal_rows(shape[0])
        rate = self._sample_rate(shape[0], rows)
        numbers = 2 * len(rows) * shape[2]
        self._expect(numbers <= MAX_NUMBERS, f"responses of at most {MAX_NUMBERS} numbers", numbers)
        ears = self._ears(shape[0], rows)
        responses = self._rows(data, rows)[:, ears]
        self._expect(bool(np.isfinite(responses).all()), "finite numbers in Data.IR", "NaN or infinity")
        peaks = np.abs(responses).max(axis=2)
        self._expect(
            bool((peaks >= MIN_PEAK).all() and (peaks <= MAX_PEAK).all()),
            f"responses with a peak from {MIN_PEAK:g} to {MAX_PEAK:g}",
            f"{peaks.min():g} to {peaks.max():g}",
        )
        responses = self._delayed(responses, rows, ears)
        level = near_ear_level(azimuths, responses, rate)
        if level < -MIN_LEVEL if mirror is None else mirror:
            exchange = ears == [1, 0]
            if exchange:
                responses = responses[:, ::-1]
            else:
                mirrored = angles.wrap(-azimuths)
                order = np.argsort(mirrored)
                azimuths, responses = mirrored[order], responses[order]
            if mirror is None:
                self._warn(
                    f"the ear that faces the source is the quieter one, by {-level:.0f} dB, so the file is read with "
                    f"{'exchanged ears' if exchange else 'negated azimuths'}; mirror=False (--no-mirror) reads it as "
                    "it is labelled"
                )
        return HorizontalResponses(azimuths, responses, rate, front_only)

    @staticmethod
    def _rows(data: Any, rows: np.ndarray) -> FloatArray:
        """Return the rows of a dataset in any order (h5py reads them in ascending order only)."""
        order = np.argsort(rows)
        values = np.empty((len(rows), *data.shape[1:]))
        values[order] = data[rows[order].tolist()]
        return values

    def _sample_rate(self, count: int, rows: np.ndarray) -> float:
        rates = self._array("Data.SamplingRate", 1, 2).ravel()
        self._expect(len(rates) in (1, count), f"1 or {count} numbers in Data.SamplingRate", len(rates))
        used = rates[rows] if len(rates) > 1 else rates
        lowest, highest = float(used.min()), float(used.max())
        self._expect(
            lowest == highest, "one sample rate for all measurements", f"{lowest:g} to {highest:g} Hz; resample them"
        )
        expected = f"a sample rate from {MIN_RATE:g} to {MAX_RATE:g} Hz"
        self._expect(MIN_RATE <= lowest <= MAX_RATE, expected, f"{lowest:g}")
        return lowest

    def _cartesian(self, key: str, values: FloatArray, attributes: Any, direction: bool = False) -> FloatArray:
        """Return positions (..., 3) in Cartesian coordinates (m), with the length 1 if they are a `direction`."""
        kind, units = (self._text(attributes, name).strip().lower() for name in ("Type", "Units"))
        self._expect(kind in ("spherical", "cartesian", ""), f"spherical or cartesian {key}", short_repr(kind))
        default = key == "SourcePosition" and not kind and not units  # AES69: spherical by default
        if kind != "spherical" and "deg" not in units and not default:
            self._expect("rad" not in units, f"{key} in metres", short_repr(units))
            return values
        self._expect("deg" in units or not units, f"{key} in degrees and metres", short_repr(units))
        azimuth, elevation = np.radians(values[..., 0]), np.radians(values[..., 1])
        flat = np.cos(elevation)
        unit = np.stack((np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)), axis=-1)
        return unit if direction else unit * values[..., 2:]

    def _positions(
        self, key: str, count: int, default: tuple[float, float, float] | None = None, like: str = ""
    ) -> FloatArray:
        """Return positions (1, 3) or (count, 3) in Cartesian coordinates, directions if there is a `default`.

        The variable `like` has their type and units, unless they have their own.
        """
        if default is not None and key not in self._content:
            return np.array([default])
        values = self._array(key, 2, 3)
        values = values[..., 0] if values.ndim == 3 else values
        self._expect(
            len(values) in (1, count) and values.shape[1] == 3,
            f"1 or {count} rows of 3 coordinates in {key}",
            f"shape {values.shape}",
        )
        attributes = self._content[key].attrs
        if like in self._content and not any(self._text(attributes, name) for name in ("Type", "Units")):
            attributes = self._content[like].attrs
        return self._cartesian(key, values, attributes, key in ("ListenerView", "ListenerUp"))

    def _relative(self, count: int) -> FloatArray:
        """Return the positions (count, 3) of the sources relative to the head: x ahead, y left, z up."""
        source = self._positions("SourcePosition", count)
        source = source - self._positions("ListenerPosition", count, (0.0, 0.0, 0.0))
        view = self._positions("ListenerView", count, (1.0, 0.0, 0.0))
        up = self._positions("ListenerUp", count, (0.0, 0.0, 1.0), "ListenerView")
        left = np.cross(up, view)
        lengths = np.linalg.norm(left, axis=1)
        sizes = np.linalg.norm(up, axis=1) * np.linalg.norm(view, axis=1)
        self._expect(
            bool((lengths > 1e-3 * sizes).all()),
            "a ListenerView and a ListenerUp in different directions",
            "parallel ones, or zeros",
        )
        axes = view, left, np.cross(view, left)
        relative = [np.sum(source * axis, axis=1) / np.linalg.norm(axis, axis=1) for axis in axes]
        return np.broadcast_to(np.stack(relative, axis=1), (count, 3))

    def _horizontal_rows(self, count: int) -> tuple[np.ndarray, FloatArray, bool]:
        """Return the rows of the horizontal plane in the order of their azimuths, these azimuths, and `front_only`."""
        positions = self._relative(count)
        distance = np.linalg.norm(positions, axis=1)
        self._expect(
            bool((distance > 0.05).all()), "sources at least 0.05 m from the listener", f"{distance.min():g} m"
        )
        elevation = np.degrees(np.arcsin(np.clip(positions[:, 2] / distance, -1, 1)))
        azimuths = angles.wrap(np.round(np.degrees(np.arctan2(positions[:, 1], positions[:, 0])), 6))
        near = np.flatnonzero(np.abs(elevation) <= MAX_ELEVATION)
        self._expect(
            len(near) > 0,
            f"directions within {MAX_ELEVATION:g} degrees of the horizontal plane",
            f"none: the nearest has an elevation of {elevation[np.abs(elevation).argmin()]:.1f} degrees",
        )
        reference = _main_distance(distance[near], azimuths[near])
        relative = np.abs(distance / reference - 1)
        rows = near[relative[near] <= MAX_DISTANCE]
        offset = np.hypot(np.radians(elevation), relative)
        rows = np.array([group[offset[group].argmin()] for group in _directions(rows, azimuths)])
        chosen, front_only = self._covered(azimuths[rows])
        rows = rows[chosen]
        candidates = np.flatnonzero(np.abs(elevation) <= 2 * MAX_ELEVATION)
        left_out = _left_out(azimuths[rows], azimuths[candidates])
        if left_out:
            self._warn(
                f"{left_out} directions are left out: they were not measured within {MAX_ELEVATION:g} degrees of the "
                f"horizontal plane and {100 * MAX_DISTANCE:.0f} % of the distance of the others, {reference:.3g} m"
            )
        return rows, azimuths[rows], front_only

    def _covered(self, azimuths: FloatArray) -> tuple[np.ndarray, bool]:
        """Return which of the ascending azimuths to use, and whether they cover the front half only."""
        self._expect(
            len(azimuths) <= MAX_DIRECTIONS,
            f"at most {MAX_DIRECTIONS} directions in the horizontal plane",
            len(azimuths),
        )
        gap = float(np.max(np.diff(azimuths, append=azimuths[0] + 360.0)))
        if len(azimuths) > 1 and gap <= MAX_GAP + 1e-6:
            return np.arange(len(azimuths)), False
        front = np.flatnonzero(np.abs(azimuths) <= 90.0 + MERGED)
        ends = azimuths[front[[0, -1]]] if len(front) else np.zeros(2)
        between = float(np.max(np.diff(azimuths[front]), initial=0.0))
        self._expect(
            ends[0] <= MAX_GAP / 2 - 90 and ends[1] >= 90 - MAX_GAP / 2 and between <= MAX_GAP + 1e-6,
            f"directions all around the head or in its front half, at most {MAX_GAP:g} degrees apart and within "
            f"{MAX_ELEVATION:g} degrees of the horizontal plane",
            f"a gap of {gap:g} degrees",
        )
        return front, True

    def _ears(self, count: int, rows: np.ndarray) -> list[int]:
        """Return the receivers in the order left, right."""
        values = self._array("ReceiverPosition", 2, 3)
        values = values.reshape(*values.shape[:2], -1)
        self._expect(
            values.shape[:2] == (2, 3) and values.shape[2] in (1, count),
            f"ReceiverPosition of shape (2, 3, 1) or (2, 3, {count})",
            f"shape {values.shape}",
        )
        positions = self._cartesian(
            "ReceiverPosition", np.moveaxis(values, 2, 0), self._content["ReceiverPosition"].attrs
        )
        sides = positions[rows if len(positions) > 1 else [0], :, 1]
        differences = sides[:, 0] - sides[:, 1]
        self._expect(
            bool((differences > 0.01).all() or (differences < -0.01).all()),
            "one receiver on the left (positive y) and one on the right",
            f"y = {', '.join(f'{side:g}' for side in sides[0])} m",
        )
        return [0, 1] if differences[0] > 0 else [1, 0]

    def _delayed(self, responses: FloatArray, rows: np.ndarray, ears: list[int]) -> FloatArray:
        """Return `responses` (A, 2, N) with `Data.Delay` (samples) applied, as far as the ears or directions differ."""
        if "Data.Delay" not in self._content:
            return responses
        delays = self._array("Data.Delay", 2)
        self._expect(delays.shape[1] == 2, "Data.Delay for two receivers", f"shape {delays.shape}")
        delays = delays if len(delays) > 1 else np.broadcast_to(delays, (int(rows.max()) + 1, 2))
        self._expect(len(delays) > int(rows.max()), "Data.Delay for each measurement", f"shape {delays.shape}")
        delays = delays[rows][:, ears]
        delays = delays - delays.min()
        if not delays.any():
            return responses
        self._expect(float(delays.max()) <= MAX_LENGTH, f"delays of at most {MAX_LENGTH} samples", f"{delays.max():g}")
        length = responses.shape[2] + int(np.ceil(delays.max())) + 32
        turns = np.fft.rfftfreq(2 * length, 1.0)
        shifted = np.empty((len(responses), 2, length))
        for both, pair, delay in zip(shifted, responses, delays, strict=True):  # one direction at a time: less memory
            spectrum = np.fft.rfft(pair, 2 * length) * np.exp(-2j * np.pi * turns * delay[:, np.newaxis])
            both[:] = np.fft.irfft(spectrum, 2 * length)[:, :length]
        return shifted


def near_ear_level(azimuths: FloatArray, responses: FloatArray, sample_rate: float) -> float:
    """Return the level in dB of the ear that faces the source above that of the other one, for sources at the sides.

    It is the mean of both sides at 4 to 8 kHz, or in the highest octave of a lower sample rate; NaN without directions
    at one of the sides.
    """
    high = min(8000.0, 0.45 * sample_rate)
    size = max(256, responses.shape[2])
    frequencies = np.fft.rfftfreq(size, 1 / sample_rate)
    band = (frequencies >= high / 2) & (frequencies <= high)
    sides = np.sin(np.radians(azimuths))
    levels = []
    for side in (sides > _SIDE, sides < -_SIDE):
        spectra = np.fft.rfft(responses[side], size)[..., band]
        powers = np.maximum(np.sum(np.abs(spectra) ** 2, axis=-1), np.finfo(float).tiny)
        levels.append(np.mean(10 * np.log10(powers[:, 0] / powers[:, 1])) if side.any() else np.nan)
    return float(levels[0] - levels[1]) / 2


def _main_distance(distances: FloatArray, azimuths: FloatArray) -> float:
    """Return the median (m) of the group of similar distances that has most directions."""
    ordered = np.sort(distances)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > MAX_DISTANCE / 2 * ordered[:-1]) + 1)
    inside = [azimuths[(distances >= group[0]) & (distances <= group[-1])] for group in groups]
    numbers = [len(_directions(np.arange(len(found)), found)) for found in inside]
    return float(np.median(groups[len(groups) - 1 - int(np.argmax(numbers[::-1]))]))  # of equal ones the farthest


def _directions(rows: np.ndarray, azimuths: FloatArray) -> list[np.ndarray]:
    """Return rows in the order of their `azimuths`, in groups of one direction; 180 degrees is the last one."""
    at = azimuths[rows]
    at = np.where(at < -180.0 + MERGED, at + 360.0, at)
    order = np.argsort(at, kind="stable")
    starts = [0] if len(rows) else []
    for place in range(1, len(rows)):
        if at[order[place]] - at[order[starts[-1]]] > MERGED:
            starts.append(place)
    return np.split(rows[order], starts[1:]) if starts else []


def _left_out(used: FloatArray, candidates: FloatArray) -> int:
    """Return the number of directions of `candidates` in a gap between the azimuths that are used (both in degrees)."""
    spacing = float(np.median(np.diff(used)))
    distance = np.abs(angles.difference(candidates[:, np.newaxis], used)).min(axis=1)
    inside = (candidates > used[0] - spacing) & (candidates < used[-1] + spacing)
    missing = np.flatnonzero((distance > max(0.6 * spacing, MERGED)) & inside)
    return len(_directions(missing, candidates))
