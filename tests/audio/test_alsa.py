"""The ALSA source: with a scripted PCM for hardware failures, and with the real libasound and plugins."""

from __future__ import annotations

import errno
import importlib
import os
import select
import sys
import threading
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from rosafe.audio.devices import alsa, libasound, open_source
from rosafe.audio.devices.alsa import AlsaSource, DeviceBusyError
from rosafe.interface import ComponentError
from rosafe.ros1.transport import paths

CHUNK, RATE = 10, 1000
XRUN = -errno.EPIPE


class FakePcm:
    """A PCM that follows `script`: a number of frames to return, XRUN, 0 (no frames yet) or the text of an exception.

    Frame k of channel c is 1000 * k + c, counted over all reads. `clock` advances by the duration of returned frames.
    """

    script: ClassVar[list[Any]] = []
    info_changes: ClassVar[dict[str, Any]] = {}
    refusals: ClassVar[list[str]] = []
    available_channels: ClassVar[tuple[int, ...]] = (2,)
    opened: ClassVar[list[FakePcm]] = []
    frame: ClassVar[int] = 0
    clock: ClassVar[float] = 100.0

    def __init__(self, **settings: Any) -> None:
        if self.refusals:
            raise FakeAlsa.ALSAAudioError(f"{self.refusals.pop(0)} [{settings['device']}]")
        requested = settings["channels"]
        channels = requested if requested in self.available_channels else self.available_channels[0]
        self.channels = channels
        self.settings = {
            "format_name": "S32_LE",
            "channels": channels,
            "rate": settings["rate"],
            "period_size": settings["periodsize"],
            **self.info_changes,
        }
        self.closed = False
        self._pipe = os.pipe()  # never readable
        self.opened.append(self)

    def info(self) -> dict[str, Any]:
        """Return the settings in the form of pyalsaaudio."""
        return self.settings

    def getformats(self) -> dict[str, int]:
        """Return the formats of a cheap microphone."""
        return {"S16_LE": 2, "S24_3LE": 32}

    def getrates(self) -> list[int]:
        """Return the sample rates of a cheap microphone."""
        return [32000, 48000]

    def avail(self) -> int:
        """Return 0: no further frames are available."""
        return 0

    def polldescriptors(self) -> list[tuple[int, int]]:
        """Return a descriptor that is ready immediately."""
        os.write(self._pipe[1], b"x")
        return [(self._pipe[0], 1)]

    def polldescriptors_revents(self, ready: list[tuple[int, int]]) -> int:
        """Read the byte that made the descriptor ready."""
        os.read(self._pipe[0], 1)
        return ready[0][1]

    def read(self) -> tuple[int, bytes]:
        """Execute the next step of the script; after its end, return chunks."""
        step = FakePcm.script.pop(0) if FakePcm.script else CHUNK
        if isinstance(step, tuple):
            step, seconds = step
            FakePcm.clock += seconds
        if isinstance(step, str):
            raise FakeAlsa.ALSAAudioError(f"{step} [hw:9]")
        if step <= 0:
            return step, b""
        numbers = np.arange(FakePcm.frame, FakePcm.frame + step)
        FakePcm.frame += step
        FakePcm.clock += step / RATE
        return step, (1000 * numbers[:, None] + np.arange(self.channels)).astype("<i4").tobytes()

    def close(self) -> None:
        """Close the pipe."""
        if not self.closed:
            self.closed = True
            for end in self._pipe:
                os.close(end)


class FakeAlsa:
    """The parts of the module alsaaudio that the source uses."""

    class ALSAAudioError(Exception):
        """The exception of pyalsaaudio."""

    PCM_CAPTURE, PCM_NONBLOCK, PCM_FORMAT_S32_LE = 1, 1, 10
    PCM = FakePcm


@pytest.fixture
def pcm(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[FakePcm]]:
    """Replace pyalsaaudio by the fake, with its own clock and without pauses between attempts."""
    monkeypatch.setattr(alsa, "load_alsaaudio", lambda: FakeAlsa)
    monkeypatch.setattr(alsa, "time", types.SimpleNamespace(monotonic=lambda: FakePcm.clock))
    monkeypatch.setattr(alsa, "RETRY_SECONDS", 0.001)
    for name, value in {
        "script": [],
        "info_changes": {},
        "refusals": [],
        "available_channels": (2,),
        "opened": [],
        "frame": 0,
        "clock": 100.0,
    }.items():
        monkeypatch.setattr(FakePcm, name, value)
    yield FakePcm
    for opened in FakePcm.opened:
        opened.close()


