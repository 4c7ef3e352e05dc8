"""Write the results of `rosafe.localize` as CSV and JSON; read the yaw of a head and lists of recordings."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Iterator, Mapping
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.localization import angles
from rosafe.localization.streams import RATE
from rosafe.system.input import open_regular
from rosafe.system.terminal import printable

MAX_TABLE = 1 << 26  # bytes
MAX_LINES = 2_000_000
YAW_COLUMNS = ("time_s", "head_yaw_deg")
RECORDING_COLUMNS = ("file", "azimuth_deg")


def estimates_csv(result: Mapping[str, Any]) -> str:
    """Return one line for each window: `time_s, azimuth_deg, confidence, level_db`; an azimuth may be `nan`."""
    columns = (result["time"], result["azimuth"], result["confidence"], result["level_db"])
    lines = [
        f"{time:.3f},{azimuth:.1f},{sure:.4f},{level:.2f}" for time, azimuth, sure, level in zip(*columns, strict=True)
    ]
    return "\n".join(["time_s,azimuth_deg,confidence,level_db", *lines]) + "\n"


def tracks_csv(result: Mapping[str, Any]) -> str:
    """Return one line for each source and time: `id, time_s, azimuth_deg, azimuth_std_deg, probability`, and `speech`.

    The last column is present if streams were computed.
    """
    with_speech = any("speech" in track for track in result["tracks"])
    lines = ["id,time_s,azimuth_deg,azimuth_std_deg,probability" + (",speech" if with_speech else "")]
    for track in result["tracks"]:
        columns = [track["time"], track["azimuth"], track["azimuth_std"], track["probability"]]
        layout = "{:.3f},{:.1f},{:.1f},{:.4f}"
        if with_speech:
            columns.append(track["speech"])
            layout += ",{:.4f}"
        lines += [f"{track['id']}," + layout.format(*values) for values in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"


def stream_files(result: Mapping[str, Any], folder: Path) -> dict[Path, bytes]:
    """Return a WAV file for each track with a stream, and `streams.csv`: `file, id, start_s, azimuth_deg, speech`.

    The azimuth is that at the start, and the speech the mean probability, `nan` if it is unknown.
    """
    import soundfile

    files: dict[Path, bytes] = {}
    lines = ["file,id,start_s,azimuth_deg,speech"]
    for track in result["tracks"]:
        if not len(track["stream"]):
            continue
        name = f"source-{track['id']}.wav"
        with io.BytesIO() as file:
            soundfile.write(file, track["stream"], RATE, format="WAV", subtype="PCM_16")
            files[folder / name] = file.getvalue()
        start = track["stream_time"]
        azimuth = track["azimuth"][min(np.searchsorted(track["time"], start), len(track["time"]) - 1)]
        known = track["speech"][np.isfinite(track["speech"])]
        speech = float(known.mean()) if len(known) else math.nan
        lines.append(f"{name},{track['id']},{start:.3f},{azimuth:.1f},{speech:.4f}")
    return {**files, folder / "streams.csv": ("\n".join(lines) + "\n").encode()}


def as_json(result: Mapping[str, Any]) -> str:
    """Return estimates and tracks as JSON; an azimuth may be `null`."""

    def numbers(values: np.ndarray, digits: int) -> list[float | None]:
        return [None if math.isnan(value) else round(float(value), digits) for value in values]

    document = {
        "time_s": numbers(result["time"], 3),
        "azimuth_deg": numbers(result["azimuth"], 1),
        "confidence": numbers(result["confidence"], 4),
        "level_db": numbers(result["level_db"], 2),
        "tracks": [
            {
                "id": track["id"],
                "first_time_s": round(track["first_time"], 3),
                "last_time_s": round(track["last_time"], 3),
                "time_s": numbers(track["time"], 3),
                "azimuth_deg": numbers(track["azimuth"], 1),
                "azimuth_std_deg": numbers(track["azimuth_std"], 1),
                "probability": numbers(track["probability"], 4),
                **({"speech": numbers(track["speech"], 4)} if "speech" in track else {}),
            }
            for track in result["tracks"]
        ],
    }
    return json.dumps(document, allow_nan=False) + "\n"


def read_yaw(path: str | os.PathLike[str]) -> list[list[float]]:
    """Return [time in s, degrees] from a CSV file with the columns `time_s` and `head_yaw_deg`, such as a truth file.

    ValueError, one line that names the file and the line, if that is not possible.
    """
    points: list[list[float]] = []
    for number, (time, yaw) in _rows(path, YAW_COLUMNS):
        try:
            point = [float(time), float(yaw)]
        except ValueError:
            point = [math.nan, math.nan]
        if not abs(point[0]) <= angles.MAX_TIME or not angles.in_limits(point[1]):
            raise ValueError(
                f"{printable(path)}, line {number}: expected numbers in {', '.join(YAW_COLUMNS)}, up to "
                f"{angles.MAX_TIME:g} s and {angles.LIMITS}, got {short_repr(f'{time},{yaw}')}"
            )
        if points and point[0] < points[-1][0]:
            raise ValueError(f"{printable(path)}, line {number}: expected ascending times")
        if not points or point != points[-1]:  # a truth file has a line for each source
            points.append(point)
    if not points:
        raise ValueError(f"{printable(path)}: expected lines with {', '.join(YAW_COLUMNS)}, got none")
    return points


def read_recordings(path: str | os.PathLike[str]) -> list[tuple[str, float]]:
    """Return (file, azimuth in degrees) from a CSV file with these columns; files are relative to it."""
    folder = os.path.dirname(os.fspath(path))
    recordings = []
    for number, (file, azimuth) in _rows(path, RECORDING_COLUMNS):
        try:
            degrees = float(azimuth)
        except ValueError:
            degrees = math.nan
        if not file or not angles.in_limits(degrees):
            got = short_repr(f"{file},{azimuth}")
            raise ValueError(
                f"{printable(path)}, line {number}: expected a file and an azimuth {angles.LIMITS}, got {got}"
            )
        recordings.append((os.path.join(folder, os.path.expanduser(file)), degrees))
    if not recordings:
        raise ValueError(f"{printable(path)}: expected lines with {', '.join(RECORDING_COLUMNS)}, got none")
    return recordings


def _rows(path: str | os.PathLike[str], columns: tuple[str, str]) -> Iterator[tuple[int, tuple[str, str]]]:
    """Yield number and two columns of each line of a CSV file with a header."""
    name = printable(os.fspath(path))
    try:
        with TextIOWrapper(open_regular(path), "utf-8-sig", newline="") as file:
            if os.fstat(file.fileno()).st_size > MAX_TABLE:
                raise ValueError(f"expected at most {MAX_TABLE >> 20} MiB")
            rows = csv.reader(file)
            header = [cell.strip() for cell in next(rows, [])]
            missing = [column for column in columns if column not in header]
            if missing:
                got = short_repr(", ".join(header))
                raise ValueError(f"expected the columns {', '.join(columns)}, got {got}")
            places = [header.index(column) for column in columns]
            for number, row in enumerate(rows, 2):
                if number > MAX_LINES:
                    raise ValueError(f"expected at most {MAX_LINES} lines")
                if any(cell.strip() for cell in row):
                    if len(row) <= max(places):
                        raise ValueError(f"line {number}: expected {len(header)} columns, got {len(row)}")
                    yield number, (row[places[0]].strip(), row[places[1]].strip())
    except UnicodeDecodeError:
        raise ValueError(f"{name}: expected a CSV file in UTF-8, got other bytes") from None
    except (OSError, ValueError, csv.Error) as problem:
        raise ValueError(f"{name}: {getattr(problem, 'strerror', None) or printable(problem)}") from None
