"""`rosafe.to_xarray`: a result with named axes, their coordinates and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.missing import require
from rosafe.view.coordinates import EARS, along, check_result, frame_times

if TYPE_CHECKING:
    from xarray import Dataset

_UNITS = {"channel": "Hz", "filter": "Hz", "lag": "s"}


def to_xarray(result: Mapping[str, Any], sample_rate: float | None = None) -> Dataset:
    """A result as an xarray Dataset: named axes, coordinates and units.

    Parameters
    ----------
    result : mapping
        What `rosafe.process` or `rosafe.load` returned.
    sample_rate : float, optional
        Hz, for outputs without frames of results that tell neither times nor the rate.

    Returns
    -------
    xarray.Dataset
        A variable for each output, with its `units`. Its axes are `ear` (left, right), `channel` (centre frequencies in
        Hz), `lag` (s), `filter` (Hz), `feature` and `time` (s, the middle of each frame). Where outputs differ in
        these, the first one's is `time` and another's `time_ild`, as of lags and features; beside frames, samples
        have `time_samples`.

    Raises
    ------
    ValueError
        The result holds no output, or times cannot be told.
    ModuleNotFoundError
        xarray is not installed.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> result = rosafe.process(np.ones((2, 16000)), 16000, outputs=["ratemap"])
    >>> rosafe.to_xarray(result).ratemap.sel(ear="left").sel(channel=500, method="nearest").dims    # doctest: +SKIP
    ('time',)
    """
    xarray = require("xarray", "rosafe.to_xarray")
    check_result(result)
    coordinates: dict[str, tuple[str, Any, dict[str, str]]] = {}
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = {}
    there = [(k, name, part) for k in KINDS.values() for name, part in k.outputs.items() if name in result]
    framed = any(f"{kind.kind}_frameRate" in result for kind, _, _ in there)
    for kind, name, part in there:
        samples = framed and f"{kind.kind}_frameRate" not in result
        data = np.asarray(result[name])
        if data.ndim != len(part.axes):
            raise ValueError(f"{name} has shape {data.shape}, wanted are the axes {', '.join(part.axes)}")
        dims = []
        for axis, size in zip(part.axes, data.shape, strict=True):
            if axis == "ear":
                values: Any = list(EARS[:size])
            elif axis == "time":
                values = frame_times(result, kind, size, sample_rate)
            else:
                values = along(result, kind, axis, size)
            unit = "s" if axis == "time" else _UNITS.get(axis, "")
            first = "time_samples" if axis == "time" and samples else axis
            dims.append(_named(coordinates, first, f"{axis}_{kind.kind}", values, unit))
        variables[name] = (tuple(dims), data, {"units": part.unit, "long_name": kind.doc})
    if not variables:
        raise ValueError("the result holds no output")
    kept = ("sample_rate", "rosafe_version", "source")
    attributes = {name: result[name] for name in kept if name in result}
    return xarray.Dataset(variables, coordinates, attributes)


def _named(coordinates: dict[str, Any], first: str, other: str, values: Any, unit: str) -> str:
    """The name of an axis with these values, which is among the `coordinates` then: `first`, or that of a like."""
    likes = [name for name in coordinates if name.split("_")[0] == first]
    for name in (first, *likes, other):
        if name not in coordinates:
            coordinates[name] = (name, values, {"units": unit} if unit else {})
        if np.array_equal(coordinates[name][1], values):
            return name
    raise ValueError(f"{other}: an axis has values of two sorts")
