"""Who may use genomixd: programs that reach it under a name of this machine, and no web pages."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Collection, Mapping

from rosafe.interface import ComponentError


def refuse_web_pages(headers: Mapping[str, str], hosts: Collection[str]) -> None:
    """Raise ``::genomix::e_forbidden`` for what a page that someone happens to look at has sent.

    Pages can make browsers send GETs anywhere. Browsers say so, each in one of these ways at least; and a page cannot
    reach us under a name of its own (DNS rebinding), as only names of this machine count.

    Parameters
    ----------
    headers : mapping
        Of the HTTP request.
    hosts : collection of str
        Names, besides IP addresses, by which clients may call this machine, in lower case.
    """
    refuse_other_names(headers, hosts)
    for header in ("Origin", "Referer", "Sec-Fetch-Site", "Sec-Fetch-Mode", "Sec-Fetch-Dest"):
        if header in headers:
            raise _forbidden(f"requests of web pages and browsers are refused ({header})")
    if headers.get("User-Agent", "").startswith("Mozilla/"):
        raise _forbidden("requests of web browsers are refused (User-Agent)")


def refuse_other_names(headers: Mapping[str, str], hosts: Collection[str]) -> None:
    """Raise ``::genomix::e_forbidden`` for what was sent to a name that is not one of `hosts`, nor an IP address."""
    host = _host_name(headers.get("Host", ""))
    if host not in hosts and not _is_address(host):
        raise _forbidden(f"{host[:80]!r} is no name of this server; --host gives it one")


def own_names() -> set[str]:
    """What this machine is called by others."""
    return {socket.gethostname(), socket.getfqdn()}


def _host_name(header: str) -> str:
    """The host of a Host header, without port and brackets."""
    match = re.fullmatch(r"\[([^\]]+)\](:\d*)?|([^:]*)(:\d*)?", header.strip())
    return (match[1] or match[3] or "").lower().rstrip(".") if match else header.lower()


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _forbidden(what: str) -> ComponentError:
    return ComponentError("::genomix::e_forbidden", what=what)
