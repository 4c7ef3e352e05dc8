"""The views that one page has subscribed to, and the binary messages with their new columns."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rosafe.interface import ComponentError
from rosafe.web.live.components import format_error
from rosafe.web.live.views import Hub, Key, View

MAX_VIEWS = 16
BYTES_PER_SECOND = 200_000
BUFFER_LIMIT = 0.8  # share of them for columns; above it, only every second (third, ...) column is sent
MAX_PICTURE = 40_000  # bytes of one message
CATCH_UP_SECONDS = 1.0  # of columns that a page gets after it was slow; the older ones are skipped
MAX_NAME = 4096  # characters
HEADER = struct.Struct("<HHI")  # format, pieces, padding
FORMAT = 2


@dataclass
class _SubscribedView:
    """A view, and the next column to send."""

    view: View
    cursor: int = 0

    @property
    def bytes_per_second(self) -> float:
        return self.view.column_bytes * self.view.rate

    @property
    def delay(self) -> float:
        """Seconds of columns that have not been sent."""
        return (self.view.next - self.cursor) / self.view.rate


class Subscriptions:
    """The views that one page has subscribed to.

    Parameters
    ----------
    hub : Hub

    Attributes
    ----------
    keys : list of Key
        The requested views, including those that are not available.
    """

    def __init__(self, hub: Hub) -> None:
        self.keys: list[Key] = []
        self._hub = hub
        self._views: dict[Key, _SubscribedView] = {}
        self._problems: dict[Key, str] = {}
        self._lock = asyncio.Lock()  # held during changes

    async def replace(self, keys: list[Key], resend: bool = False) -> None:
        """Subscribe to these views and to no others; `resend` sends the columns of the last seconds again."""
        async with self._lock:
            self.keys = keys
            for key in self._views.keys() - keys:
                await asyncio.to_thread(self._hub.unsubscribe, key, self._views.pop(key).view)
            for key in keys:
                if key not in self._views:
                    await self._add(key)
                elif resend:
                    self._views[key].cursor = 0
            self._problems = {key: problem for key, problem in self._problems.items() if key in keys}

    async def refresh(self, changed: set[Key]) -> None:
        """Subscribe again after the tree has changed: to these views, and to those that were not available."""
        async with self._lock:
            for key in self.keys:
                if key in changed and key in self._views and not self._hub.shows(key, self._views[key].view):
                    del self._views[key]
                if key not in self._views:
                    await self._add(key)

    async def _add(self, key: Key) -> None:
        try:
            self._views[key] = _SubscribedView(await asyncio.to_thread(self._hub.subscribe, key))
            self._problems.pop(key, None)
        except ComponentError as problem:
            self._problems[key] = format_error(problem)
        except ValueError as problem:
            self._problems[key] = str(problem)

    def describe(self) -> list[dict[str, Any]]:
        """Return the description of each requested view, or the reason why it is not available."""
        views = []
        for key in self.keys:
            described: dict[str, Any] = {"key": {"what": key.what, "name": key.name, "part": key.part, "row": key.row}}
            if (subscribed := self._views.get(key)) is not None:
                described |= {"number": subscribed.view.number, **subscribed.view.description}
            else:
                described |= {"error": self._problems.get(key, "")}
            views.append(described)
        return views

    def skip_old_columns(self) -> None:
        """Skip the columns that have accumulated while the client was not reading."""
        for subscribed in self._views.values():
            oldest = subscribed.view.next - round(CATCH_UP_SECONDS * subscribed.view.rate)
            subscribed.cursor = max(subscribed.cursor, oldest)

    def next_message(self) -> bytes:
        """Return a message with new columns of the views, those with the longest delay first; empty if none are new."""
        total = sum(subscribed.bytes_per_second for subscribed in self._views.values())
        stride = max(1, -int(-total // (BUFFER_LIMIT * BYTES_PER_SECOND)))
        pieces: list[bytes] = []
        room = MAX_PICTURE
        for subscribed in sorted(self._views.values(), key=lambda one: -one.delay):
            view = subscribed.view
            first = subscribed.cursor if subscribed.cursor <= view.next else 0  # 0: the audio has restarted
            subscribed.cursor, piece = view.piece(first, stride, max(1, room // view.column_bytes))
            if piece:
                pieces.append(piece)
                room -= len(piece)
            if room <= 0:
                break
        return HEADER.pack(FORMAT, len(pieces), 0) + b"".join(pieces) if pieces else b""


def parse_keys(values: Mapping[str, Any]) -> list[Key]:
    """Return the views that a page requests; raise ValueError if the request is malformed."""
    keys = values.get("keys")
    if not isinstance(keys, list) or len(keys) > MAX_VIEWS:
        raise ValueError(f"keys: expected an array of at most {MAX_VIEWS} objects")
    return list(dict.fromkeys(map(_parse_key, keys)))


def _parse_key(key: Any) -> Key:
    if not isinstance(key, dict):
        raise ValueError("keys: expected an array of objects")
    what, name = key.get("what", ""), key.get("name", "")
    if what not in ("picture", "directions", "levels") or not isinstance(name, str) or len(name) > MAX_NAME:
        raise ValueError("keys: expected what to be picture, directions or levels, and name to be that of a processor")
    part, row = key.get("part", 0), key.get("row", -1)
    if not all(type(number) is int and -1 <= number < 2**16 for number in (part, row)):
        raise ValueError("keys: expected part and row to be whole numbers")
    return Key(what, name, part, row) if what == "picture" else Key(what)
