"""`rosafe.to_xarray`: a result as an xarray dataset with named axes, coordinates and units."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rosafe.interface import KINDS, Representation
from rosafe.results.view.coordinates import EARS, axis_coordinates, check_result, frame_times
from rosafe.system.missing import require

if TYPE_CHECKING:
    from xarray import Dataset

_UNITS = {"channel": "Hz", "filter": "Hz", "lag": "s", "time": "s"}


def to_xarray(result: Mapping[str, Any], sample_rate: float | None = None) -> Dataset:
    """Return a result as an xarray Dataset: named axes, coordinates and units.

    Parameters
    ----------
    result : mapping
        A result of `rosafe.process` or `rosafe.load`.
    sample_rate : float, optional
        Hz, for outputs without frames if the result has neither times nor a sample rate.

    Returns
    -------
    xarray.Dataset
        A variable for each output, with its `units`. Its axes are `ear` (left, right), `channel` (centre frequencies in
        Hz), `lag` (s), `filter` (Hz), `feature` and `time` (s, the centre of each frame). If outputs differ in their
        times, the axis of the first one is `time` and that of another one, for example, `time_ild`; the same holds for
        lags and features. If there are outputs with frames, the axis of samples is `time_samples`. Its attributes
        are `sample_rate` (Hz), `rosafe_version` and `parameters` (JSON).

    Raises
    ------
    ValueError
        The result contains no output, or its times are not known.
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
    found = [(k, name, part) for k in KINDS.values() for name, part in k.outputs.items() if name in result]
    any_frames = any(f"{kind.kind}_frameRate" in result for kind, _, _ in found)
    for kind, name, part in found:
        data = np.asarray(result[name])
        if data.ndim != len(part.axes):
            raise ValueError(f"{name}: expected the axes {', '.join(part.axes)}, got an array of shape {data.shape}")
        time_name = "time_samples" if any_frames and f"{kind.kind}_frameRate" not in result else "time"
        dims = []
        for axis, size in zip(part.axes, data.shape, strict=True):
            values = _coordinates(result, kind, axis, size, sample_rate)
            first = time_name if axis == "time" else axis
            dims.append(_add_axis(coordinates, first, f"{axis}_{kind.kind}", values, _UNITS.get(axis, "")))
        variables[name] = (tuple(dims), data, {"units": part.unit, "long_name": kind.doc})
    if not variables:
        raise ValueError("result: expected at least one output, got none")
    return xarray.Dataset(variables, coordinates, _attributes(result))


def _attributes(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of the dataset."""
    attributes = {name: result[name] for name in ("sample_rate", "rosafe_version", "source") if name in result}
    parameters = getattr(result, "parameters", None)
    if parameters is not None:
        attributes["parameters"] = json.dumps(parameters)
    return attributes


def _coordinates(
    result: Mapping[str, Any], kind: Representation, axis: str, size: int, sample_rate: float | None
) -> Any:
    if axis == "ear":
        return list(EARS[:size])
    if axis == "time":
        return frame_times(result, kind, size, sample_rate)
    return axis_coordinates(result, kind, axis, size)


def _add_axis(coordinates: dict[str, Any], first: str, other: str, values: Any, unit: str) -> str:
    """Return the name of the axis with these values: `first`, an existing one or `other`, which is added."""
    similar = [name for name in coordinates if name.split("_")[0] == first]
    for name in (first, *similar, other):
        if name not in coordinates:
            coordinates[name] = (name, values, {"units": unit} if unit else {})
        if np.array_equal(coordinates[name][1], values):
            return name
    raise ValueError(f"{other}: the outputs of the kind have different coordinates")
