"""The URL space of genomixd (docs/genomixd.md) on aiohttp, and who may use it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import unquote_to_bytes

from aiohttp import web

from rosafe.client.asyncio_tools import wait_any
from rosafe.client.component_client import ComponentClient, Value
from rosafe.client.graph import middleware_error
from rosafe.client.values import bad_value, parse_input
from rosafe.genomix import binary_format
from rosafe.genomix.activity_request import Request
from rosafe.genomix.names import Names
from rosafe.genomix.sessions import Session, Sessions
from rosafe.genomix.text_formats import JSON, SYNTAXES, TCL, Syntax, plain, structure
from rosafe.http_server.access import check_host, check_no_browser
from rosafe.http_server.connections import Connections, Limits
from rosafe.http_server.listener import HttpListener, connection_of
from rosafe.http_server.refusal import HttpRefusal
from rosafe.interface import ComponentError
from rosafe.version import VERSION

MAX_WAIT_MS = 3_600_000
FORMATTERS = 4  # threads
BATCH = 128 * 1024  # characters written at a time
REFUSAL_SECONDS = 0.05
ANSWER_SECONDS = 75.0  # for any answer that is not told to wait; a component has 60 s for its part
HEARTBEAT_SECONDS = 15.0  # between two signs of life to a listener
LAST_WORDS_SECONDS = 1.0  # that answers under way have at the end

LIMITS = Limits(
    max_connections=2000,
    max_url=256 * 1024,  # a list of 1024 numbers fits, percent-encoded
    max_header_bytes=16 * 2**20,
    max_answers=512 * 2**20,
    request_seconds=15.0,
    idle_seconds=3600.0,
)

log = logging.getLogger("genomixd")

_STATUS = {
    "::genom::serialization": 400,
    "::genom::no_such_service": 404,
    "::genom::no_such_outport": 404,
    "::genomix::e_noSuchRequest": 404,
    "::genomix::e_load": 404,
    "::genomix::e_forbidden": 403,
    "::genomix::e_url": 404,
    "::genomix::e_notDone": 409,
    "::genom::mwerr": 502,
    "::genom::unkex": 500,
    "::genomix::e_tooMany": 503,
}
_COMPONENT_ERROR = 422  # the request was understood, sent and refused
_SESSION_NAME = re.compile(r"[\w.:@-]{1,100}")
_PACKED = "packed"  # the one syntax that is not text
_HELP = """genomixd {version}: components of the ROS graph by HTTP GET.
Answers are JSON, with syntax=tcl Tcl dicts, with syntax=packed bytes for MATLAB and Octave.
/session/start?s=NAME  /session/stop?s=NAME  /session/listen?s=NAME (server-sent events: request, unload, quit)
/load/COMPONENT[?i=INSTANCE][&as=NAME]  /unload/NAME  /describe/NAME  /components  /rpath?dir=DIR
/call/NAME/SERVICE[?input=JSON]  /call/NAME/PORT[/ELEMENT]      waits for the result; an activity returns once it runs
/call/NAME/request?input=["ild",{{"fb_nChannels":16}}]          builds what a representation needs, or finds it
/send/NAME/SERVICE[?input=JSON][&ack][&oneway]                  returns the request's id and status at once
/request/status?id=ID  /request/result?id=ID  /request/wait?id=ID[&ms=N]  /request/abort?id=ID  /request/clean?id=ID
/requests
Every URL may carry s=SESSION. docs/genomixd.md tells the rest.
"""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
T = TypeVar("T")


class HttpApi:
    """The HTTP server for `sessions`.

    Parameters
    ----------
    sessions : Sessions
    names : Names
        Besides IP addresses and localhost, by which clients may call this machine.
    """

    def __init__(self, sessions: Sessions, names: Names) -> None:
        self._sessions = sessions
        self._names = names
        app = web.Application(middlewares=[self._guard])
        for path, handler in (
            ("/", self._help),
            ("/session/start", self._session_start),
            ("/session/stop", self._session_stop),
            ("/session/listen", self._session_listen),
            ("/load/{component:.+}", self._load),
            ("/unload/{name}", self._unload),
            ("/describe/{name}", self._describe),
            ("/components", self._components),
            ("/rpath", self._rpath),
            ("/call/{name}/{service}", self._call),
            ("/call/{name}/{service}/{element:.+}", self._call),
            ("/send/{name}/{service}", self._send),
            ("/send/{name}/{service}/{element:.+}", self._send),
            ("/request/status", self._request_status),
            ("/request/result", self._request_result),
            ("/request/wait", self._request_wait),
            ("/request/abort", self._request_abort),
            ("/request/clean", self._request_clean),
            ("/requests", self._requests),
        ):
            app.router.add_get(path, handler, allow_head=False)
        self._connections = Connections(LIMITS, _format_refusal, log)
        self._listener = HttpListener(app, self._connections)
        # A few threads for all results: more would only fight for the interpreter.
        self._formatters = ThreadPoolExecutor(FORMATTERS, "format")

    async def start(self, host: str, port: int) -> int:
        """Listen and return the port; OSError where that cannot be."""
        access_log = log if log.isEnabledFor(logging.DEBUG) else None
        return await self._listener.start(host, port, access_log)

    async def close(self) -> None:
        """Stop listening, end all sessions and connections."""
        self._listener.stop_listening()
        await self._sessions.close()
        await self._listener.close(LAST_WORDS_SECONDS)
        self._formatters.shutdown(wait=False, cancel_futures=True)

    # --- who may ---

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse what comes from a web page, and put every error into the client's syntax."""
        session: Session | None = None
        connection_of(request).request_parsed()
        try:
            await self._check_host(request)
            check_no_browser(request.headers)
            _check_url(request)
            if not _is_packed(request):
                _syntax(request)
            if not request.path.startswith("/session/"):
                session = self._session(request)
                session.busy += 1
            return await handler(request)
        except HttpRefusal as refusal:
            answer = _error(request, _refusal_error(refusal))
            if refusal.status == HTTPStatus.FORBIDDEN:
                answer.set_status(refusal.status)  # also of a packed answer: the clients know what it means
            answer.force_close()
            return answer
        except ComponentError as problem:
            return _error(request, problem)
        except web.HTTPException as problem:
            what = f"{request.method} {request.path[:200]}: {problem.reason}; see /"
            return _error(request, ComponentError("::genomix::e_url", what=what), problem.status)
        except (ConnectionResetError, asyncio.CancelledError):
            raise
        except Exception as problem:  # a fault of ours: the log has all, the client a line
            log.exception("%s", request.path_qs[:500])
            return _error(request, ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127]))
        finally:
            if session is not None:
                session.busy -= 1
                session.touch()

    async def _check_host(self, request: web.Request) -> None:
        advice = "genomixd --name NAME accepts a further name"
        try:
            check_host(request.headers, self._names.known, advice)
        except HttpRefusal:
            check_host(request.headers, await self._names.from_parameter(), advice)

    def _session(self, request: web.Request) -> Session:
        name = request.query.get("s", "")
        if name and not _SESSION_NAME.fullmatch(name):
            raise bad_value("s: a session's name has up to 100 letters, digits and . : @ _ -")
        return self._sessions.get(name, connection_of(request).account.address)

    # --- sessions ---

    async def _help(self, request: web.Request) -> web.Response:
        return _text(_HELP.format(version=VERSION))

    async def _session_start(self, request: web.Request) -> web.Response:
        if not request.query.get("s"):
            raise bad_value("s: the session needs a name")
        return _text(self._session(request).name)

    async def _session_stop(self, request: web.Request) -> web.Response:
        await self._sessions.stop(request.query.get("s", ""))
        return _text("")

    async def _session_listen(self, request: web.Request) -> web.StreamResponse:
        with self._connections.long_poll(connection_of(request)):
            return await self._listen(request, self._session(request), _syntax(request))

    async def _listen(self, request: web.Request, session: Session, form: Syntax) -> web.StreamResponse:
        queue = session.listen()
        try:
            response = web.StreamResponse(headers={"Content-Type": "text/event-stream", **_HEADERS})
            await response.prepare(request)
            await response.write(b": genomixd\n\n")
            while True:
                try:
                    event, data = await asyncio.wait_for(queue.get(), HEARTBEAT_SECONDS)
                except TimeoutError:
                    await response.write(b":\n\n")
                    continue
                if isinstance(data, Request):
                    data = "".join(_unwrapped(form, data.pieces(form)))
                elif data:
                    data = "".join(_unwrapped(form, iter((plain(form, data),))))
                await response.write(_utf8(f"event: {event}\ndata: {data}\n\n"))
                if event == "quit":
                    return response
        finally:
            session.leave(queue)

    # --- components ---

    async def _load(self, request: web.Request) -> web.StreamResponse:
        name = request.query.get("as", "")
        if name and not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise bad_value("as: letters, digits and _ only, a letter first")
        component, instance = request.match_info["component"], request.query.get("i", "")
        return _small(request, await self._in_time(self._session(request).load(component, instance, name)))

    async def _unload(self, request: web.Request) -> web.StreamResponse:
        await self._in_time(self._session(request).unload(request.match_info["name"]))
        return _small(request, {})

    async def _describe(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        return _small(request, (await self._in_time(self._component(request))).describe(name))

    async def _components(self, request: web.Request) -> web.StreamResponse:
        loaded = self._session(request).components
        return _small(request, {n: {"component": p.component.name, "instance": p.instance} for n, p in loaded.items()})

    async def _rpath(self, request: web.Request) -> web.StreamResponse:
        # Components are found on the graph: there are no plugins to look for. Scripts of the original say it anyway.
        return _small(request, {})

    # --- requests ---

    async def _component(self, request: web.Request) -> ComponentClient:
        name = request.match_info["name"]
        return await self._session(request).component(name, request.query.get("i", ""))

    async def _target(self, request: web.Request) -> tuple[Session, ComponentClient, str, Any, str]:
        session, path = self._session(request), request.match_info
        given = parse_input(request.query.get("input", request.query.get("argv", "")))
        proxy = await self._component(request)
        return session, proxy, path["service"], given, path.get("element", request.query.get("element", ""))

    async def _in_time(self, work: Coroutine[Any, Any, T]) -> T:
        """What `work` returns; ``::genom::mwerr`` where it waits too long, for what is ahead of it, say.

        It is cancelled then, and not waited for: to undo what it has done may take as long again.
        """
        task = asyncio.create_task(work)
        self._sessions.keep(task)
        try:
            await asyncio.wait({task}, timeout=ANSWER_SECONDS)
        finally:
            in_time = task.done()
            task.cancel()
        if not in_time:
            raise middleware_error(f"no answer within {ANSWER_SECONDS:g} s: other requests take too long")
        return task.result()

    async def _call(self, request: web.Request) -> web.StreamResponse:
        async def work() -> Value:
            session, proxy, name, given, element = await self._target(request)
            return await session.call(proxy, name, given, element)

        return await self._stream(request, await self._in_time(work()))

    async def _send(self, request: web.Request) -> web.StreamResponse:
        session, proxy, name, given, element = await self._in_time(self._target(request))
        oneway = _flag(request, "oneway")
        size = len(request.raw_path)
        sent = session.send(request.match_info["name"], proxy, name, given, element, not oneway, size)
        if oneway:
            return _small(request, {})
        if _flag(request, "ack"):
            with contextlib.suppress(TimeoutError):  # then it is still sent, as far as anybody knows
                await asyncio.wait_for(sent.acknowledged.wait(), ANSWER_SECONDS)
            with contextlib.suppress(TimeoutError):  # a refusal is acknowledged and then told, at once
                await asyncio.wait_for(sent.finished.wait(), REFUSAL_SECONDS)
        return _status(request, sent)

    def _known(self, request: web.Request) -> Request:
        return self._session(request).request(request.query.get("id", ""))

    async def _request_status(self, request: web.Request) -> web.StreamResponse:
        return _status(request, self._known(request))

    async def _request_result(self, request: web.Request) -> web.StreamResponse:
        known = self._known(request)
        if known.error is not None:
            raise known.error
        if known.status == "sent":
            raise ComponentError("::genomix::e_notDone", what=f"{known.id} is not done yet")
        return await self._stream(request, known.value)

    async def _request_wait(self, request: web.Request) -> web.StreamResponse:
        known, seconds = self._known(request), _milliseconds(request) / 1000
        connection = connection_of(request)
        with self._connections.long_poll(connection):
            await wait_any(known.finished, connection.gone, timeout=seconds)
        return _status(request, known)

    async def _request_abort(self, request: web.Request) -> web.StreamResponse:
        known = self._known(request)
        known.abort()
        return _status(request, known)

    async def _request_clean(self, request: web.Request) -> web.StreamResponse:
        self._session(request).clean(request.query.get("id", ""))
        return _small(request, {})

    async def _requests(self, request: web.Request) -> web.StreamResponse:
        return _small(request, {r.id: r.status for r in self._session(request).requests.values()})

    async def _stream(self, request: web.Request, value: Value) -> web.StreamResponse:
        """Send a value, however large, in pieces that are made in another thread as fast as the client takes them."""
        pieces = _encoded(request, value)
        if value.size <= BATCH // 8:
            return _respond(request, b"".join(pieces))
        with self._connections.reading_answer(connection_of(request), value.data, value.size):
            return await self._stream_pieces(request, pieces)

    async def _stream_pieces(self, request: web.Request, pieces: Iterator[bytes]) -> web.StreamResponse:
        response = web.StreamResponse(headers={"Content-Type": _media_type(request), **_HEADERS})
        await response.prepare(request)
        loop = asyncio.get_running_loop()
        while batch := await loop.run_in_executor(self._formatters, _batch, pieces):
            await response.write(batch)
        await response.write_eof()
        return response


# --- reading ----------------------------------------------------------------------------------------------------


def _check_url(request: web.Request) -> None:
    """Raise ``::genom::serialization`` for a URL that is no text: what was meant would silently be something else."""
    try:
        unquote_to_bytes(request.raw_path.encode("utf-8", "surrogateescape")).decode()
    except UnicodeDecodeError:
        raise bad_value("the URL is not UTF-8") from None


def _is_packed(request: web.Request) -> bool:
    return request.query.get("syntax") == _PACKED


def _syntax(request: web.Request) -> Syntax:
    name = request.query.get("syntax", "json")
    if name not in SYNTAXES:
        raise bad_value(f"syntax: {name[:20]!r} is not one of {', '.join((*SYNTAXES, _PACKED))}")
    return SYNTAXES[name]


def _written_in(request: web.Request) -> Syntax:
    """The syntax of an answer; JSON where what is asked for is none, which is an error to be told."""
    return SYNTAXES.get(request.query.get("syntax", "json"), SYNTAXES["json"])


def _flag(request: web.Request, name: str) -> bool:
    return request.query.get(name, "0").lower() not in ("0", "false", "no")


def _milliseconds(request: web.Request) -> int:
    text = request.query.get("ms", str(MAX_WAIT_MS))
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise bad_value(f"ms: {text[:20]!r} is not a number of milliseconds")
    return min(int(text), MAX_WAIT_MS)


# --- writing ----------------------------------------------------------------------------------------------------

_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def _text(text: str) -> web.Response:
    return web.Response(text=text, headers=_HEADERS)


def _utf8(text: str) -> bytes:
    """Half a surrogate pair, such as a node may send, has no UTF-8; it is told as an escape, as in exdetail."""
    return text.encode("utf-8", "backslashreplace")


def _unwrapped(form: Syntax, pieces: Iterator[str]) -> Iterator[str]:
    """A whole document: in Tcl the outermost braces would make it a list of one."""
    if form is not TCL:
        yield from pieces
        return
    held = next(pieces)[1:]
    for piece in pieces:
        yield held
        held = piece
    yield held[:-1]


def _encoded(request: web.Request, value: Value | Request) -> Iterator[bytes]:
    if _is_packed(request):
        return value.packed() if isinstance(value, Request) else binary_format.structure(*value.content)
    form = _syntax(request)
    pieces = value.pieces(form) if isinstance(value, Request) else structure(form, *value.content)
    return (_utf8(piece) for piece in _unwrapped(form, pieces))


def _media_type(request: web.Request) -> str:
    if _is_packed(request):
        return "application/octet-stream"
    return f"{_written_in(request).media_type}; charset=utf-8"


def _respond(request: web.Request, body: bytes, status: int = 200) -> web.Response:
    return web.Response(body=body, status=status, headers={"Content-Type": _media_type(request), **_HEADERS})


def _small(request: web.Request, value: Any) -> web.Response:
    if _is_packed(request):
        return _respond(request, binary_format.plain(value))
    form = _syntax(request)
    return _respond(request, _utf8("".join(_unwrapped(form, iter((plain(form, value),))))))


def _error(request: web.Request, error: ComponentError, status: int = 0) -> web.Response:
    if _is_packed(request):  # MATLAB and Octave lose the body of an answer with any other status
        return _respond(request, binary_format.error(error.body))
    form = _written_in(request)
    text = "".join(_unwrapped(form, iter((plain(form, error.body),))))
    return _respond(request, _utf8(text), status or _STATUS.get(error.ex, _COMPONENT_ERROR))


def _refusal_error(refusal: HttpRefusal) -> ComponentError:
    ex = {403: "e_forbidden", 503: "e_tooMany"}.get(refusal.status, "e_url")
    return ComponentError(f"::genomix::{ex}", what=str(refusal))


def _format_refusal(refusal: HttpRefusal) -> tuple[bytes, str]:
    return _utf8(plain(JSON, _refusal_error(refusal).body)), JSON.media_type


def _status(request: web.Request, known: Request) -> web.Response:
    return _respond(request, b"".join(_encoded(request, known)))


def _batch(pieces: Iterator[bytes]) -> bytes:
    parts: list[bytes] = []
    size = 0
    for piece in pieces:
        parts.append(piece)
        size += len(piece)
        if size >= BATCH:
            break
    return b"".join(parts)
