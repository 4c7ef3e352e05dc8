"""A source that reads the DedicatedSocket of a bass, on this machine or another one."""

from __future__ import annotations

import threading
import time

from rosafe.audio.devices.base import Chunk, device_error
from rosafe.ros1.bass.recording.topic_source import STALL_SECONDS
from rosafe.ros1.bass.socket_client import SocketClient, blocks


class SocketSource:
    """The frames that are captured after the source was created.

    Parameters
    ----------
    host, port : str, int
        Address of the socket.
    sample_rate : int
        Hz; it is not part of the protocol and cannot be checked.

    Attributes
    ----------
    newest : int
        Index of the frame before the first one that is read.

    Raises
    ------
    ComponentError
        ``::bass::e_device`` if the connection cannot be made.
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
            raise device_error(f"{self.name}: {problem.strerror or problem}; call DedicatedSocket of bass") from None
        self._next = self.newest + 1
        self._blocks = blocks(host, port, first=self._next, patience=STALL_SECONDS, stopping=stopping)

    def read(self) -> Chunk | None:
        """Return the new frames, in any number; None if no new frame arrives for some seconds.

        Raises ``::bass::e_device`` if a new stream begins, or the socket is closed.
        """
        try:
            block = next(self._blocks, None)
        except OSError as problem:
            raise device_error(f"{self.name}: {problem.strerror or problem}") from None
        if block is None:
            return None
        if block.first - block.lost != self._next:
            raise device_error(f"{self.name}: a new stream begins at frame {block.first}")
        self._next = block.first + block.samples.shape[1]
        self.overruns += block.lost > 0
        self.lost_frames += block.lost
        return Chunk(block.samples, block.lost, time.monotonic())

    def close(self) -> None:
        """Close the connection."""
        self._blocks.close()
