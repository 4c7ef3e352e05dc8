"""Named exceptions of components, as sent to clients."""

from __future__ import annotations

import json
from typing import Any

MAX_WHAT = 4000  # characters of a reason


class ComponentError(Exception):
    """A named exception of the interface.

    Parameters
    ----------
    ex : str
        Full identifier, such as ``::rosAFE::e_noData`` or ``::genom::no_such_inport``.
    why : str, optional
        The reason, one line of text. It is sent as ``what`` if the exception has no member of that name.
    **detail
        The members of the exception, such as ``what`` of ``::rosAFE::e_badNewValue``.
    """

    def __init__(self, ex: str, why: str = "", **detail: Any) -> None:
        super().__init__(why or detail.get("what") or ex)
        self.ex = ex
        self.reason = why
        self.detail = detail

    @property
    def what(self) -> str:
        """The reason as text; empty if it is unknown."""
        return str(self.detail.get("what", "")) or self.reason

    @property
    def body(self) -> dict[str, Any]:
        """The error as sent to clients: ``ex``, ``detail`` if it has members, ``what`` if it is not one of these."""
        body: dict[str, Any] = {"ex": self.ex}
        if self.detail:
            body["detail"] = self.detail
        if self.reason and "what" not in self.detail:
            body["what"] = self.reason[:MAX_WHAT]
        return body

    @property
    def exdetail(self) -> str:
        """The JSON text for `genom_exdetail`: `body` without spaces."""
        text = json.dumps(self.body, separators=(",", ":"), ensure_ascii=False)
        # An unpaired surrogate cannot be encoded in UTF-8; as an escape it is valid JSON.
        return text.encode("utf-8", "backslashreplace").decode()


def forget_frames(error: BaseException) -> None:
    """Drop the tracebacks of an error that is kept, and of its causes: their frames refer to many objects, or to it."""
    seen, waiting = set(), [error]
    while waiting:
        one = waiting.pop()
        BaseException.with_traceback(one, None)  # an assignment would call `__setattr__`, which may be another one
        seen.add(id(one))
        waiting += [other for other in (one.__cause__, one.__context__) if other is not None and id(other) not in seen]
