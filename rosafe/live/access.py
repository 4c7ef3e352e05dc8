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


class Door:
    """Lets in requests with the token in the URL, or with the cookie that the page got for it.

    Parameters
    ----------
    hosts : collection of str
        Names, besides IP addresses and localhost, by which clients may call this machine.

    Attributes
    ----------
    cookie_name : str
        Another one for each port: browsers send the cookies of all servers of a machine to each of them.
    """

    def __init__(self, hosts: Collection[str]) -> None:
        self.token = secrets.token_urlsafe(32)
        self.cookie_name = "rosafe_live"
        self.cookie = secrets.token_urlsafe(32)
        self._hosts = {host_name(host) for host in hosts}

    def refusal(self, headers: Mapping[str, str], query: Mapping[str, str], cookies: Mapping[str, str]) -> str:
        """Why a request is refused, in one line; empty where it is let in."""
        try:
            check_host(headers, self._hosts, "use its IP address")
            check_same_origin(headers)
        except HttpRefusal as refusal:
            return str(refusal)
        if not (self.has_token(query) or _equal(cookies.get(self.cookie_name, ""), self.cookie)):
            return "open the URL that `rosafe live` has printed: its token is missing here, or an old one"
        return ""

    def has_token(self, query: Mapping[str, str]) -> bool:
        """Whether the URL has the token."""
        return _equal(query.get("token", ""), self.token)


def _equal(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())
