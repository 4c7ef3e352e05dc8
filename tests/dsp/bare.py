"""Chains of stages without the processor tree: the default chain, and the division of a signal into blocks."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rosafe import interface
from rosafe.dsp.stage import Output, Stage
from rosafe.representations import STAGES
from rosafe.representations.filterbank import Filterbank
from rosafe.representations.haircell import InnerHairCell
from rosafe.representations.registry import CORE_KINDS

FloatArray = NDArray[np.float64]

KIND_OF = {p.name: kind.kind for kind in interface.CORE_REPRESENTATIONS.values() for p in kind.parameters}


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


class Chain:
    """All seven stages; `ihc` is the parent of the last three."""

    def __init__(self, sample_rate: float, parameters: Mapping[str, Any]) -> None:
        own: dict[str, dict[str, Any]] = {kind: {} for kind in CORE_KINDS}
        for name, value in parameters.items():
            own[KIND_OF[name]][name] = value
        self.stages = {kind: STAGES[kind](sample_rate, **own[kind]) for kind in CORE_KINDS}

    def process(self, block: NDArray[Any]) -> dict[str, FloatArray]:
        """Return the output of each stage for one block."""
        filterbank, hair_cell = self.stages["gammatone"], self.stages["ihc"]
        assert isinstance(filterbank, Filterbank)
        assert isinstance(hair_cell, InnerHairCell)
        filterbank.provide = frozenset({hair_cell.required_extra})
        out = {"input": single(self.stages["input"].process(block))}
        out["preProc"] = single(self.stages["preProc"].process(out["input"]))
        out["gammatone"] = filterbank.process(out["preProc"])
        out["ihc"] = hair_cell.process(out["gammatone"], filterbank.provided.get("envelope"))
        for kind in ("ild", "ratemap", "crossCorrelation"):
            out[kind] = single(self.stages[kind].process(out["ihc"]))
        return out

    def run(
        self, blocks: Sequence[NDArray[Any]], changes: Iterable[tuple[int, str, Any]] = ()
    ) -> list[dict[str, FloatArray]]:
        """Return the outputs by block. `changes` are (block index, parameter, value), applied before that block."""
        changes = list(changes)
        outputs = []
        for index, block in enumerate(blocks):
            for _, name, value in (change for change in changes if change[0] == index):
                self.stages[KIND_OF[name]].configure(**{name: value})
            outputs.append(self.process(block))
        return outputs


def joined(outputs: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the outputs of all blocks as one array per stage."""
    return {kind: np.concatenate([output[kind] for output in outputs], axis=-1) for kind in outputs[0]}
