"""Errors that are raised in more than one place."""

from __future__ import annotations

from rosafe.interface import ComponentError


def too_many(what: str) -> ComponentError:
    """The error of a bound that is reached."""
    return ComponentError("::genomix::e_tooMany", what=what)
