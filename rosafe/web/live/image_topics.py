"""The last seconds of ratemap and level differences as sensor_msgs/Image, for rviz; `rosafe live --images`."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import rospy
from sensor_msgs.msg import Image

from rosafe.interface import ComponentError
from rosafe.web.live.views import Hub, Key, View

KINDS = ("ratemap", "ild")  # the first processor of each is shown
SECONDS = 10.0
PERIOD = 0.2  # s between two images
MIN_HEIGHT = 160  # pixels of an ear
RANGE_DB = 60.0  # of levels, below the loudest
MIN_RANGE_DB = 5.0  # of level differences


class Images:
    """Publishes images, and subscribes to their views, while a node subscribes to them.

    Parameters
    ----------
    hub : Hub
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._publishers = {
            kind: rospy.Publisher(f"rosafe_live/{kind}", Image, queue_size=1, tcp_nodelay=True) for kind in KINDS
        }
        self._views: dict[str, tuple[Key, View]] = {}

    @property
    def requested(self) -> bool:
        """Whether a node subscribes to an image."""
        return any(publisher.get_num_connections() for publisher in self._publishers.values())

    def publish(self) -> None:
        """Publish the requested images and release the views of the others."""
        self._update_views()
        for kind, (_, view) in self._views.items():
            image = draw_image(view.newest(round(SECONDS * view.rate)), view.description)
            message = Image(height=image.shape[0], width=image.shape[1], encoding="rgb8", step=3 * image.shape[1])
            message.header.stamp = rospy.Time.now()
            message.data = image.tobytes()
            self._publishers[kind].publish(message)

    def _update_views(self) -> None:
        for kind, publisher in self._publishers.items():
            if kind in self._views and not self._hub.shows(*self._views[kind]):
                del self._views[kind]
            requested = publisher.get_num_connections() > 0
            if not requested and kind in self._views:
                self._hub.unsubscribe(*self._views.pop(kind))
            elif requested and kind not in self._views:
                first = next((p.name for p in self._hub.tree.processors.values() if p.kind == kind), None)
                if first is not None:
                    key = Key("picture", first)
                    with contextlib.suppress(ComponentError, ValueError):  # not available yet: try again later
                        self._views[kind] = (key, self._hub.subscribe(key))


def draw_image(columns: np.ndarray, description: Mapping[str, Any]) -> np.ndarray:
    """Return columns (ears * rows, n) as an image, uint8 (height, n, 3): the left ear above the right one.

    Frequency increases upwards. Levels have the colours of magma and span 60 dB below the loudest one. Differences are
    blue on the left and red on the right. Missing values are black.
    """
    import matplotlib

    finite = np.isfinite(columns)
    if description["level"]:
        high = np.ceil(np.max(columns, where=finite, initial=-200.0) / 5) * 5
        low, colours = high - RANGE_DB, matplotlib.colormaps["magma"]
    else:
        high = max(MIN_RANGE_DB, float(np.percentile(np.abs(columns[finite]), 99)) if finite.any() else 0.0)
        low, colours = -high, matplotlib.colormaps["RdBu_r"]
    scaled = np.where(finite, (columns - low) / (high - low), 0.0)
    pixels = colours(scaled, bytes=True)[..., :3]
    pixels[~finite] = 0
    rows, factor = description["rows"], -(-MIN_HEIGHT // description["rows"])
    ears = [pixels[ear * rows : (ear + 1) * rows][::-1].repeat(factor, axis=0) for ear in range(description["ears"])]
    gap = np.zeros((4, columns.shape[1], 3), np.uint8)
    return np.ascontiguousarray(np.concatenate([part for ear in ears for part in (gap, ear)][1:]))
