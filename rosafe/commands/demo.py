"""Run both nodes on a private ROS master for some seconds, and save a figure of seven representations.

It makes the requests of the user guide, records all ports, and prints the number of messages, lost frames and the
direction of the source. No running master or node is used."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import os
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.commands._component import format_error, open_graph
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, ROSAFE, ComponentError, ros_type
from rosafe.system import option_types
from rosafe.system.terminal import printable

if TYPE_CHECKING:
    import numpy as np

    from rosafe.commands._launcher import Launcher
    from rosafe.ros import Frames
    from rosafe.ros1.client.component_client import ComponentClient

PLOT_FILE = "rosafe-demo.png"
SOUND_FILES = {".wav", ".flac", ".ogg", ".oga", ".opus", ".mp3", ".aif", ".aiff", ".aifc", ".au", ".caf", ".w64"}
FIRST_SECONDS = 30.0  # until the first message of each port
SILENT_SECONDS = 2.0  # without new frames until the sound has ended
COLOUR_END = "\x1b[0m"  # of a log line of rospy
WINDOW_SECONDS = 0.5  # of integration of the direction
HOP_SECONDS, FRAME_SECONDS = 0.01, 0.02
SHOWN = {"ratemap": "ratemap", "ild": "ild", "crossCorrelation": "correlation"}  # and their names in the figure
NAMES = {kind: representation.name for kind, representation in CORE_REPRESENTATIONS.items()}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.epilog = (
        "examples:\n"
        "  rosafe demo                               the built-in scene; scripts/demo installs what is missing first\n"
        "  scripts/demo 'scene:?rt60=0.4'            the same in a room with a reverberation time of 0.4 s\n"
        "  scripts/demo speech.wav --seconds 5       a sound file with two channels\n"
        "  scripts/demo plughw:1,0 --out /tmp/me     a microphone pair"
    )
    parser.add_argument(
        "sound",
        type=_argument,
        nargs="?",
        default="scene:",
        metavar="WAV or ALSA device",
        help="sound file, ALSA capture device or scene: (default: %(default)s, a source moves left to right in 10 s)",
    )
    parser.add_argument(
        "--seconds",
        type=option_types.seconds(2.0, 600.0),
        default=10.0,
        metavar="N",
        help="seconds of audio (default: 10)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("rosafe-demo"),
        metavar="DIR",
        help=f"folder for the figure, {PLOT_FILE} (default: ./rosafe-demo)",
    )


def _argument(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a sound file or a device, got an empty text; omit it for scene:")
    return text


def run(options: argparse.Namespace) -> int:
    """Run the demonstration; return 0 on success, 1 after a failure, 128 + number after a signal."""
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.commands._launcher import Launcher, ManagedProcess, environment
    from rosafe.ros1.component import generate, startup
    from rosafe.ros1.transport.master import PrivateMaster
    from rosafe.ros1.transport.paths import writable

    received: list[int] = []
    recording: list[asyncio.Task[Any]] = []  # while it runs

    def stop(number: int, frame: object) -> None:
        for one in startup.ending_signals():
            signal.signal(one, signal.SIG_IGN)  # another one must not interrupt the clean-up
        received.append(number)
        if not recording:
            raise KeyboardInterrupt
        recording[0].get_loop().call_soon_threadsafe(recording[0].cancel)

    async def record(launcher: Launcher) -> tuple[dict[str, _Port], Any]:
        recording[:] = filter(None, [asyncio.current_task()])
        try:
            return await _record(launcher, sound)
        finally:
            recording.clear()

    for number in startup.ending_signals():
        signal.signal(number, stop)
    created = [folder for folder in (options.out, *options.out.parents) if not os.path.exists(folder)]
    try:
        if not writable(options.out):
            raise CommandError(f"cannot write to {options.out}: choose another folder with --out")
        sound = choose(options.sound, options.seconds)
        with tempfile.TemporaryDirectory(prefix="rosafe-demo-") as folder:
            for name in [name for name in os.environ if name.startswith("ROS_")]:  # of another graph
                del os.environ[name]
            os.environ.update(ROS_LOG_DIR=folder, ROS_HOME=folder)
            generate.ensure_messages()
            with PrivateMaster() as master:
                os.environ["ROS_MASTER_URI"] = master.uri
                os.environ.update(environment())
                with Launcher(os.environ) as launcher:
                    launcher.processes["roscore"] = ManagedProcess("roscore", "runs", master.uri)
                    ports, parameters = asyncio.run(record(launcher))
            _show(sound, ports, parameters, options.out / PLOT_FILE)
    except (AudioFileError, ComponentError) as problem:
        text = format_error(problem) if isinstance(problem, ComponentError) else str(problem)
        raise CommandError(" ".join(text.split())) from None
    except BaseException:  # a library may have converted that of a signal to another one
        if received:
            return 128 + received[0]
        raise
    finally:
        for folder in created:
            with contextlib.suppress(OSError):  # it has the picture
                folder.rmdir()
    return 0


@dataclass(frozen=True)
class DemoSound:
    """A source of sound: the argument of Acquire, its rate (Hz), seconds to record; `source` if it has a beginning."""

    device: str
    title: str
    sample_rate: int
    seconds: float
    source: Any = None

    @property
    def block(self) -> int:
        """Frames: the default, as in the user guide; a similar duration at rates far from 44100 Hz."""
        return 12000 if 32000 <= self.sample_rate <= 48000 else max(1, self.sample_rate // 4)


def choose(argument: str, seconds: float = math.inf) -> DemoSound:
    """Return the source for an argument: a sound file, a scene, or an ALSA device, which is not checked.

    Raises
    ------
    AudioFileError, ComponentError, CommandError
        The file or the scene cannot be used.
    """
    from rosafe.audio.devices import DEFAULT_RATE, open_source
    from rosafe.audio.files.audiofile import AudioFile

    path, device, frames = Path(argument).expanduser(), argument, None
    if not argument.startswith(("scene:", "file:")):
        if "/" not in argument.partition(":")[0] and path.suffix.lower() not in SOUND_FILES and not path.is_file():
            return DemoSound(argument, argument, DEFAULT_RATE, seconds)
        device = f"file:{path.absolute()}"
        file = AudioFile(path)
        frames = file.frames
        file.close()
    source = open_source(device, 0, 1, threading.Event())
    source.close()
    title, rate = path.name, source.sample_rate
    if argument.startswith("scene:"):
        frames = getattr(source, "frames", None)
        walk = "A source moves from left to right" + " in a room" * ("rt60=" in argument)
        title = title.removeprefix("scene:") if hasattr(source, "scene") else walk
    sound = DemoSound(device, title, rate, seconds, source)
    if frames is None or frames >= seconds * rate:
        return sound
    complete = frames // sound.block * sound.block  # a shorter rest is not processed
    if not complete:
        raise CommandError(f"{title} lasts {frames / rate:.3f} s, which is too short")
    if complete < frames:
        rest = (frames - complete) / rate
        say(f"the last {rest:.2f} s are shorter than a block of {sound.block} frames and are omitted")
    return DemoSound(device, title, rate, complete / rate, source)


def requests(sound: DemoSound) -> list[tuple[str, str, dict[str, Any]]]:
    """Return the requests of the user guide: node, service and arguments."""
    rate = sound.sample_rate
    chunk = 2205 if sound.block == 12000 else max(1, rate // 20)
    highest = 8000 if rate >= 16000 else rate * 9 // 20  # Hz
    values: dict[str, dict[str, Any]] = {
        "input": {"nFramesPerBlock": sound.block, "bufferSize_s_port": 1, "bufferSize_s_getSignal": 1},
        "gammatone": {"fb_lowFreqHz": 80, "fb_highFreqHz": highest, "fb_nERBs": 1},
        "ihc": {"ihc_method": "dau"},
    }
    for kind, prefix in (("ild", "ild"), ("ratemap", "rm"), ("crossCorrelation", "cc")):
        values[kind] = {f"{prefix}_wSizeSec": FRAME_SECONDS, f"{prefix}_hSizeSec": HOP_SECONDS}
    for kind, one in CORE_REPRESENTATIONS.items():
        above = {"upperDepName": NAMES[one.parent]} if one.parent else {}
        values[kind] = {"name": NAMES[kind], **above, **values.get(kind, {})}
    acquire = {"device": sound.device, "sampleRate": rate, "nFramesPerChunk": chunk, "nChunksOnPort": 20}
    return [
        ("rosAFE", "connect_port", {"local": "Audio", "remote": "bass/Audio"}),
        ("bass", "Acquire", acquire),
        *(("rosAFE", KINDS[kind].request, values[kind]) for kind in NAMES),
    ]


def command_line(node: str, service: str, arguments: Mapping[str, Any]) -> str:
    """Return the command for a request as typed in a shell."""
    import shlex

    import yaml

    text = yaml.safe_dump({**arguments}, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    quoted = shlex.quote(text.strip()) if set('"$`\\!') & set(text) else f'"{text.strip()}"'
    return f"rosservice call /{node}/{service} {quoted}"


def say(line: str) -> None:
    """Print a line of text at once."""
    print("\n".join(map(printable, line.split("\n"))), flush=True)


class _Port:
    """The frames of one port since the sound has begun last; lost ones are zeros."""

    def __init__(self, kind: str) -> None:
        from rosafe.ros import PortReader

        port = ROSAFE.port(KINDS[kind].port)
        self.kind, self.type = kind, ros_type(port.idl)
        self.starts = self.index = self.first = self.frames = self.lost = 0
        self.rate = 1.0
        self.arrivals: list[float] = []
        self.pieces: list[np.ndarray] = []
        self.reader = PortReader(f"/rosAFE/{port.name}" + (f"/{NAMES[kind]}" if port.multiple else ""), self._add)

    def _add(self, frames: Frames) -> None:
        import numpy as np

        if frames.restarted or not self.starts:
            self.first, self.rate, self.frames, self.lost = frames.first_frame, frames.rate, 0, -frames.lost
            self.arrivals, self.pieces = [], []
            self.starts += 1
        self.arrivals.append(time.monotonic())
        self.frames += frames.data.shape[-1]
        self.lost += frames.lost
        self.index = frames.index - 1
        if self.kind in (*SHOWN, "input"):
            data = frames.data.mean(axis=0) if self.kind == "crossCorrelation" else frames.data
            if frames.lost and self.pieces:
                data = np.concatenate((np.zeros((*data.shape[:-1], frames.lost)), data), axis=-1)
            self.pieces.append(data)

    def series(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the times (s) of the middles of all frames, and the frames."""
        import numpy as np

        data = np.concatenate(self.pieces, axis=-1)
        return (self.first + np.arange(data.shape[-1])) * HOP_SECONDS + FRAME_SECONDS / 2, data


