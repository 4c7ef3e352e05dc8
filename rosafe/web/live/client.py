"""The WebSocket of one page: requests, answers, state messages, and the views that it has subscribed to.

All messages are limited to the rate that the page can receive.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import struct
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from rosafe.interface import MAX_SETUP, ComponentError
from rosafe.ros1.client.asyncio_tools import run_shared
from rosafe.web.live.components import Action, format_error
from rosafe.web.live.views import Hub, Key, View
from rosafe.web.server.listener import connection_of

PERIOD = 0.04  # s between two messages with columns, at least: 25 per second
MAX_PENDING = 4  # requests
MAX_MESSAGE = 4 * MAX_SETUP  # bytes of a request, such as to load a setup
MAX_UNSENT = 16 * 1024  # bytes in the send buffer; above it, the client gets no new message
KERNEL_BYTES = 128 * 1024  # send buffer of the kernel
STALL_SECONDS = 30.0  # a client that has not read for this time is disconnected
HEARTBEAT_SECONDS = 15.0
MAX_REASON = 123  # bytes, of a WebSocket's close frame
MAX_ERROR = 500  # characters
MAX_VIEWS = 16
BYTES_PER_SECOND = 200_000
BUFFER_LIMIT = 0.8  # share of them for columns; above it, only every second (third, ...) column is sent
MAX_PICTURE = 40_000  # bytes of one message
CATCH_UP_SECONDS = 1.0  # of columns that a page gets after it was slow; the older ones are skipped
MAX_NAME = 4096  # characters of the name of a processor
HEADER = struct.Struct("<HHI")  # format, pieces, padding
FORMAT = 2
REASONS: dict[int, bytes] = {
    WSCloseCode.PROTOCOL_ERROR: b"expected a valid WebSocket frame",
    WSCloseCode.INVALID_TEXT: b"expected a text in UTF-8",
    WSCloseCode.MESSAGE_TOO_BIG: b"expected a message of at most %d MiB" % (MAX_MESSAGE >> 20),
}

log = logging.getLogger("rosout.rosafe_live")  # stderr and /rosout, as rospy.logerr


# --- views --------------------------------------------------------------------------------------------------------


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


# --- the connection -----------------------------------------------------------------------------------------------


class _Socket(web.WebSocketResponse):
    """A WebSocket that gives a reason also if aiohttp closes it."""

    async def close(self, *, code: int = WSCloseCode.OK, message: bytes = b"", **options: Any) -> bool:
        """Close it; newer versions of aiohttp have further options."""
        return await super().close(code=code, message=message or REASONS.get(code, b""), **options)


class BrowserConnection:
    """One WebSocket.

    Parameters
    ----------
    hub : Hub
    actions : mapping
        The requests of the page by name, except `look`.
    changed : callable
        Called after a request, because the tree may have changed.
    """

    def __init__(self, hub: Hub, actions: Mapping[str, Action], changed: Callable[[], None]) -> None:
        self._actions, self._changed = actions, changed
        self._socket = _Socket(max_msg_size=MAX_MESSAGE, compress=False, heartbeat=HEARTBEAT_SECONDS, timeout=2.0)
        self._wake = asyncio.Event()
        self._latest: dict[str, str] = {}  # unsent messages by subject
        self._answers: deque[str] = deque()
        self._pending: set[asyncio.Task[None]] = set()
        self._subscriptions = Subscriptions(hub)
        self._failure: asyncio.Task[None] | None = None  # closes the connection and sends the reason

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Serve until the connection is closed."""
        await self._socket.prepare(request)
        connection_of(request).become_websocket()
        transport = request.transport
        if transport is None:
            return self._socket
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
        sender = asyncio.create_task(self._keep_sending(transport))
        try:
            async with self._close_on_failure("receiving"):
                async for message in self._socket:
                    if message.type == WSMsgType.TEXT:
                        await self._receive(message.data)
                    elif message.type == WSMsgType.BINARY:
                        await self._close(WSCloseCode.UNSUPPORTED_DATA, "expected a request as text, got bytes")
                    elif message.type == WSMsgType.ERROR:
                        log.warning("a page's connection is closed: %s", message.data)
        finally:
            sender.cancel()
            # waits for a request in progress, so that the views that it subscribes to are released as well
            released = run_shared(self._subscriptions.replace([]))
            await asyncio.gather(sender, *filter(None, [self._failure]), return_exceptions=True)
            await released
        return self._socket

    async def close(self) -> None:
        """Close the connection because the server ends."""
        await self._close(WSCloseCode.GOING_AWAY, "rosafe live has ended")

    async def _close(self, code: WSCloseCode, reason: str) -> None:
        """Close the WebSocket; the page shows the reason."""
        message = reason.encode("utf-8", "replace")[:MAX_REASON].decode("utf-8", "ignore").encode()
        await self._socket.close(code=code, message=message)

    @contextlib.asynccontextmanager
    async def _close_on_failure(self, activity: str) -> AsyncIterator[None]:
        """Close the connection, with a reason and one log entry, if an exception is raised in the block."""
        try:
            yield
        except ConnectionError:  # the page has closed it
            return
        except Exception as problem:
            if self._failure is not None:
                return
            reason = f"{activity} failed: {type(problem).__name__}: {problem}".splitlines()[0]
            log.exception("a page's connection is closed: %s", reason[:MAX_ERROR])
            self._failure = asyncio.create_task(self._close(WSCloseCode.INTERNAL_ERROR, reason))

    def wake(self) -> None:
        """Check for new columns."""
        self._wake.set()

    def send_latest(self, subject: str, message: Mapping[str, Any]) -> None:
        """Send a message; it replaces an unsent one on the same subject."""
        self._latest[subject] = json.dumps({"about": subject, **message})
        self._wake.set()

    async def on_tree_changed(self, changed: set[Key]) -> None:
        """Subscribe to the views of the new tree."""
        async with self._close_on_failure("an update of the tree"):
            await self._subscriptions.refresh(changed)
            if self._subscriptions.keys:
                self._send_views()

    # --- requests ---

    async def _receive(self, text: str) -> None:
        try:
            request = json.loads(text)
            number, action = request["id"], request["do"]
            values = request.get("with", {})
            if not isinstance(number, int) or not isinstance(action, str) or not isinstance(values, dict):
                raise TypeError
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            await self._close(WSCloseCode.UNSUPPORTED_DATA, "expected a request with id and do")
            return
        if len(self._pending) >= MAX_PENDING:
            self._answer(number, {"error": f"{MAX_PENDING} requests are in progress; try again in a moment"})
            return
        task = asyncio.create_task(self._execute(number, action, values))
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)

    async def _execute(self, number: int, action: str, values: Mapping[str, Any]) -> None:
        async with self._close_on_failure(action[:40]):
            try:
                self._answer(number, {"ok": await self._result(action, values)})
            except ComponentError as problem:
                self._answer(number, {"error": format_error(problem)})
            except (ValueError, TypeError) as problem:
                self._answer(number, {"error": str(problem)[:MAX_ERROR]})
            if action != "look":
                self._changed()

    async def _result(self, action: str, values: Mapping[str, Any]) -> dict[str, Any]:
        if action == "look":
            await self._subscribe(parse_keys(values), resend=bool(values.get("anew")))
            return {}
        if action not in self._actions:
            raise ValueError(f"unknown request {action[:40]!r}")
        return await self._actions[action](values)

    async def _subscribe(self, keys: list[Key], resend: bool) -> None:
        await self._subscriptions.replace(keys, resend)
        self._send_views()

    def _send_views(self) -> None:
        self.send_latest("views", {"views": self._subscriptions.describe()})

    def _answer(self, number: int, answer: Mapping[str, Any]) -> None:
        self._answers.append(json.dumps({"about": "answer", "id": number, **answer}))
        while len(self._answers) > 8 * MAX_PENDING:  # a client that sends requests without reading the answers
            self._answers.popleft()
        self._wake.set()

    # --- sending ---

    async def _keep_sending(self, transport: asyncio.Transport) -> None:
        async with self._close_on_failure("sending"):
            await self._send(transport)

    async def _send(self, transport: asyncio.Transport) -> None:
        loop = asyncio.get_running_loop()
        read_at, slow = loop.time(), False
        while not self._socket.closed:
            if transport.get_write_buffer_size() > MAX_UNSENT:
                slow = True
                if loop.time() - read_at > STALL_SECONDS:
                    transport.abort()
                    return
                await asyncio.sleep(PERIOD)
                continue
            read_at = loop.time()
            if slow:
                self._subscriptions.skip_old_columns()
                slow = False
            text = self._next_text()
            if text is not None:
                await self._socket.send_str(text)
                await asyncio.sleep(len(text) / BYTES_PER_SECOND)
                continue
            self._wake.clear()
            columns = self._subscriptions.next_message()
            if columns:
                await self._socket.send_bytes(columns)
                self._wake.set()  # there may be more than one message holds
                await asyncio.sleep(max(PERIOD, len(columns) / BYTES_PER_SECOND))
            else:
                await self._wake.wait()

    def _next_text(self) -> str | None:
        if self._answers:
            return self._answers.popleft()
        if self._latest:
            return self._latest.pop(next(iter(self._latest)))
        return None
