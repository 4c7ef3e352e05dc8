"""The commands `scripts/demo` and `rosafe demo`: options, signals, clean-up and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rosafe.ros1.component.startup import Parser
from rosafe.system import option_types
from rosafe.system.terminal import printable

DEFAULT_DEVICE = "scene:"
DEFAULT_SECONDS = 10.0
MIN_SECONDS, MAX_SECONDS = 2.0, 600.0
PLOT_FILE = "rosafe-demo.png"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Stopped(BaseException):
    """A signal that ends the program was received."""


class _Signals:
    """Signal handlers that raise `_Stopped` in the main thread.

    Attributes
    ----------
    received : int
        The first signal that was received, or 0.
    """

    def __init__(self) -> None:
        self.received = 0
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # ignored under nohup
                signal.signal(number, self._stop)

    def _stop(self, number: int, frame: object) -> None:
        self.defer()
        self.received = number
        raise _Stopped

    def check(self) -> None:
        """Raise `_Stopped` again if it was lost: Python discards exceptions that are raised in a destructor."""
        if self.received:
            raise _Stopped

    def defer(self) -> None:
        """Only remember signals from now on, so that they do not interrupt the clean-up."""
        for number in SIGNALS:
            if signal.getsignal(number) == self._stop:
                signal.signal(number, self._remember)

    def _remember(self, number: int, frame: object) -> None:
        self.received = self.received or number


def _sound(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError(
            "expected a sound file or a device, got an empty text; omit the argument for scene:"
        )
    return text


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.epilog = (
        "examples:\n"
        f"  {parser.prog}                              the built-in scene\n"
        f"  {parser.prog} speech.wav --seconds 5       a sound file with two channels\n"
        f"  {parser.prog} plughw:1,0 --out /tmp/me     a microphone pair"
    )
    parser.add_argument(
        "sound",
        type=_sound,
        nargs="?",
        default=DEFAULT_DEVICE,
        metavar="WAV or ALSA device",
        help="sound file, ALSA capture device or scene: (default: %(default)s, a source moves left to right in 10 s)",
    )
    parser.add_argument(
        "--seconds",
        type=option_types.seconds(MIN_SECONDS, MAX_SECONDS),
        default=DEFAULT_SECONDS,
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


def main(arguments: list[str] | None = None) -> int:
    """Run `scripts/demo` and return its exit code, as `run`. SystemExit: 2 for a wrong command line, 0 after -h."""
    parser = Parser(
        prog="scripts/demo",
        description="Process audio into seven auditory representations on ROS topics, and save a figure of them.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    configure(parser)
    return run(parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Run the demonstration; return 0 on success, 1 after a failure, 128 + number after a signal."""
    signals = _Signals()
    try:
        try:
            with (
                _without_empty_folders(options.out, signals),
                tempfile.TemporaryDirectory(prefix="rosafe-demo-") as scratch,
            ):
                return _run(options, signals, scratch)
        except BrokenPipeError:  # the reader of the output has ended: `scripts/demo | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for output that Python has not flushed
            return 1
    except BaseException:
        if not signals.received:
            raise
        return 128 + signals.received  # a library may have converted it to another error (numpy does during its import)


@contextlib.contextmanager
def _without_empty_folders(path: Path, signals: _Signals) -> Iterator[None]:
    """Remove `path` and its parents at the end if they did not exist before and are empty."""
    created = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        yield
    finally:
        signals.defer()
        for folder in created:
            if os.path.isdir(folder) and not any(folder.iterdir()):
                folder.rmdir()


def _run(options: argparse.Namespace, signals: _Signals, scratch: str) -> int:
    """Run the demonstration and print a failure as one line; `scratch` is a folder for log files and caches."""
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.demo import scenario
    from rosafe.interface import ComponentError
    from rosafe.ros1.component.generate import GenerationError
    from rosafe.ros1.transport.paths import writable
    from rosafe.system.output import OutputError
    from rosafe.system.trust import foreign, user_cache

    try:
        if not writable(options.out):
            raise scenario.DemoError(f"cannot write to {options.out}: choose another folder with --out")
        cache = user_cache()
        kept = cache is not None and not foreign(cache) and writable(cache / "matplotlib")
        os.environ["MPLCONFIGDIR"] = str(cache / "matplotlib") if cache and kept else scratch
        scenario.run(options.sound, options.seconds, options.out / PLOT_FILE, scratch, signals.check, signals.defer)
    except (scenario.DemoError, AudioFileError, ComponentError, GenerationError, OutputError) as problem:
        print(f"demo: {printable(' '.join(str(problem).split()))}", file=sys.stderr)
        return 1
    return 0
