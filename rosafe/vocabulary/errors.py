"""Named exceptions of components, as they go over the wire."""

from __future__ import annotations

import json
from typing import Any


class ComponentError(Exception):
    """A named exception of the interface.

    Parameters
    ----------
    ex : str
        Full identifier, such as ``::rosAFE::e_noData`` or ``::genom::no_such_inport``.
    why : str, optional
        One line for people (logs, stderr). It crosses the wire only where the exception has a member for it.
    **detail
        The exception's members, such as ``what`` of ``::rosAFE::e_badNewValue``.
    """

    def __init__(self, ex: str, why: str = "", **detail: Any) -> None:
        super().__init__(why or detail.get("what") or ex)
        self.ex = ex
        self.why = why
        self.detail = detail

    @property
    def exdetail(self) -> str:
        """The JSON text for `genom_exdetail`: no spaces, `detail` only where there are members."""
        body: dict[str, Any] = {"ex": self.ex}
        if self.detail:
            body["detail"] = self.detail
        text = json.dumps(body, separators=(",", ":"), ensure_ascii=False)
        # Half a surrogate pair has no UTF-8; as an escape it is valid JSON.
        return text.encode("utf-8", "backslashreplace").decode()
