"""Compute auditory representations of sound files.

Reads WAV (integer or float, any rate), FLAC and whatever else libsndfile reads, two channels: left and right ear.
Writes an .npz for numpy.load beside each file, or where -o says, while it reads: neither has to fit into the memory.
The numbers are those of the node on the same samples and blocks, bit for bit; so samples are taken as 32-bit integers
(float files are scaled by 2^31-1 and rounded), and in_doNormalize is true unless told otherwise."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
import time
from functools import partial
from pathlib import Path
from typing import Any

from rosafe.commands import Failure
from rosafe.commands._parameters import add_settings, parameters_of, words
from rosafe.commands._progress import Display, bytes_text
from rosafe.commands._workers import Interrupted, Interrupts, Report, run_together
from rosafe.interface import FIXED, KINDS, ROSAFE, Parameter
from rosafe.interface.arguments import check_outputs

_BLOCK = ROSAFE.service("InputProc").parameter("nFramesPerBlock")
_MAX_JOBS = 10_000

# --- the command line -------------------------------------------------------------------------------------------


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe process IN [IN ...] [-o OUT] [--set NAME=VALUE ...] [--outputs NAME,...]\n"
        "                      [--block N] [--jobs N] [--force] [--quiet]"
    )
    parser.add_argument("inputs", nargs="*", metavar="IN", help="sound file; several are processed at once")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help="output file, replaced where there is one; or the folder for all outputs, there already or ending in / "
        "(it is made then; default: beside each input); files in it are named as the inputs, with .npz",
    )
    add_settings(parser, "see below")
    parser.add_argument(
        "--outputs",
        metavar="NAME,...",
        help=f"what to keep of {', '.join(KINDS)} (default: the first {len(FIXED)}); "
        "what none of them needs is not computed",
    )
    parser.add_argument(
        "--block",
        type=partial(_count, maximum=_BLOCK.maximum),
        default=_BLOCK.default,
        metavar="N",
        help=f"frames processed at a time, as the node's {_BLOCK.name} (default: {_BLOCK.default})",
    )
    parser.add_argument(
        "--jobs",
        type=partial(_count, maximum=_MAX_JOBS),
        default=len(os.sched_getaffinity(0)),
        metavar="N",
        help="files processed at the same time (default: as many as there are processor cores)",
    )
    parser.add_argument("--force", action="store_true", help="replace outputs that -o does not name")
    parser.add_argument("-q", "--quiet", action="store_true", help="say nothing unless something is wrong")
    parser.epilog = _epilog()


def _count(text: str, maximum: float) -> int:
    if not (text.isascii() and text.isdigit()) or not 1 <= int(text[:20]) <= maximum:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {maximum:.0f}")
    return int(text)


def _epilog() -> str:
    parts = [named for kind in KINDS.values() for named in kind.outputs.items()]
    lines = [
        "The .npz holds, as rosafe.process returns them, of the outputs:",
        *(f"  {name} ({', '.join(part.axes)}) {part.unit}".rstrip() for name, part in parts),
        "what lies along their axes:",
        *textwrap.wrap(_coordinates(), 100, initial_indent="  ", subsequent_indent="  "),
        "and KIND_frameRate in Hz of those in frames. Besides: sample_rate in Hz, block_frames, and parameters, all of",
        "them with their values as JSON.",
        "",
        "exit status: 0 all done, 1 something failed (the other files are done), 2 wrong command line, 130 interrupted",
        "",
        "examples:",
        "  rosafe process speech.wav --outputs ild,ratemap --set fb_nChannels=64 ihc_method=bernstein",
        "  rosafe process *.wav -o results/ --set fb_cfHz=500,1000,2000",
        "",
        "parameters, with their defaults:",
    ]
    for kind in KINDS.values():
        lines.append(f"  {kind.kind}")
        for parameter in kind.parameters:
            lines += _parameter_lines(parameter)
    return "\n".join(lines)


def _coordinates() -> str:
    units = {parameter.name: parameter.unit for kind in KINDS.values() for parameter in kind.parameters}
    units |= {derived.name: derived.unit for kind in KINDS.values() for derived in kind.derived}
    names = dict.fromkeys(name for kind in KINDS.values() for name in kind.coordinates)
    return ", ".join(f"{name} ({units[name]})" if units[name] else name for name in names)


def _parameter_lines(parameter: Parameter) -> list[str]:
    default: Any = parameter.default
    if isinstance(default, bool):
        default = str(default).lower()
    elif isinstance(default, tuple):
        default = "{" + ",".join(map(str, default)) + "}"
    limits = "true or false" if parameter.idl == "boolean" else parameter.range_text
    if parameter.idl.startswith("sequence"):
        limits = f"numbers, each {limits}"
    return [
        *textwrap.wrap(
            f"{parameter.name}={default}  ({limits})", 100, initial_indent=" " * 4, subsequent_indent=" " * 8
        ),
        f"        {parameter.doc}",
    ]


# --- the work ---------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> int:
    """Process all files; 0 if all went well."""
    inputs = [Path(name) for name in (*options.inputs, *options.more_inputs)]
    if not inputs:
        options.usage_error("no sound file is named")
    targets, named = _targets(inputs, options.output)
    try:
        parameters = parameters_of(options.settings)
        outputs = check_outputs(words(options.outputs))
    except ValueError as problem:
        raise Failure(str(problem)) from None
    signals = Interrupts()
    # Once, for all processes that are forked from this one.
    from rosafe.offline.files import process_file
    from rosafe.output import OutputError
    from rosafe.sound.audiofile import AudioFileError

    if len(inputs) > 1:
        import scipy.signal  # noqa: F401

    works = [
        partial(process_file, source, target, parameters, options.block, outputs, named or options.force)
        for source, target in zip(inputs, targets, strict=True)
    ]
    display = Display(sys.stderr, [_size(path) for path in inputs], options.quiet)
    begun = time.monotonic()
    failed = False

    def report(index: int, told: Report) -> None:
        nonlocal failed
        if told.failure:
            failed = True
            text = told.failure if str(inputs[index]) in told.failure else f"{inputs[index]}: {told.failure}"
            display.message(f"rosafe process: {text}")
        elif told.last and not options.quiet:
            seconds, size = told.result
            passed = time.monotonic() - begun
            display.message(
                f"{inputs[index]} -> {targets[index]}: {seconds:.1f} s of sound, {bytes_text(size)}; "
                f"{passed:.1f} s since the start"
            )
        display.update(index, 1.0 if told.last else told.part)

    made = _make_folder(options.output)
    try:
        run_together(works, options.jobs, (AudioFileError, OutputError, ValueError), report, signals)
    except Interrupted:
        display.message("rosafe process: interrupted; what was not finished is removed")
        raise
    finally:
        display.clear()
        if made and not any(made.iterdir()):
            made.rmdir()
    return 1 if failed else 0


def _make_folder(output: str | None) -> Path | None:
    """The folder for the outputs, if it is wanted and was not there; Failure where it cannot be made."""
    if output is None or not output.endswith("/") or os.path.isdir(output):
        return None
    try:
        os.mkdir(output)
    except OSError as problem:
        raise Failure(f"-o {output}: {problem.strerror}") from None
    return Path(output)


def _targets(inputs: list[Path], output: str | None) -> tuple[list[Path], bool]:
    """Where the output of each input goes, and whether the user named that file; Failure where two go to one place."""
    if output is None:
        targets = [path.with_name(path.stem + ".npz") if path.name else path for path in inputs]
    elif output.endswith("/") or os.path.isdir(output):
        targets = [Path(output, path.stem + ".npz") for path in inputs]
    elif len(inputs) == 1:
        return [Path(output)], True
    else:
        raise Failure(f"-o {output}: for several files, wanted is a folder, ending in / or there already")
    taken: dict[str, Path] = {}
    for path, target in zip(inputs, targets, strict=True):
        other = taken.setdefault(os.path.realpath(target), path)
        if other is not path:
            raise Failure(f"{other} and {path} would both go to {target}")
    return targets, False


def _size(path: Path) -> float:
    """How much a file counts in the display."""
    return float(os.path.getsize(path)) if os.path.isfile(path) else 0.0
