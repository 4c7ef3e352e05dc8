"""The output ports: one latched topic per processor, with a window that advances by one block at a time."""

from __future__ import annotations

import functools
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
