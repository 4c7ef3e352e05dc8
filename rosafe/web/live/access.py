"""Access control of the live page: a token, the Host header and the Origin header."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Collection, Mapping

from rosafe.web.server.access import HttpRefusal, check_host, check_same_origin, host_name

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class TokenAuth:
    """Checks the requests: the Host header must name this machine, the Origin header this page.

    The WebSocket also requires the token. The files of the page contain no secret and do not. Cookies are not used,
    because browsers send them to every port of a host.

    Parameters
    ----------
    hosts : collection of str
        Host names that are accepted in addition to IP addresses and localhost.

    Attributes
    ----------
    token : str
        Part of the URL of the page and of the WebSocket.
    """

    def __init__(self, hosts: Collection[str]) -> None:
        self.token = secrets.token_urlsafe(32)
        self._hosts = {host_name(host) for host in hosts}

    def check(self, headers: Mapping[str, str], query: Mapping[str, str]) -> None:
        """Raise HttpRefusal if the request is for another host, from another page, or has a wrong token."""
        check_host(headers, self._hosts, "use its IP address")
        check_same_origin(headers)
        if "token" in query:
            self.check_token(query)

    def check_token(self, query: Mapping[str, str]) -> None:
        """Raise HttpRefusal unless the query has the token."""
        token = query.get("token", "").encode("utf-8", "replace")
        if not hmac.compare_digest(token, self.token.encode()):
            raise HttpRefusal(403, "the token is missing or outdated; open the URL that `rosafe live` has printed")
