"""The course of the demonstration: start, requests, recording, table, picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rosafe.demo import sound as sounds
from rosafe.demo.progress import Progress
from rosafe.demo.recorder import PortRecorder
from rosafe.demo.session import NAMES, POLL_SECONDS, DemoError, DemoSession, acquire, requests
from rosafe.demo.sound import DemoSound
from rosafe.terminal import printable
from rosafe.view import estimates, report
from rosafe.view.representations import Representations

__all__ = ["DemoError", "run"]

HEALTH_SECONDS = 5.0  # the nodes tell about themselves every second
SILENT_SECONDS = 2.0  # sound of which nothing has come for so long has ended
PARALLEL = 3  # the last requests, which do not depend on each other
PATH_STEPS = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)  # s
PATH_LINES = 21


def run(
    argument: str, seconds: float, picture: Path, scratch: str, check: Callable[[], None], defer: Callable[[], None]
) -> None:
    """Demonstrate.

    Parameters
    ----------
    argument : str
        The sound: a file, ``scene:`` or an ALSA device.
    seconds : float
        How long.
    picture : Path
        Where the picture goes.
    scratch : str
        A folder for log files.
    check : callable
        Called while waiting; raises to end it all.
    defer : callable
        Called before taking down what runs: nothing may interrupt that.

    Raises
    ------
    DemoError, AudioFileError, interface.ComponentError, generate.GenerationError
        One line says why it cannot go on.
    """
    sound = sounds.choose(argument)
    asked_seconds, seconds = seconds, sound.seconds_to_follow(seconds)
    if seconds == 0:
        raise DemoError(f"{sound.title} lasts {sound.length:.3f} s, which is too short to show anything")
    print(f"rosAFE, the auditory front-end, on {printable(sound.device)}", flush=True)
    if sound.note:
        print(printable(sound.note), flush=True)
    left_out = min(asked_seconds, sound.length) - seconds
    if left_out > 0:
        print(
            f"its last {left_out:.2f} s fill no block of {sound.frames_per_block} frames, and are left out", flush=True
        )
    session = DemoSession(scratch, check)
    try:
        print(f"master of its own at {session.uri}; starting bass-ros and rosAFE-ros", flush=True)
        session.start_nodes()
        session.join()
        recorder = PortRecorder(NAMES, sound.sample_rate, sound.frames_per_block)
        start = _build(session, recorder, sound)
        _follow(session, recorder, sound, seconds, start)
        session.kill_nodes(_say_command)
        _say_ports(recorder)
        shown = recorder.representations()
        if len(shown.times) < 2:
            raise DemoError(f"{sound.device} gave too little sound for a picture")
        _say_path(shown, sound)
        _draw(shown, sound, picture)
    finally:
        defer()
        session.close()
    print(f"\npicture: {printable(picture)}", flush=True)


def _say_command(command: str) -> None:
    print(f"$ {printable(command)}", flush=True)


def _build(session: DemoSession, recorder: PortRecorder, sound: DemoSound) -> tuple[int, int]:
    """Make the guide's requests; returns the position (`PortRecorder.position`) after which to follow."""
    steps = requests(sound)
    for service, arguments in steps[:-PARALLEL]:
        session.request(service, arguments, _say_command)
    session.requests_together(steps[-PARALLEL:], _say_command)
    recorder.center_frequencies, recorder.lags = _axes()
    position = recorder.position
    if sound.has_beginning:
        print("once more from the beginning, now that everything is listening:", flush=True)
        session.request(*acquire(sound), _say_command)
        position = position[0] + 1, 0
    return position


def _follow(
    session: DemoSession, recorder: PortRecorder, sound: DemoSound, seconds: float, start: tuple[int, int]
) -> None:
    """Follow the ports for so long, or until the sound ends."""
    print(f"following {len(recorder.ports)} ports for {seconds:.1f} s", flush=True)
    progress = Progress(recorder, seconds)
    elapsed, position, moved = 0.0, start, time.monotonic()
    try:
        while elapsed < seconds and time.monotonic() < moved + SILENT_SECONDS:
            session.check_nodes()
            if recorder.position > position:
                position, moved = recorder.position, time.monotonic()
                elapsed = (position[1] - start[1]) / sound.sample_rate
            progress.show(elapsed)
            time.sleep(POLL_SECONDS)
    finally:
        progress.close()
    if elapsed < seconds:
        problem = session.why_silent()
        if problem:
            raise DemoError(f"{sound.device}: {problem}")
        print(f"{printable(sound.device)} has come to its end", flush=True)
    recorder.stop()
    asked = time.monotonic()
    session.wait(lambda: recorder.health_since(asked), HEALTH_SECONDS, "the nodes tell nothing on /diagnostics")


def _axes() -> tuple[np.ndarray, np.ndarray]:
    """Centre frequencies (Hz) and lags (s) as getParameters tells them."""
    import rosAFE.srv
    import rospy

    parameters = rospy.ServiceProxy("/rosAFE/getParameters", rosAFE.srv.getParameters)().parameters
    return np.array(parameters.gammatone[0].fb_cfHz), np.array(parameters.crossCorrelation[0].cc_lags)


def _say_ports(recorder: PortRecorder) -> None:
    print(f"\n{report.port_table([follower.row for follower in recorder.ports.values()])}")
    bass, audio = recorder.health["bass: capture"], recorder.health["rosAFE: audio"]
    print(
        f"by their own count bass lost {bass['lost frames']} frames ({bass['overruns']} overruns) "
        f"and rosAFE {audio['lost']} ({audio['gaps']} gaps)",
        flush=True,
    )


def _say_path(shown: Representations, sound: DemoSound) -> None:
    from_ild, from_correlation = estimates.azimuth_from_ild(shown), estimates.azimuth_from_correlation(shown)
    truth = sound.true_azimuth(shown.times) if sound.true_azimuth else None
    length = shown.times[-1] - shown.times[0]
    every = next((step for step in PATH_STEPS if length / step <= PATH_LINES), PATH_STEPS[-1])
    print("\nwhere the source was, from level differences (I), from the cross-correlation's peak (C), both (X)")
    print(report.path_table(shown.times, from_ild, from_correlation, truth, every))
    agreement = estimates.agreement(from_ild, from_correlation)
    if np.isfinite(agreement):
        print(f"the two agree on the side in {100 * agreement:.0f} % of the frames", flush=True)


def _draw(shown: Representations, sound: DemoSound, picture: Path) -> None:
    from rosafe.view import axes, figure  # matplotlib takes a second to import

    channels = len(shown.center_frequencies)
    subtitle = (
        f"{sound.device.split('/')[-1]} at {sound.sample_rate} Hz, {channels} channels, "
        f"{shown.times[-1] - shown.times[0]:.1f} s as they came from rosAFE's ports"
    )
    drawing = figure.draw(shown, sound.title, subtitle, sound.true_azimuth)
    axes.save(drawing, picture)
