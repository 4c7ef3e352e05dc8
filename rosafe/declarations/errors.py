"""Named exceptions of components, as they go over the wire."""

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
        One line for people. It goes along as ``what`` where the exception has no member of that name.
    **detail
        The exception's members, such as ``what`` of ``::rosAFE::e_badNewValue``.
    """

    def __init__(self, ex: str, why: str = "", **detail: Any) -> None:
        super().__init__(why or detail.get("what") or ex)
        self.ex = ex
        self.reason = why
        self.detail = detail

    @property
    def what(self) -> str:
        """The reason, for people; empty where none is known."""
        return str(self.detail.get("what", "")) or self.reason

    @property
    def body(self) -> dict[str, Any]:
        """As clients get it: ``ex``, ``detail`` only where there are members, ``what`` where none of those is that."""
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
        # Half a surrogate pair has no UTF-8; as an escape it is valid JSON.
        return text.encode("utf-8", "backslashreplace").decode()
