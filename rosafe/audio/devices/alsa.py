"""The source for ALSA capture devices, through pyalsaaudio: opening, reading, and counting of lost frames."""

from __future__ import annotations

import errno
import math
import os
import select
import threading
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rosafe.audio.devices.base import Chunk, Chunker, device_error, hwparams_error, parse_options
from rosafe.audio.devices.libasound import captured_alsa_errors, checked_name, forget_configuration, load_alsaaudio
from rosafe.audio.files.audiofile import channel_pair
from rosafe.interface import ComponentError

POLL_SECONDS = 0.1  # maximum, so that a stop is noticed
STALL_SECONDS = 5.0  # without a frame, a device counts as lost; PulseAudio takes 2 s to start
RETRIES, RETRY_SECONDS = 5, 0.2  # to reopen a device that failed
STANDSTILL_SECONDS = 1.0  # without a read; a sound server may then have dropped audio without reporting it
SETTLE_SECONDS = 2.0  # until a sound server has delivered the audio that it stored during a standstill
SLACK_SECONDS = 0.25  # possible change of a sound server's delay
RING_CHUNKS = 8  # requested size of the device's ring buffer; the device may use a smaller one
MAX_CHANNELS = 32  # of a device of which two channels are selected
_SEE_LIST = "see ListDevices and `arecord -L` for the available devices"
_HINTS = {
    os.strerror(errno.EBUSY): "another program uses it; see `fuser -v /dev/snd/*`",
    os.strerror(errno.ENOENT): _SEE_LIST,
    os.strerror(errno.ENODEV): _SEE_LIST,
    os.strerror(errno.EACCES): "add the user to the group audio",
}
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


# --- opening ----------------------------------------------------------------------------------------------------------


class DeviceBusyError(ComponentError):
    """``::bass::e_device`` because the device is in use, perhaps by this component's own acquisition."""

    def __init__(self, why: str) -> None:
        super().__init__(device_error(why).ex, why)


@dataclass(frozen=True)
class PcmOpener:
    """Opens a PCM as S32_LE with exactly the requested sample rate and period.

    Parameters
    ----------
    alsa : module
        The module `alsaaudio`.
    device : str
        The name for error messages.
    pcm_name : str
        The name for libasound.
    channels : tuple of int, or None
        The two selected channels (from 1); None for a PCM with two channels.
    sample_rate : int
        Hz.
    frames_per_chunk : int
        The period.
    """

    alsa: Any
    device: str
    pcm_name: str
    channels: tuple[int, int] | None
    sample_rate: int
    frames_per_chunk: int

    @property
    def alsa_error(self) -> type[Exception]:
        """The class of the errors of pyalsaaudio."""
        error: type[Exception] = self.alsa.ALSAAudioError
        return error

    def open(self) -> Any:
        """Return the open PCM. Raises ComponentError."""
        if self.channels is None:
            return self._open(2)
        for count in range(max(self.channels), MAX_CHANNELS + 1):
            pcm = self._open(count, exact_channels=False)
            if pcm is not None:
                return pcm
        raise hwparams_error(f"{self.device}: expected at least {max(self.channels)} channels, got fewer")

    def _open(self, channels: int, exact_channels: bool = True) -> Any:
        """Return the open PCM; None if only the number of channels differs, and it need not be exact."""
        with captured_alsa_errors() as messages:
            try:
                pcm = self.alsa.PCM(
                    type=self.alsa.PCM_CAPTURE,
                    mode=self.alsa.PCM_NONBLOCK,  # neither opening a busy device nor stopping a silent one may block
                    device=self.pcm_name,
                    rate=self.sample_rate,
                    channels=channels,
                    format=self.alsa.PCM_FORMAT_S32_LE,
                    periodsize=self.frames_per_chunk,
                    periods=RING_CHUNKS,
                )
            except self.alsa_error as problem:
                raise self._open_error(self.message(problem), messages) from None
            info = pcm.info()
            differences = self._differences(pcm, info, channels)
        if not differences:
            return pcm
        pcm.close()
        if not exact_channels and info["channels"] != channels:
            return None
        raise hwparams_error(f"{self.device}: {'; '.join(differences)}")

    def message(self, problem: Exception) -> str:
        """Return the text of pyalsaaudio's error without the name of the PCM."""
        return str(problem).removesuffix(f" [{self.pcm_name}]")

    def _open_error(self, text: str, messages: list[str]) -> ComponentError:
        """Return the error for a PCM that is missing, busy or broken, with the last message of libasound."""
        if text == os.strerror(errno.EINVAL) and not messages:  # libasound explains other failures to open
            return hwparams_error(
                f"{self.device}: the device does not support {self.sample_rate} Hz with two channels of S32_LE"
            )
        details = [detail for detail in (*messages[-1:], _HINTS.get(text)) if detail]
        why = f"{self.device}: {text}" + (f" ({'; '.join(details)})" if details else "")
        return DeviceBusyError(why) if text == os.strerror(errno.EBUSY) else device_error(why)

    def _differences(self, pcm: Any, info: dict[str, Any], channels: int) -> list[str]:
        """Return the differences of the open PCM from the request, and its own values."""
        differences = []
        if info["format_name"] != "S32_LE":
            formats = ", ".join(sorted(pcm.getformats())) or info["format_name"]
            converter = ("plug" if self.pcm_name.startswith("hw:") else "plug:") + self.pcm_name
            differences.append(f"expected format S32_LE, got {formats}: use {converter}, which converts")
        if info["channels"] != channels:
            mono = ", or 1,1 for both ears" if info["channels"] == 1 else ""
            differences.append(
                f"expected {channels} channels, got {info['channels']}: choose two with ?channels=1,2{mono}"
            )
        if info["rate"] != self.sample_rate:
            differences.append(f"expected {self.sample_rate} Hz, got {_rates_text(pcm.getrates())}")
        elif info["period_size"] != self.frames_per_chunk:
            differences.append(f"expected chunks of {self.frames_per_chunk} frames, got {info['period_size']}")
        return differences


def _rates_text(rates: int | tuple[int, int] | list[int]) -> str:
    """Describe the sample rates in any of pyalsaaudio's three forms: one rate, a range, or a list."""
    if isinstance(rates, tuple):
        return f"{rates[0]} to {rates[1]} Hz"
    return f"{rates} Hz" if isinstance(rates, int) else f"{', '.join(map(str, rates))} Hz"
