"""Functions for one representation, such as `rosafe.ratemap`; plugins have them, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rosafe.declarations.text import short_repr
from rosafe.interface import KINDS, functions
from rosafe.processing.process import process
from rosafe.results.result import Result
from rosafe.results.view.coordinates import EARS, axis_coordinates


class RepresentationArray(np.ndarray[Any, Any]):
    """An array with the coordinates of its axes.

    Attributes
    ----------
    axes : dict of str to ndarray
        The coordinates along each axis, by its name and in the order of the axes: `ear` (left, right), `channel` and
        `filter` (Hz), `lag` (s), `feature` (names, or indices) and `time` (s, the middle of each frame). Arrays that
        are computed from this one, such as slices, have none.
    """

    axes: dict[str, npt.NDArray[Any]]

    def __array_finalize__(self, source: Any) -> None:
        self.axes = {}

    def __reduce__(self) -> tuple[Any, ...]:
        function, arguments, state = tuple(super().__reduce__())
        return function, arguments, (state, self.axes)

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state[0])
        self.axes = state[1]


def _with_axes(result: Result, kind: str, name: str) -> RepresentationArray:
    array = result[name].view(RepresentationArray)
    known = {"ear": np.array(EARS[: len(array)]), "time": result[f"{kind}_time"]}
    for axis, size in zip(result.axes[name], array.shape, strict=True):
        array.axes[axis] = known[axis] if axis in known else axis_coordinates(result, KINDS[kind], axis, size)
    return array


def function_of(kind: str) -> Callable[..., Any]:
    """Return the function that computes one representation; arguments and docstring are those of its declaration."""
    declared = KINDS[kind]
    own = functions.arguments(declared)

    def function(sound: npt.ArrayLike, sample_rate: float, **given: Any) -> Any:
        parameters: dict[str, Any] = {}
        for argument, value in given.items():
            parameter = own.get(argument)
            name = argument if parameter is None else parameter.name
            if name in parameters:
                raise ValueError(f"{name}: expected one value, got {short_repr(value)} as another one")
            if value is not None or parameter is None or functions.default(parameter) is not None:
                parameters[name] = value
        result = process(sound, sample_rate, parameters=parameters, outputs=[kind])
        arrays = {name: _with_axes(result, kind, name) for name in declared.outputs}
        return arrays if len(arrays) > 1 else arrays[kind]

    function.__name__ = function.__qualname__ = kind
    function.__module__ = "rosafe"
    function.__doc__ = functions.documentation(declared, KINDS)
    function.__signature__ = functions.signature(declared)  # type: ignore[attr-defined]
    return function
