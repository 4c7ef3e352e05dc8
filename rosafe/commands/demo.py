"""Run both nodes on a private ROS master for some seconds, and save a figure of the sound and its directions.

The nodes are started as by `rosafe up`. All ports are recorded, and the directions come from the recorded sound. The
numbers of messages and lost frames and the direction of the source are printed. No running master or node is used.

examples:
  rosafe demo                               the built-in scene; scripts/demo installs what is missing first
  scripts/demo 'scene:?rt60=0.4'            the same in a room with a reverberation time of 0.4 s
  scripts/demo speech.wav --seconds 5       a sound file with two channels
  scripts/demo plughw:1,0 --out /tmp/me     a microphone pair"""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rosafe.commands import CommandError
from rosafe.commands._component import format_error, open_graph
from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE, ComponentError, ros_type
from rosafe.system import option_types
from rosafe.system.terminal import printable
from rosafe.tree.setups import AcquireSettings, Setup, SetupProcessor, write

if TYPE_CHECKING:
    import numpy as np

    from rosafe.commands._launcher import Launcher
    from rosafe.ros import Frames
    from rosafe.ros1.client.component_client import ComponentClient

PLOT_FILE = "rosafe-demo.png"
FIRST_SECONDS = 30.0  # until the first frames of all ports
SILENT_SECONDS = 2.0  # without new frames until the sound has ended
WINDOW_SECONDS = 0.5  # of integration of the direction
PLOTTED = {"ratemap": ("left", "right"), "ild": (None,), "crossCorrelation": (None,)}  # outputs and their ears


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "sound",
        nargs="?",
        default="scene:",
        metavar="WAV or ALSA device",
        help="sound file, ALSA capture device or scene: (default: %(default)s, a source moves left to right in 10 s)",
    )
    seconds = option_types.seconds(2.0, 600.0)
    parser.add_argument("--seconds", type=seconds, default=10.0, metavar="N", help="seconds of audio (default: 10)")
    text = f"folder for the figure, {PLOT_FILE} (default: ./rosafe-demo)"
    parser.add_argument("--out", type=Path, default=Path("rosafe-demo"), metavar="DIR", help=text)


def run(options: argparse.Namespace) -> int:
    """Run the demonstration; return 0 on success, 1 after a failure, 128 + number after a signal."""
    from rosafe.ros1.client.asyncio_tools import until_signal
    from rosafe.ros1.transport.paths import writable

    existing = next(folder for folder in (options.out, *options.out.absolute().parents) if folder.exists())
    if not writable(existing):
        raise CommandError(f"cannot write to {existing}: choose another folder with --out")
    ports: dict[str, Port] = {}
    try:
        sound = DemoSound.of(options.sound)
        if number := asyncio.run(until_signal(record(sound, options.seconds, ports))):
            return 128 + number
    except ComponentError as problem:
        raise CommandError(" ".join(format_error(problem).split())) from None
    show(sound, ports, options.out / PLOT_FILE)
    return 0


def _say(text: str) -> None:
    print("\n".join(map(printable, text.split("\n"))), flush=True)


