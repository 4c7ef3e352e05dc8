"""One page: what it looks at, what it asks for, and what it is sent, never more than it takes and a screen can show."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import struct
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, NamedTuple

from aiohttp import WSCloseCode, WSMsgType, web

from rosafe.client.asyncio_tools import run_shared
from rosafe.http_server.listener import connection_of
from rosafe.interface import MAX_SETUP, ComponentError
from rosafe.live.components import format_error
from rosafe.live.views import FLOAT, Hub, Key, View

PERIOD = 0.04  # s between two pictures, at least: 25 a second
BYTES_PER_SECOND = 200_000
MAX_PICTURE = 40_000  # bytes of one message
BUFFER_LIMIT = 0.8  # of the bytes per second are for columns that go on; beyond, columns are left out
MAX_VIEWS = 16
MAX_PENDING = 4  # requests
MAX_MESSAGE = 4 * MAX_SETUP  # bytes of a request, such as to load a setup
UNSENT = 16 * 1024  # bytes that a client has not taken; while there are more, it gets nothing new
KERNEL_BYTES = 128 * 1024  # that the kernel keeps for a client
STALL_SECONDS = 30.0  # a client that takes nothing for so long is dropped
BEHIND_SECONDS = 1.0  # of columns that one gets that was slow; those before are skipped
HEARTBEAT_SECONDS = 15.0
HEAD = struct.Struct("<HHI")  # format, pieces, nothing
FORMAT = 2
MAX_REASON = 123  # bytes, of a WebSocket's close frame
REASONS: dict[int, bytes] = {
    WSCloseCode.PROTOCOL_ERROR: b"expected a valid WebSocket frame",
    WSCloseCode.INVALID_TEXT: b"expected a text in UTF-8",
    WSCloseCode.MESSAGE_TOO_BIG: b"expected a message of at most %d MiB" % (MAX_MESSAGE >> 20),
}

log = logging.getLogger("rosout.rosafe_live")  # stderr and /rosout, as rospy.logerr

Ask = Callable[[Mapping[str, Any]], Awaitable[dict[str, Any]]]


class _SubscribedView(NamedTuple):
    """A view that the page looks at, and its next column there."""

    view: View
    description: dict[str, Any]


class _Socket(web.WebSocketResponse):
    """A WebSocket that gives a reason also if aiohttp closes it."""

    async def close(self, *, code: int = WSCloseCode.OK, message: bytes = b"") -> bool:
        return await super().close(code=code, message=message or REASONS.get(code, b""))


class BrowserConnection:
    """One WebSocket.

    Parameters
    ----------
    hub : Hub
    asks : mapping
        What the page may ask for, by name.
    changed : callable
        Called after a request, as the tree may be another one.
    """

    def __init__(self, hub: Hub, asks: Mapping[str, Ask], changed: Callable[[], None]) -> None:
        self._hub, self._pending_requests, self._changed = hub, asks, changed
        self._socket = _Socket(max_msg_size=MAX_MESSAGE, compress=False, heartbeat=HEARTBEAT_SECONDS, timeout=2.0)
        self._wake = asyncio.Event()
        self._newest: dict[str, str] = {}  # messages of which only the last one counts
        self._answers: deque[str] = deque()  # to requests, of which there are few
        self._pending: set[asyncio.Task[None]] = set()
        self._looking: dict[Key, _SubscribedView] = {}
        self._problems: dict[Key, str] = {}
        self._cursors: dict[Key, int] = {}
        self._wanted: list[Key] = []
        self._turn = asyncio.Lock()  # for changes of what it looks at
        self._failure: asyncio.Task[None] | None = None  # closes the connection, with its reason

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Until the page goes."""
        await self._socket.prepare(request)
        connection_of(request).become_websocket()
        transport = request.transport
        if transport is None:
            return self._socket
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
        sender = asyncio.create_task(self._keep_sending(transport))
        try:
            async with self._failing("receiving"):
                async for message in self._socket:
                    if message.type == WSMsgType.TEXT:
                        await self._receive(message.data)
                    elif message.type == WSMsgType.BINARY:
                        await self._close(WSCloseCode.UNSUPPORTED_DATA, "expected a request as text, got bytes")
                    elif message.type == WSMsgType.ERROR:
                        log.warning("a page's connection is closed: %s", message.data)
        finally:
            sender.cancel()
            # After what it has asked for last, which goes on: what that looks at has to be let go, too.
            gone = run_shared(self._subscribe([], anew=False))
            await asyncio.gather(sender, *filter(None, [self._failure]), return_exceptions=True)
            await gone
        return self._socket

    async def close(self) -> None:
        """The server ends."""
        await self._close(WSCloseCode.GOING_AWAY, "rosafe live has ended")

    async def _close(self, code: WSCloseCode, reason: str) -> None:
        """Close the WebSocket; the page shows the reason."""
        message = reason.encode("utf-8", "replace")[:MAX_REASON].decode("utf-8", "ignore").encode()
        await self._socket.close(code=code, message=message)

    @contextlib.asynccontextmanager
    async def _failing(self, what: str) -> AsyncIterator[None]:
        """Close the page's connection with a reason and one log entry, whatever exception is raised in the block."""
        try:
            yield
        except ConnectionError:  # the page has gone
            return
        except Exception as problem:
            if self._failure is not None:
                return
            reason = f"{what} failed: {type(problem).__name__}: {problem}".splitlines()[0]
            log.exception("a page's connection is closed: %s", reason[:500])
            self._failure = asyncio.create_task(self._close(WSCloseCode.INTERNAL_ERROR, reason))

    def wake(self) -> None:
        """There is something new to look at."""
        self._wake.set()

    def tell(self, about: str, message: Mapping[str, Any]) -> None:
        """Send a message, in the place of one about the same that was not sent yet."""
        self._newest[about] = json.dumps({"about": about, **message})
        self._wake.set()

    # --- what the page says ---

    async def _receive(self, text: str) -> None:
        try:
            said = json.loads(text)
            number, what = said["id"], said["do"]
            arguments = said.get("with", {})
            if not isinstance(number, int) or not isinstance(what, str) or not isinstance(arguments, dict):
                raise TypeError
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            await self._close(WSCloseCode.UNSUPPORTED_DATA, "expected a request with id and do")
            return
        if len(self._pending) >= MAX_PENDING:
            self._answer(number, {"error": f"{MAX_PENDING} requests are under way; try again in a moment"})
            return
        task = asyncio.create_task(self._answer_request(number, what, arguments))
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)

    async def _answer_request(self, number: int, what: str, arguments: Mapping[str, Any]) -> None:
        async with self._failing(what[:40]):
            await self._do(number, what, arguments)

    async def _do(self, number: int, what: str, arguments: Mapping[str, Any]) -> None:
        try:
            if what == "look":
                await self._subscribe(_keys(arguments), anew=bool(arguments.get("anew")))
                self._answer(number, {"ok": {}})
                return
            ask = self._pending_requests.get(what)
            if ask is None:
                raise ValueError(f"there is no request {what[:40]!r}")
            self._answer(number, {"ok": await ask(arguments)})
        except ComponentError as problem:
            self._answer(number, {"error": format_error(problem)})
        except (ValueError, TypeError) as problem:
            self._answer(number, {"error": str(problem)[:500]})
        if what != "look":
            self._changed()

    def _answer(self, number: int, answer: Mapping[str, Any]) -> None:
        self._answers.append(json.dumps({"about": "answer", "id": number, **answer}))
        while len(self._answers) > 8 * MAX_PENDING:  # of one who asks and takes no answers
            self._answers.popleft()
        self._wake.set()

    # --- what it looks at ---

    async def _subscribe(self, keys: list[Key], anew: bool) -> None:
        """Look at these and nothing else; `anew` sends the last seconds again."""
        async with self._turn:
            self._wanted = keys
            for key in [key for key in self._looking if key not in keys]:
                view = self._looking.pop(key).view
                await asyncio.to_thread(self._hub.unsubscribe, key, view)
            for key in keys:
                if key not in self._looking:
                    await self._begin(key)
                elif anew:
                    self._cursors[key] = 0
            self._problems = {key: why for key, why in self._problems.items() if key in keys}
            self._cursors = {key: at for key, at in self._cursors.items() if key in self._looking}
            self._tell_views()

    async def _begin(self, key: Key) -> None:
        try:
            self._looking[key] = _SubscribedView(*await asyncio.to_thread(self._hub.subscribe, key))
            self._cursors[key] = 0
            self._problems.pop(key, None)
        except ComponentError as problem:
            self._problems[key] = format_error(problem)
        except ValueError as problem:
            self._problems[key] = str(problem)

    async def on_tree_changed(self, changed: set[Key]) -> None:
        """The tree has changed: these views are gone, and what was not there may be there now."""
        async with self._failing("an update of the tree"), self._turn:
            for key in self._wanted:
                if key in changed and key in self._looking and not self._hub.shows(key, self._looking[key].view):
                    del self._looking[key]
                if key not in self._looking:
                    await self._begin(key)
            if self._wanted:
                self._tell_views()

    def _tell_views(self) -> None:
        views = []
        for key in self._wanted:
            place = {"what": key.what, "name": key.name, "part": key.part, "row": key.row}
            if key in self._looking:
                looking = self._looking[key]
                views.append({"key": place, "number": looking.view.number, **looking.description})
            else:
                views.append({"key": place, "error": self._problems.get(key, "")})
        self.tell("views", {"views": views})

    # --- what it gets ---

    async def _keep_sending(self, transport: asyncio.Transport) -> None:
        async with self._failing("sending"):
            await self._send(transport)

    async def _send(self, transport: asyncio.Transport) -> None:
        loop = asyncio.get_running_loop()
        taken_at, slow = loop.time(), False
        while not self._socket.closed:
            if transport.get_write_buffer_size() > UNSENT:
                slow = True
                if loop.time() - taken_at > STALL_SECONDS:
                    transport.abort()
                    return
                await asyncio.sleep(PERIOD)
                continue
            taken_at = loop.time()
            if slow:
                self._skip()
                slow = False
            text = self._next_text()
            if text is not None:
                await self._socket.send_str(text)
                await asyncio.sleep(len(text) / BYTES_PER_SECOND)
                continue
            self._wake.clear()
            picture = self._picture()
            if picture:
                await self._socket.send_bytes(picture)
                self._wake.set()  # for what was too much for one message
                await asyncio.sleep(max(PERIOD, len(picture) / BYTES_PER_SECOND))
            else:
                await self._wake.wait()

    def _next_text(self) -> str | None:
        if self._answers:
            return self._answers.popleft()
        if self._newest:
            return self._newest.pop(next(iter(self._newest)))
        return None

    def _skip(self) -> None:
        """Leave out what has piled up while it took nothing."""
        for key, looking in self._looking.items():
            newest = looking.view.next - round(BEHIND_SECONDS * looking.view.rate)
            self._cursors[key] = max(self._cursors.get(key, 0), newest)

    def _picture(self) -> bytes:
        """A message of new columns of all that it looks at; empty where there are none."""
        views = [looking.view for looking in self._looking.values()]
        wanted = sum(view.size * view.rate * (4 if view.form == FLOAT else 1) for view in views)
        stride = max(1, -int(-wanted // (BUFFER_LIMIT * BYTES_PER_SECOND)))
        pieces: list[bytes] = []
        room = MAX_PICTURE
        for key, looking in sorted(self._looking.items(), key=self._progress):
            view = looking.view
            cursor = self._cursors.get(key, 0)
            if cursor > view.next:  # the sound began anew
                cursor = 0
            width = view.size * (4 if view.form == FLOAT else 1)
            cursor, piece = view.piece(cursor, stride, max(1, room // width))
            self._cursors[key] = cursor
            if piece:
                pieces.append(piece)
                room -= len(piece)
            if room <= 0:
                break
        return HEAD.pack(FORMAT, len(pieces), 0) + b"".join(pieces) if pieces else b""

    def _progress(self, item: tuple[Key, _SubscribedView]) -> float:
        """Who is furthest behind comes first."""
        key, looking = item
        return (self._cursors.get(key, 0) - looking.view.next) / looking.view.rate


def _keys(arguments: Mapping[str, Any]) -> list[Key]:
    """What a page wants to look at; ValueError where that is nonsense."""
    given = arguments.get("keys")
    if not isinstance(given, list) or len(given) > MAX_VIEWS:
        raise ValueError(f"keys: wanted is a list of at most {MAX_VIEWS}")
    keys: dict[Key, None] = {}
    for one in given:
        if not isinstance(one, dict):
            raise ValueError("keys: wanted are objects")
        what, name, part, row = (one.get(k, d) for k, d in (("what", ""), ("name", ""), ("part", 0), ("row", -1)))
        if what not in ("picture", "direction", "levels") or not isinstance(name, str) or len(name) > 4096:
            raise ValueError("keys: what is picture, direction or levels, of the processor called name")
        if not all(isinstance(n, int) and not isinstance(n, bool) and -1 <= n < 2**16 for n in (part, row)):
            raise ValueError("keys: part and row are whole numbers")
        keys[Key(what, name, part, row) if what == "picture" else Key(what, name if what == "direction" else "")] = None
    return list(keys)
