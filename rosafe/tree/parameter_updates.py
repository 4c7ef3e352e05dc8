"""Parameter changes of one processor: planned on copies of its stage, made between two blocks."""

from __future__ import annotations

import copy
import itertools
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

from rosafe.dsp.plugin_checks import PluginError
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.tree.block import Block


class ParameterUpdate(NamedTuple):
    """A change that waits for the processor's next block, or for a later one."""

    block: int  # of the input; it is made before this one, or the next one if that is a later one
    name: str
    value: Any
    needs: str  # of the parent's by-products, from then on


class ParameterUpdates:
    """The stage of a processor as it is at work, and as it will be.

    A change is made before the first block that the stage can then work on: a method that needs the parent's envelope
    waits for a block that has it, one that goes with the parent's coming format only waits for that.

    Attributes
    ----------
    planned : Stage
        As it will be after all changes, its own and its parents': to be asked, and not to be run.
    """

    def __init__(self, stage: Stage) -> None:
        self.final_stage = stage
        self._active = stage
        self._queue: list[ParameterUpdate] = []
        self._lock = threading.Lock()  # guards _waiting, and the exchange of _working

    def preview(self, name: str, value: Any) -> Stage:
        """The stage after one more change, which is not made yet; ValueError where it refuses that."""
        stage = copy.copy(self.final_stage)
        stage.configure(**{name: value})
        return stage

    def preview_input(self, given: SignalFormat) -> Stage:
        """The stage under a parent that puts out another format, or ValueError; `final_stage` where it is the same."""
        if given == self.final_stage.input_format:
            return self.final_stage
        stage = copy.copy(self.final_stage)
        stage.set_input_format(given)
        return stage

    def enqueue(self, planned: Stage, name: str, value: Any, block: int = 0) -> None:
        """Apply a previewed change before block `block` of the input; blocks of successive calls ascend."""
        with self._lock:
            self.final_stage = planned
            self._queue.append(ParameterUpdate(block, name, value, planned.required_extra))

    def needs(self, number: int) -> str:
        """Which of the parent's by-products block `number` should carry."""
        if not self._queue:
            return self._active.required_extra
        with self._lock:
            due = self._due(number)
            return due[-1].needs if due else self._active.required_extra

    def stage_for_block(self, block: Block) -> Stage | None:
        """The stage to work on `block`, after all changes that are due and go with it; None where none can."""
        stage = self._active
        if not self._queue and block.signal is stage.input_format:
            needs = stage.required_extra
            return stage if not needs or needs in block.extras else None
        with self._lock:
            due = self._due(block.number)
            for count in range(len(due), -1, -1):
                changed = _changed(stage, block.signal, due[:count])
                if changed is not None and (not changed.required_extra or changed.required_extra in block.extras):
                    self._active = changed
                    del self._queue[:count]
                    return changed
        return None

    def _due(self, number: int) -> list[ParameterUpdate]:
        return list(itertools.takewhile(lambda change: change.block <= number, self._queue))


def _changed(stage: Stage, given: SignalFormat, changes: Sequence[ParameterUpdate]) -> Stage | None:
    """`stage` after `changes`, with blocks of the format `given`, or None where that cannot be.

    It shares the state of `stage`, which does not notice.
    """
    if given == stage.input_format and not changes:
        stage.set_input_format(given)
        return stage
    changed = copy.copy(stage)
    try:
        changed.reconfigure(given, [{change.name: change.value} for change in changes])
    except PluginError:
        raise
    except ValueError:
        return None
    return changed
