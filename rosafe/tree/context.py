"""What all processors of one tree have in common: workers, and who hears of what they do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rosafe.tree.block import Block
from rosafe.tree.states import State
from rosafe.tree.workers import Workers

if TYPE_CHECKING:
    from rosafe.tree.processor import Processor


class TreeListener(Protocol):
    """Who hears of what the processors do. Called by workers, of which others go on; must not wait for the tree."""

    def on_added(self, processor: Processor) -> None:
        """A processor is about to start; nothing was released yet. Where this raises, it is taken out again."""

    def on_executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in so many seconds; the last one perhaps after `on_removed`."""

    def on_released(self, processor: Processor, block: Block) -> None:
        """A processor with consumers released a block. One worker calls at a time, and never after `on_removed`."""

    def on_removed(self, processor: Processor) -> None:
        """The processor is gone; `processor.error` tells why where it was not asked to."""


# Gets (processor, state that it enters, number of the block at hand or None). Called under the tree's lock: no waiting.
Observer = Callable[["Processor", State, "int | None"], None]


@dataclass(frozen=True)
class TreeContext:
    """What all processors of one tree have in common.

    `on_failure` is called, by the worker, where a processor's `error` is set.
    """

    workers: Workers
    listener: TreeListener
    on_failure: Callable[[Processor], None]
    finished_condition: threading.Condition  # on the tree's lock: somebody may have come to its end
    observers: list[Observer] = field(default_factory=list)
