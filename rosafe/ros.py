"""For clients in Python on the ROS graph: classes with numpy arrays where the generated ones have lists."""

from __future__ import annotations

from typing import Any


def array_msg(generated: Any) -> Any:
    """As `rosafe.component.wire.array_msg`: the message class to use in place of a generated one."""
    from rosafe.component import wire  # which needs ROS, and generated messages

    return wire.array_msg(generated)


def array_srv(generated: Any) -> Any:
    """As `rosafe.component.wire.array_srv`: the service class to use in place of a generated one."""
    from rosafe.component import wire

    return wire.array_srv(generated)
