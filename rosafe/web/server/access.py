"""Refused requests; checks of the headers Host and Origin: names of this machine only, no pages of other servers."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Collection, Mapping

_HOST = re.compile(r"(?:\[(?P<address>[0-9A-Fa-f:.]+)\]|(?P<name>[\w-]+(?:\.[\w-]+)*)\.?)(?::[0-9]{0,5})?", re.ASCII)


class HttpRefusal(Exception):
    """A refused request or connection; the text is one line for the client.

    Parameters
    ----------
    status : int
        HTTP status: 403 (not allowed), 503 (a limit is reached), or another one from 400 on.
    reason : str
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def check_no_browser(headers: Mapping[str, str]) -> None:
    """Raise HttpRefusal for requests that a web page can cause a browser to send.

    Pages can cause browsers to send GET requests to any server. Browsers mark them in at least one of these ways.
    """
    for header in ("Origin", "Referer", "Sec-Fetch-Site", "Sec-Fetch-Mode", "Sec-Fetch-Dest"):
        if header in headers:
            raise HttpRefusal(403, f"requests from web pages and browsers are refused ({header})")
    if headers.get("User-Agent", "").startswith("Mozilla/"):
        raise HttpRefusal(403, "requests from web browsers are refused (User-Agent)")


def check_same_origin(headers: Mapping[str, str]) -> None:
    """Raise HttpRefusal for requests from pages that another server has delivered."""
    origin = headers.get("Origin")
    if origin is not None and origin.lower() != f"http://{headers.get('Host', '')}".lower():
        raise HttpRefusal(403, "requests from pages of other servers are refused (Origin)")
    if headers.get("Sec-Fetch-Site") in ("cross-site", "same-site") and headers.get("Sec-Fetch-Mode") != "navigate":
        raise HttpRefusal(403, "requests from pages of other servers are refused (Sec-Fetch-Site)")


def check_host(headers: Mapping[str, str], names: Collection[str], advice: str) -> None:
    """Raise HttpRefusal for requests to a name of another machine, as caused by DNS rebinding.

    Parameters
    ----------
    headers : mapping
        Headers of the HTTP request.
    names : collection of str
        Names of this machine, as `host_name` returns them. IP addresses and localhost are always accepted.
    advice : str
        Next step for the user: the end of the message.
    """
    header = headers.get("Host", "")
    host = host_name(header)
    if host != "localhost" and host not in names and not _is_address(host):
        raise HttpRefusal(403, f"Host: expected a name of this server, got {header[:80]!r}; {advice}")


def own_names(environ: Mapping[str, str] = os.environ) -> set[str]:
    """Return the names of this machine: with and without domain, with .local, and ROS_HOSTNAME."""
    host = socket.gethostname()
    short = host.partition(".")[0]
    names = {host, socket.getfqdn(), short, f"{short}.local", environ.get("ROS_HOSTNAME", "")}
    return {host_name(name) for name in names} - {""}


def host_name(text: str) -> str:
    """Return the host of a Host header or URL in lower case, without port, brackets and final dot; "" if malformed."""
    match = _HOST.fullmatch(text.strip(" \t"))
    return (match["address"] or match["name"]).lower() if match else ""


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
