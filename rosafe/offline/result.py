"""The result of offline processing: a mapping that knows its parameters, axes and units."""

from __future__ import annotations

import copy
import html
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rosafe.interface import KINDS
from rosafe.offline.chain import needed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

_MAX_VALUES = 8  # of a parameter that are shown


class Result(dict[str, Any]):
    """The outputs and coordinates by name, as `rosafe.process` and `rosafe.load` return them.

    The attributes are entries, too: `version` as `rosafe_version`, and `axes` and `units` for the outputs. `copy` and
    `|` return a `Result`.

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
        super().__init__(entries)
        self["parameters"], self["sample_rate"] = dict(parameters), float(sample_rate)  # whole rates are int in files
        self["rosafe_version"], self["clipped"] = version, clipped
        self._describe_outputs()

    def _describe_outputs(self) -> None:
        axes, units = self.axes, self.units
        self["axes"] = {**self.get("axes", {}), **axes}
        self["units"] = {**self.get("units", {}), **{name: units[name] for name in axes}}

    def copy(self) -> Result:
        """Return a shallow copy."""
        return copy.copy(self)

    def __or__(self, other: Mapping[str, Any]) -> Result:  # type: ignore[override]
        return self.copy().__ior__(other) if isinstance(other, Mapping) else NotImplemented

    def __ror__(self, other: Mapping[str, Any]) -> Result:  # type: ignore[override]
        return self | {name: value for name, value in other.items() if name not in self}

    def __ior__(self, other: Any) -> Result:  # type: ignore[override, misc]
        self.update(other)
        self._describe_outputs()
        return self

    @property
    def parameters(self) -> dict[str, Any]:
        return cast(dict[str, Any], self["parameters"])

    @property
    def sample_rate(self) -> float:
        return cast(float, self["sample_rate"])

    @property
    def version(self) -> str:
        return cast(str, self["rosafe_version"])

    @property
    def clipped(self) -> int:
        return cast(int, self["clipped"])

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
        import rosafe

        return rosafe.plot(self, outputs, ax, **options)

    def to_xarray(self) -> Dataset:
        """Return an xarray Dataset, as `rosafe.to_xarray`."""
        import rosafe

        return rosafe.to_xarray(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file that `rosafe.load` reads. An existing file is replaced.

        Parameters
        ----------
        path : path
            The end of its name (.npz, .h5, .mat, .zarr, .csv) selects the format.

        Raises
        ------
        ValueError
            The suffix is unknown, or the format cannot store these outputs.
        rosafe.output.OutputError
            The file cannot be written.
        ModuleNotFoundError
            h5py or zarr is not installed.
        """
        from rosafe.offline.formats import save

        save(self, path)

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
