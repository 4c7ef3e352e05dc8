"""Client of DedicatedSocket for programs without ROS: `blocks` yields the stream in order. Needs only numpy.

>>> from rosafe.ros1.bass.socket_client import blocks
>>> for block in blocks("127.0.0.1", 8081, frames=4410):        # doctest: +SKIP
...     print(block.first, block.samples.shape, block.lost)
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Generator
from typing import NamedTuple

import numpy as np

TIMEOUT_SECONDS = 10.0  # for a response
POLL_SECONDS = 0.02  # between two requests when no new frames are available
RESTART_SECONDS = 1.0  # without new frames, until the client checks whether the stream was restarted
_HEADER = struct.Struct("<iiq")
_MAX_FRAMES = 2**24  # maximum length of the window
_CLOSED = "bass has closed the connection"


class Received(NamedTuple):
    """Some frames of the stream."""

    first: int  # frame index of the first one; less than expected if the stream was restarted
    samples: np.ndarray  # int32, (2, n): left, right
    lost: int  # number of frames before `first` that were requested too late


class SocketClient:
    """One connection to a DedicatedSocket.

    Raises OSError if the connection cannot be made, or breaks.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8081, timeout: float = TIMEOUT_SECONDS) -> None:
        self._connection = socket.create_connection((host, port), timeout)
        self._stream = self._connection.makefile("rb")

    def read(self, frames: int, first: int) -> Received:
        """Return up to `frames` frames from frame index `first` (from 1) on; none if no new frames are available."""
        try:
            self._connection.sendall(b"Read Port - N %d - nfr %d\n" % (frames, first))
            header = self._take(_HEADER.size)
        except (BrokenPipeError, ConnectionResetError):  # reset: bass had not read the request
            raise ConnectionError(_CLOSED) from None
        count, lost, following = _HEADER.unpack(header)
        if not 0 <= count <= min(frames, _MAX_FRAMES) or lost < 0 or following < count:
            raise ConnectionError(f"expected at most {frames} frames from bass, got {count}: this is not a bass")
        samples = np.frombuffer(self._take(8 * count), "<i4").reshape(2, count)
        return Received(following - count, samples, lost)

    def newest(self) -> int:
        """Return the index of the newest frame; 0 if there is none."""
        window = self.read(_MAX_FRAMES, 1)
        return window.first + window.samples.shape[1] - 1

    def _take(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) != size:
            raise ConnectionError(_CLOSED)
        return data

    def close(self) -> None:
        """Close the connection."""
        self._stream.close()
        self._connection.close()

    def __enter__(self) -> SocketClient:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def blocks(
    host: str = "127.0.0.1",
    port: int = 8081,
    frames: int = 2205,
    first: int | None = None,
    patience: float | None = None,
    stopping: threading.Event | None = None,
) -> Generator[Received, None, None]:
    """Yield the stream in blocks of at most `frames` frames, without end by default.

    Parameters
    ----------
    host, port : str, int
        Address of the DedicatedSocket of a bass.
    first : int, optional
        Index of the first frame; by default the next one that is captured.
    patience : float, optional
        End after this many seconds without new frames.
    stopping : threading.Event, optional
        End once it is set.

    Raises
    ------
    OSError
        The connection cannot be made, or breaks (CloseSocket, the end of bass).
    """
    stopping = stopping or threading.Event()
    with SocketClient(host, port) as client:
        following = client.newest() + 1 if first is None else first
        received = checked = time.monotonic()
        while not stopping.wait(POLL_SECONDS):
            while (block := client.read(frames, following)).samples.shape[1]:
                following = block.first + block.samples.shape[1]
                yield block
                received = checked = time.monotonic()
            now = time.monotonic()
            if patience is not None and now - received > patience:
                return
            if now - checked > RESTART_SECONDS:
                checked = now
                if client.newest() + 1 < following:
                    following = 1
