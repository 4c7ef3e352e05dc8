"""What systemd is told by a service of Type=notify (sd_notify(3)): one datagram each. Elsewhere nothing happens."""

from __future__ import annotations

import contextlib
import os
import socket

SEND_SECONDS = 1.0


def notify(*assignments: str) -> None:
    """Send assignments such as ``READY=1``; where nobody takes them, that is for systemd to notice."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if path:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.settimeout(SEND_SECONDS)
            sock.connect("\0" + path[1:] if path.startswith("@") else path)
            sock.send("\n".join(assignments).encode())


def watchdog_seconds() -> float | None:
    """How often systemd wants to hear ``WATCHDOG=1`` of this process at least; None where it does not care."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    meant = os.environ.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
    if not (meant and microseconds.isascii() and microseconds.isdigit() and int(microseconds)):
        return None
    return int(microseconds) / 1e6