class DemoSound(NamedTuple):
    """The device of bass, its sample rate (Hz), and its source, which for a scene has the truth; None: a sound card."""

    device: str
    sample_rate: int
    source: Any = None

    @classmethod
    def of(cls, argument: str) -> DemoSound:
        """Return the sound for a file, a scene, or an ALSA device, which is not opened."""
        from rosafe.audio.devices import DEFAULT_RATE, open_source

        path = os.path.abspath(os.path.expanduser(argument))
        named = os.path.exists(path) or (":" not in argument and ("/" in argument or "." in argument))
        device = f"file:{path}" if named and argument else argument
        if not device.startswith(("file:", "scene:")):
            return cls(device, DEFAULT_RATE)
        source: Any = open_source(device, 0, 1, threading.Event())
        source.close()
        length = (getattr(source, "frames", None) or math.inf) / source.sample_rate
        if length < 1:
            raise CommandError(f"{argument}: expected at least 1 s of sound, got {length:.3g} s")
        return cls(device, source.sample_rate, source)

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of the filterbank."""
        return {"fb_highFreqHz": min(8000.0, 0.45 * self.sample_rate)}

    @property
    def acquire(self) -> AcquireSettings:
        """The arguments of Acquire."""
        return AcquireSettings.of({"device": self.device, "sampleRate": self.sample_rate})

    @property
    def setup(self) -> Setup:
        """The tree of the user guide; blocks last 0.1 s."""
        explicit = {"input": {"nFramesPerBlock": self.sample_rate // 10}, "gammatone": self.parameters}
        names = {"": "", **{kind: one.name for kind, one in CORE_REPRESENTATIONS.items()}}
        processors = [
            SetupProcessor(one.name, kind, names[one.parent], explicit.get(kind, {}))
            for kind, one in CORE_REPRESENTATIONS.items()
        ]
        return Setup(self.acquire, {"Audio": "bass/Audio"}, tuple(processors))


class Port:
    """Counts the frames of a port since the sound has begun last, up to those of `wanted` audio frames.

    Keeps those of the input, lost ones as zeros.
    """

    def __init__(self, kind: str) -> None:
        from rosafe.ros import PortReader

        port, name = ROSAFE.port(CORE_REPRESENTATIONS[kind].port), CORE_REPRESENTATIONS[kind].name
        self.kind, self.type = kind, ros_type(port.idl)
        self.waits, self.index, self.frames, self.lost, self.rate = False, 0, 0, 0, 1.0
        self.wanted = math.inf
        self.arrivals: list[float] = []
        self.sound: list[Frames] = []
        self.reader = PortReader(f"/rosAFE/{port.name}" + (f"/{name}" if port.multiple else ""), self._add)

    def _add(self, frames: Frames) -> None:
        if frames.restarted:
            self.waits, self.index, self.frames, self.lost = False, 0, 0, -frames.lost
            self.arrivals, self.sound = [], []
        if self.waits or self.index >= self.wanted:
            return
        self.arrivals.append(time.monotonic())
        self.frames += frames.data.shape[-1]
        self.lost += frames.lost
        self.index, self.rate = frames.index, frames.rate
        if self.kind == "input":
            self.sound.append(frames)

    def row(self) -> tuple[str, str, float, int, int, int]:
        """Return topic, type, messages per second, frames, frames per second, and lost frames."""
        seconds = self.arrivals[-1] - self.arrivals[0]
        pace = (len(self.arrivals) - 1) / seconds if seconds else math.nan
        return self.reader.topic, self.type, pace, self.frames, round(self.rate), self.lost


# --- recording ----------------------------------------------------------------------------------------------------


async def record(sound: DemoSound, seconds: float, ports: dict[str, Port]) -> None:
    """Start the nodes on a master of their own, load the setup, and read all `ports`."""
    from rosafe.commands._launcher import Launcher, ManagedProcess, environment
    from rosafe.ros1.component import generate
    from rosafe.ros1.transport.master import PrivateMaster

    generate.ensure_messages()
    with tempfile.TemporaryDirectory(prefix="rosafe-demo-") as folder, PrivateMaster() as master:
        for name in [name for name in os.environ if name.startswith("ROS_")]:  # of another graph
            del os.environ[name]
        os.environ.update(ROS_LOG_DIR=folder, ROS_HOME=folder, ROS_MASTER_URI=master.uri)
        os.environ.update(environment())
        with Launcher(os.environ) as launcher:
            launcher.processes["roscore"] = ManagedProcess("roscore", "runs", master.uri)
            await _run(launcher, sound, seconds, ports)


async def _run(launcher: Launcher, sound: DemoSound, seconds: float, ports: dict[str, Port]) -> None:
    import rospy

    from rosafe.ros1.client import whole_trees

    _say(f"rosAFE, the auditory front-end, on {sound.device} at {sound.sample_rate} Hz")
    _say("starting bass-ros and rosAFE-ros on a private master")
    async with open_graph() as graph:
        bass, afe = await asyncio.gather(*(launcher.start_node(graph, name) for name in ("bass", "rosAFE")))
        _check(launcher)
        if bass is None or afe is None:
            raise CommandError(f"the nodes do not start: {'; '.join(launcher.lines())}")
        _say("loading the setup")
        try:
            await whole_trees.load(afe, write(sound.setup), wait=10.0)
            rospy.init_node("rosafe_demo", argv=["rosafe_demo"], disable_signals=True, log_level=rospy.FATAL)
            ports.update((kind, Port(kind)) for kind in CORE_REPRESENTATIONS)
            await _follow(launcher, bass, sound, seconds, ports)
        except ComponentError:
            for _ in range(50):  # the connections of a node that is killed end before its process
                _check(launcher)
                await asyncio.sleep(0.02)
            raise
        for port in ports.values():
            port.reader.close()


def _check(launcher: Launcher) -> None:
    for process in launcher.ended:
        raise CommandError(f"{process.name}-ros has ended: {process.detail}")


async def _follow(
    launcher: Launcher, bass: ComponentClient, sound: DemoSound, seconds: float, ports: Mapping[str, Port]
) -> None:
    """Wait until all ports have sound, begin it again, and wait until they have all seconds of it, or it ends."""
    # The index of the new beginning is lower: this is how readers recognize it.
    if await _reach(launcher, ports, sound.sample_rate // 2) < sound.sample_rate // 2:
        raise CommandError(f"{sound.device}: no sound arrives; check it with rosafe record --device")
    wanted = round(seconds * sound.sample_rate)
    for port in ports.values():
        port.waits, port.index, port.wanted = True, 0, wanted
    await bass.outputs("Acquire", sound.acquire.values)
    _say(f"recording {len(ports)} ports for {seconds:g} s")
    if (frames := await _reach(launcher, ports, wanted)) < wanted:
        if sound.source is None or not frames:
            raise CommandError(f"{sound.device}: the sound has ended; check it with rosafe record --device")
        _say(f"{sound.device} has ended")


async def _reach(launcher: Launcher, ports: Mapping[str, Port], wanted: int) -> int:
    """Wait until all ports have `wanted` audio frames, or no new ones arrive; return the number that all have."""
    reached, moved = 0, time.monotonic()
    while reached < wanted and time.monotonic() < moved + (SILENT_SECONDS if reached else FIRST_SECONDS):
        await asyncio.sleep(0.02)
        _check(launcher)
        now = min(port.index for port in ports.values())
        reached, moved = (now, time.monotonic()) if now > reached else (reached, moved)
    return reached


# --- results ------------------------------------------------------------------------------------------------------


def show(sound: DemoSound, ports: Mapping[str, Port], picture: Path) -> None:
    """Print the tables, and save the figure."""
    import numpy as np

    from rosafe.localization import angles
    from rosafe.localization.localize import localize
    from rosafe.localization.localizer import SPHERE
    from rosafe.results.view import report

    _say("\n" + report.port_table([port.row() for port in ports.values()]))
    pieces = ports["input"].sound
    first = pieces[0].first_frame
    samples = np.zeros((2, pieces[-1].after - first))
    for piece in pieces:
        samples[:, piece.first_frame - first : piece.after - first] = piece.data
    head = getattr(getattr(sound.source, "scene", None), "head", SPHERE)
    _say("\nlocalizing; at the first use of a head and sample rate, they are learned, which takes up to a minute")
    try:
        found = localize(samples, sound.sample_rate, head, WINDOW_SECONDS)
    except ValueError as problem:
        raise CommandError(f"the direction is not estimated: {problem}") from None
    complete = found["time"] >= WINDOW_SECONDS
    found |= {name: found[name][complete] for name in ("time", "azimuth", "confidence", "posterior")}
    found["time"] -= WINDOW_SECONDS / 2  # then, a moving source was in the mean direction
    series = {"estimate": found["azimuth"]}
    if (truth := getattr(sound.source, "truth", None)) is not None:
        true = [truth(float(time)).azimuths for time in found["time"] + first / sound.sample_rate]
        series["truth"] = nearest([angles.lateral(one) for one in true] if head.front_back_equal else true, **series)
    span = found["time"][-1] - found["time"][0]
    every = next((step for step in (0.25, 0.5, 1.0, 2.0, 5.0, 10.0) if span / step <= 21), 30.0)
    _say("\ndirection of the source, estimated (E)" + (" and true (T), or both (X)" if "truth" in series else ""))
    _say(report.path_table(found["time"], series, every))
    draw(sound, samples, found, series, picture)
    _say(f"\nfigure: {picture}")
    heard = np.flatnonzero(np.isfinite(found["azimuth"]))
    if not len(heard):
        return _say("no source was found")
    line = f"at {found['time'][heard[-1]]:.1f} s: estimate {report.side(found['azimuth'][heard[-1]]).strip()}"
    line += f" (confidence {found['confidence'][heard[-1]]:.2f})"
    if "truth" in series:
        errors = np.abs(angles.difference(found["azimuth"], series["truth"]))
        _say(f"RMS error {np.sqrt(np.nanmean(errors**2)):.1f} deg, largest {np.nanmax(errors):.0f} deg")
        line += f", the source is {report.side(series['truth'][heard[-1]]).strip()}, error {errors[heard[-1]]:.0f} deg"
    return _say(line)


def nearest(azimuths: Any, estimate: np.ndarray) -> np.ndarray:
    """Return the azimuth (T,) nearest to each estimate, of lists of azimuths in degrees; NaN for an empty list."""
    import numpy as np

    from rosafe.localization.angles import difference

    found = np.full(len(estimate), np.nan)
    for place, one in enumerate(azimuths):
        if len(one):
            found[place] = one[np.abs(difference(one, np.nan_to_num(estimate[place]))).argmin()]
    return found


def draw(
    sound: DemoSound, samples: np.ndarray, found: Mapping[str, Any], series: Mapping[str, np.ndarray], picture: Path
) -> None:
    """Draw representations and directions of the recorded sound."""
    import numpy as np
    from matplotlib.figure import Figure

    from rosafe.processing.process import process
    from rosafe.results.view.axes import save, style
    from rosafe.results.view.directions import draw_posterior

    result = process(samples, sound.sample_rate, parameters=sound.parameters, outputs=list(PLOTTED))
    with style():
        figure = Figure(figsize=(11, 11.5), layout="constrained")
        figure.suptitle(f"{sound.device.rpartition('/')[2]} at {sound.sample_rate} Hz, from the port of the input")
        *rows, last = figure.subplots(5, 1, sharex=True)
        for axes, (output, ear) in zip(
            rows, ((one, ear) for one, ears in PLOTTED.items() for ear in ears), strict=True
        ):
            result.plot(output, axes, ear=ear)
            axes.set_xlabel("")
        draw_posterior(last, found)
        for name, azimuths in series.items():
            last.plot(found["time"], azimuths, ".", markersize=3, label=name)
        limit = 180 if any(np.nanmax(np.abs(azimuths), initial=0.0) > 90 for azimuths in series.values()) else 90
        last.set(xlabel="time (s)", ylabel="azimuth (deg, left is positive)", ylim=(-limit, limit))
        last.set_title(f"Direction: posterior probability, {' and '.join(series)}")
        last.legend(loc="best")
    picture.parent.mkdir(parents=True, exist_ok=True)
    save(figure, picture)
