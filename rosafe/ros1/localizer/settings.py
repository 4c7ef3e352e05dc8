"""The settings of the localizer: options of the command line, then private ROS parameters, then defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import rosgraph.names
import rospy

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.localization.localizer import MAX_SECONDS

MAX_AUDIO_DELAY = 5.0  # s


@dataclass(frozen=True)
class LocalizerSettings:
    """The settings, by the names of the private ROS parameters.

    Attributes
    ----------
    head : str
        `sphere`, or the path of a SOFA file or of a learned model.
    mirror : bool or None
        Of a SOFA file, as of `rosafe.Head.from_sofa`. An empty text is None.
    seconds : float
        Length of the window of integration.
    world_frame : str
        Coordinate frame of the azimuths, by tf; empty: they are relative to the head.
    head_frame : str
        Coordinate frame of the head: x ahead, y left, z up.
    rosafe : str
        Name of the rosAFE node.
    connect : str
        Topic of the sound, if the input has to be created; empty: bass/Audio, unless the port is connected.
    audio_delay : float
        Latency of the sound card in s: the sound was heard earlier than its time stamp by this.
    noise : str
        File of `rosafe localize --calibrate-noise`; empty: the default file if it exists; `none`: no file.
    parameters : mapping
        Of the representations, by the names of docs/parameters.md.
    """

    head: str = "sphere"
    mirror: bool | None = None
    seconds: float = 0.5
    world_frame: str = ""
    head_frame: str = "head"
    rosafe: str = "rosAFE"
    connect: str = ""
    audio_delay: float = 0.0
    noise: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def frame_id(self) -> str:
        """The coordinate frame of all published azimuths."""
        return self.world_frame or self.head_frame


def read_settings(options: Mapping[str, Any], node: str = "~") -> LocalizerSettings:
    """Return the settings; options that are None or missing are read from the private ROS parameters of the node.

    `node` is the prefix of its parameters.

    Raises
    ------
    ValueError
        One line that names the option or parameter.
    """
    values: dict[str, Any] = {}
    for setting in dataclasses.fields(LocalizerSettings):
        given = options.get(setting.name)
        if given is None and setting.name != "parameters":
            given = rospy.get_param(f"{node}{setting.name}", None)
        if setting.name == "mirror" and given == "":  # the default of the launch file
            continue
        if given is not None:
            values[setting.name] = _check(setting.name, given)
    settings = LocalizerSettings(**values)
    if settings.world_frame == settings.head_frame:
        raise ValueError(f"world_frame: expected another frame than head_frame, got {settings.world_frame!r}")
    return settings


def _check(name: str, value: Any) -> Any:
    if name in ("parameters", "mirror"):
        return value if name == "parameters" else _flag(name, value)
    if name in ("seconds", "audio_delay"):
        return _number(name, value)
    if not isinstance(value, str) or len(value) > 4096:
        raise ValueError(f"{name}: expected a text, got {short_repr(value)}")
    if name in ("world_frame", "head_frame"):
        value = value.strip("/")  # tf2 has no leading slash
    elif name in ("rosafe", "connect") and value and not rosgraph.names.is_legal_name(value):
        raise ValueError(f"{name}: expected a ROS name, got {short_repr(value)}")
    if not value and name in ("head", "head_frame", "rosafe"):
        raise ValueError(f"{name}: expected a text that is not empty")
    return value


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name}: expected true or false, got {short_repr(value)}")
    return value


def _number(name: str, value: Any) -> float:
    low, high = (0.01, MAX_SECONDS) if name == "seconds" else (-MAX_AUDIO_DELAY, MAX_AUDIO_DELAY)
    if not is_number(value) or not low <= value <= high:
        raise ValueError(f"{name}: expected a number from {low:g} to {high:g}, got {short_repr(value)}")
    return float(value)
