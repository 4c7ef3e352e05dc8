"""Requests that clients follow by their ids: how they end, and how that is told."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Iterator
from typing import Any

from rosafe.client.actions import Goal
from rosafe.client.component_client import NOTHING, Value
from rosafe.genomix import binary_format, text_formats
from rosafe.genomix.text_formats import Syntax, plain
from rosafe.interface import ComponentError

REQUEST_BYTES = 4096  # of a request without arguments and results
EVENT_BYTES = 65_536  # larger results are not part of events and of the status
KEPT_BYTES = 1024  # smaller ones may wait in events for a listener


class Request:
    """One request that a client follows by its id. `status` is ``sent``, ``done`` or ``error``.

    `abortable` are activities only. `size` is about how many bytes it occupies.
    """

    def __init__(self, number: str, abortable: bool = False, size: int = 0) -> None:
        self.id = number
        self.size = REQUEST_BYTES + size
        self.status = "sent"
        self.value: Value = NOTHING
        self.output_size = 0
        self._told = True  # the output is part of events and of the status
        self.error: ComponentError | None = None
        self.warning = ""  # of the component, where it grants the request all the same
        self.acknowledged = asyncio.Event()
        self.finished = asyncio.Event()
        self.forgotten = asyncio.Event()  # nobody is interested in its end
        self._abortable = abortable
        self._aborted = False
        self._goal: Goal | None = None

    def abort(self) -> None:
        """Ask the activity to end, or not to begin; ``::genom::syserr`` (EAGAIN) for a function under way."""
        if self.finished.is_set():
            return
        if not self._abortable:
            raise ComponentError("::genom::syserr", f"{self.id} is no activity, and is not aborted", code=errno.EAGAIN)
        self._aborted = True
        if self._goal is not None:
            self._goal.cancel()

    def raise_if_aborted(self) -> None:
        """Raise ``::genom::interrupted`` where the request was aborted before it was sent."""
        if self._aborted:
            raise ComponentError("::genom::interrupted", by="client")

    def begun(self, goal: Goal) -> None:
        """It is in the component's hands."""
        self._goal = goal
        if self._aborted:
            goal.cancel()

    def finish(self, value: Value, error: ComponentError | None) -> None:
        """Record the end."""
        self.value, self.error, self.output_size = value, error, value.size
        self.warning = self.warning or value.warning
        self._told = value.size <= EVENT_BYTES
        self.status = "done" if error is None else "error"
        self.acknowledged.set()
        self.finished.set()

    def drop_output(self) -> None:
        """Forget an output that takes memory. An event that waits for its listener tells how large it was, then."""
        if self.output_size > KEPT_BYTES:
            self.value, self._told = NOTHING, False

    def pieces(self, form: Syntax) -> Iterator[str]:
        """The status as text: id, status, warning if there is one, and output or exception once there is one."""
        yield form.open("struct")
        told = self._publish_status()
        yield "".join(form.key(index, name) + plain(form, value) for index, (name, value) in enumerate(told.items()))
        if self._has_output:
            yield form.key(len(told), "output")
            yield from text_formats.structure(form, *self.value.content)
        yield form.close("struct")

    def packed(self) -> Iterator[bytes]:
        """The status as `pieces` tells it, packed."""
        yield binary_format.STRUCTURE
        for name, value in self._publish_status().items():
            yield binary_format.member(name) + binary_format.plain(value)
        if self._has_output:
            yield binary_format.member("output")
            yield from binary_format.structure(*self.value.content)
        yield binary_format.END

    def _publish_status(self) -> dict[str, Any]:
        """The status but for its output."""
        told: dict[str, Any] = {"id": self.id, "status": self.status}
        if self.warning:
            told["warning"] = self.warning
        if self.error is not None:
            told["exception"] = self.error.body
        elif self.status == "done" and not self._told:
            told["large"] = self.output_size
        return told

    @property
    def _has_output(self) -> bool:
        return self.status == "done" and self._told
