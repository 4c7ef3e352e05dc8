"""The source for ALSA capture devices, through pyalsaaudio."""

from __future__ import annotations

import errno
import math
import os
import select
import threading
import time
from typing import Any

import numpy as np

from rosafe.bass.sources.base import Chunk, Chunker, device_error, hwparams_error, parse_options
from rosafe.bass.sources.libasound import captured_alsa_errors, load_alsaaudio
from rosafe.bass.sources.pcmname import checked_name
from rosafe.interface import ComponentError

RING_CHUNKS = 8  # asked for; the device may give fewer
MAX_CHANNELS = 32  # of a device of which two are picked
POLL_SECONDS = 0.1  # at most, so that a stop is seen
STALL_SECONDS = 5.0  # without a frame, a device counts as gone; PulseAudio takes 2 s to begin
RETRIES, RETRY_SECONDS = 5, 0.2  # to reopen a device that failed
STANDSTILL_SECONDS = 1.0  # without asking the device; then a sound server may have dropped sound and not say so
SETTLE_SECONDS = 2.0  # until it has handed over what it kept meanwhile
SLACK_SECONDS = 0.25  # what its delay may change by


def _channel_pair(text: str) -> tuple[int, int]:
    wanted = f"two channel numbers from 1 to {MAX_CHANNELS}, such as 3,4"
    words = text.split(",")
    if len(words) != 2 or not all(word.isascii() and word.isdigit() and len(word) <= 2 for word in words):
        raise ValueError(wanted)
    left, right = (int(word) for word in words)
    if not (1 <= left <= MAX_CHANNELS and 1 <= right <= MAX_CHANNELS):
        raise ValueError(wanted)
    return left, right