def open_fake(device: str = "hw:9", stopping: threading.Event | None = None) -> AlsaSource:
    source = open_source(device, RATE, CHUNK, stopping or threading.Event())
    assert isinstance(source, AlsaSource)
    return source


def left(source: AlsaSource) -> tuple[list[int], int]:
    """Return the left ear's frame numbers in the next chunk (-1 for zeros after frame 0), and the gap before it."""
    chunk = source.read()
    assert chunk is not None
    return [int(v) // 1000 if v else -1 for v in chunk.samples[0]], chunk.gap


def test_short_reads_are_joined_to_chunks(pcm: type[FakePcm]) -> None:
    pcm.frame = 1
    pcm.script[:] = [3, 0, 4, 2, 8, 3, 0, 0, 10]
    source = open_fake()
    assert [left(source) for _ in range(3)] == [
        (list(range(1, 11)), 0),
        (list(range(11, 21)), 0),
        (list(range(21, 31)), 0),
    ]
    assert source.overruns == source.lost_frames == 0


def test_ears_and_time_of_the_last_frame(pcm: type[FakePcm]) -> None:
    pcm.script[:] = [10, 15]
    source = open_fake()
    first, second = source.read(), source.read()
    assert first is not None and second is not None
    assert first.samples[1].tolist() == [1000 * k + 1 for k in range(10)]
    assert first.time == pytest.approx(100.010)
    assert second.time == pytest.approx(100.020)  # five frames of that read belong to the next chunk


def test_overrun_between_chunks_is_a_gap(pcm: type[FakePcm]) -> None:
    pcm.frame = 1
    pcm.script[:] = [10, (XRUN, 0.0), (XRUN, 0.025), 10]
    source = open_fake()
    assert left(source) == (list(range(1, 11)), 0)
    pcm.clock += 0.032
    assert left(source) == (list(range(11, 21)), 57)  # 32 and 25 ms at 1 kHz
    assert (source.overruns, source.lost_frames) == (2, 57)


def test_overrun_within_a_chunk_is_zeros_and_then_a_gap(pcm: type[FakePcm]) -> None:
    pcm.frame = 1
    pcm.script[:] = [4, XRUN, 10]
    source = open_fake()
    source._read_some()
    pcm.clock += 0.003
    assert left(source) == ([1, 2, 3, 4, -1, -1, -1, 5, 6, 7], 0)
    pcm.script[:] = [XRUN]
    pcm.clock += 0.040
    # Frames 8 to 14 follow; the loss fills the rest of their chunk, and its remainder precedes the next chunk.
    chunk, gap = left(source)
    assert (chunk, gap) == ([8, 9, 10, 11, 12, 13, 14, -1, -1, -1], 0)
    chunk, gap = left(source)
    assert (chunk, gap) == (list(range(15, 25)), 37)
    assert source.lost_frames == 43


def test_repeated_overruns_without_audio_are_a_device_error(pcm: type[FakePcm]) -> None:
    pcm.script[:] = [XRUN] * 1000
    with pytest.raises(ComponentError, match="repeated overruns") as caught:
        open_fake().read()
    assert caught.value.ex == "::bass::e_device"


def test_device_that_returns_is_reopened(pcm: type[FakePcm]) -> None:
    pcm.frame = 1
    pcm.script[:] = [10, ("Input/output error", 0.5), 10]
    source = open_fake()
    left(source)
    pcm.refusals += ["No such device", "No such device"]
    chunk, gap = left(source)
    assert (chunk, gap) == (list(range(11, 21)), 500)
    assert len(pcm.opened) == 2 and pcm.opened[0].closed


@pytest.mark.parametrize("trouble", ["Input/output error", XRUN])
def test_loss_ends_with_the_next_audio(pcm: type[FakePcm], trouble: Any) -> None:
    """A device that needs seconds to restart, such as PulseAudio."""
    pcm.frame = 1
    pcm.script[:] = [10, (trouble, 0.5), (0, 0.9), (0, 1.0), 10]
    source = open_fake()
    left(source)
    assert left(source) == (list(range(11, 21)), 2400)
    assert (source.overruns, source.lost_frames) == (1, 2400)


def test_no_frame_is_lost_before_the_first_audio(pcm: type[FakePcm]) -> None:
    pcm.frame = 1
    pcm.script[:] = [(0, 1.0), ("Input/output error", 0.5), (XRUN, 0.1), 10]
    source = open_fake()
    assert left(source) == (list(range(1, 11)), 0)
    assert (source.overruns, source.lost_frames) == (2, 0)


@pytest.mark.parametrize(("kept", "lost"), [(400, 6000), (6400, 0)])
def test_audio_that_is_dropped_in_a_standstill_is_counted(pcm: type[FakePcm], kept: int, lost: int) -> None:
    """A sound server stores a limited number of frames for a stopped process, and drops the others without a report."""
    source = open_fake()
    begin = pcm.clock
    left(source)
    pcm.clock += 6.4
    pcm.script[:] = [(kept, -kept / RATE)]  # at once
    frames = CHUNK
    frames += sum(CHUNK + left(source)[1] for _ in range(kept // CHUNK + 50))
    pcm.clock += 1.5  # a second standstill before the comparison after the first one
    pcm.script[:] = [(1500, -1.5)]
    while pcm.clock < begin + 12:
        frames += CHUNK + left(source)[1]
    assert (source.lost_frames, source.overruns) == (lost, lost > 0)
    assert frames + source._chunks.pending == pytest.approx(12 * RATE, abs=2 * CHUNK)


@pytest.mark.parametrize(("change", "lost"), [(0.2, 0), (-0.2, 0), (0.3, 300)])
def test_small_change_of_delay_in_a_standstill_is_not_a_loss(pcm: type[FakePcm], change: float, lost: int) -> None:
    """The number of frames in a sound server can change; only a large increase is a loss."""
    source = open_fake()
    left(source)
    pcm.clock += 3.0
    pcm.script[:] = [(3000 - round(change * RATE), -3.0 + change)]
    while pcm.clock < 110:
        left(source)
    assert (source.lost_frames, source.overruns) == (lost, lost > 0)


def test_plugins_get_the_result_of_poll(pcm: type[FakePcm], monkeypatch: pytest.MonkeyPatch) -> None:
    """A plugin whose descriptor is ready immediately, and that returns audio after it got the result of poll."""
    poll_results: list[list[tuple[int, int]]] = []
    monkeypatch.setattr(pcm, "polldescriptors_revents", lambda self, ready: poll_results.append(ready))
    read = pcm.read

    def read_after_poll(self: FakePcm) -> tuple[int, bytes]:
        if poll_results:
            return read(self)
        pcm.clock += 0.1
        return 0, b""

    monkeypatch.setattr(pcm, "read", read_after_poll)
    source = open_fake()
    assert source.read() is not None
    ((descriptor, events),) = poll_results[0]
    assert descriptor == pcm.opened[0]._pipe[0] and events & select.POLLIN


def test_lost_device_is_an_error_after_bounded_attempts(pcm: type[FakePcm]) -> None:
    pcm.script[:] = [10, "No such device"]
    source = open_fake()
    left(source)
    pcm.refusals += ["No such device"] * 100
    with pytest.raises(ComponentError, match="hw:9: No such device; gave up after 5 attempts") as caught:
        source.read()
    assert caught.value.ex == "::bass::e_device"
    assert len(pcm.refusals) == 95
    source.close()


def test_device_that_opens_but_never_works_is_an_error(pcm: type[FakePcm]) -> None:
    pcm.script[:] = ["Input/output error"] * 100
    with pytest.raises(ComponentError, match="gave up after 5"):
        open_fake().read()


def test_silent_device_counts_as_lost(pcm: type[FakePcm]) -> None:
    pcm.script[:] = [(0, 1.0)] * 1000
    with pytest.raises(ComponentError, match="delivers no more audio"):
        open_fake().read()


def test_stop_ends_the_wait_for_sound(pcm: type[FakePcm]) -> None:
    stopping = threading.Event()
    source = open_fake(stopping=stopping)
    pcm.script[:] = [0] * 100_000
    threading.Timer(0.05, stopping.set).start()
    assert source.read() is None


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"format_name": "S16_LE"}, "expected format S32_LE, got S16_LE, S24_3LE: use plughw:9"),
        ({"rate": 48000}, "expected 1000 Hz, got 32000, 48000 Hz"),
        ({"period_size": 16}, "expected chunks of 10 frames, got 16"),
        ({"channels": 8}, "expected 2 channels, got 8: choose two with ?channels=1,2"),
        ({"channels": 1}, "1,1 for both ears"),
    ],
)
def test_inexact_device_is_rejected_with_its_capabilities(
    pcm: type[FakePcm], changes: dict[str, Any], why: str
) -> None:
    pcm.info_changes.update(changes)
    with pytest.raises(ComponentError) as caught:
        open_fake()
    assert caught.value.ex == "::bass::e_hwparams"
    assert why in caught.value.reason and "\n" not in caught.value.reason
    assert pcm.opened[0].closed


