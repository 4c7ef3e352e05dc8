"""Compute auditory representations of sounds: files, and whole folders of them.

Reads WAV, FLAC, Ogg, MP3 and whatever else libsndfile reads, and rosbags: two channels, left and right ear, or those
that --channels names. Writes a file of results beside each, or where -o says; rosafe.load and rosafe plot read it.
Unless --outputs says otherwise, what is in frames is kept: ild, ratemap and crossCorrelation.
The numbers are those of the node on the same samples, bit for bit; so samples are taken as 32-bit integers
(float files are scaled by 2^31-1 and rounded), and in_doNormalize is true unless told otherwise."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import os
import re
import sys
import textwrap
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_settings, parameters_of, parse_settings
from rosafe.commands._progress import Display, bytes_text
from rosafe.commands._workers import Interrupted, Interrupts, TaskReport, run_parallel
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, ROSAFE, Parameter
from rosafe.interface.arguments import check_outputs
from rosafe.terminal import printable

_BLOCK = ROSAFE.service("InputProc").parameter("nFramesPerBlock")
_MAX_JOBS = 10_000
_EXTENSIONS = (".npz", ".h5", ".mat", ".zarr", ".csv")
_NAMED = 20  # failures that are named at the end, where failed.csv has them all

# --- the command line -------------------------------------------------------------------------------------------


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe process PATH [PATH ...] [-o OUT] [--set NAME=VALUE ...] [--outputs NAME,...]\n"
        "                      [--format EXT] [--channels A,B] [--topic NAME] [--block N]\n"
        "                      [--resume | --force] [--jobs N | --dask ADDRESS|local] [-v | -q]"
    )
    parser.add_argument(
        "inputs",
        nargs="*",
        metavar="PATH",
        help="sound file, rosbag (.bag), or folder with such",
    )
    parser.add_argument(
        "-o",
        "--to",
        dest="to",
        metavar="OUT",
        help=f"file of results, ending in {', '.join(_EXTENSIONS)}, replaced where there is one; or, for several files "
        "or ending in /, the folder for all results, made where there is none (default: beside each input)",
    )
    add_settings(parser, "see below")
    parser.add_argument(
        "--outputs",
        metavar="NAME,...",
        help=f"what to keep of {', '.join(KINDS)} (default: ild,ratemap,crossCorrelation; the original's seven are "
        f"{', '.join(CORE_REPRESENTATIONS)}); what none of them needs is not computed",
    )
    parser.add_argument(
        "--format",
        choices=[extension[1:] for extension in _EXTENSIONS],
        help="of results whose names -o does not say (default: npz)",
    )
    parser.add_argument(
        "--channels",
        type=_channels,
        metavar="A,B",
        help="the channels (from 1) that are the left and the right ear; 1,1 for mono (default: 1,2 of two)",
    )
    parser.add_argument(
        "--topic", metavar="NAME", help="the port Audio in rosbags (default: /bass/Audio, or the only one)"
    )
    parser.add_argument(
        "--block",
        type=partial(_count, maximum=cast(float, _BLOCK.maximum)),
        default=_BLOCK.default,
        metavar="N",
        help=f"frames at a time, as the node's {_BLOCK.name} (default: {_BLOCK.default})",
    )
    parser.add_argument(
        "--jobs",
        type=partial(_count, maximum=_MAX_JOBS),
        default=len(os.sched_getaffinity(0)),
        metavar="N",
        help="files processed at the same time (default: as many as there are processor cores)",
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS|local",
        help="send the files to the workers of the Dask scheduler at tcp://HOST:8786; local starts --jobs workers here",
    )
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument("--resume", action="store_true", help="go on: leave results that are complete as they are")
    kept.add_argument("--force", action="store_true", help="replace results that -o does not name")
    loud = parser.add_mutually_exclusive_group()
    loud.add_argument("-v", "--verbose", action="store_true", help="a line for each file")
    loud.add_argument("-q", "--quiet", action="store_true", help="say nothing unless something is wrong")
    parser.epilog = _epilog()


def _channels(text: str) -> tuple[int, int]:
    from rosafe.sound.audiofile import channel_pair

    try:
        return channel_pair(text)
    except ValueError as problem:
        raise argparse.ArgumentTypeError(f"{text!r} is not {problem}") from None


def _count(text: str, maximum: float) -> int:
    if not (text.isascii() and text.isdigit()) or not 1 <= int(text[:20]) <= maximum:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {maximum:.0f}")
    return int(text)


def _epilog() -> str:
    parts = [named for kind in KINDS.values() for named in kind.outputs.items()]
    lines = [
        "A file of results holds, as rosafe.process returns them and rosafe.load reads them, of the outputs:",
        *(f"  {name} ({', '.join(part.axes)}) {part.unit}".rstrip() for name, part in parts),
        "what lies along their axes:",
        *textwrap.wrap(_coordinates(), 100, initial_indent="  ", subsequent_indent="  "),
        "KIND_time in s of each kind, and KIND_frameRate in Hz of those in frames. Besides: sample_rate in Hz,",
        "block_frames, parameters (all of them with their values, as JSON), source (the name of the input),",
        "rosafe_version, axes and units. A .csv holds one output of two axes.",
        "",
        "In a folder -o the results lie as the inputs do in theirs. What fails is named at the end and in failed.csv",
        "there, and does not keep the others.",
        "",
        "exit status: 0 all done, 1 something failed (the other files are done), 2 wrong command line, 130 interrupted",
        "",
        "examples:",
        "  rosafe process speech.wav --outputs ild,ratemap --set fb_nChannels=64 ihc_method=bernstein",
        "  rosafe process speech.flac -o speech.h5 --set fb_cfHz=500,1000,2000",
        "  rosafe process corpus -o results --resume",
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
    if options.dask is not None and not re.fullmatch(r"local|((tcp|tls)://)?[^/\s]+:\d{1,5}", options.dask):
        options.usage_error(f"--dask {options.dask}: wanted is a scheduler, such as tcp://HOST:8786, or local")
    folder, file = _output_path(inputs, options)
    # Once, for all processes that are forked from this one.
    from rosafe.offline.corpus import compute
    from rosafe.output import OutputError
    from rosafe.sound.audiofile import AudioFileError

    try:
        plan = _plan(inputs, folder, file, options)
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    signals = Interrupts()
    made = _make_folder(folder)
    if options.dask:
        plan = _for_dask(plan, options)
    else:
        importlib.import_module("scipy.signal")
    works = [partial(compute, *pair, plan.settings) for pair in zip(plan.sources, plan.targets, strict=True)]
    corpus = _Corpus(plan.names, plan.targets, options)
    for path, why in plan.problems:
        corpus.fail(str(path), why)
    try:
        if works:
            _runner(options, len(works))(
                works, options.jobs, (AudioFileError, OutputError, ValueError), corpus.report, signals
            )
    except BaseException as problem:
        corpus.display.clear()
        if isinstance(problem, Interrupted):
            left = "is left as .part, to be used up" if options.dask else "is removed"
            again = "; --resume goes on" if folder is not None else ""
            corpus.display.message(f"rosafe process: interrupted; what was not finished {left}{again}")
        _remove_empty(plan.targets, folder, made)
        raise
    corpus.display.clear()
    corpus.end(folder, inputs)
    _remove_empty(plan.targets, folder, made)
    return 1 if corpus.failed else 0


class _Plan(NamedTuple):
    """What is to be done."""

    names: list[Path]  # of the inputs, as they are told of
    sources: list[Path]
    targets: list[Path]
    settings: Any
    problems: list[tuple[Path, str]]  # known before


def _plan(inputs: list[Path], folder: Path | None, file: Path | None, options: argparse.Namespace) -> _Plan:
    """All that is to be done, checked as far as that can be without reading the files; ValueError."""
    from rosafe.offline.corpus import Settings, find, output_paths
    from rosafe.offline.files import OUTPUTS
    from rosafe.offline.formats import FORMATS, check_format, format_of

    parameters = parameters_of(options.settings)
    outputs = check_outputs(OUTPUTS if options.outputs is None else parse_settings(options.outputs))
    form = FORMATS[f".{options.format or 'npz'}"] if file is None else format_of(file)
    check_format(form, outputs)
    if options.dask:
        importlib.import_module("distributed")
    items, problems = find(inputs, folder)
    if file is not None:
        targets = [file]
    elif folder is not None:
        targets = output_paths(items, folder, form.extension)
    else:
        targets = output_paths([item._replace(place=item.source) for item in items], Path(), form.extension)
    settings = Settings(
        parameters,
        outputs,
        options.block,
        options.channels,
        options.topic,
        options.force or (file is not None and not options.resume),
        options.resume,
        folder is not None,
    )
    sources = [item.source for item in items]
    return _Plan(sources, sources, targets, settings, problems)


def _for_dask(plan: _Plan, options: argparse.Namespace) -> _Plan:
    """The same for workers, who have folders of their own.

    A scheduler has done again what a worker that died had finished but not told of. So what is there already is refused
    here, and a worker that finds a result which is complete takes it for its own.
    """
    names, sources, targets, problems = [], [], [], list(plan.problems)
    for name, target in zip(plan.names, plan.targets, strict=True):
        if not (plan.settings.replace or options.resume) and os.path.lexists(target):
            problems.append((name, f"{name}: {target} is there already; --resume leaves it, --force replaces it"))
            continue
        names.append(name)
        sources.append(Path(os.path.abspath(name)))
        targets.append(Path(os.path.abspath(target)))
    settings = dataclasses.replace(plan.settings, resume=not plan.settings.replace)
    return _Plan(names, sources, targets, settings, problems)


def _runner(options: argparse.Namespace, count: int) -> Any:
    if options.dask:
        from rosafe.commands._dask import run_on

        return partial(run_on, options.dask)
    if count > 1:  # the cores have a process each, and its tree needs no more of them
        from rosafe.tree.workers import VARIABLE

        cores = len(os.sched_getaffinity(0))
        os.environ.setdefault(VARIABLE, str(max(1, cores // min(options.jobs, count))))
    return run_parallel


def _output_path(inputs: list[Path], options: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """The folder for the results, or the file for the one; Failure where it can be neither."""
    out = options.to
    one = len(inputs) == 1 and not os.path.isdir(inputs[0])
    if out is None:
        for path in inputs:
            if os.path.isdir(path):
                raise CommandError(f"{path} is a folder: name one for its results with -o")
        return None, None
    if out == "":
        options.usage_error("-o wants a name")
    extension = os.path.splitext(out)[1].lower()
    if out.endswith("/") or (os.path.isdir(out) and not (one and extension == ".zarr")):
        return Path(out), None
    if one:
        if extension not in _EXTENSIONS:
            raise CommandError(f"-o {out}: results end in {', '.join(_EXTENSIONS)}; the name of a folder ends in /")
        if options.format and extension != f".{options.format}":
            options.usage_error(f"-o {out} and --format {options.format} are different formats")
        return None, Path(out)
    if extension:
        raise CommandError(f"-o {out}: for several files, wanted is a folder, ending in / or there already")
    return Path(out), None


def _make_folder(folder: Path | None) -> Path | None:
    """Make the folder for the results; the topmost one that was not there. Failure where it cannot be made."""
    if folder is None or os.path.isdir(folder):
        return None
    new = folder
    while not os.path.lexists(new.parent):
        new = new.parent
    from rosafe.offline.corpus import make_folder

    try:
        make_folder(folder)
    except OSError as problem:
        raise CommandError(f"-o {folder}: {problem.strerror}") from None
    return new


def _remove_empty(targets: Sequence[Path], folder: Path | None, made: Path | None) -> None:
    """Folders for results that are empty, all having failed; of those that were there before, none."""
    if folder is None:
        return
    below: set[Path] = set()
    for target in targets:
        path = target.parent
        while path not in below and len(path.parts) > len(folder.parts):
            below.add(path)
            path = path.parent
    for path in sorted(below, key=lambda path: len(path.parts), reverse=True):
        with contextlib.suppress(OSError):
            path.rmdir()
    while made is not None and (folder == made or made in folder.parents):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent


class _Corpus:
    """What is said of all files together, on the way and at the end."""

    def __init__(self, sources: Sequence[Path], targets: Sequence[Path], options: argparse.Namespace) -> None:
        self.display = Display(sys.stderr, [_size(path) for path in sources], options.quiet)
        self.failed: dict[str, str] = {}
        self._sources, self._targets, self._options = sources, targets, options
        self._begun = time.monotonic()
        self._done = self._skipped = self._size = self._warnings = 0
        self._seconds = 0.0

    def fail(self, name: str, why: str) -> None:
        """Note that a file has failed."""
        text = why if name in why else f"{name}: {why}"
        self.failed[name] = printable(text)

    def report(self, index: int, told: TaskReport) -> None:
        """How a file stands."""
        source, target = self._sources[index], self._targets[index]
        if told.failure:
            self.fail(str(source), told.failure.replace("--force replaces", "--resume leaves it, --force replaces"))
        elif told.last:
            self._note(source, target, told.result)
        skipped = told.last and not told.failure and told.result.skipped
        self.display.update(index, 1.0 if told.last else told.part, told.last, skipped)

    def _note(self, source: Path, target: Path, done: Any) -> None:
        if done.skipped and self._options.resume:
            self._skipped += 1
            text = f"{source} -> {target}: complete already"
        else:
            self._done += 1
            self._seconds += done.seconds
            self._size += done.size
            self._warnings += done.not_finite > 0
            text = f"{source} -> {target}: {done.seconds:.1f} s of sound, {bytes_text(done.size)}"
            if done.not_finite:
                text += f"; {done.not_finite} samples that were NaN or infinite are silence or full scale"
        if self._options.verbose or (len(self._sources) == 1 and not self._options.quiet):
            kept = "" if self._options.outputs or done.skipped else "; ild, ratemap, crossCorrelation (see --outputs)"
            self.display.message(text + kept)

    def end(self, folder: Path | None, inputs: Sequence[Path]) -> None:
        """The sum, what has failed, and where all of that is listed."""
        if len(self._sources) > 1 and not self._options.quiet:
            self.display.message(self._summary())
        order = {str(source): index for index, source in enumerate(self._sources)}
        self.failed = dict(sorted(self.failed.items(), key=lambda one: order.get(one[0], -1)))
        shown = list(self.failed.values())
        listed = False
        if folder is not None:
            from rosafe.offline.corpus import FAILED, write_failed
            from rosafe.output import OutputError

            try:
                if folder.is_dir():
                    write_failed(folder, [*self._sources, *inputs], self.failed)
                    listed = bool(self.failed)
            except (OutputError, OSError) as problem:
                why = f"{folder / FAILED}: {problem.strerror}" if isinstance(problem, OSError) else str(problem)
                shown.append(why)
                self.failed[str(folder)] = why
        many = listed and len(shown) > _NAMED
        for text in shown[: _NAMED if many else None]:
            self.display.message(f"rosafe process: {text}")
        if many:
            self.display.message(f"rosafe process: and {len(shown) - _NAMED} more, in {folder}/{FAILED}")

    def _summary(self) -> str:
        counts = [f"{self._done} done"]
        counts += [f"{self._skipped} complete already"] if self._skipped else []
        counts += [f"{len(self.failed)} failed"] if self.failed else []
        passed = time.monotonic() - self._begun
        text = f"{self._done + self._skipped + len(self.failed)} files: {', '.join(counts)}"
        if self._done:
            text += f"; {self._seconds:.1f} s of sound, {bytes_text(self._size)}, in {passed:.1f} s"
            if not self._options.outputs:
                text += "; ild, ratemap, crossCorrelation (see --outputs)"
        if self._warnings:
            text += f"; {self._warnings} with NaN or infinite samples, which are silence or full scale"
        return text


def _size(path: Path) -> float:
    """How much a file counts in the display."""
    return float(os.path.getsize(path)) if os.path.isfile(path) else 0.0
