"""The HTTP server of the live page, on aiohttp: the files of the page, and a WebSocket for each window."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from aiohttp import web

from rosafe.client.asyncio_tools import run_shared
from rosafe.http_server.connections import Connections, Limits
from rosafe.http_server.listener import HttpListener, connection_of
from rosafe.http_server.refusal import HttpRefusal
from rosafe.interface import ComponentError
from rosafe.live.access import HEADERS, TokenAuth
from rosafe.live.client import Ask, BrowserConnection
from rosafe.live.components import ComponentFacade, catalogue, format_error
from rosafe.live.health import Health
from rosafe.live.plot_data import TreeSnapshot
from rosafe.live.views import Hub, Key
from rosafe.version import VERSION

PAGE = Path(__file__).with_name("page")
LOOK_SECONDS = 1.0  # between two looks at the components, while there is a page
MAX_CLIENTS = 32
AUTH_TIMEOUT_SECONDS = 10.0  # a connection that has not sent a complete request by then is closed
LIMITS = Limits(
    max_connections=256,
    max_url=8 * 1024,
    max_header_bytes=4 * 2**20,
    max_answers=0,  # none is large
    request_seconds=AUTH_TIMEOUT_SECONDS,
    idle_seconds=75.0,
)
LAST_WORDS_SECONDS = 1.0  # that requests in progress have at the end
READ_ONLY_ACTIONS = {"save"}  # what a page that only watches may ask for
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
log = logging.getLogger("rosout.rosafe_live")  # stderr and /rosout, as rospy.logerr


class ViewSubscriber(Protocol):
    """Somebody who looks at pictures: a page, or those who publish images."""

    def wake(self) -> None:
        """There are new columns."""

    def tell(self, about: str, message: Mapping[str, Any]) -> None:
        """There is news."""

    async def on_tree_changed(self, changed: set[Key]) -> None:
        """The tree has changed, and with it these views."""

    async def close(self) -> None:
        """The server ends."""


class WebServer:
    """The live page of `robot`.

    Parameters
    ----------
    robot : Robot
    hub : Hub
    health : Health
    door : Door
    asks : mapping
        What the page may ask for, by name; nothing but `look` where it is read-only.
    watch : bool
        Whether it is read-only.
    """

    def __init__(
        self, robot: ComponentFacade, hub: Hub, health: Health, door: TokenAuth, asks: Mapping[str, Ask], watch: bool
    ) -> None:
        self._robot, self._hub, self._health, self._door, self._watch = robot, hub, health, door, watch
        self._asks = {name: _watched(ask, name, watch) for name, ask in asks.items()}
        self._hello = {"version": VERSION, "watch": watch, **catalogue()}
        self._clients: set[ViewSubscriber] = set()
        self._tree_told: Any = None
        self._problem = ""
        self._fault = ""  # the last one in the log
        self._again = asyncio.Event()  # look at the components now
        self._files = {
            path.name: (path.read_bytes(), _TYPES[path.suffix]) for path in PAGE.iterdir() if path.suffix in _TYPES
        }
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.router.add_get("/", self._page)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/{name}", self._file)
        self._listener = HttpListener(app, Connections(LIMITS, _format_refusal, log))
        self._looking: asyncio.Task[None] | None = None

    async def start(self, host: str, port: int) -> int:
        """Listen and return the port; OSError where that cannot be."""
        taken = await self._listener.start(host, port)
        self._looking = asyncio.create_task(self._look())
        return taken

    async def close(self) -> None:
        """Stop listening, end all pages."""
        self._listener.stop_listening()
        if self._looking is not None:
            self._looking.cancel()
        await asyncio.gather(*(client.close() for client in self._clients), return_exceptions=True)
        await self._listener.close(LAST_WORDS_SECONDS)
        await asyncio.to_thread(self._hub.close)  # what a thread has begun meanwhile, too
        await asyncio.to_thread(self._health.close, for_good=True)

    def news(self) -> None:
        """There are new columns."""
        for client in self._clients:
            client.wake()

    def join(self, looker: ViewSubscriber) -> None:
        """From now on somebody looks."""
        if looker not in self._clients:
            self._clients.add(looker)
            self._tree_told = None
            self._again.set()

    def leave(self, looker: ViewSubscriber) -> None:
        """Somebody looks no longer."""
        self._clients.discard(looker)

    # --- who may ---

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        connection_of(request).request_parsed()
        try:
            self._door.check(request.headers, request.query)
            response = await handler(request)
        except HttpRefusal as refusal:
            response = _refused(refusal.status, str(refusal))
        except web.HTTPException as problem:
            response = _refused(problem.status, problem.reason)
        response.force_close()  # only the WebSocket authenticates a connection: others are not kept open
        return response

    # --- the page ---

    async def _page(self, request: web.Request) -> web.StreamResponse:
        return self._answer("index.html")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in self._files:
            raise web.HTTPNotFound
        return self._answer(name)

    def _answer(self, name: str) -> web.Response:
        body, kind = self._files[name]
        return web.Response(body=body, content_type=kind, charset="utf-8", headers=HEADERS)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        self._door.check_token(request.query)
        connection_of(request).mark_authenticated()
        if len(self._clients) >= MAX_CLIENTS:
            raise HttpRefusal(503, f"{MAX_CLIENTS} pages are open, which is as many as there may be")
        client = BrowserConnection(self._hub, self._asks, self._again.set)
        client.tell("hello", self._hello)
        self.join(client)
        try:
            return await client.serve(request)
        finally:
            self.leave(client)

    # --- the components ---

    async def _look(self) -> None:
        """Look at the components as long as somebody looks at the page, and tell what has changed."""
        listening = False
        while True:
            if not self._clients:
                if listening:
                    await asyncio.to_thread(self._health.close)
                    listening = False
                self._again.clear()
                await self._again.wait()
                continue
            self._again.clear()
            try:
                if not listening:
                    await asyncio.to_thread(self._health.listen)
                    listening = True
                await self._look_once()
            except Exception as fault:  # a fault of ours must not blind the page for ever
                if (text := f"{type(fault).__name__}: {fault}") != self._fault:
                    log.exception("looking at the components")
                    self._fault = text
            try:
                await asyncio.wait_for(self._again.wait(), LOOK_SECONDS)
            except TimeoutError:
                continue

    async def _look_once(self) -> None:
        try:
            await self._update_tree(await self._robot.tree())
            self._problem = ""
        except ComponentError as problem:  # what was shown stays: it may only be slow
            self._problem = format_error(problem)
        status = {
            "problem": self._problem,
            "malformed": self._hub.problems,
            "time": time.time(),
            **self._health.status(),
            **self._sound(),
        }
        for client in self._clients:
            client.tell("status", status)

    async def _update_tree(self, tree: TreeSnapshot) -> None:
        changed = await asyncio.to_thread(self._hub.on_tree_changed, tree)
        shown = [
            {"name": p.name, "kind": p.kind, "parent": p.parent, "topic": p.topic, "rate": p.rate, "values": p.values}
            for p in tree.processors.values()
        ]
        if changed or shown != self._tree_told:
            self._tree_told = shown
            for client in list(self._clients):
                client.tell("tree", {"processors": shown})
                await run_shared(client.on_tree_changed(changed))

    def _sound(self) -> dict[str, Any]:
        audio = self._hub.audio
        if audio is None:
            return {"sampleRate": 0, "silent": None, "delay": None, "latencies": {}}
        silent = time.monotonic() - audio.heard_at if audio.heard_at else None
        latencies = {topic: round(seconds, 4) for topic, seconds in list(self._hub.latencies.items())}
        return {
            "sampleRate": audio.sample_rate,
            "silent": silent,
            "delay": round(audio.delay, 4) if audio.heard_at else None,
            "latencies": latencies,
            "lostHere": self._hub.lost,
        }


def _watched(ask: Ask, name: str, watch: bool) -> Ask:
    if not watch or name in READ_ONLY_ACTIONS:
        return ask

    async def refuse(_: Mapping[str, Any]) -> dict[str, Any]:
        raise ValueError(f"{name}: this page is for watching only (rosafe live --watch)")

    return refuse


def _refused(status: int, why: str) -> web.StreamResponse:
    return web.Response(status=status, text=f"rosafe live: {why}\n", headers=HEADERS)


def _format_refusal(refusal: HttpRefusal) -> tuple[bytes, str]:
    return f"rosafe live: {refusal}\n".encode("utf-8", "backslashreplace"), "text/plain"