@pytest.mark.parametrize(
    ("strerror", "exception"),
    [
        ("No such file or directory", "e_device"),
        ("Permission denied", "e_device"),
        ("Device or resource busy", "e_device"),
        ("Invalid argument", "e_hwparams"),  # libasound has not reported an error about the name
    ],
)
def test_errors_when_opening_the_device(pcm: type[FakePcm], strerror: str, exception: str) -> None:
    pcm.refusals.append(strerror)
    with pytest.raises(ComponentError) as caught:
        open_fake()
    assert caught.value.ex == f"::bass::{exception}"
    assert isinstance(caught.value, DeviceBusyError) == ("busy" in strerror)


def test_two_channels_of_many_can_be_selected(pcm: type[FakePcm]) -> None:
    pcm.available_channels = (6, 8)
    source = open_fake("hw:9?channels=4,3")
    assert pcm.opened[-1].channels == 6
    assert all(opened.closed for opened in pcm.opened[:-1])
    chunk = source.read()
    assert chunk is not None
    assert chunk.samples[:, 2].tolist() == [2003, 2002]
    pcm.available_channels = (2,)
    with pytest.raises(ComponentError, match="expected at least 4 channels, got fewer"):
        open_fake("hw:9?channels=4,3")


@pytest.mark.parametrize("options", ["channels=3", "channels=0,1", "channels=1,33", "channels=a,b", "rate=5"])
def test_invalid_options_are_rejected(pcm: type[FakePcm], options: str) -> None:
    with pytest.raises(ComponentError) as caught:
        open_fake(f"hw:9?{options}")
    assert caught.value.ex == "::bass::e_device"
    assert not pcm.opened


