"""The settings of the localizer: options, then private ROS parameters, then defaults; and its state, in rospy's log."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import rosgraph.names
import rospy

from rosafe.declarations.text import short_repr
from rosafe.localization.live import ERROR, OK, WARN
from rosafe.localization.settings import LocalizerSettings, checked_settings
from rosafe.localization.status import NodeStatus


def read_settings(options: Mapping[str, Any], node: str = "~") -> LocalizerSettings:
    """Return the settings; options that are None or missing are read from the private ROS parameters of the node.

    `node` is the prefix of its parameters.

    Raises
    ------
    ValueError
        One line that names the option or parameter.
    """
    given = {setting.name: options.get(setting.name) for setting in dataclasses.fields(LocalizerSettings)}
    for name, value in given.items():
        if value is None and name != "parameters":
            given[name] = rospy.get_param(f"{node}{name}", None)
    settings = checked_settings(given)
    for name, value in (("rosafe", settings.rosafe), ("connect", settings.connect)):
        if value and not rosgraph.names.is_legal_name(value):
            raise ValueError(f"{name}: expected a ROS name, got {short_repr(value)}")
    return settings


def node_status(changed: Callable[[], None]) -> NodeStatus:
    """Return a state that calls `changed` after each change."""
    return NodeStatus(changed, {OK: rospy.loginfo, WARN: rospy.logwarn, ERROR: rospy.logerr})
