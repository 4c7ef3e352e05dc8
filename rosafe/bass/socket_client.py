"""A client of DedicatedSocket, for programs without ROS: `blocks` gives the stream in order. Needs numpy only.

>>> from rosafe.bass.socket_client import blocks
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

TIMEOUT_SECONDS = 10.0  # for an answer
POLL_SECONDS = 0.02  # between two requests where nothing is new
RESTART_SECONDS = 1.0  # without anything new, look whether the stream began anew
_HEADER = struct.Struct("<iiq")
_MOST = 2**24  # frames: no window is longer
_CLOSED = "bass has closed the connection"


class Received(NamedTuple):
    """Some frames of the stream."""

    first: int  # number of the first one, as bass counts; less than expected where the stream began anew
    samples: np.ndarray  # int32, (2, n): left, right
    lost: int  # frames before it that were asked for too late


class SocketClient:
    """One connection.

    Raises OSError where there is nobody, or where the connection breaks.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8081, timeout: float = TIMEOUT_SECONDS) -> None:
        self._connection = socket.create_connection((host, port), timeout)
        self._stream = self._connection.makefile("rb")

    def read(self, frames: int, first: int) -> Received:
        """Up to `frames` frames from number `first` (from 1 on); none where nothing is new."""
        try:
            self._connection.sendall(b"Read Port - N %d - nfr %d\n" % (frames, first))
            header = self._take(_HEADER.size)
        except (BrokenPipeError, ConnectionResetError):  # the latter with a request that it has not read
            raise ConnectionError(_CLOSED) from None
        count, lost, following = _HEADER.unpack(header)
        if not 0 <= count <= min(frames, _MOST) or lost < 0 or following < count:
            raise ConnectionError(f"what answers is no bass: {count} frames where {frames} were asked for")
        samples = np.frombuffer(self._take(8 * count), "<i4").reshape(2, count)
        return Received(following - count, samples, lost)

    def newest(self) -> int:
        """Number of the newest frame; 0 where there is none."""
        whole = self.read(_MOST, 1)
        return whole.first + whole.samples.shape[1] - 1

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
    """The stream, for ever unless told otherwise, in blocks of at most `frames` frames.

    Parameters
    ----------
    host, port : str, int
        Where a bass serves DedicatedSocket.
    first : int, optional
        Number of the frame to begin with; by default the next one to come.
    patience : float, optional
        End after so many seconds without anything new.
    stopping : threading.Event, optional
        End once it is set.

    Raises
    ------
    OSError
        Nobody serves, or the connection breaks (CloseSocket, the end of bass).
    """
    stopping = stopping or threading.Event()
    with SocketClient(host, port) as client:
        following = client.newest() + 1 if first is None else first
        heard = looked = time.monotonic()
        while not stopping.wait(POLL_SECONDS):
            while (block := client.read(frames, following)).samples.shape[1]:
                following = block.first + block.samples.shape[1]
                yield block
                heard = looked = time.monotonic()
            now = time.monotonic()
            if patience is not None and now - heard > patience:
                return
            if now - looked > RESTART_SECONDS:
                looked = now
                if client.newest() + 1 < following:
                    following = 1
