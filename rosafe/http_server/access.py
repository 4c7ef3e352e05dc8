"""Checks of the headers Host and Origin: only names of this machine, and no pages from elsewhere."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Collection, Mapping

from rosafe.http_server.refusal import HttpRefusal

_HOST = re.compile(r"(?:\[(?P<address>[0-9A-Fa-f:.]+)\]|(?P<name>[\w-]+(?:\.[\w-]+)*)\.?)(?::[0-9]{0,5})?", re.ASCII)


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
        Names of this machine, as `host_name` returns them; IP addresses and localhost count as well.
    advice : str
        What the user can do, the end of the text.
    """
    header = headers.get("Host", "")
    host = host_name(header)
    if host != "localhost" and host not in names and not _is_address(host):
        raise HttpRefusal(403, f"Host: {header[:80]!r} is not a name of this server; {advice}")


def own_names(environ: Mapping[str, str] = os.environ) -> set[str]:
    """Return the names of this machine: with and without domain, with .local, and that in ROS_HOSTNAME."""
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
