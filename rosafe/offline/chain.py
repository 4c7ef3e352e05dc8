"""The chain of processors that some outputs need: what `rosafe.process` and the file front end run on."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import numpy as np

from rosafe.dsp.framing import FramedStage, Framing
from rosafe.interface import KINDS, ComponentError
from rosafe.tree.processor import Processor
from rosafe.tree.roles import Observer
from rosafe.tree.tree import Tree
from rosafe.tree.zone import Block


def lags(count: int, sample_rate: float) -> np.ndarray:
    """The `count` lags of a cross-correlation, (count,) in seconds, zero in the middle."""
    return np.arange(-(count // 2), count // 2 + 1) / sample_rate


class _GatedSource:
    """Feeds blocks to the tree, one after the other, once `open` says that the whole tree stands."""

    def __init__(self, blocks: Iterable[np.ndarray], sample_rate: float) -> None:
        self.sample_rate = sample_rate
        self._blocks = iter(blocks)
        self._frames = 0
        self._stopped = False
        self._gate = threading.Event()

    def open(self) -> None:
        """Let the signal flow."""
        self._gate.set()

    def read(self) -> tuple[np.ndarray, int] | None:
        self._gate.wait()
        block = None if self._stopped else next(self._blocks, None)
        if block is None:
            return None
        self._frames += block.shape[-1]
        return block, self._frames

    def stop(self) -> None:
        self._stopped = True
        self._gate.set()


class _Listener:
    """Hands on what the wanted processors release, and keeps the first error, which ends the run."""

    def __init__(self, wanted: Iterable[str], source: _GatedSource, keep: Callable[[str, Block], None]) -> None:
        self._wanted = frozenset(wanted)
        self._source = source
        self._keep = keep
        self.error: BaseException | None = None

    def added(self, processor: Processor) -> None:
        pass

    def executed(self, processor: Processor, seconds: float) -> None:
        pass

    def released(self, processor: Processor, block: Block) -> None:
        if processor.kind in self._wanted:
            self._keep(processor.kind, block)

    def ended(self, processor: Processor) -> None:
        if processor.error is not None:
            self.error = self.error or processor.error
            self._source.stop()


class Chain:
    """The processors that some outputs need, standing in a tree; nothing flows before `run`. A context manager.

    Parameters
    ----------
    blocks : iterable of ndarray, (2, n), int32 or float
        The signal; it is asked for the next block when the chain has room for it.
    sample_rate : float
        In Hz.
    parameters : mapping
        From `rosafe.interface.arguments.check_parameters`.
    outputs : sequence of str
        From `rosafe.interface.arguments.check_outputs`.
    keep : callable
        Called with the output's name and each block of it, on a thread of that output's own, while the chain goes on
        with the next block; it does not go on beyond that, so memory is bounded. What it raises ends the run.

    Raises
    ------
    ValueError
        Parameters that do not go together, or not with the sample rate.
    """

    def __init__(
        self,
        blocks: Iterable[np.ndarray],
        sample_rate: float,
        parameters: Mapping[str, Any],
        outputs: Iterable[str],
        keep: Callable[[str, Block], None],
    ) -> None:
        self.sample_rate = sample_rate
        self._source = _GatedSource(blocks, sample_rate)
        self._listener = _Listener(outputs, self._source, keep)
        self._tree = Tree(self._listener)
        self._processors: dict[str, Processor] = {}
        try:
            with _as_value_error():
                self._build(_needed(outputs), parameters)
        except BaseException:
            self.close()
            raise

    def _build(self, needed: set[str], values: Mapping[str, Any]) -> None:
        for kind in KINDS.values():  # parents come first in the table
            mine = {p.name: values[p.name] for p in kind.parameters if p.name in values}
            if not kind.parent:
                self._processors[kind.kind] = self._tree.add_input(kind.kind, self._source, 1, 0.0, 0.0, mine)
            elif kind.kind in needed:
                self._processors[kind.kind] = self._tree.add(kind.kind, kind.kind, kind.parent, mine)

    def schedule(self, block: int, name: str, value: Any) -> None:
        """Change a (checked) parameter before block `block`; the blocks of successive calls ascend. Or ValueError."""
        with _as_value_error():
            self._tree.schedule(block, name, value)

    def observe(self, observer: Observer) -> None:
        """Tell `observer` of every state that a processor enters."""
        self._tree.observe(observer)

    def run(self) -> None:
        """Let the signal flow and wait for its end; raises what the first processor failed with."""
        self._source.open()
        for processor in self._processors.values():
            processor.join()
        if self._listener.error is not None:
            raise self._listener.error

    def close(self) -> None:
        """End the run, if it is not over, and all threads."""
        self._tree.stop()
        for processor in self._processors.values():
            processor.join()

    def __enter__(self) -> Chain:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- what it is ---

    def rows(self, output: str) -> tuple[int, ...]:
        """Leading shape of an output, such as (2, channels)."""
        return self._processors[output].rows

    def shape(self, output: str, frames: int) -> tuple[int, ...]:
        """Shape of an output for a signal of so many frames, if no parameter changes on the way."""
        stage = self._processors[output].stage
        if isinstance(stage, FramedStage):
            frames = Framing.design(stage.sample_rate, stage.PREFIX, stage.parameters).complete(frames)
        return (*self.rows(output), frames)

    def largest_block(self, frames: int) -> tuple[str, int]:
        """Which processor puts out most for one block of so many frames, and how many bytes that can be."""
        sizes = {}
        for kind, processor in self._processors.items():
            stage = processor.stage
            hop = stage.sample_rate / stage.output_rate
            sizes[kind] = 8 * math.prod(processor.rows) * math.ceil(frames / hop)
        kind = max(sizes, key=lambda kind: sizes[kind])
        return kind, sizes[kind]

    def describe(self) -> dict[str, Any]:
        """Axes and rates of what runs: `fb_cfHz` (Hz), `cc_lags` (s), `ild_frameRate` and its like (Hz)."""
        described: dict[str, Any] = {}
        for kind, processor in self._processors.items():
            if kind == "gammatone":
                described["fb_cfHz"] = np.array(processor.parameters()["fb_cfHz"])
            if isinstance(processor.stage, FramedStage):
                described[f"{kind}_frameRate"] = processor.rate
            if kind == "crossCorrelation":
                described["cc_lags"] = lags(processor.rows[1], self.sample_rate)
        return described


def _needed(outputs: Iterable[str]) -> set[str]:
    """The processors to run for `outputs`."""
    needed = {"input"}
    for kind in outputs:
        while kind:
            needed.add(kind)
            kind = KINDS[kind].parent
    return needed


@contextmanager
def _as_value_error() -> Iterator[None]:
    """Make ValueError of the interface's named exceptions."""
    try:
        yield
    except ComponentError as problem:
        raise ValueError(str(problem)) from None
