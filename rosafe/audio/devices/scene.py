"""The sources `scene:`, a talker that moves from far left to far right and back, and `scene:FILE.yaml`.

The head of the built-in scene is the rigid sphere of rosafe/localization/sphere.py.
"""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterator

import numpy as np
from scipy import signal

from rosafe.audio.devices.base import PacedSource, device_error, hwparams_error, parse_options
from rosafe.audio.files.audiofile import to_int32
from rosafe.localization.filters import HOP, SourceRenderer
from rosafe.localization.rectangular_room import MAX_DRR, MAX_RT60, MIN_DRR, MIN_RT60, RectangularRoom, RoomReflections
from rosafe.localization.reverberation import Reverberation
from rosafe.localization.scene import BLOCK, DEFAULT_DISTANCE, SceneRenderer, Truth
from rosafe.localization.scene_signals import uniform
from rosafe.localization.sphere import sphere_filters
from rosafe.system.option_types import number, seconds, whole_number

WALK_SECONDS = 10.0
LEVEL_DB = -30.0
DRR_DB = 5.0  # in a room
MIN_RATE = 1000  # Hz; almost no sound would remain below
_PITCH = (125.0, 25.0, 0.37)  # Hz: mean, excursion and speed of the talker's gliding voice
_SYLLABLE = 0.25  # s
# Values of the file in a message: remote clients can name files, whose contents they must not receive.
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")


class Scene:
    """The samples of the scene, in order. They depend only on options and sample rate, not on the block length.

    Parameters
    ----------
    sample_rate : int
        Hz.
    seconds : float
        Length of one walk.
    level : float
        RMS level of the source, before the head, in dB below full scale.
    seed : int
        Seed of noise and room.
    rt60 : float, optional
        Reverberation time of a room in s; without a room by default.
    drr : float
        Direct-to-reverberant ratio in the room, dB.
    """

    def __init__(
        self,
        sample_rate: int,
        seconds: float = WALK_SECONDS,
        level: float = LEVEL_DB,
        seed: int = 0,
        rt60: float | None = None,
        drr: float = DRR_DB,
    ) -> None:
        self.sample_rate = sample_rate
        self.seconds = seconds
        self._carrier = _Carrier(sample_rate, seed)
        first_second = _Carrier(sample_rate, seed).block(np.arange(sample_rate) / sample_rate)
        self._gain = 10 ** (level / 20) / np.sqrt(np.mean(first_second**2))
        filters = sphere_filters(sample_rate)
        self._renderer = SourceRenderer(filters)
        self._reverberation = None
        if rt60 is not None:
            reflections = RoomReflections(RectangularRoom.drawn(rt60, drr, seed), filters, sample_rate, seed)
            self._reverberation = Reverberation(reflections, [DEFAULT_DISTANCE], BLOCK)
        self._frame = 0  # number of the first frame of the next block
        self._block = np.zeros((2, 0), np.int32)

    def azimuth(self, times: np.ndarray | float) -> np.ndarray:
        """Return the azimuth of the talker at `times` (s from the first frame): degrees, left positive."""
        phase = np.mod(np.asarray(times, dtype=np.float64) / self.seconds, 2.0)
        return np.asarray(180.0 * np.abs(phase - 1.0) - 90.0)

    def frames(self, count: int) -> np.ndarray:
        """Return the next `count` frames: int32, (2, count)."""
        parts = [self._block[:, :count]]
        self._block = self._block[:, count:]
        missing = count - parts[0].shape[1]
        while missing > 0:
            block = self._next_block()
            parts.append(block[:, :missing])
            self._block = block[:, missing:]
            missing -= parts[-1].shape[1]
        return np.concatenate(parts, axis=1)

    def _next_block(self) -> np.ndarray:
        times = (self._frame + np.arange(BLOCK + 1)) / self.sample_rate
        self._frame += BLOCK
        source = self._gain * self._carrier.block(times[:-1])
        azimuths = self.azimuth(times[::HOP])
        ears = self._renderer.process(source, azimuths)
        if self._reverberation is not None:
            ears += self._reverberation.add(0, source, azimuths, np.zeros_like(azimuths))
            ears += self._reverberation.tail()
        return to_int32(ears)


