"""The exception of the package; public scripts import it from this module."""

from __future__ import annotations

import json
from typing import Any


class GenoMError(RuntimeError):
    """A component or genomixd has rejected a request, or cannot be reached.

    Attributes
    ----------
    ex : str
        Name of the exception, such as ``::rosAFE::e_noSuchProcessor``.
    detail : dict
        Its members; empty if it has none.
    what : str
        The reason as text; empty if it is unknown.
    """

    def __init__(self, ex: str, detail: dict[str, Any] | None = None, what: str = "") -> None:
        super().__init__(ex, detail, what)  # the arguments, so that the exception can be pickled
        self.ex = ex
        self.detail = detail or {}
        self.what = str(self.detail.get("what", "")) or what

    def __str__(self) -> str:
        others = {name: value for name, value in self.detail.items() if name != "what"}
        parts = [self.ex, json.dumps(others) if others else "", self.what]
        return ": ".join(part for part in parts if part)


def error_of(body: Any) -> GenoMError:
    """Return the exception for the body of an error."""
    if not isinstance(body, dict) or "ex" not in body:
        return GenoMError("::genom::mwerr", what=f"expected an answer of genomixd, got {str(body)[:80]!r}")
    detail = body.get("detail")
    return GenoMError(str(body["ex"]), detail if isinstance(detail, dict) else None, str(body.get("what", "")))
