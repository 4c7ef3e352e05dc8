"""The HTTP interface of genomixd (docs/genomixd.md) on aiohttp: routes, access checks and answers."""

from __future__ import annotations

import asyncio
import logging
import os
import re
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import unquote_to_bytes

from aiohttp import web

from rosafe.interface import ComponentError
from rosafe.ros1.client.asyncio_tools import wait_any
from rosafe.ros1.client.component_client import Call, ComponentClient, Value
from rosafe.ros1.client.errors import bad_value, middleware_error
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.ros1.client.values import parse_input
from rosafe.system.version import VERSION
from rosafe.web.genomix.formats import JSON, PACKED, SYNTAXES, Syntax
from rosafe.web.genomix.sessions import Request, Session, Sessions
from rosafe.web.server.access import HttpRefusal, check_host, check_no_browser, host_name
from rosafe.web.server.connections import Connections, Limits
from rosafe.web.server.listener import HttpListener, connection_of

MAX_WAIT_MS = 3_600_000
FORMATTERS = 4  # threads
BATCH = 128 * 1024  # characters written at a time
REFUSAL_SECONDS = 0.05  # from the acknowledgement to the error of a request that a component of another project rejects
ANSWER_SECONDS = 75.0  # for any answer except /request/wait; a component has 60 s of these
HEARTBEAT_SECONDS = 15.0  # between two lines to an event listener
READ_SECONDS = 1.0  # between two reads of the parameter ~names, regardless of the number of requests
SHUTDOWN_SECONDS = 1.0  # for answers in progress at the end

