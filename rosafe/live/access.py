"""Who may use the live page: those who know the token, under a name of this machine, and no page from elsewhere."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Collection, Mapping

from rosafe.http_server.access import check_host, check_same_origin, host_name
from rosafe.http_server.refusal import HttpRefusal

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
    """Who may use the live page: requests under a name of this machine, not of other pages; the socket needs the token.

    The files of the page contain no secret. Cookies are not used: browsers send them to every port of a host.

    Parameters
    ----------
    hosts : collection of str
        Names, besides IP addresses and localhost, by which clients may call this machine.

    Attributes
    ----------
    token : str
        Part of the URL of the page and of the WebSocket.
    """

    def __init__(self, hosts: Collection[str]) -> None:
        self.token = secrets.token_urlsafe(32)
        self._hosts = {host_name(host) for host in hosts}

    def check(self, headers: Mapping[str, str], query: Mapping[str, str]) -> None:
        """Raise HttpRefusal for requests to another name, of other pages, or with a wrong token."""
        check_host(headers, self._hosts, "use its IP address")
        check_same_origin(headers)
        if "token" in query:
            self.check_token(query)

    def check_token(self, query: Mapping[str, str]) -> None:
        """Raise HttpRefusal unless the query has the token."""
        if not _equal(query.get("token", ""), self.token):
            raise HttpRefusal(403, "the token is missing or an old one; open the URL that `rosafe live` has printed")


def _equal(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())