class AlsaSource:
    """Two channels of an ALSA PCM, S32_LE, with exactly the sample rate and period that were asked for.

    An overrun is an event with a length: the frames lost, estimated from the clock, come as zeros or as the gap
    before a chunk, and count. A device that fails is reopened a few times before it counts as gone.

    Parameters
    ----------
    device : str
        PCM name (see `checked_name`), with ``?channels=L,R`` for the channels (from 1) of a device that has others
        than two.
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
        pcm_name, _, options = device.partition("?")
        with captured_alsa_errors():
            self._pcm_name = checked_name(pcm_name)
        self._channels: tuple[int, int] | None = parse_options(device, options, {"channels": _channel_pair}).get(
            "channels"
        )
        self._frames_per_chunk = frames_per_chunk
        self._stopping = stopping
        self._alsa = load_alsaaudio()
        self._pcm: Any = None
        self._width = 2
        self._open()
        self._chunks = Chunker(frames_per_chunk)
        self._last_audio_time: float | None = None  # when the newest frame that was read left the converter
        self._since: float | None = None  # when the device was started, or gave sound
        self._broken = False  # whether it was started anew since its newest frame
        self._asked = math.inf  # when the device was last read from
        self._settled = math.inf  # after a standstill, when to compare the frames that came with the clock
        self._expected_time = 0.0  # meanwhile, when the newest one left the converter if none was dropped
        self._time = 0.0
        self._failures = 0  # attempts to reopen the device since it last gave sound
        self._overruns_without_audio = 0  # overruns since then

    # --- opening ---

    def _open(self) -> None:
        if self._channels is None:
            self._pcm = self._open_with(2)
            return
        for width in range(max(self._channels), MAX_CHANNELS + 1):
            pcm = self._open_with(width, exact_channels=False)
            if pcm is not None:
                self._pcm, self._width = pcm, width
                return
        raise hwparams_error(f"{self.name} has no {max(self._channels)} channels")

    def _open_with(self, channels: int, exact_channels: bool = True) -> Any:
        """The PCM, open and exact; None where only the number of channels is wrong and another one may be tried."""
        with captured_alsa_errors() as heard:
            try:
                pcm = self._alsa.PCM(
                    type=self._alsa.PCM_CAPTURE,
                    mode=self._alsa.PCM_NONBLOCK,  # a busy device must not block the open, nor a mute one the stop
                    device=self._pcm_name,
                    rate=self.sample_rate,
                    channels=channels,
                    format=self._alsa.PCM_FORMAT_S32_LE,
                    periodsize=self._frames_per_chunk,
                    periods=RING_CHUNKS,
                )
            except self._alsa.ALSAAudioError as problem:
                raise self._refusal(str(problem), heard) from None
            info = pcm.info()
            faults = self._faults(pcm, info, channels)
        if not faults:
            return pcm
        pcm.close()
        if not exact_channels and info["channels"] != channels:
            return None
        raise hwparams_error(f"{self.name}: {'; '.join(faults)}")

    def _refusal(self, problem: str, heard: list[str]) -> ComponentError:
        """e_device for a PCM that is not there, is busy or broken; what libasound said of it last comes along."""
        text = problem.removesuffix(f" [{self._pcm_name}]")
        not_there = "see ListDevices and `arecord -L` for what there is"
        hint = {
            os.strerror(errno.EBUSY): "another program uses it; see `fuser -v /dev/snd/*`",
            os.strerror(errno.ENOENT): not_there,
            os.strerror(errno.ENODEV): not_there,
            os.strerror(errno.EACCES): "put the user into the group audio",
        }.get(text)
        if text == os.strerror(errno.EINVAL) and not heard:  # an open that fails does not do so silently
            return hwparams_error(f"{self.name}: the device takes no {self.sample_rate} Hz with two channels of S32_LE")
        details = [word for word in (heard[-1] if heard else "", hint) if word]
        why = f"{self.name}: {text}" + (f" ({'; '.join(details)})" if details else "")
        return DeviceBusyError(why) if text == os.strerror(errno.EBUSY) else device_error(why)

    def _faults(self, pcm: Any, info: dict[str, Any], channels: int) -> list[str]:
        """What of the PCM is not as asked for, each with what it offers."""
        faults = []
        if info["format_name"] != "S32_LE":
            formats = ", ".join(sorted(pcm.getformats())) or info["format_name"]
            converter = ("plug" if self._pcm_name.startswith("hw:") else "plug:") + self._pcm_name
            faults.append(f"no format S32_LE, it offers {formats}: {converter} converts")
        if info["channels"] != channels:
            faults.append(
                f"not {channels} channels, it opens with {info['channels']}: pick two with ?channels=1,2"
                + (", or 1,1 for both ears" if info["channels"] == 1 else "")
            )
        if info["rate"] != self.sample_rate:
            faults.append(f"no sample rate of {self.sample_rate} Hz, it offers {_listed(pcm.getrates())}")
        elif info["period_size"] != self._frames_per_chunk:
            faults.append(f"no chunks of {self._frames_per_chunk} frames, the nearest are of {info['period_size']}")
        return faults

    # --- reading ---

    def read(self) -> Chunk | None:
        """The next chunk; None when told to stop, ``::bass::e_device`` when the device is gone."""
        with captured_alsa_errors():
            while (chunk := self._chunks.take()) is None:
                if self._stopping.is_set():
                    return None
                self._read_some()
        self._time = max(self._time, (self._last_audio_time or 0.0) - self._chunks.pending / self.sample_rate)
        return Chunk(*chunk, self._time)

    def _read_some(self) -> None:
        """Take what the device has, which may be less than asked for; or wait a little; or note what was lost."""
        before = time.monotonic()
        if self._since is None:
            self._since = before  # the first read starts the device
        if self._last_audio_time is not None and before - self._asked > STANDSTILL_SECONDS:
            if self._settled == math.inf:  # else the reckoning of an earlier one goes on
                self._expected_time = self._last_audio_time
            self._settled = before + SETTLE_SECONDS
        self._asked = before
        try:
            count, data = self._pcm.read()
            if count > 0:
                # What is still in the device came after the newest frame of this read.
                behind = min(max(0, self._pcm.avail()), RING_CHUNKS * self._frames_per_chunk)
                self._since = time.monotonic()
                newest = self._since - behind / self.sample_rate
                if self._broken:
                    self._lose(newest - count / self.sample_rate)
                self._last_audio_time = newest
                self._expected_time += count / self.sample_rate
                if newest > self._settled:
                    self._compare(newest)
                left, right = self._channels or (1, 2)
                frames = np.frombuffer(data, "<i4").reshape(-1, self._width).T
                self._chunks.add(frames[[left - 1, right - 1]])
                self._failures = self._overruns_without_audio = 0
            elif count == 0:
                self._wait_for_sound(before)
            elif count == -errno.EPIPE:  # pyalsaaudio has prepared the device; the next read starts it again
                self._overruns_without_audio += 1
                if self._overruns_without_audio > RETRIES:
                    raise self._alsa.ALSAAudioError("overrun after overrun and no sound")
                self._break()
            else:
                raise self._alsa.ALSAAudioError(os.strerror(-count))
        except self._alsa.ALSAAudioError as problem:
            self._reopen(str(problem))

    def _wait_for_sound(self, now: float) -> None:
        if self._since is not None and now - self._since > STALL_SECONDS + self._frames_per_chunk / self.sample_rate:
            raise self._alsa.ALSAAudioError("no sound comes any more")
        poll = select.poll()
        for descriptor, events in self._pcm.polldescriptors():
            poll.register(descriptor, events)
        ready = poll.poll(POLL_SECONDS * 1000)
        if ready:
            self._pcm.polldescriptors_revents(ready)  # plugins need to see it, or they stay ready for ever
            # Some are ready before there is a frame to read; the pause keeps that from becoming a busy loop.
            self._stopping.wait(0.001)

    def _break(self) -> None:
        """Note that the device starts anew. What was lost shows with its next sound, for which it may take seconds."""
        self.overruns += 1
        self._since = None
        self._broken = True

    def _lose(self, begin: float) -> None:
        """Account for the frames between the newest one read and `begin`, from which on there is sound again."""
        self._broken = False
        self._expected_time = begin
        if self._last_audio_time is not None:  # else the stream only begins
            self._count(max(1, round((begin - self._last_audio_time) * self.sample_rate)))

    def _compare(self, newest: float) -> None:
        """Account for what was dropped in a standstill without a word; the newest frame is of the time `newest`."""
        self._settled = math.inf
        missing = newest - self._expected_time
        if missing > SLACK_SECONDS:
            self.overruns += 1
            self._count(round(missing * self.sample_rate))

    def _count(self, lost: int) -> None:
        self.lost_frames += lost
        self._chunks.lose(lost)

    def _reopen(self, problem: str) -> None:
        """Get a failed device back, or raise ``::bass::e_device`` after some attempts."""
        text = problem.removesuffix(f" [{self._pcm_name}]")
        self._pcm.close()
        while self._failures < RETRIES:
            self._failures += 1
            if self._stopping.wait(RETRY_SECONDS):
                return
            try:
                self._open()
            except ComponentError:
                continue
            self._break()
            return
        raise device_error(f"{self.name}: {text}; given up after {RETRIES} attempts to open it again")

    def close(self) -> None:
        """Give the device back."""
        self._pcm.close()


class DeviceBusyError(ComponentError):
    """``::bass::e_device`` because somebody, maybe this component's running acquisition, uses the device."""

    def __init__(self, why: str) -> None:
        super().__init__(device_error(why).ex, why)


def _listed(rates: int | tuple[int, int] | list[int]) -> str:
    """pyalsaaudio's three ways to say which rates there are, in words."""
    if isinstance(rates, int):
        return f"{rates} Hz"
    if isinstance(rates, tuple):
        return f"{rates[0]} to {rates[1]} Hz"
    return ", ".join(map(str, rates)) + " Hz"
