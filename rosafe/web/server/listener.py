"""A listening socket that serves an aiohttp application with limited connections."""

from __future__ import annotations

import asyncio
import errno
import functools
import logging
import os
import socket

from aiohttp import web

from rosafe.web.server.connections import Connections, HttpConnection

BACKLOG = 512  # connections that the kernel completes before they are accepted
ACCEPTED_AT_ONCE = 8  # connections of a burst; otherwise they would all be busy before the first request is handled


class ListenError(OSError):
    """A server cannot listen at an address; the text is one line with the reason and the next step for the user."""

    def __init__(self, problem: OSError | UnicodeError, host: str, port: int) -> None:
        number = getattr(problem, "errno", None)
        address = f"port {port} of {host}"
        if number == errno.EADDRINUSE:
            text = f"{address} is in use, perhaps by another instance of this program; choose another with --port"
        elif number == errno.EACCES:
            text = f"permission denied for {address}; choose another with --port"
        elif number in (errno.EADDRNOTAVAIL, None):  # None: a UnicodeError
            text = f"--host: expected a name or address of this machine, got {host!r}"
        else:
            text = f"cannot listen on {address}: {getattr(problem, 'strerror', None) or problem}"
        super().__init__(text)


class HttpListener:
    """Serve `app` to connections that `connections` admits.

    The middleware of `app` calls `connection_of(request).request_parsed()` first.

    Parameters
    ----------
    app : aiohttp.web.Application
    connections : Connections
    """

    def __init__(self, app: web.Application, connections: Connections) -> None:
        self._runner = web.AppRunner(app)
        self._connections = connections
        self._listener: asyncio.AbstractServer | None = None

    async def start(self, host: str, port: int, access_log: logging.Logger | None = None) -> int:
        """Listen and return the port; ListenError if the address cannot be used."""
        await self._runner.setup()
        assert self._runner.server is not None
        connect = functools.partial(HttpConnection, self._connections, self._runner.server, access_log=access_log)
        try:
            loop = asyncio.get_running_loop()
            self._listener = await loop.create_server(connect, host, port, backlog=ACCEPTED_AT_ONCE)
        except (OSError, UnicodeError) as problem:
            raise ListenError(problem, host, port) from None
        for listening in self._listener.sockets:
            with socket.socket(fileno=os.dup(listening.fileno())) as same:
                same.listen(BACKLOG)  # asyncio has one number for both
        return int(self._listener.sockets[0].getsockname()[1])

    def stop_listening(self) -> None:
        """Accept no further connections."""
        if self._listener is not None:
            self._listener.close()

    async def close(self, seconds: float) -> None:
        """Close all connections. Requests in progress have `seconds` to finish."""
        self.stop_listening()
        if self._runner.server is not None:
            await self._runner.server.shutdown(seconds)
        await self._runner.cleanup()


def connection_of(request: web.BaseRequest) -> HttpConnection:
    """Return the connection that a request came on."""
    connection = request.protocol
    assert isinstance(connection, HttpConnection)
    return connection
