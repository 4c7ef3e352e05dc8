"""The formats of result files, by the suffix of the name."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from rosafe.interface import KINDS
from rosafe.results.result_metadata import Contents
from rosafe.results.writers import CsvWriter, H5Writer, Mat5Writer, Mat73Writer, NpzWriter, ResultWriter
from rosafe.system.input import open_regular
from rosafe.system.missing import require

MAX_MAT5 = 2**30  # bytes of a variable; the limit of MATLAB's version 5 is 2**31, and scipy copies an array
ZARR = "rosafe.load(RESULT).to_xarray().to_zarr(PATH) writes a .zarr of the contents of a .npz or .h5"
_OPTIONS = re.compile(rb"options\W+([0-9a-f]{32})")
_OPTIONS_WITHIN = 256  # bytes


@dataclass(frozen=True)
class Format:
    """A format of result files.

    Attributes
    ----------
    extension : str
    writer : callable
        Returns the class of its writer for given contents.
    begins : bytes
        The first bytes of its files.
    module : str
        A package that must be installed.
    """

    extension: str
    writer: Callable[[Contents], type[ResultWriter]]
    begins: bytes
    module: str = ""

    def is_one(self, path: Path) -> bool:
        """Return whether an existing file looks like a result of this format, or the beginning of one."""
        if not path.is_file():
            return False
        begin = _begin(path, len(self.begins))
        return self.begins.startswith(begin) or (self.begins.startswith(b"MATLAB") and not any(begin))


def _mat_writer(contents: Contents) -> type[ResultWriter]:
    largest = max((8 * math.prod(shape) for shape in contents.shapes.values()), default=0)
    return Mat73Writer if largest > MAX_MAT5 else Mat5Writer


FORMATS = {
    one.extension: one
    for one in (
        Format(".npz", lambda contents: NpzWriter, b"PK"),
        Format(".h5", lambda contents: H5Writer, b"\x89HDF", "h5py"),
        Format(".mat", _mat_writer, b"MATLAB"),
        Format(".csv", lambda contents: CsvWriter, b"# rosafe"),
    )
}


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format of a result file by the suffix of its name; ValueError if the suffix is unknown."""
    extension = Path(path).suffix.lower()
    if extension not in FORMATS:
        advice = f"; {ZARR}" if extension == ".zarr" else ""
        raise ValueError(f"{path}: expected a name that ends in {', '.join(FORMATS)}{advice}")
    return FORMATS[extension]


def check_format(file_format: Format, outputs: Collection[str]) -> None:
    """Raise ValueError if a format cannot store these outputs, or ModuleNotFoundError if its package is missing."""
    if file_format.module:
        require(file_format.module, f"{file_format.extension} files")
    if file_format.extension == ".csv":
        parts = [part for kind in outputs for part in KINDS[kind].outputs.values()]
        if len(parts) != 1 or len(parts[0].axes) != 2:
            possible = [kind for kind, one in KINDS.items() if [len(p.axes) for p in one.outputs.values()] == [2]]
            raise ValueError(
                f"outputs: expected for a .csv one output of two axes ({', '.join(possible)}), got {', '.join(outputs)}"
            )


def options_in(path: Path) -> str:
    """Return the digest of the options in a .mat or .csv; ValueError if it has none, OSError if it cannot be read."""
    found = _OPTIONS.search(_begin(path, _OPTIONS_WITHIN))
    if not found:
        raise ValueError("it has no digest of the options")
    return found[1].decode()


def _begin(path: Path, length: int) -> bytes:
    with open_regular(path) as file:
        return file.read(length)
