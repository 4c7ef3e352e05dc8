"""`rosafe.process`: the whole chain on a signal in memory, on the same tree as the node, as fast as it goes."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.interface import KINDS, ComponentError, Parameter
from rosafe.tree import Processor, Tree
from rosafe.tree.zone import Block

DEFAULT_BLOCK = 12000  # frames, as InputProc's


class _ArraySource:
    """Feeds a signal to the tree block by block, once `open` says that the whole tree stands."""

    def __init__(self, signal: np.ndarray, sample_rate: float, sizes: Iterable[int]) -> None:
        self.sample_rate = sample_rate
        self._signal = signal
        self._sizes = iter(sizes)
        self._at = 0
        self._stopped = False
        self._gate = threading.Event()

    def open(self) -> None:
        """Let the signal flow."""
        self._gate.set()

    def read(self) -> tuple[np.ndarray, int] | None:
        self._gate.wait()
        if self._stopped or self._at >= self._signal.shape[1]:
            return None
        begin = self._at
        self._at = min(begin + next(self._sizes), self._signal.shape[1])
        return self._signal[:, begin : self._at], self._at

    def stop(self) -> None:
        self._stopped = True
        self._gate.set()


class _Collector:
    """Keeps what the wanted processors release, and the lags that go with a cross-correlation."""

    def __init__(self, wanted: set[str]) -> None:
        self.blocks: dict[str, list[np.ndarray]] = {kind: [] for kind in wanted}

    def added(self, processor: Processor) -> None:
        pass

    def executed(self, processor: Processor, seconds: float) -> None:
        pass

    def released(self, processor: Processor, block: Block) -> None:
        if processor.kind in self.blocks:
            self.blocks[processor.kind].append(block.data)

    def ended(self, processor: Processor) -> None:
        pass


def _all_parameters() -> dict[str, Parameter]:
    return {p.name: p for kind in KINDS.values() for p in kind.parameters}


def _checked(name: str, value: Any) -> tuple[str, Any]:
    """The real name and the checked value of one parameter, or ValueError."""
    for parameter in _all_parameters().values():
        if name == parameter.name or name in parameter.aliases:
            checked = parameter.check(value)
            if parameter.choices and checked not in parameter.choices:
                if checked != "jespen":  # the guide's slip for jepsen
                    raise ValueError(f"{name}: {checked!r} is unknown, allowed is {parameter.range_text}")
                checked = parameter.known_word(checked)
            return parameter.name, checked
    raise ValueError(f"unknown parameter {name!r}; there are: {', '.join(_all_parameters())}")


def _checked_signal(signal: Any) -> np.ndarray:
    array = np.asarray(signal)
    if array.ndim != 2 or array.shape[0] != 2:
        raise ValueError(f"signal has shape {array.shape}, wanted is (2, frames): left and right ear")
    if array.dtype == np.int32:
        return array
    if array.dtype.kind == "f":
        array = array.astype(np.float64)
        if not np.isfinite(array).all():
            raise ValueError("signal holds NaN or infinite samples")
        return array
    raise ValueError(f"signal is of type {array.dtype}, wanted is a float type or int32")


def _block_sizes(block_frames: int | Sequence[int]) -> Iterable[int]:
    sizes: list[Any] = list(block_frames) if isinstance(block_frames, (Sequence, np.ndarray)) else [block_frames]
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 0 for n in sizes)
    if not sizes or not whole or not any(sizes):
        raise ValueError(f"block_frames: {block_frames!r} is not a positive whole number, or a sequence of such")
    return itertools.cycle(int(n) for n in sizes)


def _needed(outputs: Sequence[str] | None) -> tuple[set[str], set[str]]:
    """The outputs to keep, and the processors to run for them."""
    if isinstance(outputs, str):
        outputs = [outputs]
    wanted = set(KINDS) if outputs is None else set(outputs)
    unknown = wanted - set(KINDS)
    if unknown:
        raise ValueError(f"unknown output {sorted(unknown)[0]!r}; there are: {', '.join(KINDS)}")
    run = set(wanted)
    for kind in wanted:
        while kind := KINDS[kind].parent:
            run.add(kind)
    return wanted, run


def _join(kind: str, blocks: list[np.ndarray], rows: tuple[int, ...]) -> np.ndarray:
    """All blocks along the last axis. Where the leading shape changed on the way, the largest rules.

    Lags are centred on lag zero, channels aligned at the first; what lies outside is 0.
    """
    if not blocks:
        return np.zeros((*rows, 0))
    if all(block.shape[:-1] == blocks[0].shape[:-1] for block in blocks):
        return np.concatenate(blocks, axis=-1)
    shape = tuple(max(sizes) for sizes in zip(*(block.shape[:-1] for block in blocks), strict=True))
    joined = np.zeros((*shape, sum(block.shape[-1] for block in blocks)))
    at = 0
    for block in blocks:
        place = [slice(0, size) for size in block.shape]
        place[-1] = slice(at, at + block.shape[-1])
        if kind == "crossCorrelation":
            first = (shape[1] - block.shape[1]) // 2
            place[1] = slice(first, first + block.shape[1])
        joined[tuple(place)] = block
        at += block.shape[-1]
    return joined


def process(
    signal: np.ndarray,
    sample_rate: float,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int | Sequence[int] = DEFAULT_BLOCK,
    modifications: Sequence[tuple[int, str, Any]] = (),
    outputs: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Compute auditory representations of a binaural signal.

    Parameters
    ----------
    signal : ndarray, shape (2, N), float or int32
        Left and right ear.
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Any of the original's parameter names (`in_*`, `pp_*`, `fb_*`, `ihc_*`, `ild_*`, `rm_*`, `cc_*`) and its value.
        The rest takes the interface table's defaults, but for `in_doNormalize`: True for int32, False for float.
    block_frames : int or sequence of int
        Block size, or sizes that are used in turn. The numbers do not depend on it.
    modifications : sequence of (block, name, value)
        Parameter changes, each made before the block of that number (from 0).
    outputs : sequence of str, optional
        The representations to return, of `input`, `preProc`, `gammatone`, `ihc`, `ild`, `ratemap`,
        `crossCorrelation`. All by default.

    Returns
    -------
    dict
        `input`, `preProc` (2, N); `gammatone`, `ihc` (2, C, N); `ild` (C, F) in dB; `ratemap` (2, C, F);
        `crossCorrelation` (C, L, F); `fb_cfHz` (C,) in Hz; `cc_lags` (L,) in seconds; `ild_frameRate`,
        `ratemap_frameRate`, `crossCorrelation_frameRate` in Hz. Where a change alters the number of lags or channels,
        L and C are the largest and what lies outside is 0; rates are the last ones.

    Raises
    ------
    ValueError
        For a parameter that does not exist, or a value of the wrong type or out of its range.
    """
    samples = _checked_signal(signal)
    rate = float(sample_rate)
    if not np.isfinite(rate) or rate <= 0:
        raise ValueError(f"sample_rate: {sample_rate!r} is not a positive number")
    sizes = _block_sizes(block_frames)
    values: dict[str, Any] = {"in_doNormalize": samples.dtype == np.int32}
    values.update(_checked(name, value) for name, value in (parameters or {}).items())
    changes = []
    for block, name, value in modifications:
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 0:
            raise ValueError(f"modifications: {block!r} is not a block number")
        changes.append((int(block), *_checked(name, value)))
    wanted, run = _needed(outputs)

    collector = _Collector(wanted)
    tree = Tree(collector)
    source = _ArraySource(samples, rate, sizes)
    try:
        _build(tree, source, run, values)
        for block, name, value in changes:
            tree.schedule(block, name, value)
        source.open()
        tree.wait_done()
        return _results(tree, collector)
    except ComponentError as problem:
        raise ValueError(str(problem)) from None
    finally:
        tree.stop()


def _build(tree: Tree, source: _ArraySource, run: set[str], values: Mapping[str, Any]) -> None:
    for kind in KINDS.values():  # parents come first in the table
        if kind.kind not in run and kind.parent:
            continue
        mine = {p.name: values[p.name] for p in kind.parameters if p.name in values}
        if kind.parent:
            tree.add(kind.kind, kind.kind, kind.parent, mine)
        else:
            tree.add_input(kind.kind, source, 1, 0.0, 0.0, mine)


def _results(tree: Tree, collector: _Collector) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for processor in tree.processors:
        kind = processor.kind
        if kind in collector.blocks:
            results[kind] = _join(kind, collector.blocks.pop(kind), processor.rows)
        if kind == "gammatone":
            results["fb_cfHz"] = np.array(processor.parameters()["fb_cfHz"])
        if kind in ("ild", "ratemap", "crossCorrelation"):
            results[f"{kind}_frameRate"] = processor.rate
        if kind == "crossCorrelation":
            longest = results[kind].shape[1] // 2
            results["cc_lags"] = np.arange(-longest, longest + 1) / tree.sample_rate
    return results