def _check(launcher: Launcher) -> None:
    """Raise CommandError if a node has ended."""
    for process in launcher.ended:
        raise CommandError(f"{process.name}-ros has ended: {process.detail}")


async def _request(
    launcher: Launcher, client: ComponentClient, node: str, service: str, arguments: Mapping[str, Any]
) -> None:
    """Print and make a request; raise CommandError if it fails."""
    say(f"$ {command_line(node, service, arguments)}")
    try:
        declared = client.service(service)
        await client.call(declared, client.arguments(declared, {**arguments}))
    except ComponentError as problem:
        _check(launcher)
        raise CommandError(f"/{node}/{service} failed: {format_error(problem)}") from None


async def _record(launcher: Launcher, sound: DemoSound) -> tuple[dict[str, _Port], Any]:
    """Start the nodes, make the requests, and record all ports; return them and the parameters of the processors."""
    import rospy

    say(f"rosAFE, the auditory front-end, on {sound.device} at {sound.sample_rate} Hz")
    say(f"private master at {os.environ['ROS_MASTER_URI']}; starting bass-ros and rosAFE-ros")
    async with open_graph() as graph:
        bass, afe = await asyncio.gather(*(launcher.start_node(graph, name) for name in ("bass", "rosAFE")))
        _check(launcher)
        if bass is None or afe is None:
            raise CommandError("the nodes do not start")
        rospy.init_node("rosafe_demo", argv=["rosafe_demo"], disable_signals=True, log_level=rospy.FATAL)
        ports = {kind: _Port(kind) for kind in NAMES}
        for step in requests(sound):
            await _request(launcher, afe if step[0] == "rosAFE" else bass, *step)
        deadline = time.monotonic() + FIRST_SECONDS
        # An index that falls shows the restart of the sound: it has to be above that of the first block.
        least = min(2 * sound.block, round(sound.seconds * sound.sample_rate))
        while not all(port.index >= least for port in ports.values()):
            _check(launcher)
            if time.monotonic() > deadline:
                raise CommandError(f"{sound.device}: no sound arrives")
            await asyncio.sleep(0.02)
        parameters = (await afe.outputs("getParameters", {}))["parameters"]
        begin = {kind: (port.starts, port.index) for kind, port in ports.items()}
        if sound.source is not None:
            say("restarting the sound from the beginning:")
            begin = {kind: (port.starts + 1, 0) for kind, port in ports.items()}
            await _request(launcher, bass, *requests(sound)[1])
        await _follow(launcher, sound, ports, begin)
    return ports, parameters


