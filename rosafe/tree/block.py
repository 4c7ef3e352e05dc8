"""Blocks of a signal, which processors exchange, and the source of the first ones."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat


class Block(NamedTuple):
    """A block released by a processor.

    It is read-only, except that a sole child may overwrite it in place (`Processor.output_buffer_for`) if no other
    consumer needs it.

    Attributes
    ----------
    number : int
        Number of the input's block, from 0.
    parts : tuple of ndarray
        Samples or frames along the last axis: an array for each part of the representation.
    next_index : int
        Index of the audio frame after the last one that this block depends on.
    signal : SignalFormat
        The format of the block.
    extras : mapping of str to ndarray
        By-products that children need, such as the envelope.
    """

    number: int
    parts: tuple[FloatArray, ...]
    next_index: int
    signal: SignalFormat
    extras: Mapping[str, FloatArray] = {}

    @property
    def data(self) -> FloatArray:
        """The first part, which is the input of children."""
        return self.parts[0]

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.signal.rate


# Creates a block from all its attributes, without Python's constructor of named tuples.
new_block: Callable[[tuple[Any, ...]], Block] = functools.partial(tuple.__new__, Block)


class Source(Protocol):
    """The source of the input's blocks. The tree calls it without holding a lock, and `read` from one thread at a time.

    Attributes
    ----------
    sample_rate : float
        In Hz.
    ended : bool
        Whether no further sound will arrive; blocks that have arrived may still be read.
    waiting : bool
        Whether it has no further block now, and will call `wake` for the next one, or at the end.
    """

    sample_rate: float

    @property
    def ended(self) -> bool:
        """See the class."""

    @property
    def waiting(self) -> bool:
        """See the class."""

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float]) -> None:
        """Call `wake` from now on whenever there may be a block to read, or the end. `wake` returns immediately.

        The tree reads once without being woken, because a block may be there already.

        `required_frames()` returns how many frames the tree needs, in total from the first one, before the next awaited
        output can be complete; infinite if none is awaited, and 0 if it is unknown. A source of short blocks may read
        several as one until then.
        """

    def read(self) -> tuple[NDArray[Any], int] | None:
        """Return the next block, (2, n), and the index of the frame after it, or None if there is none."""

    def stop(self) -> None:
        """Stop: the tree reads no further block."""
