"""The HTTP server of the live page, with aiohttp: the files of the page, and a WebSocket for each window."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from aiohttp import web

from rosafe.interface import ComponentError
from rosafe.ros1.client.asyncio_tools import run_shared
from rosafe.ros1.client.tree_snapshot import TreeSnapshot
from rosafe.system.version import VERSION
from rosafe.web.live.access import HEADERS, TokenAuth
from rosafe.web.live.client import BrowserConnection
from rosafe.web.live.components import Action, ComponentFacade, catalogue, format_error
from rosafe.web.live.health import Health
from rosafe.web.live.views import Hub
from rosafe.web.server.access import HttpRefusal
from rosafe.web.server.connections import Connections, Limits
from rosafe.web.server.listener import HttpListener, connection_of

PAGE = Path(__file__).with_name("page")
POLL_SECONDS = 1.0  # between two requests to the components, while a page is open
MAX_CLIENTS = 32
AUTH_TIMEOUT_SECONDS = 10.0  # a connection that has not sent a complete request by then is closed
LIMITS = Limits(
    max_connections=256,
    max_url=8 * 1024,
    max_header_bytes=4 * 2**20,
    max_answers=0,  # there are no large answers
    request_seconds=AUTH_TIMEOUT_SECONDS,
)
CLOSE_SECONDS = 1.0  # for requests in progress when the server ends
READ_ONLY_ACTIONS = {"save"}  # requests that are allowed with --watch
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
log = logging.getLogger("rosout.rosafe_live")  # stderr and /rosout, as rospy.logerr


class WebServer:
    """The server of the live page.

    Parameters
    ----------
    components : ComponentFacade
    hub : Hub
    health : Health
    auth : TokenAuth
    watch : bool
        Whether pages may only watch: all requests except `look` and the read-only ones are rejected.
    """

    def __init__(
        self,
        components: ComponentFacade,
        hub: Hub,
        health: Health,
        auth: TokenAuth,
        watch: bool,
    ) -> None:
        self._components, self._hub, self._health, self._auth = components, hub, health, auth
        self._actions = {
            name: _reject(name) if watch and name not in READ_ONLY_ACTIONS else action
            for name, action in components.actions().items()
        }
        self._hello = {"version": VERSION, "watch": watch, **catalogue()}
        self._clients: set[BrowserConnection] = set()
        self._background = False
        self._sent_tree: Any = None
        self._problem = ""
        self._logged_fault = ""
        self._poll_now = asyncio.Event()
        self._files = {
            path.name: (path.read_bytes(), _TYPES[path.suffix]) for path in PAGE.iterdir() if path.suffix in _TYPES
        }
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.router.add_get("/", self._file)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/{name}", self._file)
        self._listener = HttpListener(app, Connections(LIMITS, _format_refusal, log))
        self._polling: asyncio.Task[None] | None = None

    async def start(self, host: str, port: int) -> int:
        """Listen and return the port; raise OSError if that is not possible."""
        port = await self._listener.start(host, port)
        self._polling = asyncio.create_task(self._poll())
        return port

    async def close(self) -> None:
        """Stop listening and close all connections."""
        self._listener.stop_listening()
        if self._polling is not None:
            self._polling.cancel()
        await asyncio.gather(*(client.close() for client in self._clients), return_exceptions=True)
        await self._listener.close(CLOSE_SECONDS)
        await asyncio.to_thread(self._hub.close)  # including subscriptions that a thread is about to begin
        await asyncio.to_thread(self._health.close, permanent=True)

    def on_new_columns(self) -> None:
        """Notify the pages of new columns."""
        for client in self._clients:
            client.wake()

    def set_background_polling(self, enabled: bool) -> None:
        """Follow the changes of the tree even if no page is open."""
        if enabled and not self._background:
            self._poll_now.set()
        self._background = enabled

    # --- access ---

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        connection_of(request).request_parsed()
        try:
            self._auth.check(request.headers, request.query)
            response = await handler(request)
        except HttpRefusal as refusal:
            response = _error(refusal.status, str(refusal))
        except web.HTTPException as problem:
            response = _error(problem.status, problem.reason)
        response.force_close()  # connections that are not authenticated, which only the WebSocket is, are not kept open
        return response

    # --- the page ---

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "index.html")
        if name not in self._files:
            raise web.HTTPNotFound
        body, content_type = self._files[name]
        return web.Response(body=body, content_type=content_type, charset="utf-8", headers=HEADERS)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        self._auth.check_token(request.query)
        connection_of(request).mark_authenticated()
        if len(self._clients) >= MAX_CLIENTS:
            raise HttpRefusal(503, f"the limit of {MAX_CLIENTS} open pages is reached")
        client = BrowserConnection(self._hub, self._actions, self._poll_now.set)
        client.send_latest("hello", self._hello)
        self._clients.add(client)
        self._sent_tree = None
        self._poll_now.set()
        try:
            return await client.serve(request)
        finally:
            self._clients.discard(client)

    # --- the components ---

    async def _poll(self) -> None:
        """Request the state of the components while a page is open, and send it to the pages."""
        while True:
            if not (self._clients or self._background):
                self._poll_now.clear()
                await asyncio.to_thread(self._health.close)
                await self._poll_now.wait()
                continue
            self._poll_now.clear()
            try:
                await asyncio.to_thread(self._health.listen)
                await self._update()
            except Exception as fault:  # an internal error must not stop the updates of the page
                if (text := f"{type(fault).__name__}: {fault}") != self._logged_fault:
                    log.exception("updating the state of the components")
                    self._logged_fault = text
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._poll_now.wait(), POLL_SECONDS)

    async def _update(self) -> None:
        try:
            await self._update_tree(await self._components.tree())
            self._problem = ""
        except ComponentError as problem:  # the known tree is kept: rosAFE may only be slow
            self._problem = format_error(problem)
        status = {
            "problem": self._problem,
            "malformed": self._hub.problems,
            "time": time.time(),
            **self._health.status(),
            **self._audio_status(),
        }
        for client in self._clients:
            client.send_latest("status", status)

    async def _update_tree(self, tree: TreeSnapshot) -> None:
        changed = await asyncio.to_thread(self._hub.on_tree_changed, tree)
        processors = [
            {"name": p.name, "kind": p.kind, "parent": p.parent, "topic": p.topic, "rate": p.rate, "values": p.values}
            for p in tree.processors.values()
        ]
        if changed or processors != self._sent_tree:
            self._sent_tree = processors
            for client in list(self._clients):
                client.send_latest("tree", {"processors": processors})
                await run_shared(client.on_tree_changed(changed))

    def _audio_status(self) -> dict[str, Any]:
        audio = self._hub.audio
        if audio is None:
            return {"sampleRate": 0, "silent": None, "delay": None, "latencies": {}}
        received = audio.received_at > 0
        return {
            "sampleRate": audio.sample_rate,
            "silent": time.monotonic() - audio.received_at if received else None,
            "delay": round(audio.delay, 4) if received else None,
            "latencies": {topic: round(seconds, 4) for topic, seconds in list(self._hub.latencies.items())},
            "lostHere": self._hub.lost,
        }


def _reject(name: str) -> Action:
    async def reject(_: Mapping[str, Any]) -> dict[str, Any]:
        raise ValueError(f"{name}: not allowed, this page only watches (rosafe live --watch)")

    return reject


def _error(status: int, reason: str) -> web.StreamResponse:
    return web.Response(status=status, text=f"rosafe live: {reason}\n", headers=HEADERS)


def _format_refusal(refusal: HttpRefusal) -> tuple[bytes, str]:
    return f"rosafe live: {refusal}\n".encode("utf-8", "backslashreplace"), "text/plain"