async def _follow(
    launcher: Launcher, sound: DemoSound, ports: Mapping[str, _Port], begin: Mapping[str, tuple[int, int]]
) -> None:
    """Wait until all ports have the seconds of the sound, or it has ended; `begin` has starts and index of each."""
    from rosafe.results.view import report

    say(f"recording {len(ports)} ports for {sound.seconds:.1f} s")
    elapsed, shown, moved = 0.0, 0.0, time.monotonic()
    while elapsed < sound.seconds and time.monotonic() < moved + SILENT_SECONDS:
        _check(launcher)
        await asyncio.sleep(0.02)
        if all(port.starts >= begin[kind][0] for kind, port in ports.items()):
            now = min(port.index - begin[kind][1] for kind, port in ports.items()) / sound.sample_rate
            elapsed, moved = (now, time.monotonic()) if now > elapsed else (elapsed, moved)
        if elapsed >= shown + 1:
            shown = elapsed
            left, right = (report.level_db(ear) for ear in ports["input"].pieces[-1])
            say(f"{elapsed:5.1f} s   left {left:6.1f} dB   right {right:6.1f} dB")
    for port in ports.values():
        port.reader.close()
    if elapsed < sound.seconds:
        child = launcher.processes["bass"].child
        if child is not None and (failures := re.findall(r"\[ERROR\].*the acquisition has ended: (.*)", child.err)):
            raise CommandError(f"{sound.device}: {failures[-1].removesuffix(COLOUR_END)}")
        say(f"{sound.device} has ended")


