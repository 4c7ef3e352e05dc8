"""A room whose sound a test chooses while it is published, in real time, in place of bass."""

from __future__ import annotations

import itertools
import threading
import time
from types import TracebackType

import numpy as np

import rosafe
from rosafe.localization.scene import BLOCK
from rosafe.localization.scene_signals import NoiseSignal
from tests.harness import Graph
from tests.localization.conftest import RATE
from tests.ros1.afe.session import Microphone

CHUNK = RATE // 20
QUIET = 1e-4  # RMS of the noise of the microphones
LEVEL = 0.05


class _StampedMicrophone(Microphone):
    """A microphone whose messages have the time of their capture."""

    def stamp(self) -> dict[str, int]:
        sec, nsec = divmod(time.time_ns(), 1_000_000_000)
        return {"sec": sec, "nsec": nsec}


class Room:
    """Publishes the sound at the ears of a spherical head, on a thread of its own.

    Attributes
    ----------
    azimuth : float or None
        Direction of the source in degrees; None for quiet.
    gains : tuple of float
        Of the two channels.
    swapped : bool
        Whether the channels are exchanged.
    """

    def __init__(self, graph: Graph) -> None:
        self.azimuth: float | None = None
        self.gains = 1.0, 1.0
        self.swapped = False
        self._head = rosafe.Head.sphere()
        self._sounds: dict[float, np.ndarray] = {}
        self._microphone = _StampedMicrophone(graph, RATE, CHUNK, 20, "/bass/Audio")
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def sound(self, azimuth: float) -> np.ndarray:
        """Return a second of sound from a direction, (2, RATE)."""
        if azimuth not in self._sounds:
            signal = LEVEL * NoiseSignal(RATE, 1, 0).samples(BLOCK, 2 * RATE)
            self._sounds[azimuth] = self._head.render(signal, RATE, azimuth)[:, -RATE:]
        return self._sounds[azimuth]

    def _run(self) -> None:
        random = np.random.default_rng(1)
        began = time.monotonic()
        for number in itertools.count(1):
            if self._ending.wait(max(0.0, began + number * CHUNK / RATE - time.monotonic())):
                return
            ears = QUIET * random.standard_normal((2, CHUNK))
            if self.azimuth is not None:
                begin = number * CHUNK % RATE
                ears += self.sound(self.azimuth)[:, begin : begin + CHUNK]
            ears = np.array(self.gains)[:, np.newaxis] * (ears[::-1] if self.swapped else ears)
            self._microphone.play((2**31 * np.clip(ears, -0.99, 0.99)).astype(np.int32))

    def __enter__(self) -> Room:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()
        self._microphone.close()
