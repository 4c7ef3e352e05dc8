"""Requests that clients follow by their ids: their state, and its representation in events and answers."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Iterator
from typing import Any

from rosafe.interface import ComponentError
from rosafe.ros1.client.actions import Goal
from rosafe.ros1.client.component_client import NOTHING, Value
from rosafe.web.genomix import binary_format, text_formats
from rosafe.web.genomix.text_formats import Syntax, plain

REQUEST_BYTES = 4096  # size of a request without arguments and results
EVENT_BYTES = 65_536  # larger results are not included in events and the status
KEPT_BYTES = 1024  # smaller results remain in queued events


class Request:
    """One request that a client follows by its id. `status` is ``sent``, ``done`` or ``error``.

    Only activities are `abortable`. `size` is the approximate size of the request in bytes.
    """

    def __init__(self, number: str, abortable: bool = False, size: int = 0) -> None:
        self.id = number
        self.size = REQUEST_BYTES + size
        self.status = "sent"
        self.value: Value = NOTHING
        self.output_size = 0
        self._output_included = True  # in events and the status
        self.error: ComponentError | None = None
        self.warning = ""  # of the component that has accepted the request
        self.acknowledged = asyncio.Event()
        self.finished = asyncio.Event()
        self.forgotten = asyncio.Event()  # no client follows it
        self._abortable = abortable
        self._aborted = False
        self._goal: Goal | None = None

    def abort(self) -> None:
        """Ask the activity to end, or not to begin; ``::genom::syserr`` (EAGAIN) for a function in progress."""
        if self.finished.is_set():
            return
        if not self._abortable:
            why = f"{self.id} is not an activity, and cannot be aborted"
            raise ComponentError("::genom::syserr", why, code=errno.EAGAIN)
        self._aborted = True
        if self._goal is not None:
            self._goal.cancel()

    def raise_if_aborted(self) -> None:
        """Raise ``::genom::interrupted`` if the request was aborted before it was sent."""
        if self._aborted:
            raise ComponentError("::genom::interrupted", by="client")

    def begun(self, goal: Goal) -> None:
        """Note that the component has received the request."""
        self._goal = goal
        if self._aborted:
            goal.cancel()

    def finish(self, value: Value, error: ComponentError | None) -> None:
        """Record the end."""
        self.value, self.error, self.output_size = value, error, value.size
        self.warning = self.warning or value.warning
        self._output_included = self.output_size <= EVENT_BYTES
        self.status = "done" if error is None else "error"
        self.acknowledged.set()
        self.finished.set()

    def drop_output(self) -> None:
        """Free the memory of a large output. Queued events then contain only its size."""
        if self.output_size > KEPT_BYTES:
            self.value, self._output_included = NOTHING, False

    def pieces(self, syntax: Syntax) -> Iterator[str]:
        """Yield the status as text: id, status, warning, and output or exception, if there are any."""
        yield syntax.open("struct")
        status = self._status_members()
        yield "".join(
            syntax.key(index, name) + plain(syntax, value) for index, (name, value) in enumerate(status.items())
        )
        if self._has_output:
            yield syntax.key(len(status), "output")
            yield from text_formats.structure(syntax, *self.value.content)
        yield syntax.close("struct")

    def packed(self) -> Iterator[bytes]:
        """Yield the status in the binary format."""
        yield binary_format.STRUCTURE
        for name, value in self._status_members().items():
            yield binary_format.member(name) + binary_format.plain(value)
        if self._has_output:
            yield binary_format.member("output")
            yield from binary_format.structure(*self.value.content)
        yield binary_format.END

    def _status_members(self) -> dict[str, Any]:
        """Return the status without its output."""
        status: dict[str, Any] = {"id": self.id, "status": self.status}
        if self.warning:
            status["warning"] = self.warning
        if self.error is not None:
            status["exception"] = self.error.body
        elif self.status == "done" and not self._output_included:
            status["large"] = self.output_size
        return status

    @property
    def _has_output(self) -> bool:
        return self.status == "done" and self._output_included
