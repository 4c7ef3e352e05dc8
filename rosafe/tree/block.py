"""Blocks of a signal: what processors hand each other, and where the first ones come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat


class Block(NamedTuple):
    """What one processor released; it is not written again, but by an only child whom nobody asks for it (`place`).

    Attributes
    ----------
    number : int
        Counts the input's blocks from 0.
    parts : tuple of ndarray
        Samples or frames along the last axis: an array for each part of the representation.
    next_index : int
        Index of the audio frame after the last one that this block knows of.
    signal : Signal
        Its format.
    extras : mapping of str to ndarray
        By-products for those children that need them, such as the envelope.
    """

    number: int
    parts: tuple[FloatArray, ...]
    next_index: int
    signal: SignalFormat
    extras: Mapping[str, FloatArray] = {}

    @property
    def data(self) -> FloatArray:
        """The first part, which is what children take."""
        return self.parts[0]

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.signal.rate


class Source(Protocol):
    """Where the input reads. Called with no lock of the tree's held, and `read` by one thread at a time.

    Attributes
    ----------
    sample_rate : float
        In Hz.
    ended : bool
        Nothing more will come; what has come may still be read.
    """

    sample_rate: float
    ended: bool

    def open(self, wake: Callable[[], None]) -> None:
        """From now on call `wake` whenever there may be a block to read, or the end. It returns at once.

        There may be one already: the tree looks once without being called.
        """

    def read(self) -> tuple[NDArray[Any], int] | None:
        """The next block, (2, n), and the index of the frame after it; None where there is none yet, or no more."""

    def stop(self) -> None:
        """Nobody will read any more."""
