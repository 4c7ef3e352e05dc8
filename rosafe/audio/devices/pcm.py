"""Opens ALSA PCMs through pyalsaaudio and explains why a PCM cannot be used."""

from __future__ import annotations

import errno
import os
from typing import Any

from rosafe.audio.devices.base import device_error, hwparams_error
from rosafe.audio.devices.libasound import captured_alsa_errors
from rosafe.interface import ComponentError

RING_CHUNKS = 8  # requested size of the device's ring buffer; the device may use a smaller one
MAX_CHANNELS = 32  # of a device of which two channels are selected
_SEE_LIST = "see ListDevices and `arecord -L` for the available devices"
_HINTS = {
    os.strerror(errno.EBUSY): "another program uses it; see `fuser -v /dev/snd/*`",
    os.strerror(errno.ENOENT): _SEE_LIST,
    os.strerror(errno.ENODEV): _SEE_LIST,
    os.strerror(errno.EACCES): "add the user to the group audio",
}


class DeviceBusyError(ComponentError):
    """``::bass::e_device`` because the device is in use, perhaps by this component's own acquisition."""

    def __init__(self, why: str) -> None:
        super().__init__(device_error(why).ex, why)


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

    def __init__(
        self,
        alsa: Any,
        device: str,
        pcm_name: str,
        channels: tuple[int, int] | None,
        sample_rate: int,
        frames_per_chunk: int,
    ) -> None:
        self.alsa_error = alsa.ALSAAudioError
        self._alsa = alsa
        self._device = device
        self._pcm_name = pcm_name
        self._channels = channels
        self._sample_rate = sample_rate
        self._frames_per_chunk = frames_per_chunk

    def open(self) -> Any:
        """Return the open PCM. Raises ComponentError."""
        if self._channels is None:
            return self._open(2)
        for count in range(max(self._channels), MAX_CHANNELS + 1):
            pcm = self._open(count, exact_channels=False)
            if pcm is not None:
                return pcm
        raise hwparams_error(f"{self._device}: expected at least {max(self._channels)} channels, got fewer")

    def _open(self, channels: int, exact_channels: bool = True) -> Any:
        """Return the open PCM; None if only the number of channels differs, and it need not be exact."""
        with captured_alsa_errors() as messages:
            try:
                pcm = self._alsa.PCM(
                    type=self._alsa.PCM_CAPTURE,
                    mode=self._alsa.PCM_NONBLOCK,  # neither opening a busy device nor stopping a silent one may block
                    device=self._pcm_name,
                    rate=self._sample_rate,
                    channels=channels,
                    format=self._alsa.PCM_FORMAT_S32_LE,
                    periodsize=self._frames_per_chunk,
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
        raise hwparams_error(f"{self._device}: {'; '.join(differences)}")

    def message(self, problem: Exception) -> str:
        """Return the text of pyalsaaudio's error without the name of the PCM."""
        return str(problem).removesuffix(f" [{self._pcm_name}]")

    def _open_error(self, text: str, messages: list[str]) -> ComponentError:
        """Return the error for a PCM that is missing, busy or broken, with the last message of libasound."""
        if text == os.strerror(errno.EINVAL) and not messages:  # libasound explains other failures to open
            return hwparams_error(
                f"{self._device}: the device does not support {self._sample_rate} Hz with two channels of S32_LE"
            )
        details = [detail for detail in (*messages[-1:], _HINTS.get(text)) if detail]
        why = f"{self._device}: {text}" + (f" ({'; '.join(details)})" if details else "")
        return DeviceBusyError(why) if text == os.strerror(errno.EBUSY) else device_error(why)

    def _differences(self, pcm: Any, info: dict[str, Any], channels: int) -> list[str]:
        """Return how the open PCM differs from the request, and what it offers instead."""
        differences = []
        if info["format_name"] != "S32_LE":
            formats = ", ".join(sorted(pcm.getformats())) or info["format_name"]
            converter = ("plug" if self._pcm_name.startswith("hw:") else "plug:") + self._pcm_name
            differences.append(f"expected format S32_LE, got {formats}: use {converter}, which converts")
        if info["channels"] != channels:
            mono = ", or 1,1 for both ears" if info["channels"] == 1 else ""
            differences.append(
                f"expected {channels} channels, got {info['channels']}: choose two with ?channels=1,2{mono}"
            )
        if info["rate"] != self._sample_rate:
            differences.append(f"expected {self._sample_rate} Hz, got {_rates_text(pcm.getrates())}")
        elif info["period_size"] != self._frames_per_chunk:
            differences.append(f"expected chunks of {self._frames_per_chunk} frames, got {info['period_size']}")
        return differences


def _rates_text(rates: int | tuple[int, int] | list[int]) -> str:
    """Describe the sample rates in any of pyalsaaudio's three forms: one rate, a range, or a list."""
    if isinstance(rates, tuple):
        return f"{rates[0]} to {rates[1]} Hz"
    return f"{rates} Hz" if isinstance(rates, int) else f"{', '.join(map(str, rates))} Hz"
