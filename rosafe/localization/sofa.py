"""Read head-related impulse responses from SOFA files (AES69, convention SimpleFreeFieldHRIR), horizontal plane only.

AES69-2022, "AES standard for file exchange - Spatial acoustic data file format".
"""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.offline.containers import open_hdf5
from rosafe.terminal import printable

CONVENTION = "SimpleFreeFieldHRIR"
MAX_RESPONSES = 100_000
MAX_LENGTH = 16384  # samples of an impulse response
MAX_DIRECTIONS = 720  # in the horizontal plane
MAX_NUMBERS = 1 << 23  # in the responses of the horizontal plane
MIN_PEAK, MAX_PEAK = 1e-6, 1e6  # of a response
MIN_RATE, MAX_RATE = 8000.0, 768_000.0  # Hz
MAX_ELEVATION = 1.0  # degrees; positions up to here belong to the horizontal plane
MAX_GAP = 30.0  # degrees between neighbouring directions


class HorizontalResponses(NamedTuple):
    """The measurements of a SOFA file in the horizontal plane."""

    azimuths: FloatArray  # (A,) degrees, ascending in (-180, 180]
    responses: FloatArray  # (A, 2, N): left and right ear
    sample_rate: float  # Hz


def read_sofa(path: str | os.PathLike[str]) -> HorizontalResponses:
    """Read the impulse responses of the horizontal plane.

    Parameters
    ----------
    path : str or Path
        A SOFA file with the convention SimpleFreeFieldHRIR.

    Returns
    -------
    HorizontalResponses
        Responses with `Data.Delay` applied. Ears are assigned by `ReceiverPosition` (positive y is left). If the file
        has several distances, the one with most directions is used.

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
            return _SofaReader(name, content).horizontal()
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

    def _array(self, key: str, dimensions: int) -> FloatArray:
        data = self._variable(key)
        shape = data.shape
        self._expect(
            len(shape) == dimensions and 0 < math.prod(shape) <= 3 * MAX_RESPONSES,
            f"{key} with {dimensions} dimensions and up to {3 * MAX_RESPONSES} numbers",
            f"shape {shape}",
        )
        values = np.asarray(data[()], np.float64)
        self._expect(bool(np.isfinite(values).all()), f"finite numbers in {key}", "NaN or infinity")
        return values

    def horizontal(self) -> HorizontalResponses:
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
        rate = float(self._array("Data.SamplingRate", 1)[0])
        self._expect(MIN_RATE <= rate <= MAX_RATE, f"a sample rate from {MIN_RATE:g} to {MAX_RATE:g} Hz", f"{rate:g}")
        rows, azimuths = self._horizontal_rows(shape[0])
        numbers = 2 * len(rows) * shape[2]
        self._expect(numbers <= MAX_NUMBERS, f"responses of at most {MAX_NUMBERS} numbers", numbers)
        ears = self._ears()
        responses = self._rows(data, rows)[:, ears]
        self._expect(bool(np.isfinite(responses).all()), "finite numbers in Data.IR", "NaN or infinity")
        peaks = np.abs(responses).max(axis=2)
        self._expect(
            bool((peaks >= MIN_PEAK).all() and (peaks <= MAX_PEAK).all()),
            f"responses with a peak from {MIN_PEAK:g} to {MAX_PEAK:g}",
            f"{peaks.min():g} to {peaks.max():g}",
        )
        return HorizontalResponses(azimuths, self._delayed(responses, rows, ears), rate)

    @staticmethod
    def _rows(data: Any, rows: np.ndarray) -> FloatArray:
        """Return the rows of a dataset in any order (h5py reads them in ascending order only)."""
        order = np.argsort(rows)
        values = np.empty((len(rows), *data.shape[1:]))
        values[order] = data[rows[order].tolist()]
        return values

    def _positions(self, key: str) -> FloatArray:
        """Return positions (M, 3) in Cartesian coordinates (m)."""
        data = self._variable(key)
        values = self._array(key, len(data.shape))
        values = values[..., 0] if values.ndim == 3 else values
        self._expect(values.ndim == 2 and values.shape[1] == 3, f"{key} with 3 coordinates", f"shape {data.shape}")
        kind, units = (self._text(data.attrs, name).strip().lower() for name in ("Type", "Units"))
        self._expect(kind in ("spherical", "cartesian", ""), f"spherical or cartesian {key}", short_repr(kind))
        if kind != "spherical":
            return values
        self._expect(units.startswith("degree") or not units, f"{key} in degrees and metres", short_repr(units))
        azimuth, elevation = np.radians(values[:, 0]), np.radians(values[:, 1])
        flat = np.cos(elevation)
        unit = np.stack((np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)), axis=1)
        return unit * values[:, 2:]

    def _horizontal_rows(self, count: int) -> tuple[np.ndarray, FloatArray]:
        """Return the rows of the horizontal plane in the order of their azimuths, and these azimuths."""
        positions = self._positions("SourcePosition")
        self._expect(len(positions) == count, f"{count} rows in SourcePosition", len(positions))
        if "ListenerPosition" in self._content:
            listener = self._positions("ListenerPosition")
            self._expect(len(listener) in (1, count), f"1 or {count} rows in ListenerPosition", len(listener))
            positions = positions - listener
        distance = np.linalg.norm(positions, axis=1)
        self._expect(
            bool((distance > 0.05).all()), "sources at least 0.05 m from the listener", f"{distance.min():g} m"
        )
        elevation = np.degrees(np.arcsin(np.clip(positions[:, 2] / distance, -1, 1)))
        rows = np.flatnonzero(np.abs(elevation) <= MAX_ELEVATION)
        self._expect(len(rows) > 0, "directions in the horizontal plane", "none")
        distances, inverse = np.unique(np.round(distance[rows], 2), return_inverse=True)
        rows = rows[inverse == np.bincount(inverse, minlength=len(distances)).argmax()]
        azimuths = np.degrees(np.arctan2(positions[rows, 1], positions[rows, 0])) - self._view_azimuth()
        azimuths = np.round(180.0 - np.mod(180.0 - azimuths, 360.0), 6)
        azimuths[azimuths == -180.0] = 180.0
        azimuths, first = np.unique(azimuths, return_index=True)
        gap = float(np.max(np.diff(azimuths, append=azimuths[0] + 360.0)))
        self._expect(
            len(azimuths) > 1 and gap <= MAX_GAP,
            f"directions all around the head, at most {MAX_GAP:g} degrees apart",
            f"a gap of {gap:g} degrees",
        )
        self._expect(
            len(azimuths) <= MAX_DIRECTIONS,
            f"at most {MAX_DIRECTIONS} directions in the horizontal plane",
            len(azimuths),
        )
        return rows[first], azimuths

    def _view_azimuth(self) -> float:
        if "ListenerView" not in self._content:
            return 0.0
        view = self._positions("ListenerView")[0]
        return float(np.degrees(np.arctan2(view[1], view[0])))

    def _ears(self) -> list[int]:
        """Return the receivers in the order left, right."""
        sides = self._positions("ReceiverPosition")[:, 1]
        self._expect(
            len(sides) == 2 and abs(sides[0] - sides[1]) > 0.01,
            "one receiver on the left (positive y) and one on the right",
            f"y = {', '.join(f'{side:g}' for side in sides[:3])} m",
        )
        return [int(np.argmax(sides)), int(np.argmin(sides))]

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
