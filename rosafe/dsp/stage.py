"""The base class of stages: declared parameters that change atomically, checked blocks, derived formats."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.representation import Representation

from . import buffer_pool, kernels
from .copies import OwnState
from .numeric_limits import FloatArray
from .signal_format import SignalFormat

SAMPLE_RATE = Parameter.positive("sample_rate", REQUIRED, "Samples per second (Hz)", 1e9, unit="Hz")
FLOAT64 = np.dtype(np.float64)
Output = FloatArray | tuple[FloatArray, ...]  # a tuple if the representation has several parts


class Stage(OwnState):
    """The computation of a processor: it converts blocks to blocks and keeps its state between them.

    A representation is a subclass with a declaration. It implements `build`, `process` and `reset`. If the defaults do
    not fit, it also overrides `output_rows`, `output_format`, `output_count`, `look_ahead`, `required_extra`,
    `input_format_changed`, `state_size` or `block_size_dependent`.

    Rule: `build`, and therefore `configure` and `set_input_format`, replaces the objects that it changes (filters,
    framings, tables) and never modifies them. A shallow copy of a stage can therefore be configured while the original
    computes. The tree tries updates on such copies; it discards them, or uses them with the state of that moment.
    Copies by `copy.deepcopy` and `pickle` are independent.

    Parameters
    ----------
    input_format : SignalFormat or float
        The format of the blocks for `process`, or the sample rate (Hz) of sound.
    **parameters
        Values by their declared names; other parameters have their defaults.

    Attributes
    ----------
    values : dict of str to object
        The checked value of each parameter, by its name.
    provide : frozenset of str
        Those of the `EXTRAS` that the children need; `process` stores them in `provided`.
    provided : dict of str to ndarray
        The extras of the last block.

    Raises
    ------
    ValueError
        One line that names the parameter.
    """

    REPRESENTATION: ClassVar[Representation]
    DECLARED_WITHIN: ClassVar[Representation | None] = None  # of a variant: the names within the stage
    INPUT: ClassVar[tuple[str, ...]] = ("ear", "channel", "time")  # axes of the input blocks
    EXTRAS: ClassVar[tuple[str, ...]] = ()  # by-products for children, such as the envelope
    SUPPORTS_IN_PLACE: ClassVar[bool] = False  # `out` may be the input block
    TAKES_OUT: ClassVar[bool]  # whether `process` has the argument `out`; determined when the class is created
    CHANNEL_INDEPENDENT: ClassVar[bool] = False  # the output of a channel depends on no other one, to the last bit

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        cls.TAKES_OUT = callable(cls.process) and "out" in inspect.signature(cls.process).parameters

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        if isinstance(input_format, SignalFormat):
            SAMPLE_RATE.check(input_format.sample_rate)
        else:
            input_format = SignalFormat.sound(SAMPLE_RATE.check(input_format))
        self.input_format = input_format
        self.provide: frozenset[str] = frozenset()
        self.provided: dict[str, FloatArray] = {}
        declared = (self.DECLARED_WITHIN or self.REPRESENTATION).parameters
        self.values = {parameter.name: parameter.check(parameter.default) for parameter in declared}
        self.values = self._checked_values(parameters)
        self.build(self.values, frozenset(self.values))
        self._update_output_format()

    def __copy__(self) -> Stage:
        copied = object.__new__(type(self))
        vars(copied).update(vars(self))
        return copied

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return `parameters` of a stage with these checked values, as far as it does not depend on the sample rate.

        Raises ValueError for a combination of values that is invalid at all sample rates.
        """
        return dict(values)

    @classmethod
    def resolve_rate_defaults(
        cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float
    ) -> dict[str, Any]:
        """Return `values` with the defaults for this sample rate (Hz) of parameters that are not `given`.

        Only parameters declared with `follows_rate` have such defaults.
        """
        return dict(values)

    @classmethod
    def request_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return `values` as a request may hold them, to create an equal stage."""
        return dict(values)

    # --- properties -------------------------------------------------------------------------------------------

    @property
    def sample_rate(self) -> float:
        """The sample rate of the sound (Hz)."""
        return self.input_format.sample_rate

    @property
    def parameters(self) -> dict[str, Any]:
        """The current values, in the order of the component's parameter structure."""
        return dict(self.values)

    @property
    def derived(self) -> dict[str, Any]:
        """The values of the representation's `derived`, by name."""
        return {}

    @cached_property
    def output_format(self) -> SignalFormat:
        """The format of the output, computed from `input_format` and `values` and updated when they change."""
        return self.input_format

    @property
    def required_extra(self) -> str:
        """The name of the parent's extra that `process` needs with each block; empty for none."""
        return ""

    @property
    def block_size_dependent(self) -> bool:
        """Whether the output depends on block boundaries by more than rounding. Always assumed for plugins."""
        return False

    @property
    def look_ahead(self) -> int:
        """The number of input frames that must follow a frame before that frame can be output."""
        return 0

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        """Return the leading shape of the output (of its first part), without the time axis, for that of the input."""
        return rows

    def part_rows(self, rows: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """Return `output_rows` of each part."""
        return (self.output_rows(rows),)

    def state_size(self, rows: tuple[int, ...]) -> int:
        """Return the maximum number of numbers kept between blocks of leading shape `rows`, besides an input frame.

        Called before the state is allocated. Stages that keep only a few numbers per row need not override it.
        """
        return 0

    def output_count(self, count: int) -> int:
        """Return the number of samples or frames of output after `count` samples or frames of input since the start."""
        return max(0, count - self.look_ahead)

    # --- updates ----------------------------------------------------------------------------------------------

    def configure(self, **changes: Any) -> None:
        """Change parameters between blocks. A ValueError changes nothing.

        A parameter that is set counts as changed even if the value is the same, as in the original. Each stage
        documents which of its states a change resets.
        """
        self.reconfigure(self.input_format, [changes])

    def set_input_format(self, given: SignalFormat) -> None:
        """Change the format of the blocks after an update of the parent. A ValueError changes nothing."""
        self.reconfigure(given, ())

    def reconfigure(self, given: SignalFormat, changes: Collection[Mapping[str, Any]]) -> None:
        """Apply `set_input_format` and several calls of `configure` together: only the final state has to be valid."""
        if given == self.input_format and not any(changes):
            self.input_format = given
            return
        tried = copy.copy(self)
        tried.input_format = given
        changed: set[str] = set()
        for change in changes:
            tried.values = tried._checked_values(change)
            changed.update(self._parameter(name).name for name in change)
        if given != self.input_format:
            tried.input_format_changed(self.input_format)
        if changed:
            tried.build(tried.values, frozenset(changed))
        tried._update_output_format()
        self.__dict__.update(tried.__dict__)

    def input_format_changed(self, before: SignalFormat) -> None:
        """Recompute objects that depend on `input_format`, which was `before`; the rule of `build` applies.

        Override it if `build` uses the format. Only `process` detects a change of the number of rows.
        """

    def _update_output_format(self) -> None:
        """Recompute `output_format`. An equal format remains the same object, which is fast to compare."""
        before = self.__dict__.pop("output_format", None)
        if self.output_format == before:
            self.__dict__["output_format"] = before

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        """Compute filters and tables for `values`, and reset the states that the `changed` parameters invalidate.

        Raise ValueError before any change. Replace objects, do not modify them: see the rule of the class.
        """

    def _checked_values(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return all values after `changes`, each checked."""
        checked = {}
        for name, value in changes.items():
            parameter = self._parameter(name)
            checked[parameter.name] = parameter.check(value)
        return self._resolve_values(checked)

    def _parameter(self, name: str) -> Parameter:
        try:
            return (self.DECLARED_WITHIN or self.REPRESENTATION).parameter(name)
        except KeyError:
            raise ValueError(f"{name}: {type(self).__name__} has no such parameter") from None

    def _resolve_values(self, checked: dict[str, Any]) -> dict[str, Any]:
        return {**self.values, **checked}

    # --- blocks -----------------------------------------------------------------------------------------------

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        """Compute the output for the next block.

        Parameters
        ----------
        block : ndarray, (..., N)
            The parent's output. It must not be modified, except if it is `out`.
        extra : ndarray, optional
            The parent's by-product of the same block that `required_extra` names.
        out : ndarray, (..., M), optional
            Array for the output: evenly strided rows, each contiguous. It may be ignored. It can be `block` if the
            stage `SUPPORTS_IN_PLACE`: the output then stays in the cache. If `process` of a stage does not have this
            argument, it is called without it.

        Returns
        -------
        ndarray, (..., M), or tuple of ndarray
            A new contiguous float64 array, or one for each part; or `out`.

        Raises
        ------
        ValueError
            If the shape or type of a block is wrong.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Reset the state to that before the first block; keep the parameters."""

    def _output_array(self, shape: tuple[int, ...], out: FloatArray | None = None) -> FloatArray:
        """Return `out` if it is suitable for an output of this shape, otherwise a new array."""
        if out is None or out.shape != shape or out.dtype != FLOAT64 or not kernels.rows_evenly_strided(out):
            return buffer_pool.empty(shape)
        return out

    def _as_valid_block(self, block: Any) -> FloatArray:
        """Return `block` as contiguous float64. Raise ValueError if its shape or type is wrong."""
        axes = self.INPUT
        usable = type(block) is np.ndarray and block.dtype is FLOAT64 and block.flags.c_contiguous
        if usable and block.ndim == len(axes) and (axes[0] != "ear" or len(block) == self.input_format.ears):
            return block  # the usual case, output of a stage
        return _converted(block, axes, self.input_format.ears)


def _converted(block: Any, axes: tuple[str, ...], ears: int) -> FloatArray:
    """Convert `block` to contiguous float64. Raise ValueError if it does not have these `axes` and `ears`."""
    array = np.asarray(block)
    right = array.ndim == len(axes) and (axes[0] != "ear" or len(array) == ears)
    if not right or array.dtype.kind not in "iuf":
        of_ears = "1 ear" if ears == 1 else f"{ears} ears"
        shape = ", ".join(of_ears if axis == "ear" else f"{axis}s" for axis in (*axes[:-1], "sample"))
        raise ValueError(f"block: expected numbers of shape ({shape}), got {array.dtype} of shape {array.shape}")
    return np.asarray(array, np.float64, order="C")


def parts_of(output: Output) -> Sequence[FloatArray]:
    """Return the arrays of an output, one for each part."""
    return output if isinstance(output, tuple) else (output,)
