"""Record sound to a WAV or a bag, with a level meter; without an output, only the meter.

The sound is that of a running bass (the topic /bass/Audio), or of a --device without ROS: a sound card, file:PATH,
bag:PATH or scene:, named as for bass's Acquire. OUT.wav holds the exact samples, 32 bits wide; from 4 GiB on it is an
RF64, which libsndfile reads like any WAV. OUT.bag is for `rosbag play` and the device bag:. What was lost on the way
is silence in its place, and reported. Ctrl-C ends it, with a file that is complete."""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.commands._workers import Interrupted, Interrupts
from rosafe.interface import ComponentError
from rosafe.output import PART, AtomicOutput, OutputError
from rosafe.terminal import printable

if TYPE_CHECKING:
    from rosafe.bass.recording.levels import LevelMeter
    from rosafe.bass.recording.outputs import Output
    from rosafe.bass.recording.recorder import SoundRecorder
    from rosafe.bass.sources import SoundSource

_TOPIC = "/bass/Audio"
_EARS = ("left", "right")
_RATE = 44100  # of a device without a rate of its own
_MAX_SECONDS = 1e7
_CALIBRATION_SECONDS = 5.0
_DIFFERENCE = 1.0  # dB between the ears, from where on one value is not for both

# --- the command line -------------------------------------------------------------------------------------------


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe record [OUT.wav|OUT.bag] [--device NAME | --topic NAME | --socket HOST:PORT]\n"
        "                     [--rate HZ] [--seconds S] [--chunk N] [--force] [--quiet]\n"
        "       rosafe record --calibrate SPL [--device NAME] [--seconds S]\n"
        "       rosafe record --list"
    )
    parser.add_argument("output", nargs="?", metavar="OUT", help="file to write, ending in .wav or .bag")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--device", metavar="NAME", help="record from there without ROS; see --list")
    source.add_argument("--topic", metavar="NAME", help=f"the port Audio to listen to (default: {_TOPIC})")
    source.add_argument(
        "--socket", type=_address, metavar="HOST:PORT", help="ask a bass's DedicatedSocket; needs --rate"
    )
    parser.add_argument(
        "--calibrate",
        type=_spl,
        metavar="SPL",
        help="a calibrator of so many dB SPL is on a microphone, usually 94: say which pp_refSPLdB fits (after 5 s)",
    )
    parser.add_argument("--list", action="store_true", help="say which devices there are, and end")
    parser.add_argument(
        "--rate",
        type=_count(768_000),
        default=0,
        metavar="HZ",
        help="sample rate; nothing is resampled (default: the source's own; 44100 for sound cards and scene:)",
    )
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="end after so much sound (default: at Ctrl-C)")
    parser.add_argument(
        "--chunk",
        type=_count(1_000_000),
        metavar="N",
        help="frames that a --device gives at a time (default: 50 ms of --rate)",
    )
    parser.add_argument("--force", action="store_true", help="replace OUT where it is there already")
    parser.add_argument("-q", "--quiet", action="store_true", help="no meter; losses and the summary only")
    parser.epilog = (
        "The meter shows, for each ear, the highest sample (peak) and the root mean square (rms) in dB below full\n"
        "scale, CLIP where samples were at the end of the scale, and the frames lost so far. On a terminal that is\n"
        "one live line, with peak/rms behind bars of the rms; else a line for each second.\n\n"
        "exit status: 0 recorded, 1 something failed (what was recorded until then is kept), 2 wrong command line\n\n"
        "examples:\n"
        "  rosafe record --device plughw:1,0              # check the levels of a sound card\n"
        "  rosafe record speech.wav --device plughw:1,0   # until Ctrl-C\n"
        "  rosafe record speech.bag --seconds 60          # what a running bass captures\n"
        "  rosafe record --calibrate 94 --device plughw:1,0"
    )


def _count(maximum: int) -> Any:
    def convert(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 1 <= int(text[:20]) <= maximum):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {maximum}")
        return int(text)

    return convert


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= _MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0, up to {_MAX_SECONDS:.0f}")
    return value


def _spl(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 200:
        raise argparse.ArgumentTypeError(f"{text!r} is not a level from 0 to 200 dB SPL, such as 94")
    return value


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port[:6]) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT, such as 127.0.0.1:8081")
    return host.strip("[]"), int(port)


# --- the work ---------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> int:
    """Record; 0 if all went well."""
    if options.list:
        return _list()
    path = _check(options)
    signals, stopping = Interrupts(), threading.Event()
    outcome: list[int | BaseException] = []

    def work() -> None:
        try:
            outcome.append(_record(path, options, stopping))
        except BaseException as problem:  # for the main thread, which alone sees signals
            outcome.append(problem)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.1)
        try:
            signals.check()
        except Interrupted:
            stopping.set()
    if isinstance(outcome[0], BaseException):
        raise outcome[0]
    return outcome[0]


def _list() -> int:
    """As bass's ListDevices; a machine without a sound card is no failure here."""
    from rosafe.bass.sources import device_lines

    try:
        for line in device_lines():
            print(printable(line))
    except ComponentError as problem:
        print(f"rosafe record: {printable(problem.reason)}", file=sys.stderr)
    return 0


