"""A listening socket that serves an aiohttp application with limited connections."""

from __future__ import annotations

import asyncio
import functools
import logging

from aiohttp import web

from rosafe.http_server.connections import Connections, HttpConnection

BACKLOG = 512  # connections that the kernel completes before they are accepted


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
        """Listen and return the port; OSError if the address cannot be used."""
        await self._runner.setup()
        assert self._runner.server is not None
        connect = functools.partial(HttpConnection, self._connections, self._runner.server, access_log=access_log)
        self._listener = await asyncio.get_running_loop().create_server(connect, host, port, backlog=BACKLOG)
        return int(self._listener.sockets[0].getsockname()[1])

    def stop_listening(self) -> None:
        """Accept no further connections."""
        if self._listener is not None:
            self._listener.close()

    async def close(self, seconds: float) -> None:
        """Close all connections; requests in progress have `seconds` to end."""
        self.stop_listening()
        if self._runner.server is not None:
            await self._runner.server.shutdown(seconds)
        await self._runner.cleanup()


def connection_of(request: web.BaseRequest) -> HttpConnection:
    """Return the connection that a request came on."""
    connection = request.protocol
    assert isinstance(connection, HttpConnection)
    return connection
