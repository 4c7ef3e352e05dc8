"""Run both nodes on a private ROS master for some seconds, and save a figure of what their ports contain.

It does by itself what `rosafe up`, a recording of the ports, `rosafe localize` and `rosafe plot` do, and prints the
number of messages, lost frames and the direction of the source. No running master or node is used."""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.commands._component import format_error, open_graph
from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE, ComponentError, ros_type
from rosafe.system import option_types
from rosafe.system.terminal import printable
from rosafe.tree.setups import AcquireSettings, Setup, SetupProcessor, write

if TYPE_CHECKING:
    import numpy as np

    from rosafe.audio.devices import SoundSource
    from rosafe.commands._launcher import Launcher
    from rosafe.ros import Frames
    from rosafe.ros1.client.component_client import ComponentClient

PLOT_FILE = "rosafe-demo.png"
FIRST_SECONDS = 30.0  # until the first frames of all ports
SILENT_SECONDS = 2.0  # without new frames until the sound has ended
WINDOW_SECONDS = 0.5  # of integration of the direction
KEPT = ("input", "ratemap", "ild", "crossCorrelation")  # the ports whose frames are used


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


def run(options: argparse.Namespace) -> int:
    """Run the demonstration; return 0 on success, 1 after a failure, 128 + number after a signal."""
    from rosafe.commands._launcher import until_signal
    from rosafe.ros1.transport.paths import writable

    existing = next(folder for folder in (options.out, *options.out.absolute().parents) if folder.exists())
    if not writable(existing):
        raise CommandError(f"cannot write to {existing}: choose another folder with --out")
    try:
        demo = Demo(options.sound, options.seconds)
        if number := asyncio.run(until_signal(demo.record())):
            return 128 + number
    except ComponentError as problem:
        raise CommandError(" ".join(format_error(problem).split())) from None
    demo.show(options.out / PLOT_FILE)
    return 0


def _say(text: str) -> None:
    print("\n".join(map(printable, text.split("\n"))), flush=True)


class Port:
    """Counts the frames of a port since the sound has begun last; keeps those of `KEPT`, lost ones as zeros."""

    def __init__(self, kind: str) -> None:
        from rosafe.ros import PortReader

        port, name = ROSAFE.port(CORE_REPRESENTATIONS[kind].port), CORE_REPRESENTATIONS[kind].name
        self.kind, self.type = kind, ros_type(port.idl)
        self.waits, self.index, self.frames, self.lost, self.rate = False, 0, 0, 0, 1.0
        self.arrivals: list[float] = []
        self.pieces: list[tuple[int, np.ndarray]] = []  # number of the first frame, and frames
        self.reader = PortReader(f"/rosAFE/{port.name}" + (f"/{name}" if port.multiple else ""), self._add)

    def _add(self, frames: Frames) -> None:
        if frames.restarted:
            self.waits, self.frames, self.lost = False, 0, -frames.lost
            self.arrivals, self.pieces = [], []
        if self.waits:
            return
        self.arrivals.append(time.monotonic())
        self.frames += frames.data.shape[-1]
        self.lost += frames.lost
        self.index, self.rate = frames.index, frames.rate
        if self.kind in KEPT:
            correlation = self.kind == "crossCorrelation"  # of all channels it would not fit into the memory
            data = frames.data.mean(axis=0, keepdims=True) if correlation else frames.data
            self.pieces.append((frames.first_frame, data))

    def row(self) -> tuple[str, str, float, int, int, int]:
        """Return topic, type, messages per second, frames, frames per second, and lost frames."""
        seconds = self.arrivals[-1] - self.arrivals[0]
        pace = (len(self.arrivals) - 1) / seconds if seconds else float("nan")
        return self.reader.topic, self.type, pace, self.frames, round(self.rate), self.lost

    def data(self) -> tuple[int, np.ndarray]:
        """Return the number of the first frame, and all frames."""
        import numpy as np

        first, (last, end) = self.pieces[0][0], self.pieces[-1]
        data = np.zeros((*end.shape[:-1], last + end.shape[-1] - first))
        for start, piece in self.pieces:
            data[..., start - first : start - first + piece.shape[-1]] = piece
        return first, data


