"""The source for ALSA capture devices, through pyalsaaudio."""

from __future__ import annotations

import errno
import math
import os
import select
import threading
import time
from functools import partial

import numpy as np

from rosafe.audio.devices.base import Chunk, Chunker, device_error, parse_options
from rosafe.audio.devices.libasound import captured_alsa_errors, forget_configuration, load_alsaaudio
from rosafe.audio.devices.pcm import MAX_CHANNELS, RING_CHUNKS, PcmOpener
from rosafe.audio.devices.pcmname import checked_name
from rosafe.audio.files.audiofile import channel_pair
from rosafe.interface import ComponentError

POLL_SECONDS = 0.1  # maximum, so that a stop is noticed
STALL_SECONDS = 5.0  # without a frame, a device counts as lost; PulseAudio takes 2 s to start
RETRIES, RETRY_SECONDS = 5, 0.2  # to reopen a device that failed
STANDSTILL_SECONDS = 1.0  # without a read; a sound server may then have dropped audio without reporting it
SETTLE_SECONDS = 2.0  # until a sound server has delivered the audio that it stored during a standstill
SLACK_SECONDS = 0.25  # possible change of a sound server's delay
_OPTIONS = {"channels": partial(channel_pair, max_channel=MAX_CHANNELS)}


class CaptureClock:
    """Times of captured frames, and the number of lost frames that follows from them.

    Attributes
    ----------
    newest : float or None
        When the newest frame left the converter, in s; None before the first frame.
    restarted : bool
        Whether the device was restarted after the newest frame.
    """

    def __init__(self, sample_rate: int) -> None:
        self.newest: float | None = None
        self.restarted = False
        self._sample_rate = sample_rate
        self._last_read = math.inf
        self._compare_at = math.inf  # after a standstill, when to compare the number of frames with the clock
        self._expected = 0.0  # time of the newest frame if a standstill has not caused a loss

    def before_read(self, now: float) -> None:
        """Register a read. A long time since the previous one starts a comparison with the clock."""
        if self.newest is not None and now - self._last_read > STANDSTILL_SECONDS:
            if self._compare_at == math.inf:  # otherwise the comparison after an earlier standstill continues
                self._expected = self.newest
            self._compare_at = now + SETTLE_SECONDS
        self._last_read = now

    def after_read(self, count: int, newest: float) -> int:
        """Register `count` frames, the last from time `newest`. Return the number of frames lost before them."""
        duration = count / self._sample_rate
        lost = 0
        if self.restarted:
            self.restarted = False
            self._expected = newest - duration
            if self.newest is not None:
                lost = max(1, round((self._expected - self.newest) * self._sample_rate))
        self.newest = newest
        self._expected += duration
        if newest > self._compare_at:
            self._compare_at = math.inf
            missing = newest - self._expected
            if missing > SLACK_SECONDS:
                lost += round(missing * self._sample_rate)
        return lost


