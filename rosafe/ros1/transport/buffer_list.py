"""A serialized message as a list of buffers, which are sent without being concatenated."""

from __future__ import annotations

from typing import Any


class BufferList:
    """A serialized message as buffers for one `sendmsg`. The buffers are not copied and must not change."""

    def __init__(self) -> None:
        self.pieces: list[Any] = []
        self.size = 0  # bytes

    def write(self, data: Any, /) -> None:
        """Append the bytes of a contiguous buffer."""
        size = len(data) if isinstance(data, (bytes, bytearray)) else data.nbytes
        if size:
            self.pieces.append(data)
            self.size += size
