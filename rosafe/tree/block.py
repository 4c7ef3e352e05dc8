"""What processors hand each other: blocks of a signal, never written again once they are released."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from rosafe.dsp.guard import FloatArray
from rosafe.dsp.signal import Signal


class Block(NamedTuple):
    """What one processor released.

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
    signal: Signal
    extras: Mapping[str, FloatArray] = {}

    @property
    def data(self) -> FloatArray:
        """The first part, which is what children take."""
        return self.parts[0]

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.signal.rate
