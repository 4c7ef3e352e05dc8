"""The exception for a request or connection that is refused."""

from __future__ import annotations


class HttpRefusal(Exception):
    """A refused request or connection; the text is one line for the client.

    Parameters
    ----------
    status : int
        HTTP status: 403 (not allowed), 503 (a limit is reached), or another one from 400 on.
    reason : str
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status
