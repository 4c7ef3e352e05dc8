"""The ROS side: component machinery, message generation, fast serialisation. For subscribers: `array_msg`."""

from __future__ import annotations

from typing import Any


def array_msg(generated: Any) -> Any:
    """As `rosafe.ros.wire.array_msg`: the message class with numpy arrays in place of a generated one with lists."""
    from rosafe.ros import wire  # which needs rospy's packages; other modules here do without

    return wire.array_msg(generated)