LIMITS = Limits(
    max_connections=2000,
    max_url=256 * 1024,  # a list of 1024 numbers fits, percent-encoded
    max_header_bytes=16 * 2**20,
    max_answers=512 * 2**20,
    request_seconds=15.0,
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
_COMPONENT_ERROR = 422  # the component has rejected the request
_SESSION_NAME = re.compile(r"[\w.:@-]{1,100}")
_HELP = """genomixd {version}: HTTP access (GET) to the components of the ROS graph.
Namespace: {namespace}
Answers are JSON; with syntax=tcl they are Tcl dicts, with syntax=packed binary data for MATLAB and Octave.
/session/start?s=NAME  /session/stop?s=NAME  /session/listen?s=NAME (server-sent events: request, unload, quit)
/load/COMPONENT[?i=INSTANCE][&as=NAME]  /unload/NAME  /describe/NAME  /components  /rpath?dir=DIR
/call/NAME/SERVICE[?input=JSON]  /call/NAME/PORT[/ELEMENT]      waits for the result; an activity returns once it runs
/call/NAME/request?input=["ild",{{"fb_nChannels":16}}]          builds a representation with all that it needs
/send/NAME/SERVICE[?input=JSON][&ack][&oneway]                  returns the request's id and status immediately
/request/status?id=ID  /request/result?id=ID  /request/wait?id=ID[&ms=N][&ack]
/request/abort?id=ID  /request/clean?id=ID  /requests
Every URL accepts s=SESSION. See docs/genomixd.md for details.
"""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
T = TypeVar("T")


class HttpApi:
    """The HTTP server for `sessions`.

    Parameters
    ----------
    sessions : Sessions
    names : Names
        Names of this machine that are accepted in addition to IP addresses and localhost.
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
        # A few threads for all results: more would only compete for the GIL.
        self._formatters = ThreadPoolExecutor(FORMATTERS, "format")

    async def start(self, host: str, port: int) -> int:
        """Listen and return the port; OSError if the address cannot be used."""
        return await self._listener.start(host, port, log if log.isEnabledFor(logging.DEBUG) else None)

    async def close(self) -> None:
        """Stop listening, and end all sessions and connections."""
        self._listener.stop_listening()
        await self._sessions.close()
        await self._listener.close(SHUTDOWN_SECONDS)
        self._formatters.shutdown(wait=False, cancel_futures=True)

    # --- access ---

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Reject requests from web pages, and return every error in the client's syntax."""
        session: Session | None = None
        connection_of(request).request_parsed()
        try:
            await self._check_host(request)
            check_no_browser(request.headers)
            if request.method == "GET" and request.body_exists:
                raise HttpRefusal(400, "expected a GET request without a body")
            _check_url(request)
            _syntax(request)
            if not request.path.startswith("/session/"):
                session = self._session(request)
                session.busy += 1
            return await handler(request)
        except HttpRefusal as refusal:
            answer = _error(request, _refusal_error(refusal), refusal.status)
            if refusal.status == HTTPStatus.FORBIDDEN:
                answer.set_status(refusal.status)  # also of a packed answer: clients use the status
            answer.force_close()
            return answer
        except ComponentError as problem:
            return _error(request, problem)
        except web.HTTPException as problem:
            what = f"{request.method} {request.path[:200]}: {problem.reason}; see /"
            return _error(request, ComponentError("::genomix::e_url", what=what), problem.status)
        except (ConnectionResetError, asyncio.CancelledError):
            raise
        except Exception as problem:  # an internal error: the log gets the traceback, the client one line
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
            raise bad_value(f"s: expected up to 100 letters, digits and . : @ _ -, got {name[:100]!r}")
        return self._sessions.get(name, connection_of(request).account.address)

    # --- sessions ---

    async def _help(self, request: web.Request) -> web.Response:
        return _text(_HELP.format(version=VERSION, namespace=self._sessions.graph.resolve("")))

    async def _session_start(self, request: web.Request) -> web.Response:
        if not request.query.get("s"):
            raise bad_value("s: expected the name of the session")
        return _text(self._session(request).name)

    async def _session_stop(self, request: web.Request) -> web.Response:
        await self._sessions.stop(request.query.get("s", ""))
        return _text("")

    async def _session_listen(self, request: web.Request) -> web.StreamResponse:
        with self._connections.long_poll(connection_of(request)):
            return await _send_events(request, self._session(request), _syntax(request, binary=False))

    # --- components ---

    async def _load(self, request: web.Request) -> web.StreamResponse:
        name = request.query.get("as", "")
        if name and not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise bad_value(f"as: expected a letter, followed by letters, digits and _, got {name[:80]!r}")
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
        # Does nothing, because components are found on the graph. Scripts for the original use it to find plugins.
        return _small(request, {})

    # --- requests ---

    async def _component(self, request: web.Request) -> ComponentClient:
        name = request.match_info["name"]
        return await self._session(request).component(name, request.query.get("i", ""))

    async def _prepare(self, request: web.Request) -> Call:
        text_args = parse_input(request.query.get("input", request.query.get("argv", "")))
        element = request.match_info.get("element", request.query.get("element", ""))
        return (await self._component(request)).prepare_call(request.match_info["service"], text_args, element)

    async def _in_time(self, work: Coroutine[Any, Any, T]) -> T:
        """Return the result of `work`, or raise ``::genom::mwerr`` after `ANSWER_SECONDS`.

        The work is then cancelled, but not awaited, because undoing it may take equally long.
        """
        task = asyncio.create_task(work)
        self._sessions.keep(task)
        try:
            await asyncio.wait({task}, timeout=ANSWER_SECONDS)
        finally:
            in_time = task.done()
            task.cancel()
        if not in_time:
            raise middleware_error(f"no answer within {ANSWER_SECONDS:g} s; other requests take too long")
        return task.result()

    async def _call(self, request: web.Request) -> web.StreamResponse:
        async def work() -> Value:
            return await self._session(request).call(await self._prepare(request))

        return await self._stream(request, await self._in_time(work()))

    async def _send(self, request: web.Request) -> web.StreamResponse:
        call = await self._in_time(self._prepare(request))
        oneway = _flag(request, "oneway")
        sent = self._session(request).send(request.match_info["name"], call, not oneway, len(request.raw_path))
        if oneway:
            return _small(request, {})
        if _flag(request, "ack"):
            await _accepted(sent, ANSWER_SECONDS)
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
            raise ComponentError("::genomix::e_notDone", what=f"{known.id} has not finished yet")
        return await self._stream(request, known.value)

    async def _request_wait(self, request: web.Request) -> web.StreamResponse:
        known, seconds = self._known(request), _milliseconds(request) / 1000
        connection = connection_of(request)
        with self._connections.long_poll(connection):
            if _flag(request, "ack"):
                await _accepted(known, seconds, connection.gone)
            else:
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
        """Send a value of any size; pieces of a large one are formatted on a thread, as fast as the client reads."""
        pieces = _encoded(request, value)
        if value.size <= BATCH // 8:
            return _respond(request, b"".join(pieces))
        loop = asyncio.get_running_loop()
        with self._connections.reading_answer(value.data, value.size):
            response = web.StreamResponse(headers=_headers(request))
            await response.prepare(request)
            while batch := await loop.run_in_executor(self._formatters, _batch, pieces):
                await response.write(batch)
            await response.write_eof()
        return response


async def _send_events(request: web.Request, session: Session, syntax: Syntax) -> web.StreamResponse:
    """Send the events of a session to a listener until the session ends."""
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
                content = b"".join(syntax.document(data.pieces(syntax)))
            else:
                content = syntax.plain_document(data) if data else b""
            await response.write(b"event: %s\ndata: %s\n\n" % (event.encode(), content))
            if event == "quit":
                return response
    finally:
        session.leave(queue)


# --- names of this machine --------------------------------------------------------------------------------------


class Names:
    """The names that genomixd accepts in the header Host.

    Parameters
    ----------
    graph : Graph
        The graph whose master has the parameter.
    parameter : str
        The full name of the ROS parameter `~names`: a name, or a list of them.
    names : iterable of str
        Names that are always accepted.
    """

    def __init__(self, graph: Graph, parameter: str, names: Iterable[str]) -> None:
        self._graph, self._parameter = graph, parameter
        self.known: Collection[str] = {host_name(name) for name in names} - {""}
        self._next_read = 0.0
        self._value: Any = []
        self._from_parameter: Collection[str] = ()

    async def from_parameter(self) -> Collection[str]:
        """Return the names in `~names`, read at most once a second; the previous ones if the master does not answer."""
        now = asyncio.get_running_loop().time()
        if now >= self._next_read:
            self._next_read = now + READ_SECONDS
            try:
                value = await self._graph.master("getParam", self._parameter)
            except NotRegisteredError:
                value = []
            except ComponentError:
                return self._from_parameter
            if value != self._value:
                self._value = value
                self._from_parameter = _parse_names(value, self._parameter)
        return self._from_parameter


def parameter_name(arguments: Sequence[str], environ: Mapping[str, str] = os.environ) -> str:
    """Return the full name of `~names` for the node name that roslaunch or `__name:=` sets."""
    remappings = dict(text.split(":=", 1) for text in arguments if ":=" in text)
    namespace = remappings.get("__ns", environ.get("ROS_NAMESPACE", ""))
    path = f"{namespace}/{remappings.get('__name', 'genomixd')}/names"
    return "/" + "/".join(filter(None, path.split("/")))


def _parse_names(value: Any, parameter: str) -> set[str]:
    """Return the names in the value of a ROS parameter; other texts are logged."""
    names = set()
    for text in value if isinstance(value, list) else [value]:
        name = host_name(text) if isinstance(text, str) else ""
        if name:
            names.add(name)
        else:
            log.warning("%s: expected the name of a host, such as robot.lab, got %s", parameter, repr(text)[:80])
    return names


# --- reading ----------------------------------------------------------------------------------------------------


def _check_url(request: web.Request) -> None:
    """Raise ``::genom::serialization`` if the URL is not UTF-8: aiohttp would silently decode another text."""
    try:
        unquote_to_bytes(request.raw_path.encode("utf-8", "surrogateescape")).decode()
    except UnicodeDecodeError:
        raise bad_value("URL: expected UTF-8") from None


def _syntax(request: web.Request, binary: bool = True) -> Syntax:
    """Return the syntax that a client requests; ``::genom::serialization`` if it is unknown, or binary for events."""
    name = request.query.get("syntax", JSON.name)
    known = [known for known, syntax in SYNTAXES.items() if binary or syntax is not PACKED]
    if name not in known:
        raise bad_value(f"syntax: expected one of {', '.join(known)}, got {name[:20]!r}")
    return SYNTAXES[name]


def _answer_syntax(request: web.Request) -> Syntax:
    """Return the syntax of an answer; JSON for the error about an unknown syntax."""
    return SYNTAXES.get(request.query.get("syntax", JSON.name), JSON)


async def _accepted(sent: Request, seconds: float, *events: asyncio.Event) -> None:
    """Wait until the activity runs or has failed, for an event, or for some seconds."""
    await wait_any(sent.acknowledged, *events, timeout=seconds)
    if sent.acknowledged.is_set():
        await wait_any(sent.finished, *events, timeout=REFUSAL_SECONDS)


def _flag(request: web.Request, name: str) -> bool:
    return request.query.get(name, "0").lower() not in ("0", "false", "no")


def _milliseconds(request: web.Request) -> int:
    text = request.query.get("ms", str(MAX_WAIT_MS))
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise bad_value(f"ms: expected a number of milliseconds, got {text[:20]!r}")
    return min(int(text), MAX_WAIT_MS)


# --- writing ----------------------------------------------------------------------------------------------------

_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def _text(text: str) -> web.Response:
    return web.Response(text=text, headers=_HEADERS)


def _encoded(request: web.Request, value: Value | Request) -> Iterator[bytes]:
    syntax = _syntax(request)
    return syntax.document(value.pieces(syntax) if isinstance(value, Request) else syntax.structure(*value.content))


def _headers(request: web.Request) -> dict[str, str]:
    return {"Content-Type": _answer_syntax(request).content_type, **_HEADERS}


def _respond(request: web.Request, body: bytes, status: int = 200) -> web.Response:
    return web.Response(body=body, status=status, headers=_headers(request))


def _small(request: web.Request, value: Any) -> web.Response:
    return _respond(request, _syntax(request).plain_document(value))


def _error(request: web.Request, error: ComponentError, status: int = 0) -> web.Response:
    syntax = _answer_syntax(request)
    if syntax is PACKED:  # MATLAB and Octave ignore the body of an answer with another status than 200
        return _respond(request, syntax.error(error.body))
    return _respond(request, syntax.error(error.body), status or _STATUS.get(error.ex, _COMPONENT_ERROR))


def _refusal_error(refusal: HttpRefusal) -> ComponentError:
    ex = {403: "e_forbidden", 503: "e_tooMany"}.get(refusal.status, "e_url")
    return ComponentError(f"::genomix::{ex}", what=str(refusal))


def _format_refusal(refusal: HttpRefusal) -> tuple[bytes, str]:
    return JSON.error(_refusal_error(refusal).body), "application/json"


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
