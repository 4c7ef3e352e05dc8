"""The source `bag:PATH`: a port Audio that was recorded by rosbag, in real time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import chain, islice

from rosafe.audio.devices.base import Chunk, PacedSource, check_sample_rate, device_error, parse_options, split_path
from rosafe.audio.files.bagsound import BagSoundError, Piece, Recording, from_first_samples
from rosafe.interface import ComponentError
from rosafe.system.option_types import seconds, whole_number


def _topic_name(text: str) -> str:
    if not text:
        raise ValueError("expected a topic, such as /bass/Audio, got ''")
    return f"/{text.removeprefix('/')}"


_OPTIONS = {
    "topic": _topic_name,
    "stream": whole_number(1, 999_999),
    "start": seconds(0, 1e9),
    "loop": whole_number(0, 1),
}


class BagSource(PacedSource):
    """One recorded stream, joined from overlapping windows. Frames that are in no window count as lost.

    Parameters
    ----------
    text : str
        ``PATH`` or ``PATH?OPTIONS``. Options: ``topic=/left/Audio`` if the bag contains several ports Audio;
        ``stream=2`` for the second of several consecutive acquisitions; ``start=SECONDS`` skips the beginning;
        ``loop=1`` repeats the rest until a stop.
    sample_rate : int
        Hz; must be that of the recording, or 0.
    frames_per_chunk : int
        The last chunk is padded with zeros.
    """

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        super().__init__(f"bag:{text}", stopping)
        path, options_text = split_path(text)
        if not path:
            raise device_error("bag: expected bag:PATH, got an empty path")
        options = parse_options(self.name, options_text, _OPTIONS)
        self._stream = options.get("stream", 1)
        self._loop = options.get("loop", 0)
        self._begin = options.get("start", 0.0)
        self._another = False  # whether the bag contains another stream after this one
        try:
            self._recording = Recording(path, options.get("topic"), stopping)
        except BagSoundError as problem:
            raise device_error(str(problem)) from None
        try:
            pieces = self._play()
            first = next(pieces, None)
            if first is None:
                raise device_error(f"{self.name}: stopped before the first audio was found")
            check_sample_rate(path, sample_rate, self.sample_rate)
        except ComponentError:
            self.close()
            raise
        self._start(self.sample_rate, frames_per_chunk, chain([first], pieces))

    def _play(self) -> Iterator[Piece]:
        """Yield the pieces of the stream from its start, repeatedly if it is looped."""
        try:
            while True:
                streams = self._recording.streams()
                chosen = next(islice(streams, self._stream - 1, None), None)
                if self._stopping.is_set():
                    return
                if chosen is None:
                    raise device_error(f"{self.name}: stream {self._stream} is not in the bag")
                self.sample_rate, pieces = chosen
                empty = True
                for piece in from_first_samples(pieces, round(self._begin * self.sample_rate)):
                    empty = False
                    yield piece
                if empty and not self._stopping.is_set():
                    raise device_error(f"{self.name}: expected a start within the stream, got start={self._begin:g}")
                if not self._loop:
                    self._another = next(streams, None) is not None
                    return
        except BagSoundError as problem:
            raise device_error(str(problem)) from None

    def read(self) -> Chunk | None:
        """Return the next chunk at its time; None after the end. Raises ``::bass::e_device`` if a stream follows."""
        chunk = super().read()
        if chunk is None and self._another and not self._stopping.is_set():
            raise device_error(f"{self.name}: a new stream begins in the bag; play it with ?stream={self._stream + 1}")
        return chunk

    def close(self) -> None:
        """Close the bag."""
        self._recording.close()
