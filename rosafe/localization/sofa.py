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
from rosafe.localization.horizontal_plane import (
    DISTANCE_TOLERANCE,
    MAX_ELEVATION,
    MIN_SHADOW_DB,
    choose_directions,
    near_ear_gain,
)
from rosafe.results.hdf5_reading import open_hdf5
from rosafe.system.terminal import printable

CONVENTION = "SimpleFreeFieldHRIR"
MAX_RESPONSES = 100_000
MAX_LENGTH = 16384  # samples of an impulse response
MAX_DIRECTIONS = 720  # in the horizontal plane
MAX_NUMBERS = 1 << 23  # in the responses of the horizontal plane
MAX_VALUE = 1e6  # of coordinates, delays and rates
MIN_PEAK, MAX_PEAK = 1e-6, 1e6  # of a response
_METRES = ("metre", "metres", "meter", "meters", "m")
MIN_RATE, MAX_RATE = 8000.0, 768_000.0  # Hz


class HorizontalResponses(NamedTuple):
    """The measurements of a SOFA file in the horizontal plane."""

    azimuths: FloatArray  # (A,) degrees, ascending in (-180, 180]
    responses: FloatArray  # (A, 2, N): left and right ear
    sample_rate: float  # Hz
    front_only: bool  # the front half is covered, and not all directions
    notes: tuple[str, ...]  # about corrected labels and directions that are left out


