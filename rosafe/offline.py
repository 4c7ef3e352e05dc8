"""`rosafe.process`: the whole chain on a signal in memory, on the same tree as the node, as fast as it goes."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.interface import KINDS, REQUIRED, ComponentError, Parameter
from rosafe.tree import Processor, Tree
from rosafe.tree.zone import Block

DEFAULT_BLOCK = 12000  # frames, as InputProc's

_SAMPLE_RATE = Parameter("sample_rate", "double", REQUIRED, "Samples per second (Hz)", 0.0, 1e9, open_minimum=True)
_PARAMETERS = {name: p for kind in KINDS.values() for p in kind.parameters for name in (p.name, *p.aliases)}


class _ArraySource:
    """Feeds a signal to the tree, cut after the frames `ends`, once `open` says that the whole tree stands."""

    def __init__(self, signal: np.ndarray, sample_rate: float, ends: list[int]) -> None:
        self.sample_rate = sample_rate
        self._signal = signal
        self._cuts = itertools.pairwise((0, *ends))
        self._stopped = False
        self._gate = threading.Event()

    def open(self) -> None:
        """Let the signal flow."""
        self._gate.set()

    def read(self) -> tuple[np.ndarray, int] | None:
        self._gate.wait()
        cut = None if self._stopped else next(self._cuts, None)
        return (self._signal[:, slice(*cut)], cut[1]) if cut is not None else None

    def stop(self) -> None:
        self._stopped = True
        self._gate.set()


class _Run:
    """Keeps what the wanted processors release, and the first error, which ends the run."""

    def __init__(self, wanted: set[str], source: _ArraySource) -> None:
        self.blocks: dict[str, list[np.ndarray]] = {kind: [] for kind in wanted}
        self._source = source
        self.processors: list[Processor] = []
        self._error: BaseException | None = None

    def added(self, processor: Processor) -> None:
        self.processors.append(processor)

    def executed(self, processor: Processor, seconds: float) -> None:
        pass

    def released(self, processor: Processor, block: Block) -> None:
        if processor.kind in self.blocks:
            self.blocks[processor.kind].append(block.data)

    def ended(self, processor: Processor) -> None:
        if processor.error is not None:
            self._error = self._error or processor.error
            self._source.stop()

    def wait(self) -> None:
        """Wait until every processor has ended; raises what one failed with."""
        for processor in self.processors:
            processor.join()
        if self._error is not None:
            raise self._error


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
        Block size, or sizes that are used in turn; the last block is what is left. Only where gain control
        (`pp_bNormalizeRMS`) starts do the numbers depend on it.
    modifications : sequence of (block, name, value)
        Parameter changes, each made before the block of that number (from 0); several for one block are made in the
        order given. Those for blocks that never come are ignored.
    outputs : sequence of str, optional
        The representations to return, of `input`, `preProc`, `gammatone`, `ihc`, `ild`, `ratemap`,
        `crossCorrelation`. All by default. What none of them depends on is not computed.

    Returns
    -------
    dict
        `input`, `preProc` (2, N); `gammatone`, `ihc` (2, C, N); `ild` (C, F) in dB; `ratemap` (2, C, F);
        `crossCorrelation` (C, L, F); `fb_cfHz` (C,) in Hz; `cc_lags` (L,) in seconds; `ild_frameRate`,
        `ratemap_frameRate`, `crossCorrelation_frameRate` in Hz. Where a change alters the number of lags or channels,
        L and C are the largest and what lies outside is 0; rates and `fb_cfHz` are the last ones.

    Raises
    ------
    ValueError
        For anything that cannot be: a signal of the wrong shape or type or with samples that are not finite, a
        parameter or output that does not exist, a value of the wrong type or out of its range.
    """
    samples = _checked_signal(signal)
    rate = _SAMPLE_RATE.check(sample_rate)
    ends = _block_ends(block_frames, samples.shape[1])
    values = {"in_doNormalize": samples.dtype == np.int32, **_checked_parameters(parameters)}
    changes = _checked_modifications(modifications)
    wanted, needed = _needed(outputs)

    source = _ArraySource(samples, rate, ends)
    run = _Run(wanted, source)
    tree = Tree(run)
    try:
        _build(tree, source, needed, values)
        for block, name, value in changes:
            if block < len(ends):
                tree.schedule(block, name, value)
        source.open()
        run.wait()
        return _results(tree, run)
    except ComponentError as problem:
        raise ValueError(str(problem)) from None
    finally:
        tree.stop()
        for processor in run.processors:
            processor.join()


# --- arguments ---


