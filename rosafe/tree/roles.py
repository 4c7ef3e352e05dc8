"""The states of a processor, and those that it has to do with: where samples come from, and who hears of its blocks."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rosafe.tree.zone import Block

if TYPE_CHECKING:
    from rosafe.tree.processor import Processor


class State(enum.Enum):
    """The four states of the user guide (figure 11), and the two ends."""

    WAIT_EXEC = "waitExec"
    EXEC = "exec"
    WAIT_RELEASE = "waitRelease"
    RELEASE = "release"
    DONE = "done"  # its input has come to its end
    REMOVED = "removed"


class Source(Protocol):
    """Where the input processor reads."""

    sample_rate: float

    def read(self) -> tuple[np.ndarray, int] | None:
        """The next block, (2, n), and the index of the frame after it; None at the end. Blocks; `stop` ends that."""

    def stop(self) -> None:
        """Make `read` return None, now and from now on."""


class Listener(Protocol):
    """Who hears of what the processors do. Called on their threads; must not wait for the tree."""

    def added(self, processor: Processor) -> None:
        """A processor is about to start; nothing was released yet. Where this raises, it is taken out again."""

    def executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in so many seconds; the last one perhaps after `ended`."""

    def released(self, processor: Processor, block: Block) -> None:
        """A block was released. Never called after `ended`."""

    def ended(self, processor: Processor) -> None:
        """The processor is gone; `processor.error` tells why where it was not asked to."""


# Gets (processor, state that it enters, number of the block at hand or None). Called under the tree's lock: no waiting.
Observer = Callable[["Processor", State, "int | None"], None]
