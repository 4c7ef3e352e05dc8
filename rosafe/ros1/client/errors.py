"""Errors that are raised in more than one module."""

from __future__ import annotations

from rosafe.interface import ComponentError


def too_many(what: str) -> ComponentError:
    """Return the error of a limit that is reached."""
    return ComponentError("::genomix::e_tooMany", what=what)


def bad_value(what: str) -> ComponentError:
    """Return the error of an invalid argument, which is not sent to the component."""
    return ComponentError("::genom::serialization", what=what)


def cannot_load(what: str) -> ComponentError:
    """Return the error of a component that cannot be offered to clients."""
    return ComponentError("::genomix::e_load", what=what)


def middleware_error(what: str) -> ComponentError:
    """Return the error of a component or master that cannot be reached or does not answer."""
    return ComponentError("::genom::mwerr", what=what)
