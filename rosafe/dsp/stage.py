"""What all stages have in common: named parameters that change atomically, and checked blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from .checks import Check, positive
from .guard import FloatArray


class Parameter(NamedTuple):
    """Default and check of one parameter."""

    default: Any
    check: Check


FLOAT64 = np.dtype(np.float64)

ParameterTable = Mapping[str, Parameter]


class Stage:
    """One processor of the chain: blocks in, blocks out, state kept between.

    The rule for every stage: `_build`, and so `configure`, puts new objects in the place of what it changes (filters,
    framings, tables) and never alters those that are there. A shallow copy of a stage is therefore a second one that
    may be configured while the first one works; the tree tries changes on such copies, and may throw them away or put
    them to work with the state as it is then.

    Parameters
    ----------
    sample_rate : float
        Of the input, in Hz.
    **parameters
        By the names of `PARAMETERS`; what is not given has the default there.

    Raises
    ------
    ValueError
        One line that names the parameter.
    """

    PARAMETERS: ClassVar[ParameterTable]
    BLOCK: ClassVar[tuple[str, ...]] = ("2 ears", "channels", "samples")

    def __init__(self, sample_rate: float, **parameters: Any) -> None:
        self.sample_rate = positive("sample_rate", sample_rate)
        self._values = {name: parameter.default for name, parameter in self.PARAMETERS.items()}
        self._values = self._with(parameters)
        self._build(self._values, frozenset(self.PARAMETERS))

    @property
    def parameters(self) -> dict[str, Any]:
        """The values in force, in the order of the component's parameter structure."""
        return dict(self._values)

    @property
    def output_rate(self) -> float:
        """Samples or frames per second of the output (Hz)."""
        return self.sample_rate

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        """The output's shape without its last (time) axis, given the input's."""
        return rows

    def configure(self, **changes: Any) -> None:
        """Change parameters between blocks; a ValueError leaves everything as it was.

        A parameter that is set counts as changed even where it had the value already, as in the original.
        Which states start anew is said by each stage.
        """
        if changes:
            values = self._with(changes)
            self._build(values, frozenset(changes))
            self._values = values

    def process(self, block: FloatArray) -> FloatArray:
        """The output for the next block, (2, ..., N) of numbers: a fresh, contiguous float64 array.

        The input is not modified. ValueError for another shape or type.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Back to the state before the first block; parameters stay."""
        raise NotImplementedError

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        """Design for `values` and drop the states that the `changed` ones invalidate; ValueError before any effect.

        New objects replace the old ones: see the rule above.
        """
        raise NotImplementedError

    def _with(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """All values after `changes`, each checked."""
        for name in changes:
            if name not in self.PARAMETERS:
                raise ValueError(f"{name}: {type(self).__name__} has no such parameter")
        return self._merge({name: self.PARAMETERS[name].check(name, value) for name, value in changes.items()})

    def _merge(self, checked: dict[str, Any]) -> dict[str, Any]:
        return {**self._values, **checked}

    def _checked(self, block: Any) -> FloatArray:
        """`block` as contiguous float64 of the right shape, or ValueError."""
        array = np.asarray(block)
        if array.dtype is FLOAT64 and array.ndim == len(self.BLOCK) and len(array) == 2 and array.flags.c_contiguous:
            return array  # what comes from a stage: no time is lost on the rest
        if array.dtype.kind not in "iuf" or array.ndim != len(self.BLOCK) or array.shape[0] != 2:
            raise ValueError(f"block: {array.dtype} of shape {array.shape} is not numbers in ({', '.join(self.BLOCK)})")
        return np.asarray(array, np.float64, order="C")
