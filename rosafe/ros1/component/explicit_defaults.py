"""Connection header by which clients declare that they send all parameters explicitly and read warnings.

Plain ROS requests carry no defaults, so that a zero in them means the default. genomixd and `rosafe request` fill in
all defaults: their values are used literally. They also read the warning of an accepted request. Other clients get an
empty `genom_exdetail` in this case, and find the warning in the log.
"""

from __future__ import annotations

import json
from typing import Any

HEADER = {"rosafe_complete": "1"}  # fields of the connection header


def has_explicit_defaults(message: Any) -> bool:
    """Return whether a request or message was received on a connection with this header."""
    header = getattr(message, "_connection_header", None) or {}
    return all(header.get(name) == value for name, value in HEADER.items())


def warning_exdetail(message: Any, warning: str) -> str:
    """Return the `genom_exdetail` of the response to an accepted request `message`, with or without a warning."""
    return json.dumps({"warning": warning}, ensure_ascii=False) if warning and has_explicit_defaults(message) else ""


def warning_in(exdetail: str) -> str:
    """Return the warning in a `genom_exdetail`, or an empty string if there is none."""
    try:
        detail = json.loads(exdetail) if exdetail else {}
    except ValueError:
        detail = {}
    warning = detail.get("warning", "") if isinstance(detail, dict) else ""
    return warning if isinstance(warning, str) else ""
