"""The command `scripts/demo`: options, the course of the demonstration, signals and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from rosafe.terminal import printable

DEFAULT_DEVICE = "scene:"
DEFAULT_SECONDS = 10.0
SHORTEST, LONGEST = 2.0, 600.0
PLOT_FILE = "rosafe-demo.png"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Stopped(BaseException):
    """A signal came that ends the program."""


class _Signals:
    """Turns the signals that end a program into `_Stopped` in the main thread, wherever that is.

    Attributes
    ----------
    received : int
        The first one that came, or 0.
    """

    def __init__(self) -> None:
        self.received = 0
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup wants it ignored
                signal.signal(number, self._take)

    def _take(self, number: int, frame: object) -> None:
        self.defer()
        self.received = number
        raise _Stopped

    def check(self) -> None:
        """Raise `_Stopped` where that got lost: Python drops what is raised while it destroys an object."""
        if self.received:
            raise _Stopped

    def defer(self) -> None:
        """From now on only remember signals: nothing may cut the end short."""
        for number in SIGNALS:
            if signal.getsignal(number) == self._take:
                signal.signal(number, self._remember)

    def _remember(self, number: int, frame: object) -> None:
        self.received = self.received or number


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"demo: {message}; scripts/demo -h shows what is possible\n")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = float("nan")
    if not SHORTEST <= seconds <= LONGEST:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds from {SHORTEST:g} to {LONGEST:g}")
    return seconds


def _sound(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty: name a sound file or a device, or leave it out for scene:")
    return text


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="scripts/demo",
        description="Sound goes in, seven auditory representations come out on ROS topics, and a picture of them.",
        epilog="examples:\n"
        "  scripts/demo                              the built-in scene\n"
        "  scripts/demo speech.wav --seconds 5       a sound file with two channels\n"
        "  scripts/demo plughw:1,0 --out /tmp/me     a microphone pair",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "sound",
        type=_sound,
        nargs="?",
        default=DEFAULT_DEVICE,
        metavar="WAV or ALSA device",
        help="sound file, ALSA capture device or scene: (default: %(default)s, which walks from left to right in 10 s)",
    )
    parser.add_argument(
        "--seconds", type=_seconds, default=DEFAULT_SECONDS, metavar="N", help="seconds of sound (default: 10)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("rosafe-demo"),
        metavar="DIR",
        help=f"folder for the picture, {PLOT_FILE} (default: ./rosafe-demo)",
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the demonstration.

    Returns
    -------
    int
        0 at its end, 1 where something failed, 128 + number where a signal ended it. A wrong command line raises
        SystemExit(2), and -h SystemExit(0).
    """
    signals = _Signals()
    try:
        options = _parse(arguments)
        try:
            with (
                _without_empty_folders(options.out, signals),
                tempfile.TemporaryDirectory(prefix="rosafe-demo-") as scratch,
            ):
                return _run(options, signals, scratch)
        except BrokenPipeError:  # nobody reads what is printed: `scripts/demo | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python still has to flush
            return 1
    except BaseException:
        if not signals.received:
            raise
        return 128 + signals.received  # a library may have made another error of it (numpy does while it is imported)


@contextlib.contextmanager
def _without_empty_folders(path: Path, signals: _Signals) -> Iterator[None]:
    """Take `path` and its parents away again at the end, those that were not there before and that hold nothing."""
    made = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        yield
    finally:
        signals.defer()
        for folder in made:
            if os.path.isdir(folder) and not any(folder.iterdir()):
                folder.rmdir()


def _run(options: argparse.Namespace, signals: _Signals, scratch: str) -> int:
    """The demonstration, with its failures as one line; `scratch` is a folder for log files and caches."""
    from rosafe.component.generate import GenerationError
    from rosafe.demo import scenario
    from rosafe.interface import ComponentError
    from rosafe.output import OutputError
    from rosafe.sound.audiofile import AudioFileError
    from rosafe.transport.paths import user_cache, writable

    try:
        if not writable(options.out):
            raise scenario.DemoError(f"cannot write to {options.out}: choose another folder with --out")
        cache = user_cache() / "matplotlib"
        os.environ["MPLCONFIGDIR"] = str(cache) if writable(cache) else scratch
        scenario.run(options.sound, options.seconds, options.out / PLOT_FILE, scratch, signals.check, signals.defer)
    except (scenario.DemoError, AudioFileError, ComponentError, GenerationError, OutputError) as problem:
        print(f"demo: {printable(' '.join(str(problem).split()))}", file=sys.stderr)
        return 1
    return 0