def _show(sound: DemoSound, ports: Mapping[str, _Port], parameters: Any, plot_file: Path) -> None:
    """Print the tables, and save the figure."""
    import numpy as np

    from rosafe.localization import angles
    from rosafe.results.view import axes, figure, report  # matplotlib takes a second to import
    from rosafe.results.view.representations import Representations

    def row(port: _Port) -> report.PortRow:
        pace = np.inf if len(port.arrivals) < 2 else np.mean(np.diff(port.arrivals))
        return report.PortRow(port.reader.topic, port.type, 1 / pace, port.frames, round(port.rate), port.lost)

    say("\n" + report.port_table([row(port) for port in ports.values()]))
    shown = Representations.aligned(
        parameters["gammatone"][0]["fb_cfHz"],
        parameters["crossCorrelation"][0]["cc_lags"],
        **{name: ports[kind].series() for kind, name in SHOWN.items()},
    )
    if len(shown.times) < 2:
        raise CommandError(f"{sound.device}: not enough sound for a figure")
    found, truth, nearest = _directions(sound, ports["input"])
    subtitle = (
        f"{sound.device.split('/')[-1]} at {sound.sample_rate} Hz, {len(shown.center_frequencies)} channels, "
        f"{shown.times[-1] - shown.times[0]:.1f} s from the ports of rosAFE"
    )
    axes.save(figure.draw(shown, sound.title, subtitle, found, truth), plot_file)
    say(f"\nfigure: {plot_file}")
    if found is None or not np.isfinite(found["azimuth"]).any():
        say("no source was found")
        return
    last = int(np.flatnonzero(np.isfinite(found["azimuth"]))[-1])
    azimuth, at = float(found["azimuth"][last]), f"at {found['time'][last]:.1f} s:"
    estimate = f"estimate {report.side(azimuth).strip()} (confidence {found['confidence'][last]:.2f})"
    if nearest is None:
        say(f"{at} {estimate}")
    else:
        true = float(nearest[1][last])
        error = abs(float(angles.difference(azimuth, true)))
        say(f"{at} the {nearest[0][last]} is {report.side(true).strip()}, {estimate}, error {error:.0f} deg")


