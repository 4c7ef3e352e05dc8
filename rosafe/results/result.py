"""The result of offline processing: a mapping that knows its parameters, axes and units."""

from __future__ import annotations

import copy
import html
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.interface.arguments import needed
from rosafe.results.formats import check_format, format_of
from rosafe.results.result_metadata import Contents
from rosafe.results.view.dataset import to_xarray
from rosafe.results.view.plot import plot
from rosafe.system.output import new_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

# attributes by the names of the same values in files
_ATTRIBUTES = {
    **{name: name for name in ("parameters", "sample_rate", "clipped", "axes", "units")},
    "rosafe_version": "version",
}
_MAX_VALUES = 8  # of a parameter that are shown


class Result(dict[str, Any]):
    """The outputs and coordinates by name, as `rosafe.process` and `rosafe.load` return them.

    The attributes can also be read as entries (`result["parameters"]`, and `version` as `rosafe_version`), but
    iteration omits them. `copy` and `|` return a `Result`, with the attributes of the left one.

    Parameters
    ----------
    entries : mapping
        Outputs and coordinates; further options of the run, such as `block_frames`.
    parameters, sample_rate, version, clipped
        The attributes of these names.

    Attributes
    ----------
    parameters : dict of str to object
        All parameters in effect: given values, defaults, and values that follow the sample rate. `rosafe.process`
        accepts them as `parameters`. After modifications they are the last values.
    sample_rate : float
        Of the signal (Hz).
    version : str
        The version of rosafe that computed the result.
    axes : dict of str to tuple of str
        The names of the axes of each output.
    units : dict of str to str
        The unit of each output and coordinate; empty for numbers without one.
    clipped : int
        Number of samples of the sound file that were limited to full scale.
    """

    def __init__(
        self,
        entries: Mapping[str, Any],
        *,
        parameters: Mapping[str, Any],
        sample_rate: float,
        version: str,
        clipped: int = 0,
    ) -> None:
        super().__init__({name: value for name, value in entries.items() if name not in _ATTRIBUTES})
        self.parameters = dict(parameters)
        self.sample_rate = float(sample_rate)  # files contain whole rates as integers
        self.version = version
        self.clipped = clipped

    def __missing__(self, name: str) -> Any:
        if name in _ATTRIBUTES:
            return getattr(self, _ATTRIBUTES[name])
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in _ATTRIBUTES

    def get(self, name: str, default: Any = None) -> Any:
        """Return an entry or an attribute by name."""
        try:
            return self[name]
        except KeyError:
            return default

    def copy(self) -> Result:
        """Return a shallow copy."""
        return copy.copy(self)

    def __or__(self, other: Any) -> Result:  # type: ignore[override]
        return self.copy().__ior__(other) if isinstance(other, Mapping) else NotImplemented

    def __ror__(self, other: Any) -> Result:  # type: ignore[override]
        merged = self.copy()
        merged.clear()
        merged.update(other)
        return merged.__ior__(self)

    @property
    def kinds(self) -> list[str]:
        """The kinds of representations whose outputs it contains."""
        return [kind for kind, declared in KINDS.items() if any(name in self for name in declared.outputs)]

    @property
    def axes(self) -> dict[str, tuple[str, ...]]:
        """The names of the axes of each output."""
        return {name: part.axes for kind in self.kinds for name, part in KINDS[kind].outputs.items() if name in self}

    @property
    def units(self) -> dict[str, str]:
        """The unit of each output and coordinate."""
        units: dict[str, str] = {}
        for kind in KINDS.values():
            units |= {f"{kind.kind}_time": "s", f"{kind.kind}_frameRate": "Hz"}
            units |= kind.units | {name: part.unit for name, part in kind.outputs.items()}
        return {name: units[name] for name in self if name in units}

    def plot(self, outputs: Sequence[str] | str | None = None, ax: Axes | None = None, **options: Any) -> Figure:
        """Plot outputs over time.

        Parameters
        ----------
        outputs, ax, **options
            As of `rosafe.plot`.

        Returns
        -------
        matplotlib.figure.Figure
            As of `rosafe.plot`.
        """
        return plot(self, outputs, ax, **options)

    def to_xarray(self) -> Dataset:
        """Return an xarray Dataset, as `rosafe.to_xarray`."""
        return to_xarray(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file. An existing file is replaced.

        Parameters
        ----------
        path : path
            The end of its name (.npz, .h5, .mat, .csv) selects the format. `rosafe.load` reads .npz and .h5.

        Raises
        ------
        ValueError
            The suffix is unknown, or the format cannot store these outputs.
        rosafe.system.output.OutputError
            The file cannot be written.
        ModuleNotFoundError
            h5py is not installed.
        """
        file_format = format_of(path)
        check_format(file_format, self.kinds)
        contents = self._contents()
        writer_class = file_format.writer(contents)
        with new_path(Path(path), replace=True) as part, closing(writer_class(part, contents)) as writer:
            for name in self.axes:
                writer.append(name, np.asarray(self[name], np.float64))
            writer.finish()

    def _contents(self) -> Contents:
        axes, units = self.axes, self.units
        times = {f"{kind}_time" for kind in self.kinds if f"{kind}_frameRate" not in self}  # of samples: not stored
        coordinates = {name: self[name] for name in self if name in units.keys() - axes.keys() - times}
        names = {name: value for name, value in coordinates.items() if isinstance(value, list)}
        options = ("source", "block_frames", "channels", "topic", "pad", "clip")
        about = {name: self[name] for name in options if name in self}
        about |= {"rosafe_version": self.version, "sample_rate": self.sample_rate, "parameters": self.parameters}
        about |= {"clipped": self.clipped, **names}
        if any(self[name].dtype == np.float32 for name in axes):
            about["dtype"] = "float32"
        return Contents(
            {name: self[name].shape for name in axes},
            axes,
            {name: units[name] for name in axes},
            {name: value for name, value in coordinates.items() if name not in names},
            about,
        )

    def __repr__(self) -> str:
        outputs = ", ".join(f"{name} {np.shape(self[name])}{unit}" for name, unit in self._outputs())
        return f"<rosafe.Result at {self.sample_rate:g} Hz: {outputs or 'no outputs'}>"

    def _outputs(self) -> Iterator[tuple[str, str]]:
        units = self.units
        return ((name, f" {units[name]}".rstrip()) for name in self.axes)

    def _repr_html_(self) -> str:
        """Return tables of outputs, coordinates and parameters, for notebooks."""
        axes, units = self.axes, self.units
        rows = [[name, _shape(self[name]), ", ".join(axes[name]), units[name]] for name in axes]
        others = [[name, _shape(self[name]), "", units[name]] for name in units if name not in axes]
        used = {p.name: p.unit for kind in needed(self.kinds) for p in KINDS[kind].parameters}
        known = self.parameters
        parameters = [[name, _short(known[name]), unit] for name, unit in used.items() if name in known]
        clipped = f", {self.clipped} samples clipped" if self.clipped else ""
        title = f"rosafe {html.escape(self.version)}, {self.sample_rate:g} Hz{clipped}"
        return (
            f"<p>{title}</p>{_table(('output', 'shape', 'axes', 'unit'), rows + others)}"
            f"<details><summary>parameters</summary>{_table(('parameter', 'value', 'unit'), parameters)}</details>"
        )


def _shape(value: Any) -> str:
    return " x ".join(map(str, np.shape(value))) or f"{value:g}"


def _short(value: Any) -> str:
    values = list(value) if isinstance(value, (list, tuple)) else [value]
    texts = [f"{one:g}" if isinstance(one, float) else str(one) for one in values[:_MAX_VALUES]]
    return ", ".join(texts) + (", ..." if len(values) > _MAX_VALUES else "")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["".join(f"<td>{html.escape(text)}</td>" for text in row) for row in rows]
    header = "".join(f"<th>{text}</th>" for text in head)
    return f"<table><tr>{header}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
