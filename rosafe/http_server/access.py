"""Checks of the headers Host and Origin: only names of this machine, and no pages from elsewhere."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Collection, Mapping

from rosafe.http_server.refusal import HttpRefusal


def check_no_browser(headers: Mapping[str, str]) -> None:
    """Raise HttpRefusal for requests that a web page can make a browser send.

    Pages can make browsers send GET requests to any server. Browsers mark them in at least one of these ways.
    """
    for header in ("Origin", "Referer", "Sec-Fetch-Site", "Sec-Fetch-Mode", "Sec-Fetch-Dest"):
        if header in headers:
            raise HttpRefusal(403, f"requests of web pages and browsers are refused ({header})")
    if headers.get("User-Agent", "").startswith("Mozilla/"):
        raise HttpRefusal(403, "requests of web browsers are refused (User-Agent)")


def check_same_origin(headers: Mapping[str, str]) -> None:
    """Raise HttpRefusal for requests of pages that another server has delivered."""
    origin = headers.get("Origin")
    if origin is not None and origin.lower() != f"http://{headers.get('Host', '')}".lower():
        raise HttpRefusal(403, "requests of pages from elsewhere are refused (Origin)")
    if headers.get("Sec-Fetch-Site") in ("cross-site", "same-site") and headers.get("Sec-Fetch-Mode") != "navigate":
        raise HttpRefusal(403, "requests of pages from elsewhere are refused (Sec-Fetch-Site)")


def check_host(headers: Mapping[str, str], names: Collection[str], advice: str) -> None:
    """Raise HttpRefusal for requests to a name of another machine, as DNS rebinding causes them.

    Parameters
    ----------
    headers : mapping
        Of the HTTP request.
    names : collection of str
        Names of this machine, in lower case; IP addresses and localhost count as well.
    advice : str
        What the user can do, the end of the text.
    """
    host = _host_name(headers.get("Host", ""))
    if host != "localhost" and host not in names and not _is_address(host):
        raise HttpRefusal(403, f"{host[:80]!r} is not a name of this server; {advice}")


def own_names() -> set[str]:
    """Return the names of this machine, in lower case."""
    return {socket.gethostname().lower(), socket.getfqdn().lower()}


def _host_name(header: str) -> str:
    """Return the host of a Host header, without port and brackets."""
    match = re.fullmatch(r"\[([^\]]+)\](:\d*)?|([^:]*)(:\d*)?", header.strip())
    return (match[1] or match[3] or "").lower().rstrip(".") if match else header.lower()


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
