"""Notifications to systemd from a service of Type=notify (sd_notify(3)); without systemd they do nothing."""

from __future__ import annotations

import contextlib
import os
import socket

SEND_SECONDS = 1.0


def notify(*assignments: str) -> None:
    """Send assignments such as ``READY=1`` in one datagram; failures are ignored, systemd has its own time limits."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if path:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.settimeout(SEND_SECONDS)
            sock.connect("\0" + path[1:] if path.startswith("@") else path)
            sock.send("\n".join(assignments).encode())


def watchdog_seconds() -> float | None:
    """Return the maximum interval of ``WATCHDOG=1`` that systemd expects; None without a watchdog."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    for_us = os.environ.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
    if not (for_us and microseconds.isascii() and microseconds.isdigit() and int(microseconds)):
        return None
    return int(microseconds) / 1e6
