"""The state of the localizer, with its changes in the log of rospy."""

from __future__ import annotations

from collections.abc import Callable

import rospy

from rosafe.localization.live import ERROR, OK, WARN
from rosafe.localization.status import NodeStatus


def node_status(changed: Callable[[], None]) -> NodeStatus:
    """Return a state that calls `changed` after each change."""
    return NodeStatus(changed, {OK: rospy.loginfo, WARN: rospy.logwarn, ERROR: rospy.logerr})
