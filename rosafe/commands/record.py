"""Record sound to a WAV file or a rosbag with a level meter; without an output, show the meter only.

The sound comes from a running bass (topic bass/Audio), another --topic, or a --device: a sound card, file:PATH,
bag:PATH, topic:/NAME or scene:, named as for Acquire of bass. Only topics need ROS. OUT.wav contains the exact samples
with 32 bits; above 4 GiB it is an RF64 file, which libsndfile reads like any WAV. OUT.bag is for `rosbag play` and the
device bag:. Lost frames are replaced by silence and reported. Ctrl-C ends the recording with a complete file.

The meter shows for each ear the highest sample (peak) and the root mean square (rms) in dB below full
scale, CLIP if samples reached full scale, and the number of lost frames. On a terminal it is one live
line with bars of the rms, followed by peak/rms; otherwise a line per second.

exit status: 0 recorded, 1 failure (the sound recorded until then is kept), 2 wrong command line

examples:
  rosafe record --device plughw:1,0              # check the levels of a sound card
  rosafe record speech.wav --device plughw:1,0   # until Ctrl-C
  rosafe record speech.bag --seconds 60          # the sound of a running bass
  rosafe record speech.wav --device topic:/audio # the sound of another driver
  rosafe record --calibrate 94 --device plughw:1,0"""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rosafe.commands import CommandError
from rosafe.commands._workers import Interrupted, Interrupts
from rosafe.interface import ComponentError
from rosafe.system import option_types
from rosafe.system.output import PART, AtomicOutput, OutputError, write_whole
from rosafe.system.terminal import printable

if TYPE_CHECKING:
    from rosafe.audio.devices import SoundSource
    from rosafe.audio.files.levels import LevelMeter
    from rosafe.ros1.bass.recording import Output, SoundRecorder

_TOPIC = "bass/Audio"
_EARS = ("left", "right")
_RATE = 44100  # of a device that does not define a rate
_MIN_SECONDS, _MAX_SECONDS = 1e-6, 1e7
_STALL_SECONDS = 5.0  # without new sound on a topic, until it counts as ended
_CALIBRATION_SECONDS = 5.0
_DIFFERENCE = 1.0  # dB; above this difference between the ears, one value does not fit both

# --- the command line -------------------------------------------------------------------------------------------


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe record [OUT.wav|OUT.bag] [--device NAME | --topic NAME]\n"
        "                     [--rate HZ] [--seconds S] [--chunk N] [--force] [--quiet]\n"
        "       rosafe record --calibrate SPL [--device NAME] [--seconds S]\n"
        "       rosafe record --list"
    )
    parser.add_argument("output", nargs="?", metavar="OUT", help="file to write, ending in .wav or .bag")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--device", metavar="NAME", help="record from this device; see --list")
    source.add_argument("--topic", metavar="NAME", help=f"the same as --device topic:NAME (default: {_TOPIC})")
    parser.add_argument(
        "--calibrate",
        type=option_types.number(0, 200, "a level in dB SPL, such as 94,"),
        metavar="SPL",
        help="print pp_refSPLdB for a calibrator of SPL dB (usually 94) on one microphone; takes 5 s",
    )
    parser.add_argument("--list", action="store_true", help="list the devices and exit")
    parser.add_argument(
        "--rate",
        type=option_types.whole_number(1, 768_000),
        default=0,
        metavar="HZ",
        help="sample rate; nothing is resampled (default: that of the source; 44100 for sound cards and scene:)",
    )
    parser.add_argument(
        "--seconds",
        type=option_types.seconds(_MIN_SECONDS, _MAX_SECONDS),
        metavar="S",
        help="end after S seconds of sound (default: at Ctrl-C)",
    )
    parser.add_argument(
        "--chunk",
        type=option_types.whole_number(1, 1_000_000),
        metavar="N",
        help="frames per chunk of a --device (default: 50 ms at --rate)",
    )
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")
    parser.add_argument("-q", "--quiet", action="store_true", help="no meter; print losses and the summary only")


