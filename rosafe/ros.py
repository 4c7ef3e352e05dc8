"""For ROS clients in Python: new frames of ports and their times, message classes with arrays instead of lists."""

from __future__ import annotations

from typing import Any

from rosafe.ros1.client.frame_clock import FrameClock, Moment
from rosafe.ros1.client.port_reader import Frames, PortReader

__all__ = ["FrameClock", "Frames", "Moment", "PortReader", "array_msg", "array_srv"]


def array_msg(generated: Any) -> Any:
    """Return the message class with arrays for a generated one; see `rosafe.ros1.component.serialization.array_msg`."""
    from rosafe.ros1.component import serialization  # requires ROS and generated messages

    return serialization.array_msg(generated)


def array_srv(generated: Any) -> Any:
    """Return the service class with arrays for a generated one; see `rosafe.ros1.component.serialization.array_srv`."""
    from rosafe.ros1.component import serialization

    return serialization.array_srv(generated)
