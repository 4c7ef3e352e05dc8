"""The source `scene:FILE.yaml`: a binaural scene with known truth, rendered in real time."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator

import numpy as np

from rosafe.audio.devices.base import PacedSource, device_error, hwparams_error
from rosafe.audio.files.audiofile import to_int32
from rosafe.localization.scene import SceneRenderer, Truth
from rosafe.localization.scene_file import SUFFIXES, SampleRateError, SceneError, read_scene

# Values of the file in a message: remote clients can name files, whose contents they must not receive.
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")


class SceneFileSource(PacedSource):
    """A scene from a file (docs/scenes.md).

    Parameters
    ----------
    path : str
        A YAML file; relative to the folder of the process.
    sample_rate : int
        Hz; must be that of the scene, or 0.
    frames_per_chunk : int
        The last chunk is filled with zeros.

    Attributes
    ----------
    scene : rosafe.localization.scene.SceneDescription
        The scene.
    """

    def __init__(self, path: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        super().__init__(f"scene:{path}", stopping)
        if not path.lower().endswith(SUFFIXES):
            raise device_error(f"{self.name}: expected a file that ends in .yaml, or options after a question mark")
        try:
            self.scene = read_scene(path, sample_rate)
        except SampleRateError as problem:
            raise hwparams_error(str(problem)) from None
        except SceneError as problem:
            raise device_error(_QUOTED.sub("...", str(problem))) from None
        duration, rate = self.scene.duration, self.scene.sample_rate
        self.frames = None if duration is None else max(1, round(duration * rate))  # None without an end
        self._start(rate, frames_per_chunk, self._rendered(frames_per_chunk))

    def _rendered(self, frames_per_chunk: int) -> Iterator[tuple[int, np.ndarray]]:
        renderer, position = SceneRenderer(self.scene), 0
        while self.frames is None or position < self.frames:
            count = frames_per_chunk if self.frames is None else min(frames_per_chunk, self.frames - position)
            yield 0, to_int32(renderer.frames(count))
            position += count

    def truth(self, time: float) -> Truth:
        """Return the true directions at a time in s from the first frame."""
        return self.scene.truth(time)