# --- recording ---------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> int:
    """Record and return the exit code."""
    if options.list:
        return _list()
    path = _check(options)
    signals, stopping = Interrupts(), threading.Event()
    outcome: list[int | BaseException] = []

    def work() -> None:
        try:
            outcome.append(_record(path, options, stopping))
        except BaseException as problem:  # raised again in the main thread, which alone receives signals
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
    """Print the devices as ListDevices of bass does. A machine without a sound card is not an error."""
    from rosafe.audio.devices import device_lines

    try:
        for line in device_lines():
            print(printable(line))
    except ComponentError as problem:
        print(f"rosafe record: {printable(problem.reason)}", file=sys.stderr)
    return 0


def _check(options: argparse.Namespace) -> Path | None:
    """Complete the options and return the path of the output. Raises CommandError, or exits with a usage error."""
    if "" in (options.device, options.topic):
        options.usage_error("--device and --topic: expected a name, got an empty text")
    if options.calibrate is not None:
        options.seconds = options.seconds or _CALIBRATION_SECONDS
    options.chunk = options.chunk or max(1, (options.rate or _RATE) // 20)
    if options.output is None:
        return None
    path = Path(os.path.expanduser(options.output))
    if path.suffix.lower() not in (".wav", ".bag"):
        options.usage_error(f"OUT: expected a name that ends in .wav or .bag, got {options.output}")
    if options.force:
        _check_replaced(path, options.device or "")
    return path


def _check_replaced(path: Path, device: str) -> None:
    """Raise CommandError if the output would replace the input."""
    for replaced in (path, path.with_name(path.name + PART)):
        if replaced.exists() and _is_input(replaced, device):
            raise CommandError(f"{replaced} is also the input; choose another name")


def _is_input(path: Path, device: str) -> bool:
    kind, _, rest = device.partition(":")
    names = (rest, rest.rpartition("?")[0]) if kind in ("file", "bag") else ()
    return any(os.path.exists(os.path.expanduser(n)) and os.path.samefile(os.path.expanduser(n), path) for n in names)


def _open_source(options: argparse.Namespace, stopping: threading.Event) -> SoundSource:
    try:
        device = options.device if options.device is not None else f"topic:{options.topic or _TOPIC}"
        if not device.startswith("topic:"):
            from rosafe.audio.devices import open_source
            from rosafe.ros1.transport.paths import prefer_pypi_packages

            prefer_pypi_packages()
            return open_source(device, options.rate, options.chunk, stopping)
        from rosafe.ros1.bass.topic_source import TopicSource
        from rosafe.ros1.component.generate import GenerationError
        from rosafe.ros1.component.startup import become_node
        from rosafe.ros1.transport.master import MasterError

        try:
            become_node("rosafe_record")
        except (MasterError, GenerationError) as problem:
            raise CommandError(f"{problem}; or record from a --device without ROS") from None
        return TopicSource(device.removeprefix("topic:"), options.rate, 0, stopping, _STALL_SECONDS)
    except ComponentError as problem:
        raise CommandError(problem.reason) from None


def _record(path: Path | None, options: argparse.Namespace, stopping: threading.Event) -> int:
    from rosafe.commands._meter import Meter
    from rosafe.ros1.bass.recording import SoundRecorder

    with ExitStack() as stack:
        # The file is created before the source is opened, so that a second recorder of the same file fails at once.
        part = (
            None
            if path is None
            else stack.enter_context(closing(AtomicOutput(path, options.force, keep_leftover=True)))
        )
        source = stack.enter_context(closing(_open_source(options, stopping)))
        if path is not None:
            _check_truth(path, options.force)
        meter = Meter(sys.stdout, source.sample_rate, options.quiet)
        limit = None if options.seconds is None else max(1, round(options.seconds * source.sample_rate))
        with _opened(part, options, source) as output:
            recorder = SoundRecorder(source, output, limit, meter.show, meter.message)
            try:
                ended = recorder.run(stopping)
            except ComponentError as problem:
                raise CommandError(problem.reason) from None
            finally:
                meter.message(_summary(recorder, str(path or "sound"), source.sample_rate))
        if ended:
            meter.message(f"{source.name} has ended")
    if options.calibrate is not None:
        _print_reference(options.calibrate, recorder.levels)
    return 0


def _truth_path(path: Path) -> Path | None:
    """Return the path of the truth of a recording; only WAV files can have one."""
    return path.with_suffix(".truth.csv") if path.suffix.lower() == ".wav" else None


def _check_truth(path: Path, replace: bool) -> None:
    """Raise CommandError if the truth of another recording exists, which would seem to be that of the new one."""
    truth_path = _truth_path(path)
    if truth_path is not None and os.path.lexists(truth_path) and not replace:
        raise CommandError(f"{truth_path} already exists; --force replaces it")


def _complete(part: AtomicOutput, replace: bool, source: SoundSource, frames: int) -> None:
    """Move the recording to its place; the truth of a scene is beside it, or no truth.

    The truth is written first, because the lock of the recording ends when it is moved: another recorder of the same
    file could complete its recording in between.
    """
    truth_path, truth = _truth_path(part.target), getattr(source, "truth", None)
    if truth_path is None:
        return part.complete()
    if os.path.lexists(truth_path):
        if not replace:
            raise OutputError(f"{truth_path} was created meanwhile; the recording is {part.name}")
        truth_path.unlink()
    if truth is not None:
        from rosafe.localization.scene import truth_csv

        write_whole(truth_path, truth_csv(truth, frames / source.sample_rate).encode())
    try:
        part.complete()
    except BaseException:
        truth_path.unlink(missing_ok=True)
        raise
    return None


def _print_reference(spl: float, levels: LevelMeter) -> None:
    """Print the reference level that fits the louder ear. Raises CommandError if the sound is not suitable."""
    from rosafe.audio.files.levels import SILENCE, reference

    if any(levels.clipped):
        raise CommandError("the sound was clipped; reduce the gain of the microphone and calibrate again")
    measured = [levels.rms(ear) for ear in range(2)]
    if max(measured) == SILENCE:
        raise CommandError("the sound was silent; check the calibrator and the name of the device")
    references = [reference(spl, level) for level in measured]
    print(f"pp_refSPLdB={max(references):.2f}")
    if abs(references[0] - references[1]) > _DIFFERENCE:
        ears = ", ".join(f"{ear} {value:.2f}" for ear, value in zip(_EARS, references, strict=True))
        print(f"rosafe record: the ears differ ({ears}); the printed value is for the louder one", file=sys.stderr)


@contextmanager
def _opened(part: AtomicOutput | None, options: argparse.Namespace, source: SoundSource) -> Iterator[Output | None]:
    """Provide the output, if there is one. At the end the file is completed and moved to its place if it has sound."""
    if part is None:
        yield None
        return
    try:
        output = _open_output(part, options, source)
        try:
            yield output
        finally:
            part.keep = output.frames > 0  # even if it cannot be closed
            output.close()
            part.keep = output.frames > 0
            if part.keep:
                _complete(part, options.force, source, output.frames)
    except BrokenPipeError:  # the reader of the meter has ended
        raise
    except FileExistsError:
        raise OutputError(f"{part.target} was created meanwhile; the recording is {part.name}") from None
    except OSError as problem:
        left = f"; the recording is in {part.name}" if part.keep and part.name.exists() else ""
        raise OutputError(f"{part.error(problem)}{left}") from None


def _open_output(part: AtomicOutput, options: argparse.Namespace, source: SoundSource) -> Output:
    from rosafe.ros1.bass.recording import BagWriter, WavFile

    descriptor = part.begin()
    if part.target.suffix.lower() == ".wav":
        return WavFile(descriptor, source.sample_rate)
    # A port Audio keeps its frame numbers and its name.
    chunk = getattr(source, "port_chunk", 0)
    topic, newest = (getattr(source, "topic", ""), getattr(source, "newest", 0)) if chunk else (f"/{_TOPIC}", 0)
    return BagWriter(descriptor, source.sample_rate, chunk or options.chunk, topic, newest)


def _summary(recorder: SoundRecorder, name: str, sample_rate: int) -> str:
    if not recorder.frames:
        return "nothing was recorded"
    levels = recorder.levels
    peaks = ", ".join(f"{ear} {levels.peak(index):.1f}" for index, ear in enumerate(_EARS))
    return (
        f"{name}: {recorder.frames / sample_rate:.3f} s at {sample_rate} Hz, highest peaks {peaks} dBFS, "
        f"{sum(levels.clipped)} samples clipped, {recorder.lost} frames lost"
    )