def test_debians_module_and_a_missing_module_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = types.ModuleType("alsaaudio")
    broken.__file__ = "/usr/lib/python3/dist-packages/alsaaudio.so"
    monkeypatch.setitem(sys.modules, "alsaaudio", broken)
    with pytest.raises(ComponentError, match=r"Debian's python3-alsaaudio 0\.8.*scripts/install"):
        open_source("hw:0", 44100, 2205, threading.Event())
    monkeypatch.setitem(sys.modules, "alsaaudio", None)  # type: ignore[misc]  # marks a module that cannot be imported
    with pytest.raises(ComponentError, match=r"need pyalsaaudio.*scripts/install"):
        open_source("hw:0", 44100, 2205, threading.Event())


def test_capture_devices_as_the_kernel_lists_them(tmp_path: Path) -> None:
    with pytest.raises(ComponentError) as caught:
        libasound.capture_devices(tmp_path)
    assert caught.value.ex == "::bass::e_nodevice"
    for card, name, pcms in ((0, "PCH", ("pcm0p", "pcm0c")), (10, "Mic", ("pcm0c",)), (2, "Loop", ("pcm1c", "pcm10c"))):
        folder = tmp_path / f"card{card}"
        folder.mkdir()
        (folder / "id").write_text(f"{name}\n")
        for pcm_name in pcms:
            (folder / pcm_name).mkdir()
            number = pcm_name[3:-1]
            (folder / pcm_name / "info").write_text(f"card: {card}\ndevice: {number}\nid: {name} Analog: x\nname: y\n")
    assert libasound.capture_devices(tmp_path) == [
        (0, 0, "PCH", "PCH Analog: x"),
        (2, 1, "Loop", "Loop Analog: x"),
        (2, 10, "Loop", "Loop Analog: x"),
        (10, 0, "Mic", "Mic Analog: x"),
    ]
    (tmp_path / "card2" / "id").unlink()  # a card that is being unplugged
    assert [card for card, *_ in libasound.capture_devices(tmp_path)] == [0, 10]


# --- the real libasound -----------------------------------------------------------------------------------------


