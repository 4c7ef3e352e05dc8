"""How clients that know the interface table mark their connections: what they send is complete, what they get is read.

Plain ROS requests carry no defaults, so a zero in them means the default. genomixd and `rosafe request` have filled in
all defaults: what they send is taken literally. They also read the warnings of a request that is granted, which plain
clients, for whom `genom_exdetail` is empty then, find in the log.
"""

from __future__ import annotations

import json
from typing import Any

HEADER = {"rosafe_complete": "1"}  # fields of the connection's header


def has_explicit_defaults(message: Any) -> bool:
    """Whether a request or message came on a marked connection."""
    header = getattr(message, "_connection_header", None) or {}
    return all(header.get(name) == value for name, value in HEADER.items())


def accepts_warnings(message: Any, warning: str) -> str:
    """The `genom_exdetail` of the answer to the request `message` that is granted with a warning, or without."""
    return json.dumps({"warning": warning}, ensure_ascii=False) if warning and has_explicit_defaults(message) else ""


def warning_in(exdetail: str) -> str:
    """What `accepts_warnings` has put into an answer; empty where that is nothing."""
    try:
        told = json.loads(exdetail) if exdetail else {}
    except ValueError:
        told = {}
    warning = told.get("warning", "") if isinstance(told, dict) else ""
    return warning if isinstance(warning, str) else ""
