"""The output ports: one latched topic per processor, a window that slides by one block at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rospy

from rosafe.component import serialization
from rosafe.interface import KINDS, LAYOUTS, ROSAFE
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.sliding_window import SlidingWindow, WindowView, frames_in

_NOTHING = np.zeros(0)  # what is always empty, such as ILD's `right`


def signal_fields(kind: str, views: Sequence[WindowView], next_index: int, rate: float) -> dict[str, Any]:
    """The members of a port message, or of an element of getSignals, for what a processor of `kind` put out.

    The frame rate is a whole number on the wire: the true rate, rounded.
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
        fields[place.field] = view if place.present else _NOTHING
    return fields


class OutputPort:
    """The topic of one processor."""

    def __init__(self, processor: Processor, publisher: rospy.Publisher, close: Callable[[], None]) -> None:
        self.processor = processor
        self._publisher = publisher
        self._close = close
        self._message = serialization.message_class("rosAFE", LAYOUTS[processor.kind].idl)
        self._windows: list[SlidingWindow] = []

    def open(self, seconds: float) -> None:
        """Publish the first message: zeros."""
        self._fit(self.processor.output_shapes, frames_in(seconds, self.processor.rate))
        self._publish(self.processor.next_index, self.processor.rate)

    def _fit(self, part_rows: Sequence[tuple[int, ...]], frames: int) -> list[SlidingWindow]:
        """A window for each part; new ones, of zeros, where a shape or the frame rate has changed."""
        if [(window.rows, window.frames) for window in self._windows] != [(rows, frames) for rows in part_rows]:
            self._windows = [SlidingWindow(rows, frames) for rows in part_rows]
        return self._windows

    def append(self, block: Block, seconds: float) -> None:
        """Shift the window by a block and publish it."""
        windows = self._fit([part.shape[:-1] for part in block.parts], frames_in(seconds, block.rate))
        for window, part in zip(windows, block.parts, strict=True):
            window.append(part)
        self._publish(block.next_index, block.rate)

    def _publish(self, next_index: int, rate: float) -> None:
        # The message refers to released blocks, which never change: it is serialised for whoever is connected, now or
        # later (latched), and costs nothing for nobody.
        views = [window.view() for window in self._windows]
        self._publisher.publish(self._message(**signal_fields(self.processor.kind, views, next_index, rate)))

    def close(self) -> None:
        """Withdraw the topic."""
        self._close()


def element(kind: str, name: str) -> str:
    """The element of a multiple port that belongs to a processor; empty for the simple port of the input."""
    return name if ROSAFE.port(KINDS[kind].port).multiple else ""