@pytest.fixture
def real_alsa(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a configuration with plugin PCMs that need no hardware; `recorded` returns `samples.raw`."""
    paths.prefer_pypi_packages()
    try:
        importlib.import_module("alsaaudio")
    except ImportError:
        pytest.skip("pyalsaaudio is not here: scripts/install brings it")
    bindings = " ".join(f"{k} {{ slave a channel {k} }}" for k in range(4))
    (tmp_path / "asound.conf").write_text(
        f"""</usr/share/alsa/alsa.conf>
pcm.recorded {{ type file slave.pcm "null" file /dev/null infile "{tmp_path}/samples.raw" format raw }}
pcm.nothing {{ type nosuch }}
pcm.swapped {{ type route slave.pcm "recorded" ttable {{ 0.1 1 1.0 1 }} }}
pcm.microphone {{ type speex slave.pcm "null" }}
pcm.sixteen {{ type upmix slave.pcm "null" }}
pcm.floating {{ type lfloat slave {{ pcm "null" format S32_LE }} }}
pcm.four {{
    type multi
    slaves.a {{ pcm "null" channels 4 }}
    bindings {{ {bindings} }}
}}
"""
    )
    monkeypatch.setenv("ALSA_CONFIG_PATH", str(tmp_path / "asound.conf"))
    return tmp_path


def test_samples_of_the_file_plugin_are_exact(real_alsa: Path) -> None:
    samples = np.random.default_rng(1).integers(-(2**31), 2**31, (2, 2205 * 5)).astype("<i4")
    samples.T.tofile(real_alsa / "samples.raw")
    source = open_source("recorded", 44100, 2205, threading.Event())
    chunks = [source.read() for _ in range(5)]
    source.close()
    assert np.array_equal(np.concatenate([c.samples for c in chunks if c], axis=1), samples)


def test_an_edited_configuration_is_used_by_the_next_acquisition(
    real_alsa: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a bass that runs while the user edits ~/.asoundrc; /usr/share/alsa/alsa.conf includes this file."""
    monkeypatch.delenv("ALSA_CONFIG_PATH")
    monkeypatch.setenv("HOME", str(real_alsa))
    with pytest.raises(ComponentError):
        open_source("edited", 44100, 2205, threading.Event())
    for value in (1, 2):
        np.full((2205, 2), value, "<i4").tofile(real_alsa / f"{value}.raw")
        (real_alsa / ".asoundrc").write_text(
            f'pcm.edited {{ type file slave.pcm "null" file /dev/null infile "{real_alsa}/{value}.raw" format raw }}'
        )
        source = open_source("edited", 44100, 2205, threading.Event())
        chunk = source.read()
        source.close()
        assert chunk is not None and (chunk.samples == value).all()


def test_plug_and_channel_options_work(real_alsa: Path) -> None:
    samples = np.random.default_rng(2).integers(-(2**31), 2**31, (4, 1000)).astype("<i4")
    samples.T.tofile(real_alsa / "samples.raw")
    source = open_source("recorded?channels=4,2", 48000, 500, threading.Event())
    chunk = source.read()
    source.close()
    assert chunk is not None and np.array_equal(chunk.samples, samples[[3, 1], :500])
    for device in ("plug:recorded", "plug:microphone"):
        source = open_source(device, 44100, 500, threading.Event())
        assert source.read() is not None
        source.close()


@pytest.mark.parametrize(
    ("device", "exception", "why"),
    [
        ("hw:7,0", "e_device", "hw:7,0: No such file or directory (Cannot get card index for 7;"),
        ("nosuch", "e_device", "Unknown PCM nosuch"),
        ("file", "e_device", "file is not defined"),
        ("", "e_device", "expected the name of a PCM"),
        ("two\nlines", "e_device", "the name of a device"),
        ("floating", "e_hwparams", "S32_LE, got FLOAT64_BE, FLOAT64_LE, FLOAT_BE, FLOAT_LE: use plug:f"),
        ("sixteen", "e_hwparams", "sixteen: expected format S32_LE, got S16_LE: use plug:sixteen"),
        ("microphone", "e_hwparams", "got 1: choose two with ?channels=1,2, or 1,1 for both ears"),
        ("nothing", "e_device", "Cannot open shared library libasound_module_pcm_nosuch.so"),
        ("four", "e_hwparams", "expected 2 channels, got 4"),
    ],
)
def test_errors_of_the_real_libasound_are_one_line(
    real_alsa: Path, capfd: pytest.CaptureFixture[str], device: str, exception: str, why: str
) -> None:
    with pytest.raises(ComponentError) as caught:
        open_source(device, 44100, 2205, threading.Event())
    assert caught.value.ex == f"::bass::{exception}"
    assert why in caught.value.reason and "\n" not in caught.value.reason
    assert capfd.readouterr().err == ""  # no messages of libasound itself
