"""The source `bag:PATH`: what a port Audio published while rosbag recorded it, in real time."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from itertools import chain, islice

from rosafe.bass.sources.base import (
    Chunk,
    Chunker,
    Pacer,
    device_error,
    flag,
    hwparams_error,
    number,
    parse_options,
)
from rosafe.bass.sources.file import split_path
from rosafe.interface import ComponentError
from rosafe.sound.bagsound import BagSoundError, Piece, Recording


def _topic_name(text: str) -> str:
    if not text:
        raise ValueError("a topic, such as /bass/Audio")
    return text if text.startswith("/") else f"/{text}"


def _stream_number(text: str) -> int:
    if not re.fullmatch("[1-9][0-9]{0,5}", text):
        raise ValueError("a whole number from 1 on")
    return int(text)


_OPTIONS = {"topic": _topic_name, "stream": _stream_number, "start": number(0, 1e9), "loop": flag}


class BagSource:
    """One recorded stream: of overlapping windows every frame once; what no window shows is lost again.

    Parameters
    ----------
    text : str
        ``PATH`` or ``PATH?OPTIONS``. Options: ``topic=/left/Audio`` where the bag holds several ports Audio;
        ``stream=2`` for the second acquisition of those that were recorded one after the other; ``start=SECONDS``
        leaves out the beginning; ``loop=1`` goes on from there again at the end, for ever.
    sample_rate : int
        Hz; must be that of the recording, or 0.
    frames_per_chunk : int
        The last chunk is filled up with zeros.
    """

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        self.name = f"bag:{text}"
        self.overruns = 0
        self.lost_frames = 0
        path, options_text = split_path(text)
        if not path:
            raise device_error("bag: names no file; write bag:PATH")
        options = parse_options(self.name, options_text, _OPTIONS)
        self._stream = options.get("stream", 1)
        self._loop = options.get("loop", False)
        self._start = options.get("start", 0.0)
        self._another = False  # whether the bag holds more streams after this one
        self.sample_rate = 0
        self._stopping = stopping
        try:
            self._recording = Recording(path, options.get("topic"), stopping)
        except BagSoundError as problem:
            raise device_error(str(problem)) from None
        try:
            self._pieces = self._play()
            first = next(self._pieces, None)
            if first is None:
                raise device_error(f"{self.name}: interrupted before its sound was found")
            self._pieces = chain([first], self._pieces)
            if sample_rate not in (0, self.sample_rate):
                raise hwparams_error(
                    f"{path} was recorded at {self.sample_rate} Hz, asked for were {sample_rate}; 0 is what it has"
                )
        except ComponentError:
            self.close()
            raise
        self._frames_per_chunk = frames_per_chunk
        self._chunks = Chunker(frames_per_chunk)
        self._pacer = Pacer(self.sample_rate, stopping)

    def _play(self) -> Iterator[Piece]:
        """The stream from its start on, again and again if it is looped."""
        try:
            while True:
                streams = self._recording.streams()
                chosen = next(islice(streams, self._stream - 1, None), None)
                if self._stopping.is_set():
                    return
                if chosen is None:
                    raise device_error(f"{self.name}: no stream {self._stream} of sound in the bag")
                self.sample_rate, pieces = chosen
                yield from self._from_start(pieces)
                if not self._loop:
                    self._another = next(streams, None) is not None
                    return
        except BagSoundError as problem:
            raise device_error(str(problem)) from None

    def _from_start(self, pieces: Iterator[Piece]) -> Iterator[Piece]:
        skip = round(self._start * self.sample_rate)
        begun = False
        for gap, samples in pieces:
            without = min(skip, gap)
            skip, gap = skip - without, gap - without
            without = min(skip, samples.shape[1])
            skip, samples = skip - without, samples[:, without:]
            if samples.shape[1]:
                yield gap * begun, samples  # it begins with sound
                begun = True
        if not begun and not self._stopping.is_set():
            raise device_error(f"{self.name}: start={self._start:g} is behind the end of the stream")

    def read(self) -> Chunk | None:
        """The next chunk in its time; None after the end, ``::bass::e_device`` where another stream follows."""
        while (chunk := self._chunks.take()) is None:
            piece = next(self._pieces, None)
            if piece is None:
                chunk = self._chunks.take(whole=False)
                break
            gap, samples = piece
            self.overruns += gap > 0
            self.lost_frames += gap
            self._chunks.lose(gap)
            self._chunks.add(samples)
        if chunk is not None:
            due = self._pacer.wait(chunk[1] + self._frames_per_chunk)
            return None if due is None else Chunk(*chunk, due)
        if self._another:
            raise device_error(
                f"{self.name}: here a new stream begins in the bag; ?stream={self._stream + 1} plays that"
            )
        return None

    def close(self) -> None:
        """Close the bag."""
        self._recording.close()
