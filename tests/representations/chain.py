"""Chains of stages without the processor tree, and the reference vectors of later kinds."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rosafe
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Output, Stage, parts_of
from rosafe.representations import KINDS, STAGES
from rosafe.representations.registry import CORE_KINDS
from tests import harness
from tests.dsp.bare import FloatArray, cut, joined


def kinds_of(name: str) -> list[str]:
    """Return the kinds with a parameter of this name or alias: both maps have the same ones."""
    found = [k.kind for k in KINDS.values() if any(name in (p.name, *p.aliases, *p.former) for p in k.parameters)]
    if not found:
        raise KeyError(name)
    return found


def with_ancestors(outputs: Iterable[str]) -> list[str]:
    """Return the kinds `outputs` and all their ancestors, parents first."""
    needed: set[str] = set()
    for kind in outputs:
        while kind and kind not in needed:
            needed.add(kind)
            kind = KINDS[kind].parent
    return [kind for kind in STAGES if kind in needed]


class Chain:
    """The stages of `outputs` and of all their ancestors, one of each kind.

    Parameters
    ----------
    given : SignalFormat or float
        The sample rate (Hz); with `root`, the output format of the parent of the root.
    outputs : iterable of str
        Kinds.
    parameters : mapping, optional
        Parameters of any stage, by name or alias.
    root : str, optional
        Begin with this kind instead of the input: blocks are outputs of its parent.
    """

    def __init__(
        self,
        given: SignalFormat | float,
        outputs: Iterable[str],
        parameters: Mapping[str, Any] | None = None,
        root: str = "",
    ) -> None:
        self.outputs = list(outputs)
        kinds = with_ancestors(self.outputs)
        if root:
            kinds = [kind for kind in kinds if root in with_ancestors([kind])]
        own: dict[str, dict[str, Any]] = {kind: {} for kind in kinds}
        for name, value in (parameters or {}).items():
            for kind in set(kinds_of(name)) & own.keys():
                own[kind][name] = value
        self.given = given
        self.stages: dict[str, Stage] = {}
        for kind in kinds:
            self.stages[kind] = STAGES[kind](self._comes_to(kind, self.stages), **own[kind])

    def _comes_to(self, kind: str, stages: Mapping[str, Stage]) -> SignalFormat | float:
        parent = stages.get(KINDS[kind].parent)
        return self.given if parent is None else parent.output_format

    def modify(self, name: str, value: Any) -> None:
        """Change one parameter between blocks, and update the stages below. A ValueError changes nothing.

        As in the tree, the change is first tried on shallow copies of the stages.
        """
        tried = {kind: copy.copy(stage) for kind, stage in self.stages.items()}
        for kind in set(kinds_of(name)) & tried.keys():
            tried[kind].configure(**{name: value})
        for kind, stage in tried.items():
            comes = self._comes_to(kind, tried)
            if isinstance(comes, SignalFormat):
                stage.set_input_format(comes)
        self.stages = tried

    def process(self, block: NDArray[Any], extra: NDArray[Any] | None = None) -> dict[str, Output]:
        """Return the output of each stage for one block. `extra` is for the root, whose parent does not exist."""
        for stage in self.stages.values():
            stage.provide = frozenset()
        for kind, stage in self.stages.items():
            if stage.required_extra and (parent := self.stages.get(KINDS[kind].parent)):
                assert stage.required_extra in parent.EXTRAS
                parent.provide |= {stage.required_extra}
        made: dict[str, Output] = {}
        for kind, stage in self.stages.items():
            parent = self.stages.get(KINDS[kind].parent)
            if parent is None:
                made[kind] = stage.process(block, extra)
                continue
            data = made[KINDS[kind].parent]
            assert not isinstance(data, tuple)
            made[kind] = stage.process(data, parent.provided[stage.required_extra] if stage.required_extra else None)
        return made

    def blocks(
        self, blocks: Iterable[NDArray[Any]], changes: Iterable[Sequence[Any]] = ()
    ) -> list[dict[str, FloatArray]]:
        """Return `outputs` for each block, by the names of `rosafe.process`: the parts of a kind are `<kind>_<part>`.

        `changes` are (block index, parameter, value), applied before that block.
        """
        changes, made = list(changes), []
        for index, block in enumerate(blocks):
            for _, name, value in (change for change in changes if change[0] == index):
                self.modify(name, value)
            of_stages = self.process(block)
            pairs = [zip(part_names(kind), parts_of(of_stages[kind]), strict=True) for kind in self.outputs]
            made.append(dict(itertools.chain(*pairs)))
        return made

    def run(
        self,
        signal: NDArray[Any],
        sizes: int | Sequence[int] | None = None,
        changes: Iterable[Sequence[Any]] = (),
    ) -> dict[str, FloatArray]:
        """Return the concatenated outputs for a signal (..., N) in blocks of `sizes`; see `blocks`."""
        return joined(self.blocks([signal] if sizes is None else cut(signal, sizes), changes))


def core_chain(sample_rate: float, parameters: Mapping[str, Any]) -> Chain:
    """Return all seven stages of the original; `ihc` is the parent of the last three."""
    return Chain(sample_rate, CORE_KINDS, parameters)


def part_names(kind: str) -> list[str]:
    """Return the names of the parts of a kind in the results of `rosafe.process`."""
    parts = KINDS[kind].parts
    return [kind] if len(parts) == 1 else [f"{kind}_{part.name}" for part in parts]


# --- vectors ----------------------------------------------------------------------------------------------------


def reference(name: str) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Return the expected results for a file of ../shared/vectors/more, and those of `rosafe.process`.

    Computed results are decimated as the expected ones; rates and coordinates have been compared.
    """
    cases = json.loads(harness.shared("vectors", "more", "manifest.json").read_text())
    (case,) = (case for case in cases if case["name"] == name)
    with np.load(harness.shared("vectors", "more", case["file"])) as arrays:
        stored = dict(arrays)
    options = {"parameters": case["params"], "block_frames": case["chunks"], "modifications": case["mods"]}
    got = rosafe.process(stored["signal"], case["fs"], outputs=case["outputs"], **options)
    for output, shape in case["full_shapes"].items():
        assert got[output].shape == tuple(shape)
    for output, axes in case["crops"].items():
        for axis in axes:
            got[output] = np.take(got[output], stored[f"{output}.idx{axis}"], axis)
    for coordinate, expected in case["axes"].items():
        if coordinate not in got:
            continue  # fb_cfHz, if the filterbank is not an output
        found = got[coordinate]
        if coordinate in ("ac_lags", "prec_lags"):
            found = [len(found), found[-1] if coordinate == "ac_lags" else found[0]]
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=0, err_msg=coordinate)
    return {output: stored[output] for output in case["full_shapes"]}, got
