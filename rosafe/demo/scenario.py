"""The steps of the demonstration: start, requests, recording, table, figure."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.demo import sound as sounds
from rosafe.demo.direction import DirectionFinder, nearest, true_azimuths
from rosafe.demo.progress import Progress
from rosafe.demo.recorder import PortRecorder
from rosafe.demo.session import NAMES, POLL_SECONDS, DemoError, DemoSession, acquire, requests
from rosafe.demo.sound import DemoSound
from rosafe.localization import angles
from rosafe.system.terminal import printable
from rosafe.view import report
from rosafe.view.representations import Representations

__all__ = ["DemoError", "run"]

HEALTH_SECONDS = 5.0  # the nodes publish their counters every second
SILENT_SECONDS = 2.0  # without new frames until the audio has ended
PARALLEL = 3  # the last requests, which are independent of each other
PATH_STEPS = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)  # s
PATH_LINES = 21


def run(
    argument: str, seconds: float, plot_file: Path, scratch: str, check: Callable[[], None], defer: Callable[[], None]
) -> None:
    """Run the demonstration.

    Parameters
    ----------
    argument : str
        A sound file, ``scene:`` or an ALSA device.
    seconds : float
        Duration of the recording.
    plot_file : Path
        File of the figure.
    scratch : str
        A folder for log files.
    check : callable
        Called while waiting; raises an exception to end the demonstration.
    defer : callable
        Called before the clean-up, to defer signals.

    Raises
    ------
    DemoError, AudioFileError, interface.ComponentError, generate.GenerationError
        The demonstration cannot continue; the text is one line.
    """
    sound = sounds.choose(argument)
    requested_seconds, seconds = seconds, sound.seconds_to_follow(seconds)
    if seconds == 0:
        raise DemoError(f"{sound.title} lasts {sound.length:.3f} s, which is too short")
    print(f"rosAFE, the auditory front-end, on {printable(sound.device)}", flush=True)
    if sound.note:
        print(printable(sound.note), flush=True)
    omitted = min(requested_seconds, sound.length) - seconds
    if omitted > 0:
        print(
            f"the last {omitted:.2f} s are shorter than a block of {sound.frames_per_block} frames and are omitted",
            flush=True,
        )
    finder = _finder(sound)
    session = DemoSession(scratch, check)
    try:
        print(f"private master at {session.uri}; starting bass-ros and rosAFE-ros", flush=True)
        session.start_nodes()
        session.join()
        recorder = PortRecorder(NAMES, sound.sample_rate, sound.frames_per_block)
        start = _build(session, recorder, sound)
        with finder.following(recorder) if finder else contextlib.nullcontext():
            _record(session, recorder, finder, sound, seconds, start)
        session.kill_nodes(_print_command)
        _print_ports(recorder)
        shown = recorder.representations()
        if len(shown.times) < 2:
            raise DemoError(f"{sound.device}: not enough audio for a figure")
        directions = finder.result(float(shown.times[-1])) if finder else None
        truth: dict[str, np.ndarray] = {}
        if finder and directions and sound.truth:
            truth = true_azimuths(sound.truth, directions["time"], finder.head.front_back_equal)
        if directions:
            _print_path(directions, truth)
        _draw(shown, sound, directions, truth, plot_file)
    finally:
        defer()
        session.close()
    print(f"\nfigure: {printable(plot_file)}", flush=True)
    if directions:
        print(_final_direction(directions, truth), flush=True)


def _finder(sound: DemoSound) -> DirectionFinder | None:
    try:
        return DirectionFinder(sound.sample_rate, sound.head, lambda line: print(line, flush=True))
    except ValueError as problem:
        print(f"the direction is not estimated: {problem}", flush=True)
        return None


def _print_command(command: str) -> None:
    print(f"$ {printable(command)}", flush=True)


def _build(session: DemoSession, recorder: PortRecorder, sound: DemoSound) -> tuple[int, int]:
    """Send the requests of the user guide; return the `PortRecorder.position` of the start of the recording."""
    steps = requests(sound)
    for service, arguments in steps[:-PARALLEL]:
        session.request(service, arguments, _print_command)
    session.request_parallel(steps[-PARALLEL:], _print_command)
    recorder.center_frequencies, recorder.lags = _axes()
    position = recorder.position
    if sound.has_beginning:
        print("restarting the audio from the beginning:", flush=True)
        session.request(*acquire(sound), _print_command)
        position = position[0] + 1, 0
    return position


def _record(
    session: DemoSession,
    recorder: PortRecorder,
    finder: DirectionFinder | None,
    sound: DemoSound,
    seconds: float,
    start: tuple[int, int],
) -> None:
    """Record the ports for `seconds`, or until the audio ends."""
    print(f"recording {len(recorder.ports)} ports for {seconds:.1f} s", flush=True)
    progress = Progress(recorder, finder, seconds)
    elapsed, position, moved = 0.0, start, time.monotonic()
    try:
        while elapsed < seconds and time.monotonic() < moved + SILENT_SECONDS:
            session.check_nodes()
            progress.show(elapsed)
            time.sleep(POLL_SECONDS)
            if recorder.position > position:
                position, moved = recorder.position, time.monotonic()
                elapsed = (position[1] - start[1]) / sound.sample_rate
    finally:
        progress.close()
    if elapsed < seconds:
        problem = session.capture_error()
        if problem:
            raise DemoError(f"{sound.device}: {problem}")
        print(f"{printable(sound.device)} has ended", flush=True)
    recorder.stop()
    stopped = time.monotonic()
    session.wait(lambda: recorder.health_since(stopped), HEALTH_SECONDS, "the nodes do not publish on /diagnostics")


def _axes() -> tuple[np.ndarray, np.ndarray]:
    """Return centre frequencies (Hz) and lags (s) from getParameters."""
    import rosAFE.srv
    import rospy

    parameters = rospy.ServiceProxy("/rosAFE/getParameters", rosAFE.srv.getParameters)().parameters
    return np.array(parameters.gammatone[0].fb_cfHz), np.array(parameters.crossCorrelation[0].cc_lags)


def _print_ports(recorder: PortRecorder) -> None:
    print(f"\n{report.port_table([follower.row for follower in recorder.ports.values()])}")
    bass, audio = recorder.health["bass: capture"], recorder.health["rosAFE: audio"]
    print(
        f"according to /diagnostics, bass lost {bass['lost frames']} frames ({bass['overruns']} overruns) "
        f"and rosAFE {audio['lost']} ({audio['gaps']} gaps)",
        flush=True,
    )


def _print_path(directions: Mapping[str, Any], truth: dict[str, np.ndarray]) -> None:
    times, azimuths = directions["time"], directions["azimuth"]
    if len(times) == 0:
        return
    series = {"estimate": azimuths}
    if truth:
        series["truth"] = nearest(azimuths, truth)[1]
    length = times[-1] - times[0]
    every = next((step for step in PATH_STEPS if length / step <= PATH_LINES), PATH_STEPS[-1])
    print("\ndirection of the source, estimated (E)" + (" and true (T), or both (X)" if truth else ""))
    print(report.path_table(times, series, every))
    if truth:
        errors = np.abs(angles.difference(azimuths, series["truth"]))
        errors = errors[np.isfinite(errors)]
        if len(errors):
            print(f"RMS error {np.sqrt(np.mean(errors**2)):.1f} deg, largest {errors.max():.0f} deg", flush=True)


def _final_direction(directions: Mapping[str, Any], truth: dict[str, np.ndarray]) -> str:
    """Return the last estimate and its error in one line."""
    found = np.flatnonzero(np.isfinite(directions["azimuth"]))
    if not len(found):
        return "no source was found"
    last = found[-1:]
    azimuth, confidence = directions["azimuth"][last], directions["confidence"][last]
    estimate = f"estimate {report.side(azimuth[0]).strip()} (confidence {confidence[0]:.2f})"
    at = f"at {directions['time'][last[0]]:.1f} s"
    if not truth:
        return f"{at}: {estimate}"
    names, true = nearest(azimuth, {name: values[last] for name, values in truth.items()})
    error = abs(float(angles.difference(azimuth, true)[0]))
    return f"{at}: the {names[0]} is {report.side(true[0]).strip()}, {estimate}, error {error:.0f} deg"


def _draw(
    shown: Representations,
    sound: DemoSound,
    directions: Mapping[str, Any] | None,
    truth: dict[str, np.ndarray],
    plot_file: Path,
) -> None:
    from rosafe.view import axes, figure  # matplotlib takes a second to import

    channels = len(shown.center_frequencies)
    subtitle = (
        f"{sound.device.split('/')[-1]} at {sound.sample_rate} Hz, {channels} channels, "
        f"{shown.times[-1] - shown.times[0]:.1f} s from the ports of rosAFE"
    )
    drawing = figure.draw(shown, sound.title, subtitle, directions, truth)
    axes.save(drawing, plot_file)