def _directions(sound: DemoSound, port: _Port) -> tuple[dict[str, Any] | None, dict[str, np.ndarray], Any]:
    """Localize the sound, and print the path of the source.

    Returns
    -------
    found : dict or None
        As of `rosafe.localize`, at the middle of each window: then a moving source was in the mean direction.
    truth : dict
        True azimuths by source.
    nearest : tuple or None
        As of `nearest_source`.
    """
    import numpy as np

    from rosafe.localization import angles
    from rosafe.localization.localize import localize
    from rosafe.localization.localizer import SPHERE
    from rosafe.results.view import report

    scene = getattr(sound.source, "scene", None)
    head = SPHERE if scene is None else scene.head
    say("\nlocalizing; at the first use of a head and sample rate, they are learned, which takes up to a minute")
    try:
        found = localize(np.concatenate(port.pieces, axis=-1), sound.sample_rate, head, WINDOW_SECONDS)
    except ValueError as problem:
        say(f"the direction is not estimated: {problem}")
        return None, {}, None
    complete = found["time"] >= WINDOW_SECONDS
    found |= {name: found[name][complete] for name in ("time", "azimuth", "confidence", "posterior")}
    times = found["time"] = found["time"] + port.first / sound.sample_rate - WINDOW_SECONDS / 2
    if not len(times):
        return None, {}, None
    series, truth, nearest = {"estimate": found["azimuth"]}, {}, None
    if (truth_of := getattr(sound.source, "truth", None)) is not None:
        truth = true_azimuths(truth_of, times, head.front_back_equal)
        nearest = nearest_source(found["azimuth"], truth)
        series["truth"] = nearest[1]
    every = next((step for step in (0.25, 0.5, 1.0, 2.0, 5.0, 10.0) if (times[-1] - times[0]) / step <= 21), 30.0)
    say("\ndirection of the source, estimated (E)" + (" and true (T), or both (X)" if truth else ""))
    say(report.path_table(times, series, every))
    if nearest is not None:
        errors = np.abs(angles.difference(found["azimuth"], nearest[1]))
        if np.isfinite(errors).any():
            say(f"RMS error {np.sqrt(np.nanmean(errors**2)):.1f} deg, largest {np.nanmax(errors):.0f} deg")
    return found, truth, nearest


def true_azimuths(truth: Callable[[float], Any], times: np.ndarray, folded: bool) -> dict[str, np.ndarray]:
    """Return the true azimuths (degrees) of each source by name, (T,); NaN while it is silent.

    `folded`: azimuths behind the head are mirrored to the front, as by the sphere.
    """
    import numpy as np

    from rosafe.localization import angles

    series: dict[str, np.ndarray] = {}
    for place, moment in enumerate(times):
        now = truth(float(moment))
        for name, azimuth in zip(now.names, now.azimuths, strict=True):
            series.setdefault(name, np.full(len(times), np.nan))[place] = azimuth
    return {name: angles.lateral(values) for name, values in series.items()} if folded else series


def nearest_source(azimuths: np.ndarray, truth: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return name and azimuth (T,) of the true source nearest to each estimate; NaN if no source sounds."""
    import numpy as np

    from rosafe.localization import angles

    names, all_truth = np.array([*truth]), np.stack([*truth.values()])
    distance = np.abs(angles.difference(all_truth, np.nan_to_num(azimuths)))
    best = np.where(np.isfinite(distance), distance, np.inf).argmin(axis=0)
    return names[best], all_truth[best, np.arange(len(azimuths))]
