"""What all stages have in common: declared parameters that change atomically, checked blocks, formats that follow."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from rosafe.vocabulary.parameter import REQUIRED, Parameter
from rosafe.vocabulary.representation import Representation

from . import kernels, memory
from .guard import FloatArray
from .signal import Signal

SAMPLE_RATE = Parameter(
    "sample_rate", "double", REQUIRED, "Samples per second (Hz)", 0.0, 1e9, open_minimum=True, unit="Hz"
)
FLOAT64 = np.dtype(np.float64)
Output = FloatArray | tuple[FloatArray, ...]  # a tuple where the representation has several parts


class Stage:
    """One processor of the chain: blocks in, blocks out, state kept between.

    A representation is a subclass with its declaration. It implements `_build`, `process`, `reset`, and what differs
    from the defaults here of `output_rows`, `_output`, `complete`, `look_ahead`, `needs`, `blocks_matter`.

    The rule for every stage: `_build`, and so `configure` and `receive`, puts new objects in the place of what it
    changes (filters, framings, tables) and never alters those that are there. A shallow copy of a stage is therefore a
    second one that may be configured while the first one works; the tree tries changes on such copies, and may throw
    them away or put them to work with the state as it is then.

    Parameters
    ----------
    given : Signal or float
        The format of the blocks that will come, or the sample rate (Hz) of sound.
    **parameters
        By their declared names; what is not given has its default.

    Attributes
    ----------
    given, output : Signal
        The formats of what comes and of what `process` returns.
    provide : frozenset of str
        Which of `PROVIDES` whoever hangs on it needs; `process` leaves these in `provided`.
    provided : dict of str to ndarray
        Of the last block.
    place : ndarray or None
        Where whoever drives it wants the output for the next block, if it fits: (..., N) with rows evenly apart, each
        in one piece. A stage that cannot write there returns another array, as always. Where the stage `OVERWRITES`, it
        may be the block that comes: what would be written to other memory stays in the cache.

    Raises
    ------
    ValueError
        One line that names the parameter.
    """

    REPRESENTATION: ClassVar[Representation]
    INPUT: ClassVar[tuple[str, ...]] = ("ear", "channel", "time")  # axes of the blocks that come
    PROVIDES: ClassVar[tuple[str, ...]] = ()  # by-products that children may need, such as the envelope
    OVERWRITES: ClassVar[bool] = False  # `place` may be the block that comes
    APART: ClassVar[bool] = False  # what it makes of a channel depends on no other one, not even in the last bit

    def __init__(self, given: Signal | float, **parameters: Any) -> None:
        if not isinstance(given, Signal):
            given = Signal.sound(SAMPLE_RATE.check(given))
        self.given = given
        self.provide: frozenset[str] = frozenset()
        self.provided: dict[str, FloatArray] = {}
        self.place: FloatArray | None = None
        declared = self.REPRESENTATION.parameters
        self._values = {parameter.name: parameter.check(parameter.default) for parameter in declared}
        self._values = self._with(parameters)
        self._build(self._values, frozenset(self._values))
        self.output = self._output()

    @classmethod
    def in_force(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """What `parameters` tells of a stage with these (checked) values, as far as no sample rate is needed for that.

        ValueError for values that go together at no sample rate.
        """
        return dict(values)

    @classmethod
    def at_rate(cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float) -> dict[str, Any]:
        """`values`, where the defaults of those not `given` that follow the sample rate (Hz) are what it makes of them.

        These parameters are declared with `follows_rate`.
        """
        return dict(values)

    @classmethod
    def asked(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """`values` as a request may hold them, without what only `in_force` tells: so one can be made like another."""
        return dict(values)

    # --- what it is -------------------------------------------------------------------------------------------

    @property
    def sample_rate(self) -> float:
        """Of the sound (Hz)."""
        return self.given.sample_rate

    @property
    def parameters(self) -> dict[str, Any]:
        """The values in force, in the order of the component's parameter structure."""
        return dict(self._values)

    @property
    def derived(self) -> dict[str, Any]:
        """The values of the representation's `derived`, by name."""
        return {}

    @property
    def needs(self) -> str:
        """Which of the parent's by-products `process` must be given with each block; empty for none."""
        return ""

    @property
    def blocks_matter(self) -> bool:
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

    def complete(self, count: int) -> int:
        """How many samples or frames it will have put out when `count` have come since the start."""
        return max(0, count - self.look_ahead)

    def _output(self) -> Signal:
        return self.given

    # --- changes ----------------------------------------------------------------------------------------------

    def configure(self, **changes: Any) -> None:
        """Change parameters between blocks; a ValueError leaves everything as it was.

        A parameter that is set counts as changed even where it had the value already, as in the original.
        Which states start anew is said by each stage.
        """
        self.become(self.given, [changes])

    def receive(self, given: Signal) -> None:
        """From now on blocks have the format `given`: the parent has changed. A ValueError changes nothing."""
        self.become(given, ())

    def become(self, given: Signal, changes: Collection[Mapping[str, Any]]) -> None:
        """`receive` and one `configure` after the other, at once: only what comes of it all must be possible."""
        if given == self.given and not any(changes):
            self.given = given
            return
        tried = copy.copy(self)
        tried.given = given
        changed: set[str] = set()
        for change in changes:
            tried._values = tried._with(change)
            changed.update(self._parameter(name).name for name in change)
        if given != self.given:
            tried._received(self.given)
        if changed:
            tried._build(tried._values, frozenset(changed))
        tried._follow()
        self.__dict__.update(tried.__dict__)

    def _received(self, before: Signal) -> None:
        """Design anew for `given`, which was `before`; the rule of `_build` holds.

        Where nothing depends on the format there is nothing to do; blocks of other rows are noticed by `process`.
        """

    def _follow(self) -> None:
        output = self._output()
        if output != self.output:
            self.output = output

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        """Design for `values` and drop the states that the `changed` ones invalidate; ValueError before any effect.

        New objects replace the old ones: see the rule above.
        """

    def _with(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """All values after `changes`, each checked."""
        checked = {}
        for name, value in changes.items():
            parameter = self._parameter(name)
            checked[parameter.name] = parameter.check(value)
        return self._merge(checked)

    def _parameter(self, name: str) -> Parameter:
        try:
            return self.REPRESENTATION.parameter(name)
        except KeyError:
            raise ValueError(f"{name}: {type(self).__name__} has no such parameter") from None

    def _merge(self, checked: dict[str, Any]) -> dict[str, Any]:
        return {**self._values, **checked}

    # --- blocks -----------------------------------------------------------------------------------------------

    def process(self, block: FloatArray, extra: FloatArray | None = None) -> Output:
        """The output for the next block, (..., N) of numbers: a contiguous float64 array, or one for each part.

        They are fresh, but for `place`.

        The input is not modified, but where it is `place`. `extra` is what `needs` names, of the same block. ValueError
        for another shape or type.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Back to the state before the first block; parameters stay."""

    def _room(self, shape: tuple[int, ...]) -> FloatArray:
        """Where to write an output of this shape: into `place`, if that is one for it."""
        place, self.place = self.place, None
        if place is None or place.shape != shape or place.dtype != FLOAT64 or not kernels.rows_apart(place):
            return memory.empty(shape)
        return place

    def _checked(self, block: Any) -> FloatArray:
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
