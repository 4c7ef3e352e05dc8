"""The output ports: one latched topic per processor, a window that slides by one block at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import rospy

from rosafe import interface
from rosafe.component import wire
from rosafe.interface import KINDS, ROSAFE
from rosafe.tree.processor import Processor
from rosafe.tree.window import SlidingWindow, WindowView, frames_in
from rosafe.tree.zone import Block

_NOTHING = np.zeros(0)  # ILD's `right`


def signal_fields(kind: str, view: WindowView, next_index: int, rate: float) -> dict[str, Any]:
    """The members of a port message, or of an element of getSignals, for what a processor of `kind` put out.

    The frame rate is a whole number on the wire: the true rate, rounded.
    """
    fields: dict[str, Any] = {
        "sampleRate": round(rate),
        "lastFrameIndex": next_index,
        "framesOnPort": view.frames,
    }
    if kind == "crossCorrelation":
        channels, lags = view.shape[:2]
        return {**fields, "numberOfLags": lags, "numberOfChannels": channels, "left": view.swap_rows()}
    if kind == "ild":
        return {**fields, "numberOfChannels": view.shape[0], "left": view, "right": _NOTHING}
    if kind in ("gammatone", "ihc", "ratemap"):
        fields["numberOfChannels"] = view.shape[1]
    return {**fields, "left": view.select(0), "right": view.select(1)}


class OutputPort:
    """The topic of one processor."""

    def __init__(self, processor: Processor, publisher: rospy.Publisher, close: Callable[[], None]) -> None:
        self.processor = processor
        self._publisher = publisher
        self._close = close
        self._idl = ROSAFE.port(KINDS[processor.kind].port).idl
        self._message = wire.message_class("rosAFE", self._idl)
        self._window: SlidingWindow | None = None

    def open(self, seconds: float) -> None:
        """Publish the first message: zeros."""
        self._fit(self.processor.rows, frames_in(seconds, self.processor.rate))
        self._publish(self.processor.next_index, self.processor.rate)

    def _fit(self, rows: tuple[int, ...], frames: int) -> SlidingWindow:
        """The window; a new one, of zeros, where the shape or the frame rate has changed."""
        if self._window is None or (self._window.rows, self._window.frames) != (rows, frames):
            self._window = SlidingWindow(rows, frames)
        return self._window

    def append(self, block: Block, seconds: float) -> None:
        """Shift the window by a block and publish it."""
        self._fit(block.data.shape[:-1], frames_in(seconds, block.rate)).append(block.data)
        self._publish(block.next_index, block.rate)

    def _publish(self, next_index: int, rate: float) -> None:
        # The message refers to released blocks, which never change: it is serialised for whoever is connected, now or
        # later (latched), and costs nothing for nobody.
        assert self._window is not None
        self._publisher.publish(
            self._message(**signal_fields(self.processor.kind, self._window.view(), next_index, rate))
        )

    def close(self) -> None:
        """Withdraw the topic."""
        self._close()


def element(kind: str, name: str) -> str:
    """The element of a multiple port that belongs to a processor; empty for the simple port of the input."""
    return name if ROSAFE.port(KINDS[kind].port).multiple else ""


def parameters_message(processors: list[Processor], messages: Any) -> Any:
    """The `rosAFE_parameters` message: seven arrays, each in the order of creation."""
    arrays: dict[str, list[Any]] = {kind: [] for kind in KINDS}
    for processor in processors:
        idl = dict(ROSAFE.structs["::rosAFE::parameters"])[processor.kind]
        struct = getattr(messages, interface.ros_type(idl[len("sequence<") : -1]))
        values = processor.parameters()
        if "fb_cfHz" in values:
            values["fb_cfHz"] = [float(f) for f in values["fb_cfHz"]]
        arrays[processor.kind].append(struct(name=processor.name, **values))
    return messages.rosAFE_parameters(**arrays)
