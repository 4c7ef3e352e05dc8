"""The settings of a localizer that listens to a robot, by their names in ROS, and the models of its head."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.localizer import MAX_SECONDS, find_model, open_head
from rosafe.system.terminal import printable

MAX_AUDIO_DELAY = 5.0  # s


@dataclass(frozen=True)
class LocalizerSettings:
    """The settings, by the names of the private ROS parameters.

    Attributes
    ----------
    head : str
        `sphere`, `pair:` and a spacing in m, or the path of a SOFA file or of a learned model.
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
    speech_only : bool
        Whether only sources that speak have poses.
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
    speech_only: bool = False
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def frame_id(self) -> str:
        """The coordinate frame of all published azimuths."""
        return self.world_frame or self.head_frame


def checked_settings(given: Mapping[str, Any]) -> LocalizerSettings:
    """Return the settings with these values, without those that are None.

    Raises
    ------
    ValueError
        One line that names the setting.
    """
    values = {
        setting.name: _check(setting.name, given[setting.name])
        for setting in dataclasses.fields(LocalizerSettings)
        if given.get(setting.name) is not None and (setting.name, given[setting.name]) != ("mirror", "")
    }  # an empty mirror is the default of the launch file
    settings = LocalizerSettings(**values)
    if settings.world_frame == settings.head_frame:
        raise ValueError(f"world_frame: expected another frame than head_frame, got {settings.world_frame!r}")
    return settings


def _check(name: str, value: Any) -> Any:
    if name in ("parameters", "mirror", "speech_only"):
        return value if name == "parameters" else _flag(name, value)
    if name in ("seconds", "audio_delay"):
        return _number(name, value)
    if not isinstance(value, str) or len(value) > 4096:
        raise ValueError(f"{name}: expected a text, got {short_repr(value)}")
    if name in ("world_frame", "head_frame"):
        value = value.strip("/")  # tf2 has no leading slash
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


class Models:
    """The models of one head, by sample rate.

    Parameters
    ----------
    settings : LocalizerSettings

    Raises
    ------
    ValueError
        The file of the head is unsuitable.
    """

    def __init__(self, settings: LocalizerSettings) -> None:
        self.report: Callable[[float], None] = lambda part: None  # of the progress
        self._parameters = settings.parameters or None
        self._head = open_head(settings.head, settings.mirror)

    def model_for(self, sample_rate: float) -> DirectionModel:
        """Return the model for a sample rate. It is learned if there is none, in up to a minute on two cores."""
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)  # of this thread only: sound comes first
        try:
            return find_model(self._head, sample_rate, self._parameters, self.report)
        except ValueError as problem:
            raise ValueError(printable(str(problem))) from None
