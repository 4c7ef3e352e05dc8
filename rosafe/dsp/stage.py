"""What all stages have in common: declared parameters that change atomically, checked blocks, formats that follow."""

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
from .numeric_limits import FloatArray
from .old_names import OldNames
from .signal_format import SignalFormat

SAMPLE_RATE = Parameter(
    "sample_rate", "double", REQUIRED, "Samples per second (Hz)", 0.0, 1e9, open_minimum=True, unit="Hz"
)
FLOAT64 = np.dtype(np.float64)
Output = FloatArray | tuple[FloatArray, ...]  # a tuple where the representation has several parts


class Stage(OldNames):
    """One processor of the chain: blocks in, blocks out, state kept between.

    A representation is a subclass with its declaration. It implements `build`, `process`, `reset`, and what differs
    from the defaults here of `output_rows`, `output_format`, `output_count`, `look_ahead`, `required_extra`,
    `input_format_changed`, `state_size`, `block_size_dependent`.

    The rule for every stage: `build`, and so `configure` and `set_input_format`, puts new objects in place of what it
    changes (filters, framings, tables) and never alters those that are there. A shallow copy of a stage is therefore a
    second one that may be configured while the first one works; the tree tries changes on such copies, and may throw
    them away or put them to work with the state as it is then.

    Parameters
    ----------
    input_format : Signal or float
        The format of the blocks that `process` gets, or the sample rate (Hz) of sound.
    **parameters
        By their declared names; what is not given has its default.

    Attributes
    ----------
    input_format : Signal
        The format of the blocks that `process` gets.
    values : dict of str to object
        The checked value of each parameter, by its name.
    provide : frozenset of str
        Which of `EXTRAS` the children need; `process` stores these in `provided`.
    provided : dict of str to ndarray
        The extras of the last block.

    Raises
    ------
    ValueError
        One line that names the parameter.
    """

    REPRESENTATION: ClassVar[Representation]
    DECLARED_WITHIN: ClassVar[Representation | None] = None  # of a variant: with the names that the stage itself uses
    INPUT: ClassVar[tuple[str, ...]] = ("ear", "channel", "time")  # axes of the blocks that come
    EXTRAS: ClassVar[tuple[str, ...]] = ()  # by-products that children may need, such as the envelope
    SUPPORTS_IN_PLACE: ClassVar[bool] = False  # `out` may be the input block
    TAKES_OUT: ClassVar[bool]  # whether `process` has the argument `out`; determined when the class is created
    CHANNEL_INDEPENDENT: ClassVar[bool] = (
        False  # what it makes of a channel depends on no other one, not even in the last bit
    )

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        cls.TAKES_OUT = callable(cls.process) and "out" in inspect.signature(cls.process).parameters

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        if not isinstance(input_format, SignalFormat):
            input_format = SignalFormat.sound(SAMPLE_RATE.check(input_format))
        self.input_format = input_format
        self.provide: frozenset[str] = frozenset()
        self.provided: dict[str, FloatArray] = {}
        declared = (self.DECLARED_WITHIN or self.REPRESENTATION).parameters
        self.values = {parameter.name: parameter.check(parameter.default) for parameter in declared}
        self.values = self._checked_values(parameters)
        self.build(self.values, frozenset(self.values))
        self._update_output_format()

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """What `parameters` tells of a stage with these (checked) values, as far as no sample rate is needed for that.

        ValueError for values that go together at no sample rate.
        """
        return dict(values)

    @classmethod
    def resolve_rate_defaults(
        cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float
    ) -> dict[str, Any]:
        """`values`, where the defaults of those not `given` that follow the sample rate (Hz) are what it makes of them.

        These parameters are declared with `follows_rate`.
        """
        return dict(values)

    @classmethod
    def request_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return `values` as a request may hold them, to create an equal stage."""
        return dict(values)

    # --- what it is -------------------------------------------------------------------------------------------

    @property
    def sample_rate(self) -> float:
        """Of the sound (Hz)."""
        return self.input_format.sample_rate

    @property
    def parameters(self) -> dict[str, Any]:
        """The values in force, in the order of the component's parameter structure."""
        return dict(self.values)

    @property
    def derived(self) -> dict[str, Any]:
        """The values of the representation's `derived`, by name."""
        return {}

    @cached_property
    def output_format(self) -> SignalFormat:
        """The format of what `process` returns; follows from `input_format` and `values`, and is updated after them."""
        return self.input_format

    @property
    def required_extra(self) -> str:
        """Which of the parent's `EXTRAS` `process` gets with each block; empty for none."""
        return ""

    @property
    def block_size_dependent(self) -> bool:
        """Whether the output depends on how sound is cut, beyond rounding. Plugins are not asked: theirs may."""
        return False

    @property
    def look_ahead(self) -> int:
        """How many frames of its input must have come after one before that one can be put out."""
        return 0

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        """The output's shape without its last (time) axis, given the input's; of the first part, if there are more."""
        return rows

    def part_rows(self, rows: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """`output_rows` of each part."""
        return (self.output_rows(rows),)

    def state_size(self, rows: tuple[int, ...]) -> int:
        """How many numbers it keeps between blocks of leading shape `rows`, at most, besides a frame of its input.

        Asked before anything of that size is made. Those that keep no more than a few for each row need not say so.
        """
        return 0

    def output_count(self, count: int) -> int:
        """The number of samples or frames returned after `count` samples or frames of input since the start."""
        return max(0, count - self.look_ahead)

    # --- changes ----------------------------------------------------------------------------------------------

    def configure(self, **changes: Any) -> None:
        """Change parameters between blocks; a ValueError leaves everything as it was.

        A parameter that is set counts as changed even where it had the value already, as in the original.
        Which states start anew is said by each stage.
        """
        self.reconfigure(self.input_format, [changes])

    def set_input_format(self, given: SignalFormat) -> None:
        """From now on blocks have the format `given`: the parent has changed. A ValueError changes nothing."""
        self.reconfigure(given, ())

    def reconfigure(self, given: SignalFormat, changes: Collection[Mapping[str, Any]]) -> None:
        """Apply `set_input_format` and several `configure` at once: only the final state has to be valid."""
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
        """Design again for `input_format`, which was `before`; the rule of `build` holds.

        Override it if something that `build` computes depends on the format. A change of the number of rows is noticed
        by `process` alone.
        """

    def _update_output_format(self) -> None:
        """Compute `output_format` again. An equal one remains the same object, which is quick to compare."""
        before = self.__dict__.pop("output_format", None)
        if self.output_format == before:
            self.__dict__["output_format"] = before

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        """Design for `values` and drop the states that the `changed` ones invalidate; ValueError before any effect.

        New objects replace the old ones: see the rule above.
        """

    def _checked_values(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """All values after `changes`, each checked."""
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
            Where the caller wants the output: evenly strided rows, each contiguous. It may be ignored. It can be
            `block` if the stage `SUPPORTS_IN_PLACE`: the output then stays in the cache. A stage whose `process` does
            not             have this argument is called without it.

        Returns
        -------
        ndarray, (..., M), or tuple of ndarray
            A new contiguous float64 array, or one for each part; or `out`.

        Raises
        ------
        ValueError
            For blocks of another shape or type.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Back to the state before the first block; parameters stay."""

    def _output_array(self, shape: tuple[int, ...], out: FloatArray | None = None) -> FloatArray:
        """`out` if it is suitable for an output of this shape, otherwise a new array."""
        if out is None or out.shape != shape or out.dtype != FLOAT64 or not kernels.rows_evenly_strided(out):
            return buffer_pool.empty(shape)
        return out

    def _as_valid_block(self, block: Any) -> FloatArray:
        """`block` as contiguous float64 of the right shape, or ValueError."""
        ears, dimensions = self.INPUT[0] == "ear", len(self.INPUT)
        quick = type(block) is np.ndarray and block.dtype is FLOAT64 and block.flags.c_contiguous
        if quick and block.ndim == dimensions and (not ears or len(block) == 2):
            return block  # what comes from a stage: no time is lost on the rest
        array = np.asarray(block)
        right = array.ndim == dimensions and (not ears or len(array) == 2)
        if not right or array.dtype.kind not in "iuf":
            axes = ", ".join("2 ears" if axis == "ear" else f"{axis}s" for axis in self.INPUT[:-1])
            raise ValueError(f"block: {array.dtype} of shape {array.shape} is not numbers in ({axes}, samples)")
        return np.asarray(array, np.float64, order="C")


def parts_of(output: Output) -> Sequence[FloatArray]:
    """The arrays of an output, one for each part."""
    return output if isinstance(output, tuple) else (output,)
