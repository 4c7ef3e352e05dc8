"""Sound sources: `open_source` opens the source that a device name denotes. Only bags need ROS."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator

from rosafe.audio.devices.base import Chunk, SoundSource, device_error
from rosafe.declarations.text import did_you_mean
from rosafe.interface import ComponentError

__all__ = ["Chunk", "SoundSource", "device_lines", "open_source"]

DEFAULT_RATE = 44100
_CONTROL = re.compile("[\0-\x1f\x7f-\x9f\u2028\u2029]")  # would break a line of the log
# Name and description of each source without hardware, for ListDevices.
BUILT_IN = (
    ("file:PATH", "a sound file in real time; ?loop=1 repeats it, ?start=SECONDS skips its beginning, ?channels=3,4"),
    ("bag:PATH", "a recording of a port Audio by rosbag; ?topic=/bass/Audio, ?loop=1, ?start=SECONDS"),
    ("topic:/NAME", "sound in messages of another driver; ?channels=3,4, ?format=S16LE&rate=16000&of=2"),
    ("scene:FILE.yaml", "a scene of several sources with known truth; docs/scenes.md describes the file"),
    ("scene:", "a source that moves from far left to far right and back; ?seconds=10&level=-30&seed=0"),
)


def device_lines() -> Iterator[str]:
    """Yield the lines of ListDevices: the built-in sources, then each capture PCM in the format of the original.

    Raises ``::bass::e_nodevice`` after the built-in sources if there is no sound card.
    """
    from rosafe.audio.devices.libasound import capture_devices

    for name, contents in BUILT_IN:
        yield f"{name} [{contents}]"
    for card, device, card_id, pcm_id in capture_devices():
        yield f"hw:{card},{device} [{card_id}] [{pcm_id}]"


def open_source(device: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> SoundSource:
    """Open `device` for reading.

    Parameters
    ----------
    device : str
        ``file:PATH``, ``bag:PATH``, ``scene:``, ``scene:FILE.yaml`` or the name of an ALSA capture device; all but
        a scene file with options after a question mark. It may come from an untrusted client: nothing is evaluated.
    sample_rate : int
        Hz; 0 is the file's or bag's own rate, or 44100 with other sources.
    frames_per_chunk : int
        Length of the chunks that `SoundSource.read` returns.
    stopping : threading.Event
        Once set, a waiting `read` returns None.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_device`` or ``::bass::e_hwparams``, with the reason in one line.
    """
    if _CONTROL.search(device):
        raise device_error(f"{device!r}: expected the name of a device, got control characters in it")
    if device.startswith("topic:"):
        raise device_error(f"{device}: expected a running node that subscribes; acquire it with bass")
    # Imported here, so that a missing library affects only the source that needs it.
    if device.startswith("file:"):
        from rosafe.audio.devices.file import FileSource

        return FileSource(device[len("file:") :], sample_rate, frames_per_chunk, stopping)
    if device.startswith("bag:"):
        from rosafe.audio.devices.bag import BagSource

        return BagSource(device[len("bag:") :], sample_rate, frames_per_chunk, stopping)
    if device.startswith("scene:"):
        from rosafe.audio.devices.scene import SceneFileSource, SceneSource

        if device[len("scene:") :].partition("?")[0]:
            return SceneFileSource(device[len("scene:") :], sample_rate, frames_per_chunk, stopping)
        return SceneSource(device[len("scene:") :], sample_rate or DEFAULT_RATE, frames_per_chunk, stopping)
    from rosafe.audio.devices.alsa import AlsaSource, DeviceBusyError

    try:
        return AlsaSource(device, sample_rate or DEFAULT_RATE, frames_per_chunk, stopping)
    except ComponentError as problem:
        first = device.strip("'\" ").partition(":")[0]
        hint = did_you_mean(first, [name.partition(":")[0] for name, _ in BUILT_IN])
        if problem.ex != device_error("").ex or isinstance(problem, DeviceBusyError) or not hint:
            raise
        raise device_error(f"{problem.what}{hint.removesuffix('?')}:?") from None