class Demo:
    """A recording of all ports, and what it shows.

    Parameters
    ----------
    sound : str
        A sound file, or a device of bass.
    seconds : float
        To record; less if the sound ends before.
    """

    def __init__(self, sound: str, seconds: float) -> None:
        from rosafe.audio.devices import DEFAULT_RATE, open_source

        path = os.path.abspath(os.path.expanduser(sound))
        is_file = os.path.exists(path) or (":" not in sound and ("/" in sound or "." in sound))
        self.device = f"file:{path}" if is_file and sound else sound
        self.seconds = seconds
        self.sample_rate = DEFAULT_RATE
        self.source: SoundSource | None = None
        if self.device.startswith(("file:", "scene:")):
            self.source = source = open_source(self.device, 0, 1, threading.Event())
            source.close()
            self.sample_rate = source.sample_rate
            length = (getattr(source, "frames", None) or math.inf) / self.sample_rate
            if length < 1:
                raise CommandError(f"{sound}: expected at least 1 s of sound, got {length:.3g} s")
        self.sound = AcquireSettings.of({"device": self.device, "sampleRate": self.sample_rate})
        self.ports: dict[str, Port] = {}
        self.parameters: Mapping[str, Any] = {}

    @property
    def setup(self) -> Setup:
        """The tree of the user guide; blocks last 0.1 s."""
        highest = min(8000.0, 0.45 * self.sample_rate)
        explicit: dict[str, dict[str, Any]] = {
            "input": {"nFramesPerBlock": self.sample_rate // 10},
            "gammatone": {"fb_highFreqHz": highest},
        }
        processors = (
            SetupProcessor(
                kind.name,
                kind.kind,
                CORE_REPRESENTATIONS[kind.parent].name if kind.parent else "",
                explicit.get(kind.kind, {}),
            )
            for kind in CORE_REPRESENTATIONS.values()
        )
        return Setup(self.sound, {"Audio": "bass/Audio"}, tuple(processors))

    # --- recording ---

    async def record(self) -> None:
        """Start the nodes on a master of their own, load the setup, and record all ports."""
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
                await self._run(launcher)

    async def _run(self, launcher: Launcher) -> None:
        import rospy

        from rosafe.ros1.client import whole_trees

        _say(f"rosAFE, the auditory front-end, on {self.device} at {self.sample_rate} Hz")
        _say("starting bass-ros and rosAFE-ros on a private master")
        async with open_graph() as graph:
            bass, afe = await asyncio.gather(*(launcher.start_node(graph, name) for name in ("bass", "rosAFE")))
            self._check(launcher)
            if bass is None or afe is None:
                raise CommandError(f"the nodes do not start: {'; '.join(launcher.lines())}")
            _say("loading the setup")
            try:
                await whole_trees.load(afe, write(self.setup), wait=10.0)
            except ComponentError:
                self._check(launcher)
                raise
            rospy.init_node("rosafe_demo", argv=["rosafe_demo"], disable_signals=True, log_level=rospy.FATAL)
            self.ports = {kind: Port(kind) for kind in CORE_REPRESENTATIONS}
            self.parameters = (await afe.outputs("getParameters", {}))["parameters"]
            await self._follow(launcher, bass)
            for port in self.ports.values():
                port.reader.close()

    def _check(self, launcher: Launcher) -> None:
        for process in launcher.ended:
            raise CommandError(f"{process.name}-ros has ended: {process.detail}")

    async def _follow(self, launcher: Launcher, bass: ComponentClient) -> None:
        """Wait until all ports have sound, begin it again, and wait until they have all seconds of it, or it ends."""
        # The index of the new beginning is lower: this is how readers recognize it.
        if await self._reach(launcher, self.sample_rate // 2) < self.sample_rate // 2:
            raise CommandError(f"{self.device}: no sound arrives; check it with rosafe record --device")
        for port in self.ports.values():
            port.waits, port.index = True, 0
        await bass.outputs("Acquire", self.sound.values)
        _say(f"recording {len(self.ports)} ports for {self.seconds:g} s")
        wanted = round(self.seconds * self.sample_rate)
        if (frames := await self._reach(launcher, wanted)) < wanted:
            if self.source is None or not frames:
                raise CommandError(f"{self.device}: the sound has ended; check it with rosafe record --device")
            _say(f"{self.device} has ended")

    async def _reach(self, launcher: Launcher, wanted: int) -> int:
        """Wait until all ports have so many audio frames, or no new ones arrive; return their number."""
        reached, moved = 0, time.monotonic()
        while reached < wanted and time.monotonic() < moved + (SILENT_SECONDS if reached else FIRST_SECONDS):
            await asyncio.sleep(0.02)
            self._check(launcher)
            now = min(port.index for port in self.ports.values())
            reached, moved = (now, time.monotonic()) if now > reached else (reached, moved)
        return reached

    # --- results ---

    def show(self, picture: Path) -> None:
        """Print the tables, and save the figure."""
        import numpy as np

        from rosafe.localization import angles
        from rosafe.localization.localize import localize
        from rosafe.localization.localizer import SPHERE
        from rosafe.results.view import report

        _say("\n" + report.port_table([port.row() for port in self.ports.values()]))
        first, sound = self.ports["input"].data()
        head = getattr(getattr(self.source, "scene", None), "head", SPHERE)
        _say("\nlocalizing; at the first use of a head and sample rate, they are learned, which takes up to a minute")
        try:
            found = localize(sound, self.sample_rate, head, WINDOW_SECONDS)
        except ValueError as problem:
            raise CommandError(f"the direction is not estimated: {problem}") from None
        complete = found["time"] >= WINDOW_SECONDS
        found |= {name: found[name][complete] for name in ("time", "azimuth", "confidence", "posterior")}
        # A moving source was in the mean direction at the middle of the window.
        times = found["time"] = found["time"] + first / self.sample_rate - WINDOW_SECONDS / 2
        series = {"estimate": found["azimuth"]}
        if (truth := getattr(self.source, "truth", None)) is not None:
            azimuths = [truth(float(time)).azimuths for time in times]
            series["truth"] = nearest(azimuths, found["azimuth"], head.front_back_equal)
        every = next((step for step in (0.25, 0.5, 1.0, 2.0, 5.0, 10.0) if (times[-1] - times[0]) / step <= 21), 30.0)
        _say("\ndirection of the source, estimated (E)" + (" and true (T), or both (X)" if "truth" in series else ""))
        _say(report.path_table(times, series, every))
        picture.parent.mkdir(parents=True, exist_ok=True)
        self._draw(found, series, picture)
        _say(f"\nfigure: {picture}")
        heard = np.flatnonzero(np.isfinite(found["azimuth"]))
        if not len(heard):
            return _say("no source was found")
        last = int(heard[-1])
        line = f"at {times[last]:.1f} s: estimate {report.side(found['azimuth'][last]).strip()}"
        line += f" (confidence {found['confidence'][last]:.2f})"
        if "truth" in series:
            errors = np.abs(angles.difference(found["azimuth"], series["truth"]))
            _say(f"RMS error {np.sqrt(np.nanmean(errors**2)):.1f} deg, largest {np.nanmax(errors):.0f} deg")
            line += f", the source is {report.side(series['truth'][last]).strip()}, error {errors[last]:.0f} deg"
        return _say(line)

    def _draw(self, found: Mapping[str, Any], series: Mapping[str, np.ndarray], picture: Path) -> None:
        """Draw ratemaps, level difference, cross-correlation and directions."""
        import numpy as np
        from matplotlib.figure import Figure

        from rosafe.results.view.axes import save, style
        from rosafe.results.view.directions import draw_posterior
        from rosafe.results.view.plot import plot

        result: dict[str, Any] = {
            "fb_cfHz": self.parameters["gammatone"][0]["fb_cfHz"],
            "cc_lags": self.parameters["crossCorrelation"][0]["cc_lags"],
        }
        for kind in KEPT[1:]:
            first, result[kind] = self.ports[kind].data()
            frames = first + 1 + np.arange(result[kind].shape[-1])  # windows of two hops
            result[f"{kind}_time"] = frames / self.ports[kind].rate
        with style():
            figure = Figure(figsize=(11, 11.5), layout="constrained")
            figure.suptitle(f"{self.device.rpartition('/')[2]} at {self.sample_rate} Hz, from the ports of rosAFE")
            rows = figure.subplots(5, 1, sharex=True)
            for axes, output, ear in zip(rows, ("ratemap", *KEPT[1:]), ("left", "right", None, None), strict=False):
                plot(result, output, axes, ear=ear)
                axes.set_xlabel("")
            draw_posterior(rows[4], found)
            for name, azimuths in series.items():
                rows[4].plot(found["time"], azimuths, ".", markersize=3, label=name)
            limit = 180 if any(np.nanmax(np.abs(azimuths), initial=0.0) > 90 for azimuths in series.values()) else 90
            rows[4].set(xlabel="time (s)", ylabel="azimuth (deg, left is positive)", ylim=(-limit, limit))
            rows[4].set_title(f"Direction: posterior probability, {' and '.join(series)}")
            rows[4].legend(loc="best")
        save(figure, picture)


def nearest(azimuths: Sequence[Sequence[float]], estimates: np.ndarray, folded: bool) -> np.ndarray:
    """Return the true azimuth (T,) nearest to each estimate (degrees); NaN while no source sounds.

    `folded`: azimuths behind the head are mirrored to the front, as by the sphere.
    """
    import numpy as np

    from rosafe.localization import angles

    found = np.full(len(estimates), np.nan)
    for place, true in enumerate(azimuths):
        if len(true):
            known = angles.lateral(true) if folded else np.asarray(true)
            distance = np.abs(angles.difference(known, np.nan_to_num(estimates[place])))
            found[place] = known[distance.argmin()]
    return found
