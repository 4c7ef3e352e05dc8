"""The context that all processors of a tree share: workers, listener and observers."""

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
    """Callbacks for processor events. They run on worker threads and must not block on the tree."""

    def on_added(self, processor: Processor) -> None:
        """A processor is about to start and has released nothing yet. If this raises, it is removed again."""

    def on_executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in `seconds`. The call for the last block may follow `on_removed`."""

    def on_released(self, processor: Processor, block: Block) -> None:
        """A processor with consumers released a block. One worker calls at a time, and never after `on_removed`."""

    def on_removed(self, processor: Processor) -> None:
        """The processor was removed; `processor.error` is the reason if it failed."""


# Called with (processor, new state, number of the current block or None), under the tree's lock: must not block.
Observer = Callable[["Processor", State, "int | None"], None]


@dataclass(frozen=True)
class TreeContext:
    """The context that all processors of a tree share.

    The worker calls `on_failure` after it has set the `error` of a processor.
    """

    workers: Workers
    listener: TreeListener
    on_failure: Callable[[Processor], None]
    finished_condition: threading.Condition  # on the tree's lock: notified when a processor is finished
    observers: list[Observer] = field(default_factory=list)