def _check(options: argparse.Namespace) -> Path | None:
    """Complete the options, and say where the output goes; Failure, or a usage error, where that cannot be."""
    if options.socket and not options.rate:
        options.usage_error("--socket needs --rate: the protocol does not tell the sample rate")
    if options.calibrate is not None:
        options.seconds = options.seconds or _CALIBRATION_SECONDS
    if options.chunk is None:
        options.chunk = max(1, (options.rate or _RATE) // 20)
    if "" in (options.device, options.topic):
        options.usage_error("--device and --topic want a name")
    if options.output is None:
        return None
    path = Path(os.path.expanduser(options.output))
    if path.suffix.lower() not in (".wav", ".bag"):
        options.usage_error(f"{options.output}: wanted is a name that ends in .wav or .bag")
    for replaced in (path, path.with_name(path.name + PART)):
        if options.force and replaced.exists() and _is_input(replaced, options.device or ""):
            raise CommandError(f"{replaced} is the input itself")
    return path


def _is_input(path: Path, device: str) -> bool:
    kind, _, rest = device.partition(":")
    names = (rest, rest.rpartition("?")[0]) if kind in ("file", "bag") else ()
    return any(os.path.exists(os.path.expanduser(n)) and os.path.samefile(os.path.expanduser(n), path) for n in names)


def _open_source(options: argparse.Namespace, stopping: threading.Event) -> SoundSource:
    try:
        if options.device is not None:
            from rosafe.bass.sources import open_source
            from rosafe.transport.paths import prefer_pypi_packages

            prefer_pypi_packages()
            return open_source(options.device, options.rate, options.chunk, stopping)
        if options.socket:
            from rosafe.bass.recording.socket_source import SocketSource

            host, port = options.socket
            return SocketSource(host, port, options.rate, stopping)
        from rosafe.bass.recording.topic_source import TopicSource
        from rosafe.component.generate import GenerationError
        from rosafe.component.startup import become_node
        from rosafe.transport.master import MasterError

        try:
            become_node("rosafe_record")
        except (MasterError, GenerationError) as problem:
            raise CommandError(f"{problem}; or record a --device without ROS") from None
        return TopicSource(options.topic or _TOPIC, options.rate, stopping)
    except ComponentError as problem:
        raise CommandError(problem.reason) from None


def _record(path: Path | None, options: argparse.Namespace, stopping: threading.Event) -> int:
    from rosafe.bass.recording.recorder import SoundRecorder
    from rosafe.commands._meter import Meter

    with ExitStack() as stack:
        # Its place comes first, so that of two recorders the second one is told, whatever they listen to.
        part = None if path is None else stack.enter_context(closing(AtomicOutput(path, options.force, precious=True)))
        source = stack.enter_context(closing(_open_source(options, stopping)))
        meter = Meter(sys.stdout, source.sample_rate, options.quiet)
        limit = None if options.seconds is None else max(1, round(options.seconds * source.sample_rate))
        with _opened(part, options, source) as output:
            recorder = SoundRecorder(source, output, limit, meter.show, meter.message)
            try:
                ended = recorder.run(stopping)
            except ComponentError as problem:
                raise CommandError(problem.reason) from None
            finally:
                meter.message(_summary(recorder, str(path or "heard"), source.sample_rate))
        if ended:
            meter.message(f"{source.name} has ended")
    if options.calibrate is not None:
        _tell_reference(options.calibrate, recorder.levels)
    return 0


def _tell_reference(spl: float, levels: LevelMeter) -> None:
    """Say which level of reference makes the louder ear right; Failure where what was heard cannot tell."""
    from rosafe.bass.recording.levels import SILENCE, reference

    if any(levels.clipped):
        raise CommandError("the sound was clipped: turn the microphone down, and begin anew")
    heard = [levels.rms(ear) for ear in range(2)]
    if max(heard) == SILENCE:
        raise CommandError("there was only silence: is the calibrator on, and the device the right one?")
    wanted = [reference(spl, level) for level in heard]
    print(f"pp_refSPLdB={max(wanted):.2f}")
    if abs(wanted[0] - wanted[1]) > _DIFFERENCE:
        ears = ", ".join(f"{ear} {value:.2f}" for ear, value in zip(_EARS, wanted, strict=True))
        print(f"rosafe record: the ears differ ({ears}); this is for the louder one", file=sys.stderr)


@contextmanager
def _opened(part: AtomicOutput | None, options: argparse.Namespace, source: SoundSource) -> Iterator[Output | None]:
    """The output, if one is wanted; complete and in its place at the end, whatever happens, if there is sound in it."""
    if part is None:
        yield None
        return
    try:
        output = _open_output(part, options, source)
        try:
            yield output
        finally:
            part.keep = output.frames > 0  # even where it cannot be closed
            output.close()
            part.keep = output.frames > 0
            if part.keep:
                part.complete()
    except BrokenPipeError:  # nobody reads the meter any more
        raise
    except FileExistsError:
        raise OutputError(f"{part.target} has come into being meanwhile; the recording is {part.name}") from None
    except OSError as problem:
        left = f"; what was recorded is in {part.name}" if part.keep and part.name.exists() else ""
        raise OutputError(f"{part.error(problem)}{left}") from None


def _open_output(part: AtomicOutput, options: argparse.Namespace, source: SoundSource) -> Output:
    from rosafe.bass.recording.outputs import BagWriter, WavFile

    descriptor = part.begin()
    if part.target.suffix.lower() == ".wav":
        return WavFile(descriptor, source.sample_rate)
    # A stream that others hear too keeps its numbers and its name.
    chunk, newest = getattr(source, "frames_per_chunk", options.chunk), getattr(source, "newest", 0)
    return BagWriter(descriptor, source.sample_rate, chunk, source.name if options.topic else _TOPIC, newest)


def _summary(recorder: SoundRecorder, name: str, sample_rate: int) -> str:
    if not recorder.frames:
        return "nothing was recorded"
    levels = recorder.levels
    peaks = ", ".join(f"{ear} {levels.peak(index):.1f}" for index, ear in enumerate(_EARS))
    return (
        f"{name}: {recorder.frames / sample_rate:.3f} s at {sample_rate} Hz, highest peaks {peaks} dBFS, "
        f"{sum(levels.clipped)} samples clipped, {recorder.lost} frames lost"
    )
