"""The output ports: one latched topic per processor, with a window that advances by one block at a time."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rosafe.interface import LAYOUTS
from rosafe.ros1.component import serialization
from rosafe.ros1.transport.publisher import NewestMessage, Publisher
from rosafe.tree.processor import Processor
from rosafe.tree.sliding_window import WindowView

_EMPTY = WindowView([np.zeros(0)])  # for fields that a kind does not use, such as ILD's `right`


def signal_fields(kind: str, views: Sequence[WindowView], next_index: int, rate: float) -> dict[str, Any]:
    """Return the fields of a port message, or of an element of getSignals, for the output of a processor of `kind`.

    The frame rate in the message is the rounded true rate.
    """
    layout = LAYOUTS[kind]
    fields: dict[str, Any] = {
        "sampleRate": round(rate),
        "lastFrameIndex": next_index,
        "framesOnPort": views[0].frames,
    }
    for field, part, axis in layout.counts:
        fields[field] = views[part].shape[axis]
    for place in layout.places:
        view = views[place.part]
        if place.ear is not None:
            view = view.select(place.ear)
        if len(view.shape) > 2:
            view = view.swap_rows()
        fields[place.field] = view if place.present else _EMPTY
    return fields


class _WindowMessage:
    """Builds the message of a port. It refers to the history alone, so that removed processors are freed at once."""

    def __init__(self, processor: Processor) -> None:
        self._kind = processor.kind
        self._history = processor.history
        self._message = serialization.message_class("rosAFE", LAYOUTS[processor.kind].idl)

    def build(self) -> Any:
        """Return a message that refers to released blocks, which never change. They are serialized without a copy."""
        views, next_index, signal = self._history.port_window()
        return self._message(**signal_fields(self._kind, views, next_index, signal.rate))


class OutputPort:
    """The topic of one processor."""

    def __init__(self, processor: Processor, publisher: Publisher, close: Callable[[], None]) -> None:
        self.close = close  # closes the topic
        self._publisher = publisher
        # Publishes the window of the processor's history; without subscribers, it is built for the first one.
        self.publish = functools.partial(publisher.publish_newest, NewestMessage(_WindowMessage(processor).build))

    @property
    def has_subscribers(self) -> bool:
        """Whether the topic has subscribers."""
        return self._publisher.has_subscribers


class OutputPorts:
    """The ports of all processors of a tree. Safe from any thread."""

    def __init__(self) -> None:
        self._by_processor: dict[Processor, OutputPort] = {}
        self._subscribed: tuple[Processor, ...] | None = None  # None if it may have changed
        self._lock = threading.Lock()

    def __getitem__(self, processor: Processor) -> OutputPort:
        return self._by_processor[processor]

    def add(self, processor: Processor, port: OutputPort) -> None:
        """Add the port of a processor."""
        self._by_processor[processor] = port
        self.forget_subscribed()

    def remove(self, processor: Processor) -> OutputPort | None:
        """Remove and return the port of a processor, if it has one."""
        port = self._by_processor.pop(processor, None)
        self.forget_subscribed()
        return port

    def forget_subscribed(self) -> None:
        """Look for subscribers again. To be called after each change of the subscribers of a port."""
        with self._lock:
            self._subscribed = None

    @property
    def subscribed(self) -> tuple[Processor, ...]:
        """The processors whose ports have subscribers."""
        known = self._subscribed
        if known is None:
            with self._lock:
                ports = tuple(self._by_processor.items())
                known = self._subscribed = tuple(one for one, port in ports if port.has_subscribers)
        return known

    @property
    def observed(self) -> bool:
        """Whether the tree has observers, which are to see each block."""
        return any(processor.observers for processor in tuple(self._by_processor)[:1])
