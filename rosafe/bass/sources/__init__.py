"""Where sound comes from: `open_source` turns a device name into a source. No ROS in here but for bags."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator

from rosafe.bass.sources.base import Chunk, SoundSource, device_error
from rosafe.declarations.text import did_you_mean
from rosafe.interface import ComponentError

__all__ = ["Chunk", "SoundSource", "device_lines", "open_source"]

DEFAULT_RATE = 44100
_CONTROL = re.compile("[\0-\x1f\x7f-\x9f\u2028\u2029]")  # would make several lines of a line in the log
# What ListDevices says of the sources that need no hardware: name, contents.
BUILT_IN = (
    ("file:PATH", "a sound file in real time; ?loop=1 repeats it, ?start=SECONDS skips its beginning, ?channels=3,4"),
    ("bag:PATH", "what rosbag recorded of a port Audio; ?topic=/bass/Audio, ?loop=1, ?start=SECONDS"),
    ("scene:", "a source that walks from far left to far right and back; ?seconds=10&level=-30&seed=0"),
)


def device_lines() -> Iterator[str]:
    """What ListDevices prints: the built-in sources, then a line for each capture PCM as the original does.

    Raises ``::bass::e_nodevice`` after the built-in ones where there is no sound card at all.
    """
    from rosafe.bass.sources.libasound import capture_devices

    for name, contents in BUILT_IN:
        yield f"{name} [{contents}]"
    for card, device, card_id, pcm_id in capture_devices():
        yield f"hw:{card},{device} [{card_id}] [{pcm_id}]"


def open_source(device: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> SoundSource:
    """Open `device` for reading.

    Parameters
    ----------
    device : str
        ``file:PATH``, ``bag:PATH``, ``scene:`` or the name of an ALSA capture device, each with options after a
        question mark. It may come from anywhere: nothing in it is evaluated.
    sample_rate : int
        Hz; 0 is the file's or bag's own rate, or 44100 with other sources.
    frames_per_chunk : int
        Length of what `SoundSource.read` returns.
    stopping : threading.Event
        Once set, a waiting `read` returns None.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_device`` or ``::bass::e_hwparams``, with one line that says why.
    """
    if _CONTROL.search(device):
        raise device_error(f"{device!r}: line ends, null bytes and the like are in no device's name")
    # Imported here: a missing library must only hurt those who use its source.
    if device.startswith("file:"):
        from rosafe.bass.sources.file import FileSource

        return FileSource(device[len("file:") :], sample_rate, frames_per_chunk, stopping)
    if device.startswith("bag:"):
        from rosafe.bass.sources.bag import BagSource

        return BagSource(device[len("bag:") :], sample_rate, frames_per_chunk, stopping)
    if device.startswith("scene:"):
        from rosafe.bass.sources.scene import SceneSource

        return SceneSource(device[len("scene:") :], sample_rate or DEFAULT_RATE, frames_per_chunk, stopping)
    from rosafe.bass.sources.alsa import AlsaSource, DeviceBusyError

    try:
        return AlsaSource(device, sample_rate or DEFAULT_RATE, frames_per_chunk, stopping)
    except ComponentError as problem:
        first = device.strip("'\" ").partition(":")[0]
        hint = did_you_mean(first, [name.partition(":")[0] for name, _ in BUILT_IN])
        if problem.ex != device_error("").ex or isinstance(problem, DeviceBusyError) or not hint:
            raise
        raise device_error(f"{problem.what}{hint.removesuffix('?')}:?") from None
