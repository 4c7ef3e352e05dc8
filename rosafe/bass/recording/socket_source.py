"""A source that asks a bass's DedicatedSocket, on this machine or another."""

from __future__ import annotations

import threading
import time

from rosafe.bass.recording.topic_source import STALL_SECONDS
from rosafe.bass.socket_client import SocketClient, blocks
from rosafe.bass.sources.base import Chunk, device_error


class SocketSource:
    """The frames that come from now on.

    Parameters
    ----------
    host, port : str, int
        Where the socket is.
    sample_rate : int
        Hz; the protocol does not tell it, so it is taken as true.

    Attributes
    ----------
    newest : int
        Number of the frame before the first one that is read.

    Raises
    ------
    ComponentError
        ``::bass::e_device`` where nobody serves there.
    """

    def __init__(self, host: str, port: int, sample_rate: int, stopping: threading.Event) -> None:
        self.name = f"{host}:{port}"
        self.sample_rate = sample_rate
        self.overruns = 0
        self.lost_frames = 0
        try:
            with SocketClient(host, port) as client:
                self.newest = client.newest()
        except OSError as problem:
            raise device_error(f"{self.name}: {problem.strerror or problem}: call DedicatedSocket of bass") from None
        self._next = self.newest + 1
        self._blocks = blocks(host, port, first=self._next, patience=STALL_SECONDS, stopping=stopping)

    def read(self) -> Chunk | None:
        """What is new, of any length; None once nothing new has come for some seconds.

        Raises ``::bass::e_device`` where another stream begins, or the socket is closed.
        """
        try:
            block = next(self._blocks, None)
        except OSError as problem:
            raise device_error(f"{self.name}: {problem.strerror or problem}") from None
        if block is None:
            return None
        if block.first - block.lost != self._next:
            raise device_error(f"{self.name}: a new stream begins (its frames count from {block.first})")
        self._next = block.first + block.samples.shape[1]
        self.overruns += block.lost > 0
        self.lost_frames += block.lost
        return Chunk(block.samples, block.lost, time.monotonic())

    def close(self) -> None:
        """Close the connection."""
        self._blocks.close()
