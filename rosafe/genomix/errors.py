"""Errors as clients get them, and those that are raised in more than one place."""

from __future__ import annotations

from typing import Any

from rosafe.interface import ComponentError


def error_body(error: ComponentError) -> dict[str, Any]:
    """An exception as clients get it."""
    return {"ex": error.ex, **({"detail": error.detail} if error.detail else {})}


def too_many(what: str) -> ComponentError:
    """The error of a bound that is reached."""
    return ComponentError("::genomix::e_tooMany", what=what)
