"""The newest seconds of ratemap and level differences as sensor_msgs/Image, for rviz; `rosafe live --images`."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import rospy
from sensor_msgs.msg import Image

from rosafe.live.views import Hub, Key, View

KINDS = ("ratemap", "ild")  # of which the first processor is shown
SECONDS = 10.0
PERIOD = 0.2  # s between two images
HEIGHT = 160  # pixels of an ear, about
RANGE_DB = 60.0  # of levels, below the loudest
REACH_DB = 5.0  # of level differences, at least


class Images:
    """Publishes while somebody subscribes, and looks at nothing otherwise. A looker, as a page is one.

    Parameters
    ----------
    hub : Hub
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._publishers = {
            kind: rospy.Publisher(f"/rosafe_live/{kind}", Image, queue_size=1, tcp_nodelay=True) for kind in KINDS
        }
        self._views: dict[str, tuple[Key, View, dict[str, Any]]] = {}
        self._turn = threading.Lock()  # one thread at a time has to do with the views

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes."""
        return any(publisher.get_num_connections() for publisher in self._publishers.values())

    # --- as a page ---

    def wake(self) -> None:
        """New columns: they are looked at in their time."""

    def tell(self, about: str, message: Mapping[str, Any]) -> None:
        """News: an image has no words."""

    async def close(self) -> None:
        """The server ends."""

    async def on_tree_changed(self, changed: set[Key]) -> None:
        """The tree has changed."""
        await asyncio.to_thread(self._look)

    def _look(self) -> None:
        with self._turn:
            self._choose()

    def _choose(self) -> None:
        for kind, publisher in self._publishers.items():
            if kind in self._views and not self._hub.shows(*self._views[kind][:2]):
                del self._views[kind]
            wanted = publisher.get_num_connections() > 0
            if not wanted and kind in self._views:
                self._hub.unsubscribe(*self._views.pop(kind)[:2])
            elif wanted and kind not in self._views:
                first = next((p.name for p in self._hub.tree.processors.values() if p.kind == kind), None)
                if first is not None:
                    key = Key("picture", first)
                    self._views[kind] = (key, *self._hub.subscribe(key))

    # --- images ---

    async def publish(self) -> None:
        """Send what is wanted, and let go of what is not."""
        await asyncio.to_thread(self._publish)

    def _publish(self) -> None:
        with self._turn:
            self._choose()
            shown = dict(self._views)
        for kind, (_, view, told) in shown.items():
            image = drawn(view.newest(round(SECONDS * view.rate)), told)
            message = Image(height=image.shape[0], width=image.shape[1], encoding="rgb8", step=3 * image.shape[1])
            message.header.stamp = rospy.Time.now()
            message.data = image.tobytes()
            self._publishers[kind].publish(message)


def drawn(columns: np.ndarray, told: Mapping[str, Any]) -> np.ndarray:
    """Columns (ears * rows, n) as uint8 (height, n, 3): high frequencies above, the left ear over the right one.

    Levels have the colours of magma, from the loudest down 60 dB; differences are blue on the left, red on the right.
    What is not there is black.
    """
    import matplotlib

    there = np.isfinite(columns)
    if told["level"]:
        high = np.ceil(np.max(columns, where=there, initial=-200.0) / 5) * 5
        low, colours = high - RANGE_DB, matplotlib.colormaps["magma"]
    else:
        high = max(REACH_DB, float(np.percentile(np.abs(columns[there]), 99)) if there.any() else 0.0)
        low, colours = -high, matplotlib.colormaps["RdBu_r"]
    scaled = np.where(there, (columns - low) / (high - low), 0.0)
    pixels = colours(scaled, bytes=True)[..., :3]
    pixels[~there] = 0
    rows, factor = told["rows"], -(-HEIGHT // told["rows"])
    ears = [np.repeat(pixels[ear * rows : (ear + 1) * rows][::-1], factor, axis=0) for ear in range(told["ears"])]
    gap = np.zeros((4, columns.shape[1], 3), np.uint8)
    return np.ascontiguousarray(np.concatenate([part for ear in ears for part in (gap, ear)][1:]))
