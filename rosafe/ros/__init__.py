"""The ROS side: component machinery, message generation, fast serialisation.

For clients in Python, `array_msg` and `array_srv` give numpy arrays where the generated classes have lists.
"""

from __future__ import annotations

from typing import Any


def array_msg(generated: Any) -> Any:
    """As `rosafe.ros.wire.array_msg`: the message class with numpy arrays in place of a generated one with lists."""
    from rosafe.ros import wire  # which needs ROS; other modules here do without

    return wire.array_msg(generated)


def array_srv(generated: Any) -> Any:
    """As `rosafe.ros.wire.array_srv`: the service class whose response has numpy arrays instead of lists."""
    from rosafe.ros import wire

    return wire.array_srv(generated)
