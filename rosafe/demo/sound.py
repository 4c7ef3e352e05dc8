"""What the demonstration listens to: from the user's argument to what Acquire is asked for, checked beforehand."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rosafe.bass.sources import DEFAULT_RATE, open_source
from rosafe.bass.sources.scene import WALK_SECONDS, scene_azimuth
from rosafe.sound.audiofile import AudioFile

SOUND_FILES = {".wav", ".flac", ".ogg", ".oga", ".opus", ".mp3", ".aif", ".aiff", ".aifc", ".au", ".caf", ".w64"}
GUIDE_RATES = (32000, 48000)  # at which the guide's block and chunk are used as they are
HIGHEST = 8000.0  # Hz, the guide's fb_highFreqHz


@dataclass(frozen=True)
class DemoSound:
    """A source of sound and how to work on it.

    Attributes
    ----------
    device : str
        For Acquire.
    asked_rate, sample_rate : int
        For Acquire (0: the file's own), and what it will be.
    title : str
        In a few words.
    note : str
        What the user should know, or nothing.
    has_beginning : bool
        Whether acquiring it anew begins it anew.
    length : float
        Seconds, where that is known; else infinite.
    true_azimuth : callable or None
        Degrees at times (s) since the first frame, where the truth is known.
    """

    device: str
    asked_rate: int
    sample_rate: int
    title: str
    note: str = ""
    has_beginning: bool = True
    length: float = math.inf
    true_azimuth: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def frames_per_block(self) -> int:
        """The guide's 12000 frames; about as much time at rates far from the guide's 44100 Hz."""
        return 12000 if self._as_in_guide else max(1, self.sample_rate // 4)

    def seconds_to_follow(self, seconds: float) -> float:
        """How much of `seconds` comes through: what fills no whole block at the end of a file does not."""
        block = self.frames_per_block / self.sample_rate
        return min(seconds, self.length // block * block)

    @property
    def frames_per_chunk(self) -> int:
        """The guide's 2205 frames, likewise."""
        return 2205 if self._as_in_guide else max(1, self.sample_rate // 20)

    @property
    def _as_in_guide(self) -> bool:
        return GUIDE_RATES[0] <= self.sample_rate <= GUIDE_RATES[1]

    @property
    def highest_frequency(self) -> float:
        """The guide's highest centre frequency (Hz), or what the sample rate allows."""
        return HIGHEST if self.sample_rate >= 2 * HIGHEST else float(self.sample_rate * 9 // 20)


def choose(argument: str) -> DemoSound:
    """The sound that the user means: a sound file, ``scene:``, ``file:PATH`` or an ALSA device.

    Raises
    ------
    AudioFileError, interface.ComponentError
        The file or the scene cannot be used; one line says why. Devices show it when they are opened.
    """
    if argument.startswith("scene:"):
        sample_rate = _checked(argument, 0)
        walk = re.search(r"[?&]seconds=([^&]+)", argument)
        truth = functools.partial(scene_azimuth, walk=float(walk[1]) if walk else WALK_SECONDS)
        return DemoSound(argument, sample_rate, sample_rate, "A source walks from left to right", true_azimuth=truth)
    if argument.startswith("file:"):
        return DemoSound(argument, 0, _checked(argument, 0), argument)
    if _names_file(argument):
        return _file(Path(argument).expanduser())
    return DemoSound(argument, DEFAULT_RATE, DEFAULT_RATE, argument, has_beginning=False)


def _names_file(argument: str) -> bool:
    path = Path(argument)
    return "/" in argument.partition(":")[0] or path.suffix.lower() in SOUND_FILES or path.expanduser().is_file()


def _file(path: Path) -> DemoSound:
    file = AudioFile(path)
    file.close()
    device = f"file:{path.absolute()}"
    sound = DemoSound(device, 0, _checked(device, 0), path.name)
    length = file.frames / file.sample_rate
    note = f"{path.name}: {length:.1f} s at {file.sample_rate} Hz"
    if sound.highest_frequency < HIGHEST:
        note += f", which holds no more than fb_highFreqHz {sound.highest_frequency:.0f}"
    return dataclasses.replace(sound, note=note, length=length)


def _checked(device: str, sample_rate: int) -> int:
    """The sample rate of a source that needs no hardware, having opened it once."""
    source = open_source(device, sample_rate, 1, threading.Event())
    source.close()
    return source.sample_rate
