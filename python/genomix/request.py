"""Requests in the background: their status, result and end."""

from __future__ import annotations

import enum
import threading
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from genomix.event import GenoMError, error_of

if TYPE_CHECKING:
    from genomix.client import Client

# Of one request to genomixd. Ctrl-C that arrives just before Python begins to read the answer has no effect until then.
WAIT_SECONDS = 5.0


class Status(enum.Enum):
    """The status of a request; ``str(status)`` is its name."""

    sent = "sent"
    done = "done"
    error = "error"

    def __str__(self) -> str:
        return self.value


class Request:
    """A request that genomixd executes in the background.

    Methods raise GenoMError if genomixd does not answer.
    """

    def __init__(self, client: Client, name: str, state: dict[str, Any], form: dict[str, str]) -> None:
        self._client = client
        self._name = name
        self._form = form  # the syntax of the result
        self._result: dict[str, Any] | None = None
        self._lock = threading.Lock()
        self._state = state

    @property
    def id(self) -> str:
        """The number of the request at genomixd, such as ``rosAFE::3``."""
        return str(self._state["id"])

    @property
    def status(self) -> Status:
        """The current status: ``Status.sent``, ``Status.done`` or ``Status.error``."""
        return self._look("status")

    @property
    def result(self) -> dict[str, Any] | None:
        """The outputs of a request that is done, None while it is sent. Raises the GenoMError of one that failed."""
        if self.status is Status.sent:
            return None
        if self.exception is not None:
            raise self.exception
        with self._lock:
            if self._result is None:
                self._result = self._get("result", self._form)
        return self._result

    @property
    def exception(self) -> GenoMError | None:
        """The error of a request that failed; otherwise None."""
        failed = self.status is Status.error
        return error_of(self._state.get("exception")) if failed else None

    def wait(self, timeout: float | None = None) -> Status:
        """Wait for the end, or for `timeout` seconds, and return the status."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            left = WAIT_SECONDS if end is None else min(max(0.0, end - time.monotonic()), WAIT_SECONDS)
            status = self._look("wait", ms=str(round(1000 * left)))
            if status is not Status.sent or (end is not None and time.monotonic() >= end):
                return status

    def wait_for_start(self) -> Status:
        """Wait until the activity runs or has failed, for at most 75 s, and return the status."""
        return self._look("wait", ms="75000", ack="1")

    def show_warning(self) -> None:
        """Show the warning of the component, if there is one."""
        if self._state.get("warning"):
            warn(self._name, self._state["warning"])

    def abort(self) -> None:
        """Ask the activity to end. Raises GenoMError if the request is not an activity."""
        if self.status is Status.sent:
            self._look("abort")

    def notify(self, callback: Callable[[Request], object]) -> None:
        """Call `callback` with this request at its end, in a thread of its own."""

        def work() -> None:
            self.wait()
            callback(self)

        threading.Thread(target=work, name=f"genomix {self.id}", daemon=True).start()

    def _look(self, page: str, **query: str) -> Status:
        """Request a page that returns the status."""
        if self._state["status"] == "sent":
            self._state = self._get(page, query)
        return Status(self._state["status"])

    def _get(self, page: str, query: dict[str, str]) -> Any:
        return self._client.get(f"/request/{page}", id=self.id, **query)

    def __del__(self) -> None:
        self._client.dropped.append(self.id)  # genomixd forgets it; an activity continues

    def __repr__(self) -> str:
        return f"<genomix.Request {self.id}: {self._name}>"


def warn(name: str, text: str) -> None:
    """Show the warning of a component, such as that an unknown word was replaced."""
    warnings.warn(f"{name}: {text}", stacklevel=4)
