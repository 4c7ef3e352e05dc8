"""The audio source of the demonstration: interpretation and check of the user's argument, arguments of Acquire."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosafe.audio.devices import DEFAULT_RATE, open_source
from rosafe.audio.files.audiofile import AudioFile
from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK
from rosafe.localization.head import Head
from rosafe.localization.scene import Truth

SOUND_FILES = {".wav", ".flac", ".ogg", ".oga", ".opus", ".mp3", ".aif", ".aiff", ".aifc", ".au", ".caf", ".w64"}
GUIDE_RATES = (32000, 48000)  # range of sample rates for the block and chunk length of the user guide
MAX_FREQUENCY = 8000.0  # Hz, fb_highFreqHz in the user guide


@dataclass(frozen=True)
class DemoSound:
    """An audio source and the settings for it.

    Attributes
    ----------
    device : str
        Argument of Acquire.
    requested_rate, sample_rate : int
        Argument of Acquire (0: the rate of the file), and the resulting rate.
    title : str
        Heading of the figure.
    note : str
        Information for the user, or empty.
    has_beginning : bool
        Whether another Acquire starts at the beginning.
    length : float
        Seconds; infinite if unknown.
    truth : callable or None
        Returns the true directions at a time (s) since the first frame, if they are known.
    head : Head or None
        The head of a scene, if it is not the sphere.
    """

    device: str
    requested_rate: int
    sample_rate: int
    title: str
    note: str = ""
    has_beginning: bool = True
    length: float = math.inf
    truth: Callable[[float], Truth] | None = None
    head: Head | None = None

    @property
    def frames_per_block(self) -> int:
        """The default of 12000 frames, as in the user guide; a similar duration at rates far from 44100 Hz."""
        return DEFAULT_FRAMES_PER_BLOCK if self._as_in_guide else max(1, self.sample_rate // 4)

    def seconds_to_follow(self, seconds: float) -> float:
        """Return the processed part of `seconds`: an incomplete block at the end of a file is not processed."""
        block = self.frames_per_block / self.sample_rate
        return min(seconds, self.length // block * block)

    @property
    def frames_per_chunk(self) -> int:
        """2205 frames, as in the user guide; a similar duration at rates far from 44100 Hz."""
        return 2205 if self._as_in_guide else max(1, self.sample_rate // 20)

    @property
    def _as_in_guide(self) -> bool:
        return GUIDE_RATES[0] <= self.sample_rate <= GUIDE_RATES[1]

    @property
    def max_frequency(self) -> float:
        """Highest centre frequency (Hz): that of the user guide, or less at low sample rates."""
        return MAX_FREQUENCY if self.sample_rate >= 2 * MAX_FREQUENCY else float(self.sample_rate * 9 // 20)


def choose(argument: str) -> DemoSound:
    """Return the source for an argument: a sound file, ``scene:``, ``file:PATH`` or an ALSA device.

    Raises
    ------
    AudioFileError, interface.ComponentError
        The file or the scene cannot be used. Devices are not checked before they are opened.
    """
    if argument.startswith("scene:"):
        return _scene(argument)
    if argument.startswith("file:"):
        return DemoSound(argument, 0, _checked(argument).sample_rate, argument)
    if _names_file(argument):
        return _file(Path(argument).expanduser())
    return DemoSound(argument, DEFAULT_RATE, DEFAULT_RATE, argument, has_beginning=False)


def _names_file(argument: str) -> bool:
    path = Path(argument)
    return "/" in argument.partition(":")[0] or path.suffix.lower() in SOUND_FILES or path.expanduser().is_file()


def _scene(device: str) -> DemoSound:
    source = _checked(device)
    rate, length = source.sample_rate, (source.frames or math.inf) / source.sample_rate
    if (scene := getattr(source, "scene", None)) is None:  # the built-in one
        return DemoSound(device, rate, rate, "A source moves from left to right", truth=source.truth)
    note = f"sources: {', '.join(one.name for one in scene.sources)}; head: {Path(scene.head.name).name}"
    title = Path(device.removeprefix("scene:")).name
    return DemoSound(device, 0, rate, title, note, length=length, truth=source.truth, head=scene.head)


def _file(path: Path) -> DemoSound:
    file = AudioFile(path)
    file.close()
    device = f"file:{path.absolute()}"
    sound = DemoSound(device, 0, _checked(device).sample_rate, path.name)
    length = file.frames / file.sample_rate
    note = f"{path.name}: {length:.1f} s at {file.sample_rate} Hz"
    if sound.max_frequency < MAX_FREQUENCY:
        note += f", which allows at most fb_highFreqHz {sound.max_frequency:.0f}"
    return dataclasses.replace(sound, note=note, length=length)


def _checked(device: str) -> Any:
    """Open a source that needs no hardware, and return it closed."""
    source = open_source(device, 0, 1, threading.Event())
    source.close()
    return source