def read_sofa(path: str | os.PathLike[str], mirror: bool | None = None) -> HorizontalResponses:
    """Read the impulse responses of the horizontal plane.

    Parameters
    ----------
    path : str or Path
        A SOFA file with the convention SimpleFreeFieldHRIR.
    mirror : bool, optional
        As of `rosafe.Head.from_sofa`.

    Returns
    -------
    HorizontalResponses
        Responses with `Data.Delay` applied. Ears are assigned by `ReceiverPosition` (positive y is left). The
        horizontal plane is that of the head, by `ListenerView` and `ListenerUp`. `choose_directions` chooses the
        measurement of each direction.

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
        raise ValueError(
            f"{name}: expected a SOFA file, got a missing file; check the path "
            "(Debian's package libmysofa1 has those in /usr/share/libmysofa)"
        ) from None
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
        return (value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)).strip(" \0")

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
        small = bool((np.abs(values) <= MAX_VALUE).all())
        self._expect(small, f"finite numbers up to {MAX_VALUE:g} in {key}", "larger ones, NaN or infinity")
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
        try:
            chosen = choose_directions(*self._directions(shape[0]))
        except ValueError as problem:
            raise ValueError(
                f"{self._name}: {problem}".replace(f"{self._name}: {self._name}: ", f"{self._name}: ")
            ) from None
        rows, azimuths = chosen.rows, chosen.azimuths
        self._expect(
            len(rows) <= MAX_DIRECTIONS, f"at most {MAX_DIRECTIONS} directions in the horizontal plane", len(rows)
        )
        numbers = 2 * len(rows) * shape[2]
        self._expect(numbers <= MAX_NUMBERS, f"responses of at most {MAX_NUMBERS} numbers", numbers)
        rate = self._sample_rate(shape[0], rows)
        ears = self._ears(shape[0], rows)
        responses = self._rows(data, rows)[:, ears]
        self._expect(bool(np.isfinite(responses).all()), "finite numbers in Data.IR", "NaN or infinity")
        peaks = np.abs(responses).max(axis=2)
        self._expect(
            bool((peaks >= MIN_PEAK).all() and (peaks <= MAX_PEAK).all()),
            f"responses with a peak from {MIN_PEAK:g} to {MAX_PEAK:g}",
            f"{peaks.min():g} to {peaks.max():g}",
        )
        responses = self._delayed(responses, shape[0], rows, ears)
        gain = near_ear_gain(azimuths, responses, rate)
        notes = []
        if mirror if mirror is not None else gain < -MIN_SHADOW_DB:
            done = "the ears are exchanged" if ears == [1, 0] else "the azimuths are negated"
            if mirror is None:
                notes.append(
                    f"sources that are labelled left are {-gain:.0f} dB louder in the right ear; {done} "
                    "(mirror=False or --no-mirror keeps the labels of the file)"
                )
            if ears == [1, 0]:
                responses = responses[:, ::-1]
            else:
                azimuths = np.where(azimuths == 180.0, 180.0, -azimuths) + 0.0  # without -0, so that keys are equal
                order = np.argsort(azimuths)
                azimuths, responses = azimuths[order], responses[order]
        if chosen.left_out:
            notes.append(
                f"{chosen.left_out} directions are left out: more than {MAX_ELEVATION:g} degrees from the horizontal "
                f"plane, not within {100 * DISTANCE_TOLERANCE:g} % of the distance of most directions, or behind a "
                "measured front half"
            )
        return HorizontalResponses(azimuths, responses, rate, chosen.front_only, tuple(notes))

    def _sample_rate(self, count: int, rows: np.ndarray) -> float:
        data = self._variable("Data.SamplingRate")
        rates = self._array("Data.SamplingRate", len(data.shape)).reshape(-1)
        self._expect(len(rates) in (1, count), f"1 or {count} numbers in Data.SamplingRate", f"shape {data.shape}")
        rates = rates[rows] if len(rates) > 1 else rates
        self._expect(
            bool((rates == rates[0]).all()),
            "one Data.SamplingRate for all directions",
            f"{rates.min():g} to {rates.max():g} Hz",
        )
        rate = float(rates[0])
        self._expect(MIN_RATE <= rate <= MAX_RATE, f"a sample rate from {MIN_RATE:g} to {MAX_RATE:g} Hz", f"{rate:g}")
        return rate

    @staticmethod
    def _rows(data: Any, rows: np.ndarray) -> FloatArray:
        """Return the rows of a dataset in any order (h5py reads them in ascending order only)."""
        order = np.argsort(rows)
        values = np.empty((len(rows), *data.shape[1:]))
        values[order] = data[rows[order].tolist()]
        return values

    def _kind(self, key: str, attributes: Any, default: str) -> str:
        """Return whether a variable is spherical or cartesian. Units count more than the type."""
        kind, units = (self._text(attributes, name).lower() for name in ("Type", "Units"))
        self._expect(kind in ("spherical", "cartesian", ""), f"spherical or cartesian {key}", short_repr(kind))
        first = units.replace(",", " ").replace(";", " ").split()[:1]
        if first and first[0].startswith("deg"):
            return "spherical"
        kind = kind or ("cartesian" if first else default)
        if kind == "spherical":
            self._expect(not first, f"{key} in degrees and metres", short_repr(units))
        self._expect(not first or first[0] in _METRES, f"{key} in metres", short_repr(units))
        return kind

    def _values(self, key: str) -> FloatArray:
        """Return coordinates (rows, 3, columns); columns are measurements, or one for all."""
        data = self._variable(key)
        values = self._array(key, len(data.shape))
        values = values[np.newaxis] if values.ndim == 1 else values
        values = values[..., np.newaxis] if values.ndim == 2 else values
        self._expect(values.ndim == 3 and values.shape[1] == 3, f"{key} with 3 coordinates", f"shape {data.shape}")
        return values

    def _positions(self, key: str, count: int, default: str = "cartesian") -> FloatArray:
        """Return positions (count or 1, 3) in Cartesian coordinates (m)."""
        values = self._values(key)[..., 0]
        self._expect(len(values) in (1, count), f"1 or {count} rows in {key}", len(values))
        return _cartesian(values, self._kind(key, self._content[key].attrs, default))

    def _directions(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return azimuths, elevations (degrees) and distances (m) of all sources relative to the head."""
        positions = np.broadcast_to(self._positions("SourcePosition", count, "spherical"), (count, 3))
        if "EmitterPosition" in self._content and (emitter := self._values("EmitterPosition")).any():
            self._expect(emitter.shape[0] == 1 and emitter.shape[2] in (1, count), "one emitter", emitter.shape)
            kind = self._kind("EmitterPosition", self._content["EmitterPosition"].attrs, "cartesian")
            offset = _cartesian(emitter[0].T, kind)
            positions = positions + np.einsum(
                "mij,mi->mj", self._axes("Source", count), np.broadcast_to(offset, (count, 3))
            )
        if "ListenerPosition" in self._content:
            positions = positions - self._positions("ListenerPosition", count)
        local = np.einsum("mij,mj->mi", self._axes("Listener", count), positions)
        distance = np.linalg.norm(local, axis=1)
        self._expect(
            bool((distance > 0.05).all()), "sources at least 0.05 m from the listener", f"{distance.min():g} m"
        )
        elevation = np.degrees(np.arcsin(np.clip(local[:, 2] / distance, -1, 1)))
        azimuth = np.round(np.degrees(np.arctan2(local[:, 1], local[:, 0])), 6)
        azimuth[azimuth == -180.0] = 180.0
        return azimuth, elevation, distance

    def _axes(self, who: str, count: int) -> FloatArray:
        """Return the axes x, y, z (count, 3, 3) of the listener or source, from its view and up vectors."""
        view, up = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
        kind = "cartesian"
        if f"{who}View" in self._content:
            kind = self._kind(f"{who}View", self._content[f"{who}View"].attrs, "cartesian")
            view = self._vectors(f"{who}View", count, kind)
        if f"{who}Up" in self._content:
            attributes = self._content[f"{who}Up"].attrs
            labelled = bool(self._text(attributes, "Type") or self._text(attributes, "Units"))
            kind = self._kind(f"{who}Up", attributes, "cartesian") if labelled else kind
            up = self._vectors(f"{who}Up", count, kind)
            if not labelled and not np.linalg.norm(np.cross(view, up), axis=1).all():
                up = self._vectors(f"{who}Up", count, "cartesian")
        left = np.cross(up, view)
        size = np.linalg.norm(left, axis=1, keepdims=True)
        self._expect(bool((size > 1e-3).all()), f"{who}Up that is not parallel to {who}View", "parallel vectors")
        left = left / size
        axes = np.stack(np.broadcast_arrays(view, left, np.cross(view, left)), axis=1)
        return np.broadcast_to(axes, (count, 3, 3))

    def _vectors(self, key: str, count: int, kind: str) -> FloatArray:
        """Return unit vectors (count or 1, 3)."""
        values = self._values(key)[..., 0]
        self._expect(len(values) in (1, count), f"1 or {count} rows in {key}", len(values))
        if kind == "spherical" and not values[:, 2].any():  # a Cartesian vector without its type
            kind = "cartesian"
        vectors = _cartesian(values, kind)
        size = np.linalg.norm(vectors, axis=1, keepdims=True)
        self._expect(bool((size > 1e-6).all()), f"vectors that are not zero in {key}", "zero")
        return vectors / size

    def _ears(self, count: int, rows: np.ndarray) -> list[int]:
        """Return the receivers in the order left, right."""
        values = self._values("ReceiverPosition")
        self._expect(
            values.shape[0] == 2 and values.shape[2] in (1, count),
            "ReceiverPosition for two receivers",
            f"shape {values.shape}",
        )
        kind = self._kind("ReceiverPosition", self._content["ReceiverPosition"].attrs, "cartesian")
        values = values[..., rows] if values.shape[2] > 1 else values
        sides = np.stack([_cartesian(receiver.T, kind)[:, 1] for receiver in values])  # (2, A)
        apart = sides[0] - sides[1]
        self._expect(
            bool((np.abs(apart) > 0.01).all() and (np.sign(apart) == np.sign(apart[0])).all()),
            "one receiver on the left (positive y) and one on the right, the same in all measurements",
            f"y = {', '.join(f'{side:g}' for side in sides[:, 0])} m",
        )
        return [0, 1] if apart[0] > 0 else [1, 0]

    def _delayed(self, responses: FloatArray, count: int, rows: np.ndarray, ears: list[int]) -> FloatArray:
        """Return `responses` (A, 2, N) with `Data.Delay` (samples) applied, as far as the ears or directions differ."""
        if "Data.Delay" not in self._content:
            return responses
        shape = self._variable("Data.Delay").shape
        delays = self._array("Data.Delay", len(shape))
        delays = delays[np.newaxis] if delays.ndim == 1 else delays
        delays = delays[..., 0] if delays.ndim == 3 and delays.shape[2] == 1 else delays
        self._expect(
            delays.ndim == 2 and delays.shape[1] == 2 and len(delays) in (1, count),
            f"Data.Delay of shape (1, 2) or ({count}, 2)",
            f"shape {shape}",
        )
        delays = np.broadcast_to(delays, (count, 2))[rows][:, ears]
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


def _cartesian(values: FloatArray, kind: str) -> FloatArray:
    """Return positions (K, 3) in Cartesian coordinates."""
    if kind == "cartesian":
        return values
    azimuth, elevation = np.radians(values[:, 0]), np.radians(values[:, 1])
    flat = np.cos(elevation)
    return np.stack((np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)), axis=1) * values[:, 2:]
