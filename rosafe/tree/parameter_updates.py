"""Parameter updates of one processor: validated on copies of its stage, applied between two blocks."""

from __future__ import annotations

import copy
import itertools
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.plugin_checks import PluginError
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.tree.block import Block


class ParameterUpdate(NamedTuple):
    """An update that waits for the processor's next block, or for a later one."""

    block: int  # of the input: it is applied before this block, or before the next one if that is later
    name: str
    value: Any
    needs: str  # the extra of the parent that is required from then on


class ParameterUpdates:
    """The active stage of a processor, and the stage after all pending updates.

    An update is applied before the first block that the updated stage can process. An update that requires the parent's
    envelope waits for a block that carries it; one that fits only the parent's next format waits for that format.

    Attributes
    ----------
    final_stage : Stage
        The stage after all pending updates, its own and its parents'. For queries only: it is never run.
    look_ahead : int
        That of the active stage.
    """

    def __init__(self, stage: Stage) -> None:
        self.final_stage = stage
        self._activate(stage)
        self._queue: list[ParameterUpdate] = []
        self._lock = threading.Lock()  # guards _queue, and the replacement of _active

    def _activate(self, stage: Stage) -> None:
        self._active = stage
        self._active_needs = stage.required_extra
        self.look_ahead = stage.look_ahead

    def preview(self, name: str, value: Any) -> Stage:
        """Return the stage after one more update, without applying it. Raises ValueError if the stage rejects it."""
        stage = copy.copy(self.final_stage)
        stage.configure(**{name: value})
        return stage

    def preview_input(self, input_format: SignalFormat) -> Stage:
        """Return the stage for another output format of the parent, or `final_stage` if it is the same.

        Raises ValueError if the stage rejects the format.
        """
        if input_format == self.final_stage.input_format:
            return self.final_stage
        stage = copy.copy(self.final_stage)
        stage.set_input_format(input_format)
        return stage

    def enqueue(self, planned: Stage, name: str, value: Any, block: int = 0) -> None:
        """Apply a previewed change before block `block` of the input; blocks of successive calls ascend."""
        with self._lock:
            self.final_stage = planned
            self._queue.append(ParameterUpdate(block, name, value, planned.required_extra))

    def needs(self, number: int) -> str:
        """Return the extra of the parent that block `number` should carry, or an empty string."""
        if not self._queue:
            return self._active_needs
        with self._lock:
            due = self._due(number)
            return due[-1].needs if due else self._active_needs

    def required_input(self, frames: int) -> int:
        """Return a lower limit of the number of input frames after which `frames` more can be output."""
        stage = self._active
        return stage.required_input(frames) if isinstance(stage, FramedStage) and not self._queue else frames

    def stage_for_block(self, block: Block) -> Stage | None:
        """Return the stage for `block` after all due updates that fit it, or None if no stage can process it."""
        stage = self._active
        if not self._queue and block.signal is stage.input_format:
            needs = self._active_needs
            return stage if not needs or needs in block.extras else None
        with self._lock:
            due = self._due(block.number)
            for count in range(len(due), -1, -1):
                changed = _changed(stage, block.signal, due[:count])
                if changed is not None and (not changed.required_extra or changed.required_extra in block.extras):
                    self._activate(changed)
                    del self._queue[:count]
                    return changed
        return None

    def _due(self, number: int) -> list[ParameterUpdate]:
        return list(itertools.takewhile(lambda change: change.block <= number, self._queue))


def _changed(stage: Stage, input_format: SignalFormat, changes: Sequence[ParameterUpdate]) -> Stage | None:
    """Return `stage` after `changes` for blocks of `input_format`, or None if that is not possible.

    The result shares the state of `stage`, which is not modified.
    """
    if input_format == stage.input_format and not changes:
        stage.set_input_format(input_format)
        return stage
    changed = copy.copy(stage)
    try:
        changed.reconfigure(input_format, [{change.name: change.value} for change in changes])
    except PluginError:
        raise
    except ValueError:
        return None
    return changed
