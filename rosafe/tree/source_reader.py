"""The connection of the input to the source of its blocks."""

from __future__ import annotations

from time import monotonic
from typing import TYPE_CHECKING

from rosafe.tree.block import Block, Source
from rosafe.tree.workers import Workers

if TYPE_CHECKING:
    from rosafe.tree.processor import Processor


class SourceReader:
    """Reads the blocks of `source` for the input `processor`, whose tasks `workers` run."""

    def __init__(self, processor: Processor, source: Source, workers: Workers) -> None:
        self._processor = processor
        self._source = source
        self._workers = workers
        self.stop = source.stop

    def start(self) -> None:
        """Begin to read."""
        self._source.open(self._wake)
        self._notify_workers()

    def check(self) -> None:
        """Read if the source has a block for which it did not call `wake`."""
        if not self._source.waiting:
            self._notify_workers()

    def read(self) -> None:
        """Read the next block of the source if there is one, or end with the source."""
        processor, source = self._processor, self._source
        processor.blocked_since = monotonic()
        while True:
            ended = source.ended  # read first: blocks that arrived before the end are still processed
            got = source.read()
            if got is not None or ended == source.ended:
                break
        more = not source.waiting
        processor.blocked_since = 0.0
        with self._workers.lock:
            if got is not None:
                block = Block(processor.blocks, (got[0],), got[1], processor.stage.input_format)
                processor.accept_input_block(block, more)
            elif ended:
                processor.end_of_stream()

    def _wake(self) -> None:
        """Run short tasks on the thread of the source. Observers show the worker of each task, and need workers."""
        if self._processor.observers:
            self._notify_workers()
            return
        with self._workers.lock:
            self._processor.notify_input()
            self._workers.run_short_tasks()

    def _notify_workers(self) -> None:
        with self._workers.lock:
            self._processor.notify_input()
            self._workers.wake()