class SceneSource(PacedSource):
    """The scene in real time.

    Parameters
    ----------
    text : str
        Options, after an optional question mark: ``seconds`` of one walk (default 10), ``level`` in dB below full
        scale (default -30), ``seed`` of noise and room (default 0), ``rt60`` in s for a room, ``drr`` in dB in it
        (default 5).
    """

    frames = None  # it has no end

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        super().__init__(f"scene:{text}", stopping)
        if text and not text.startswith("?"):
            raise device_error(f"{self.name}: expected options after a question mark, such as scene:?seconds=5")
        options = parse_options(self.name, text[1:], _OPTIONS)
        if "drr" in options and "rt60" not in options:
            raise device_error(f"{self.name}: drr: expected together with rt60, such as scene:?rt60=0.4&drr=5")
        if sample_rate < MIN_RATE:
            raise hwparams_error(f"{self.name}: expected a sample rate of at least {MIN_RATE} Hz, got {sample_rate}")
        self._scene = scene = Scene(sample_rate, **options)
        self._start(sample_rate, frames_per_chunk, ((0, scene.frames(frames_per_chunk)) for _ in itertools.count()))

    def truth(self, time: float) -> Truth:
        """Return the true direction at a time in s from the first frame, left positive."""
        return Truth(0.0, ("talker",), (float(self._scene.azimuth(time)),))


_OPTIONS = {
    "seconds": seconds(0.1, 86400),
    "level": number(-120, 0, "a number"),
    "seed": whole_number(0, 10**18 - 1),
    "rt60": seconds(MIN_RT60, MAX_RT60),
    "drr": number(MIN_DRR, MAX_DRR, "a number"),
}


class _Carrier:
    """The signal of the source, (block,) of float64: voiced syllables and bursts of noise.

    Its bandwidth is a fifth of the sample rate, and at most 8 kHz.
    """

    def __init__(self, sample_rate: int, seed: int) -> None:
        top = min(8000.0, sample_rate / 5)
        self._harmonics = max(1, int(top / (_PITCH[0] + _PITCH[1])))
        self._random = np.random.PCG64(seed)
        self._tilt = signal.butter(1, min(700.0, sample_rate / 10), fs=sample_rate)
        self._tilt_state = np.zeros(1)
        self._band = signal.butter(4, top, fs=sample_rate, output="sos")
        self._band_state = np.zeros((self._band.shape[0], 2))

    def block(self, times: np.ndarray) -> np.ndarray:
        """Return the samples at `times` (s), which must follow those of the previous call."""
        within = np.mod(times, _SYLLABLE) / _SYLLABLE
        voiced, self._tilt_state = signal.lfilter(*self._tilt, self._voice(times), zi=self._tilt_state)
        noise, self._band_state = signal.sosfilt(self._band, uniform(self._random, len(times)), zi=self._band_state)
        voiced *= np.where(within < 0.7, np.sin(np.pi * within / 0.7) ** 2, 0.0)
        noise *= 0.05 + np.where(within > 0.6, np.sin(np.pi * (within - 0.6) / 0.4) ** 2, 0.0)
        return 2.0 * voiced + 3.0 * noise

    def _voice(self, times: np.ndarray) -> np.ndarray:
        """Return a sum of equal harmonics, in closed form, with an RMS of 1."""
        mean, excursion, speed = _PITCH
        glide = excursion / speed * (1.0 - np.cos(2 * np.pi * speed * times))
        half = np.pi * np.mod(mean * times + glide / (2 * np.pi), 1.0)  # half the phase of the fundamental
        low = np.sin(half)
        safe = np.where(np.abs(low) < 1e-9, 1.0, low)
        count = self._harmonics
        kernel = np.where(np.abs(low) < 1e-9, 2.0 * count + 1.0, np.sin((2 * count + 1) * half) / safe)
        return (kernel - 1.0) / np.sqrt(2.0 * count)


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
        # here, as it needs PyYAML, which pip does not install
        from rosafe.localization.scene_file import SUFFIXES, SampleRateError, SceneError, read_scene

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
