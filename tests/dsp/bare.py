"""Stages without the processor tree, and the division of a signal into blocks."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rosafe.dsp.stage import Output, Stage

FloatArray = NDArray[np.float64]


def cut(signal: NDArray[Any], sizes: int | Iterable[int]) -> list[NDArray[Any]]:
    """Split `signal` into blocks along its last axis. `sizes` are used cyclically; the last block is the remainder."""
    blocks: list[NDArray[Any]] = []
    position = 0
    for size in itertools.cycle([sizes] if isinstance(sizes, int) else sizes):
        if position >= signal.shape[-1]:
            return blocks
        blocks.append(signal[..., position : position + size])
        position += size
    return blocks


def single(output: Output) -> FloatArray:
    """Return the output of a stage with one part."""
    assert isinstance(output, np.ndarray)
    return output


def run(stage: Stage, blocks: Iterable[NDArray[Any]]) -> FloatArray:
    """Return the concatenated outputs of `stage` for `blocks`."""
    return np.concatenate([single(stage.process(block)) for block in blocks], axis=-1)


def joined(outputs: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the outputs of all blocks as one array per stage."""
    return {kind: np.concatenate([output[kind] for output in outputs], axis=-1) for kind in outputs[0]}