def _checked_signal(signal: Any) -> np.ndarray:
    try:
        array = np.asarray(signal)
    except ValueError as problem:
        raise ValueError(f"signal is no array: {problem}") from None
    if array.ndim != 2 or array.shape[0] != 2:
        raise ValueError(f"signal has shape {array.shape}, wanted is (2, frames): left and right ear")
    if array.dtype.kind == "i" and array.dtype.itemsize == 4:
        return np.asarray(array, np.int32)
    if array.dtype.kind != "f":
        raise ValueError(f"signal is of type {array.dtype}, wanted is a float type or int32")
    with np.errstate(over="ignore"):  # a long double beyond the range of double becomes infinite
        array = np.asarray(array, np.float64)
    if not np.isfinite(array).all():
        raise ValueError("signal holds NaN or infinite samples")
    return array


def _block_ends(block_frames: Any, frames: int) -> list[int]:
    """The end of each block of a signal of so many frames."""
    several = isinstance(block_frames, (Sequence, np.ndarray)) and not isinstance(block_frames, (str, bytes))
    sizes = list(block_frames) if several else [block_frames]
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n > 0 for n in sizes)
    if not sizes or not whole:
        raise ValueError(f"block_frames: {block_frames!r} is not a positive whole number, or a sequence of such")
    ends = itertools.accumulate(itertools.cycle(map(int, sizes)))
    return [*itertools.takewhile(lambda end: end < frames, ends), frames] if frames else []


def _checked_parameters(parameters: Any) -> dict[str, Any]:
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters: {type(parameters).__name__} is not a dict of names and values")
    return dict(_checked_value(name, value) for name, value in parameters.items())


def _checked_value(name: Any, value: Any) -> tuple[str, Any]:
    """The real name and the checked value of one parameter."""
    if not isinstance(name, str) or name not in _PARAMETERS:
        known = ", ".join(p.name for kind in KINDS.values() for p in kind.parameters)
        raise ValueError(f"unknown parameter {name!r}; there are: {known}")
    parameter = _PARAMETERS[name]
    checked = parameter.check(value)
    if checked == "jespen":  # the guide's slip for jepsen
        checked = parameter.known_word(checked)
    if parameter.choices and checked not in parameter.choices:
        raise ValueError(f"{name}: {checked!r} is not {parameter.range_text}")
    return parameter.name, checked


def _checked_modifications(modifications: Any) -> list[tuple[int, str, Any]]:
    """The changes in the order of their blocks."""
    changes = []
    try:
        triples = [tuple(change) for change in modifications]
    except TypeError:
        triples = [()]
    for change in triples:
        if len(change) != 3:
            raise ValueError("modifications: wanted is a sequence of (block, name, value)")
        block, name, value = change
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 0:
            raise ValueError(f"modifications: {block!r} is not a block number")
        changes.append((int(block), *_checked_value(name, value)))
    return sorted(changes, key=lambda change: change[0])


def _needed(outputs: Any) -> tuple[set[str], set[str]]:
    """The outputs to keep, and the processors to run for them."""
    try:
        wanted = [outputs] if isinstance(outputs, str) else list(KINDS if outputs is None else outputs)
    except TypeError:
        raise ValueError(f"outputs: {outputs!r} is not a sequence of names") from None
    for name in wanted:
        if not isinstance(name, str) or name not in KINDS:
            raise ValueError(f"unknown output {name!r}; there are: {', '.join(KINDS)}")
    needed = {"input"}
    for kind in wanted:
        while kind:
            needed.add(kind)
            kind = KINDS[kind].parent
    return set(wanted), needed


# --- the tree and what comes out of it ---


def _build(tree: Tree, source: _ArraySource, needed: set[str], values: Mapping[str, Any]) -> None:
    for kind in KINDS.values():  # parents come first in the table
        mine = {p.name: values[p.name] for p in kind.parameters if p.name in values}
        if not kind.parent:
            tree.add_input(kind.kind, source, 1, 0.0, 0.0, mine)
        elif kind.kind in needed:
            tree.add(kind.kind, kind.kind, kind.parent, mine)


def _results(tree: Tree, run: _Run) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for processor in tree.processors:
        kind = processor.kind
        if kind in run.blocks:
            results[kind] = _join(kind, run.blocks.pop(kind), processor.rows)
        if kind == "gammatone":
            results["fb_cfHz"] = np.array(processor.parameters()["fb_cfHz"])
        if kind in ("ild", "ratemap", "crossCorrelation"):
            results[f"{kind}_frameRate"] = processor.rate
        if kind == "crossCorrelation":
            longest = results[kind].shape[1] // 2
            results["cc_lags"] = np.arange(-longest, longest + 1) / tree.sample_rate
    return results


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