class AlsaSource:
    """Two channels of an ALSA PCM, S32_LE, with exactly the requested sample rate and period.

    The length of an overrun is estimated from the clock: the lost frames are counted, and appear as zeros or as the gap
    before a chunk. A device that fails is reopened a few times before it counts as lost.

    Parameters
    ----------
    device : str
        PCM name (see `checked_name`); with ``?channels=L,R`` two channels (from 1) of a device with another number of
        channels.
    sample_rate : int
        Hz.
    frames_per_chunk : int
        The device's period.
    """

    def __init__(self, device: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        self.name = device
        self.sample_rate = sample_rate
        self.overruns = 0
        self.lost_frames = 0
        name, _, options = device.partition("?")
        forget_configuration()
        with captured_alsa_errors():
            pcm_name = checked_name(name)
        channels: tuple[int, int] | None = parse_options(device, options, _OPTIONS).get("channels")
        self._columns = [channel - 1 for channel in channels or (1, 2)]
        self._frames_per_chunk = frames_per_chunk
        self._stopping = stopping
        self._opener = PcmOpener(load_alsaaudio(), device, pcm_name, channels, sample_rate, frames_per_chunk)
        self._pcm = self._opener.open()
        self._chunks = Chunker(frames_per_chunk)
        self._clock = CaptureClock(sample_rate)
        self._active_since: float | None = None  # when the device was started, or last delivered frames
        self._time = 0.0
        self._failures = 0  # attempts to reopen the device since it last delivered frames
        self._overruns_without_audio = 0  # overruns since then

    def read(self) -> Chunk | None:
        """Return the next chunk; None after a stop. Raises ``::bass::e_device`` if the device is lost."""
        with captured_alsa_errors():
            while (chunk := self._chunks.take()) is None:
                if self._stopping.is_set():
                    return None
                self._read_some()
        self._time = max(self._time, (self._clock.newest or 0.0) - self._chunks.pending / self.sample_rate)
        return Chunk(*chunk, self._time)

    def _read_some(self) -> None:
        """Read the available frames, or wait a little, or register an overrun."""
        now = time.monotonic()
        if self._active_since is None:
            self._active_since = now  # the first read starts the device
        self._clock.before_read(now)
        try:
            count, data = self._pcm.read()
            if count > 0:
                # Frames that are still in the device are newer than the frames of this read.
                behind = min(max(0, self._pcm.avail()), RING_CHUNKS * self._frames_per_chunk)
                self._active_since = time.monotonic()
                self._receive(count, data, self._active_since - behind / self.sample_rate)
            elif count == 0:
                self._wait_for_sound(now - self._active_since)
            elif count == -errno.EPIPE:  # pyalsaaudio has prepared the device; the next read restarts it
                self._overruns_without_audio += 1
                if self._overruns_without_audio > RETRIES:
                    raise self._opener.alsa_error("repeated overruns without any audio")
                self._restarted()
            else:
                raise self._opener.alsa_error(os.strerror(-count))
        except self._opener.alsa_error as problem:
            self._reopen(self._opener.message(problem))

    def _receive(self, count: int, data: bytes, newest: float) -> None:
        restarted = self._clock.restarted
        lost = self._clock.after_read(count, newest)
        if lost:
            self.overruns += not restarted  # an overrun that caused a restart is counted already
            self.lost_frames += lost
            self._chunks.lose(lost)
        self._chunks.add(np.frombuffer(data, "<i4").reshape(count, -1).T[self._columns])
        self._failures = self._overruns_without_audio = 0

    def _wait_for_sound(self, silent_seconds: float) -> None:
        if silent_seconds > STALL_SECONDS + self._frames_per_chunk / self.sample_rate:
            raise self._opener.alsa_error("the device delivers no more audio")
        poll = select.poll()
        for descriptor, events in self._pcm.polldescriptors():
            poll.register(descriptor, events)
        ready = poll.poll(POLL_SECONDS * 1000)
        if ready:
            self._pcm.polldescriptors_revents(ready)  # otherwise the descriptors of plugins stay ready
            # Some descriptors become ready before a frame is available; the pause prevents a busy loop.
            self._stopping.wait(0.001)

    def _restarted(self) -> None:
        """Register a restart. The number of lost frames is known with the next audio, which may take seconds."""
        self.overruns += 1
        self._active_since = None
        self._clock.restarted = True

    def _reopen(self, problem: str) -> None:
        """Reopen a failed device. Raises ``::bass::e_device`` after several attempts."""
        self._pcm.close()
        while self._failures < RETRIES:
            self._failures += 1
            if self._stopping.wait(RETRY_SECONDS):
                return
            try:
                self._pcm = self._opener.open()
            except ComponentError:
                continue
            self._restarted()
            return
        raise device_error(f"{self.name}: {problem}; gave up after {RETRIES} attempts to reopen the device")

    def close(self) -> None:
        """Close the device."""
        self._pcm.close()
