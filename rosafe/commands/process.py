"""Compute auditory representations of sound files and of folders with sound files.

Reads all formats of libsndfile (WAV, FLAC, Ogg, MP3, ...) and rosbags. A sound has two channels, left and right ear;
--channels selects them. Writes one file of results beside each sound or to the path of -o; rosafe.load and rosafe plot
read .npz and .h5. By default the framed outputs are kept: ild, ratemap and crossCorrelation.
The results equal those of the node for the same samples, bit for bit. Therefore samples are read as 32-bit integers
(float files are scaled by 2^31-1 and rounded), and in_doNormalize is true by default.

A folder -o gets the subfolders of the input folder. Failures are printed at the end and listed in failed.csv there; the
other files are processed. A file of results contains the outputs that are listed below, as rosafe.process returns them;
the coordinates of their axes; KIND_time in s of each representation, KIND_frameRate in Hz of framed ones; furthermore
sample_rate in Hz, block_frames, parameters (all values as JSON), source (name of the input), clipped (number of
samples), rosafe_version, axes and units. A .csv file contains one output with two axes.

exit status: 0 success, 1 a file failed (the others are done), 2 wrong command line, 130 interrupted

examples:
  rosafe process speech.wav --outputs ild,ratemap --set fb_nChannels=64 ihc_method=bernstein
  rosafe process speech.flac -o speech.h5 --set fb_cfHz=500,1000,2000
  rosafe process corpus -o results --resume"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import re
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TextIO, cast

from rosafe.commands import CommandError, _parameters
from rosafe.commands._workers import Interrupted, Interrupts, TaskReport, run_parallel
from rosafe.declarations.text import bytes_text
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, ROSAFE, Parameter
from rosafe.interface.arguments import check_outputs
from rosafe.interface.remarks import no_frames, warnings_of
from rosafe.system import option_types
from rosafe.system.terminal import printable

_BLOCK = ROSAFE.service("InputProc").parameter("nFramesPerBlock")
_MAX_JOBS = 10_000
_EXTENSIONS = (".npz", ".h5", ".mat", ".csv")
_NAMED = 20  # failures that are printed at the end if failed.csv lists all of them
LIVE_SECONDS = 0.1  # minimum time between two updates of the live line
PLAIN_SECONDS = 10.0  # minimum time between two plain lines
_PLAIN = "{percentage:3.0f} %{postfix}  {remaining} left"
_LIVE = "[{bar:24}] " + _PLAIN

# --- the command line -------------------------------------------------------------------------------------------


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe process PATH [PATH ...] [-o OUT] [--set NAME=VALUE ...] [--outputs NAME,...]\n"
        "                      [--format EXT] [--channels L,R] [--topic NAME] [--block N]\n"
        "                      [--preset NAME] [--pad] [--no-clip]\n"
        "                      [--resume | --force] [--jobs N | --dask ADDRESS|local] [-v | -q]"
    )
    parser.add_argument(
        "inputs",
        nargs="*",
        metavar="PATH",
        help="sound file, rosbag (.bag), or folder with such files",
    )
    parser.add_argument(
        "-o",
        "--to",
        dest="to",
        metavar="OUT",
        help=f"file of results, ending in {', '.join(_EXTENSIONS)}, replaced if it exists; or, for several files "
        "or if it ends in /, the folder for all results, created if necessary (default: beside each input)",
    )
    _parameters.add_settings(parser, "see below")
    parser.add_argument(
        "--outputs",
        metavar="NAME,...",
        help=f"outputs to keep, of {', '.join(KINDS)} (default: ild,ratemap,crossCorrelation; the original has "
        f"{', '.join(CORE_REPRESENTATIONS)}); only what they need is computed",
    )
    parser.add_argument(
        "--format",
        choices=[extension[1:] for extension in _EXTENSIONS],
        help="format of results that -o does not name (default: npz)",
    )
    _parameters.add_channels(parser)
    parser.add_argument(
        "--topic", metavar="NAME", help="topic of the sound in rosbags (default: /bass/Audio, or the only one)"
    )
    parser.add_argument(
        "--block",
        type=option_types.whole_number(1, cast(float, _BLOCK.maximum)),
        default=_BLOCK.default,
        metavar="N",
        help=f"frames per block, as {_BLOCK.name} of the node (default: {_BLOCK.default})",
    )
    parser.add_argument(
        "--jobs",
        type=option_types.whole_number(1, _MAX_JOBS),
        default=len(os.sched_getaffinity(0)),
        metavar="N",
        help="number of files processed concurrently (default: number of processor cores)",
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS|local",
        help="send the files to the workers of the Dask scheduler at tcp://HOST:8786; local starts --jobs workers here",
    )
    parser.add_argument(
        "--pad",
        action="store_true",
        help="complete the last frames with zeros: each framed output gets ceil(N / hop) frames",
    )
    _parameters.add_preset(parser)
    _parameters.add_float_handling(parser)
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument(
        "--resume", action="store_true", help="continue an interrupted run: keep results that are complete"
    )
    kept.add_argument("--force", action="store_true", help="replace results that -o does not name")
    loud = parser.add_mutually_exclusive_group()
    loud.add_argument("-v", "--verbose", action="store_true", help="print a line for each file")
    loud.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.epilog = "\n".join([parser.epilog or "", *_declared()])


def _declared() -> Iterator[str]:
    """Yield the lines about outputs, coordinates and parameters."""
    yield "\noutputs:"
    for kind in KINDS.values():
        yield from (f"  {name} ({', '.join(part.axes)}) {part.unit}".rstrip() for name, part in kind.outputs.items())
    yield "\ncoordinates of their axes:"
    yield textwrap.fill(_coordinates(), 100, initial_indent="  ", subsequent_indent="  ")
    yield "\nparameters, with their defaults:"
    for kind in KINDS.values():
        yield f"  {kind.kind}"
        for parameter in kind.parameters:
            yield from _parameter_lines(parameter)


def _coordinates() -> str:
    units = {name: unit for kind in KINDS.values() for name, unit in kind.units.items()}
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
        *textwrap.wrap(parameter.doc, 112, initial_indent=" " * 8, subsequent_indent=" " * 8),
    ]


# --- processing -------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> int:
    """Process all files and return 0, or 1 if one failed."""
    inputs = [Path(name) for name in (*options.inputs, *options.more_inputs)]
    if not inputs:
        options.usage_error("PATH: expected a sound file or folder, got none")
    if options.dask is not None and not re.fullmatch(r"local|((tcp|tls)://)?[^/\s]+:\d{1,5}", options.dask):
        options.usage_error(f"--dask: expected a scheduler, such as tcp://HOST:8786, or local, got {options.dask!r}")
    folder, file = _output_path(inputs, options)
    try:
        plan = _plan(inputs, folder, file, options)
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    signals = Interrupts()
    created = _create_folder(folder)
    if options.dask:
        plan = _for_dask(plan, options)
    corpus = _Corpus(plan.names, plan.targets, options)
    for path, reason in plan.problems:
        corpus.fail(str(path), reason)
    try:
        _compute(plan, corpus, options, signals)
    except BaseException as problem:
        corpus.display.close()
        if isinstance(problem, Interrupted):
            state = "remain as .part files" if options.dask else "were removed"
            hint = "; continue with --resume" if folder is not None else ""
            corpus.display.message(f"rosafe process: interrupted; unfinished results {state}{hint}")
        _remove_empty_folders(plan.targets, folder, created)
        raise
    corpus.display.close()
    corpus.end(folder, inputs)
    _remove_empty_folders(plan.targets, folder, created)
    return 1 if corpus.failed else 0


def _compute(plan: _Plan, corpus: _Corpus, options: argparse.Namespace, signals: Interrupts) -> None:
    """Compute all results, in several processes or on the workers of Dask."""
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.processing.corpus import compute
    from rosafe.system.output import OutputError

    if not options.dask:
        importlib.import_module("scipy.signal")  # imported once for all processes that are forked from this one
    pairs = zip(plan.sources, plan.targets, strict=True)
    works = [partial(compute, *pair, plan.options, plan.make_folders) for pair in pairs]
    if works:
        run_tasks = _runner(options, len(works))
        run_tasks(works, options.jobs, (AudioFileError, OutputError, ValueError), corpus.report, signals)


class _Plan(NamedTuple):
    """Files to process, and the settings."""

    names: list[Path]  # of the inputs, as they are printed
    sources: list[Path]
    targets: list[Path]
    options: dict[str, Any]  # of `process_file`
    make_folders: bool
    problems: list[tuple[Path, str]]  # known before any file is processed


def _plan(inputs: list[Path], folder: Path | None, file: Path | None, options: argparse.Namespace) -> _Plan:
    """Return the plan, checked as far as possible without reading the files. Raises ValueError."""
    from rosafe.processing.corpus import find, output_paths
    from rosafe.processing.files import OUTPUTS
    from rosafe.results.formats import FORMATS, check_format, format_of

    parameters = _parameters.parameters_of(options.settings, options.preset)
    outputs = check_outputs(OUTPUTS if options.outputs is None else _parameters.parse_settings(options.outputs))
    for text in warnings_of(parameters, outputs):
        print(f"rosafe process: {text}", file=sys.stderr)
    file_format = FORMATS[f".{options.format or 'npz'}"] if file is None else format_of(file)
    check_format(file_format, outputs)
    if options.dask:
        importlib.import_module("distributed")
    items, problems = find(inputs, folder)
    if file is not None:
        targets = [file]
    elif folder is not None:
        targets = output_paths(items, folder, file_format.extension)
    else:
        targets = output_paths([item._replace(place=item.source) for item in items], Path(), file_format.extension)
    of_each = {
        "parameters": parameters,
        "outputs": outputs,
        "block_frames": options.block,
        "channels": options.channels,
        "topic": options.topic,
        "replace": options.force or (file is not None and not options.resume),
        "resume": options.resume,
        "pad": options.pad,
        "clip": not options.no_clip,
    }
    sources = [item.source for item in items]
    return _Plan(sources, sources, targets, of_each, folder is not None, problems)


def _for_dask(plan: _Plan, options: argparse.Namespace) -> _Plan:
    """Return the plan for Dask workers, whose working directories differ.

    A scheduler repeats a task that a worker finished without reporting it before it died. Therefore existing results
    are refused here, and a worker accepts a complete result as its own.
    """
    names, sources, targets, problems = [], [], [], list(plan.problems)
    for name, target in zip(plan.names, plan.targets, strict=True):
        if not (plan.options["replace"] or options.resume) and os.path.lexists(target):
            problems.append((name, f"{name}: {target} already exists; --resume keeps it, --force replaces it"))
            continue
        names.append(name)
        sources.append(Path(os.path.abspath(name)))
        targets.append(Path(os.path.abspath(target)))
    of_each = {**plan.options, "resume": not plan.options["replace"]}
    return _Plan(names, sources, targets, of_each, plan.make_folders, problems)


def _runner(options: argparse.Namespace, count: int) -> Any:
    if options.dask:
        from rosafe.commands._dask import run_on

        return partial(run_on, options.dask)
    if count > 1:  # one process per core; its tree needs no further workers
        from rosafe.tree.workers import VARIABLE

        cores = len(os.sched_getaffinity(0))
        os.environ.setdefault(VARIABLE, str(max(1, cores // min(options.jobs, count))))
    return run_parallel


def _output_path(inputs: list[Path], options: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Return the folder for the results, or the file for the only result. Raises CommandError if -o names neither."""
    out = options.to
    single = len(inputs) == 1 and not os.path.isdir(inputs[0])
    if out is None:
        if folder := next(filter(os.path.isdir, inputs), None):
            raise CommandError(f"{folder} is a folder; name a folder for its results with -o")
        return None, None
    if out == "":
        options.usage_error("-o: expected a path, got an empty text")
    extension = os.path.splitext(out)[1].lower()
    if extension == ".zarr":
        from rosafe.results.formats import ZARR

        raise CommandError(f"-o: expected a name ending in {', '.join(_EXTENSIONS)}, got {out!r}; {ZARR}")
    if out.endswith("/") or os.path.isdir(out):
        return Path(out), None
    if not single:
        if extension:
            raise CommandError(f"-o: for several files, expected an existing folder or a name ending in /, got {out!r}")
        return Path(out), None
    if extension not in _EXTENSIONS:
        raise CommandError(f"-o: expected a name ending in {', '.join(_EXTENSIONS)}, or in / for a folder, got {out!r}")
    if options.format and extension != f".{options.format}":
        options.usage_error(f"-o {out} and --format {options.format} are different formats")
    return None, Path(out)


def _create_folder(folder: Path | None) -> Path | None:
    """Create the folder for the results. Return the topmost folder that is new. Raises CommandError on failure."""
    if folder is None or os.path.isdir(folder):
        return None
    new = folder
    while not os.path.lexists(new.parent):
        new = new.parent
    from rosafe.processing.corpus import make_folder

    try:
        make_folder(folder)
    except OSError as problem:
        raise CommandError(f"-o {folder}: {problem.strerror}") from None
    return new


def _remove_empty_folders(targets: Sequence[Path], folder: Path | None, created: Path | None) -> None:
    """Remove empty folders for results, except those that existed before."""
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
    while created is not None and (folder == created or created in folder.parents):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent


class _Corpus:
    """Progress and summary of all files."""

    def __init__(self, sources: Sequence[Path], targets: Sequence[Path], options: argparse.Namespace) -> None:
        self.display = ProgressDisplay(sys.stderr, [_size(path) for path in sources], options.quiet)
        self.failed: dict[str, str] = {}
        self._sources, self._targets, self._options = sources, targets, options
        self._begun = time.monotonic()
        self._done = self._skipped = self._size = self._warnings = 0
        self._seconds = 0.0

    def fail(self, name: str, reason: str) -> None:
        """Record the failure of a file."""
        text = reason if name in reason else f"{name}: {reason}"
        self.failed[name] = printable(text)

    def report(self, index: int, task: TaskReport) -> None:
        """Update the display with the progress of a file."""
        source, target = self._sources[index], self._targets[index]
        if task.failure:
            self.fail(str(source), task.failure.replace("--force replaces", "--resume keeps it, --force replaces"))
        elif task.last:
            self._add_result(source, target, task.result)
        skipped = task.last and not task.failure and task.result.skipped
        self.display.update(index, 1.0 if task.last else task.part, task.last, skipped)

    def _add_result(self, source: Path, target: Path, done: Any) -> None:
        if done.skipped and self._options.resume:
            self._skipped += 1
            text = f"{source} -> {target}: already complete"
        else:
            self._done += 1
            self._seconds += done.seconds
            self._size += done.size
            self._warnings += done.not_finite > 0 or bool(done.remark)
            if done.remark:
                self.display.message(f"rosafe process: {done.remark}")
            if done.clipped:
                self.display.message(f"rosafe process: {source}: {_parameters.clipping_warning(done.clipped)}")
            if done.empty:
                self.display.message(f"rosafe process: {source}: {no_frames(done.empty, False, '--pad')}")
            text = f"{source} -> {target}: {done.seconds:.1f} s of sound, {bytes_text(done.size)}"
            if done.not_finite:
                text += f"; {done.not_finite} samples were NaN or infinite and were replaced by silence or full scale"
        if self._options.verbose or (len(self._sources) == 1 and not self._options.quiet):
            kept = "" if self._options.outputs or done.skipped else "; ild, ratemap, crossCorrelation (see --outputs)"
            self.display.message(text + kept)

    def end(self, folder: Path | None, inputs: Sequence[Path]) -> None:
        """Print the summary and the failures, and write failed.csv."""
        if len(self._sources) > 1 and not self._options.quiet:
            self.display.message(self._summary())
        order = {str(source): index for index, source in enumerate(self._sources)}
        self.failed = dict(sorted(self.failed.items(), key=lambda one: order.get(one[0], -1)))
        shown = list(self.failed.values())
        listed = False
        if folder is not None:
            from rosafe.processing.corpus import FAILED, write_failed
            from rosafe.system.output import OutputError

            try:
                if folder.is_dir():
                    write_failed(folder, [*self._sources, *inputs], self.failed)
                    listed = bool(self.failed)
            except (OutputError, OSError) as problem:
                reason = f"{folder / FAILED}: {problem.strerror}" if isinstance(problem, OSError) else str(problem)
                shown.append(reason)
                self.failed[str(folder)] = reason
        many = listed and len(shown) > _NAMED
        for text in shown[: _NAMED if many else None]:
            self.display.message(f"rosafe process: {text}")
        if many:
            self.display.message(f"rosafe process: and {len(shown) - _NAMED} more, in {folder}/{FAILED}")

    def _summary(self) -> str:
        counts = [f"{self._done} done"]
        counts += [f"{self._skipped} already complete"] if self._skipped else []
        counts += [f"{len(self.failed)} failed"] if self.failed else []
        passed = time.monotonic() - self._begun
        text = f"{self._done + self._skipped + len(self.failed)} files: {', '.join(counts)}"
        if self._done:
            text += f"; {self._seconds:.1f} s of sound, {bytes_text(self._size)}, in {passed:.1f} s"
            if not self._options.outputs:
                text += "; ild, ratemap, crossCorrelation (see --outputs)"
        if self._warnings:
            text += f"; {self._warnings} with NaN or infinite samples, which were replaced by silence or full scale"
        return text


def _size(path: Path) -> float:
    """Return the weight of a file in the display: its size in bytes."""
    return float(os.path.getsize(path)) if os.path.isfile(path) else 0.0


# --- progress: one live line on a terminal, otherwise a plain line now and then ---------------------------------------


class ProgressDisplay:
    """Display of the progress of several files together.

    Parameters
    ----------
    stream : text file
        The output; a live line is drawn if it is a terminal.
    sizes : sequence of float
        The weight of each file.
    quiet : bool
        Show messages only.
    """

    def __init__(self, stream: TextIO, sizes: Sequence[float], quiet: bool) -> None:
        from tqdm import tqdm

        tqdm.monitor_interval = 0  # no extra thread, because the command forks
        self._stream = stream
        self._sizes = [max(size, 1.0) for size in sizes]
        self._fractions = [0.0] * len(sizes)
        self._ended = self._computed = 0
        live = stream.isatty()
        self._bar = tqdm(
            total=sum(self._sizes),
            file=stream if live else _LineWriter(stream),
            disable=quiet,
            leave=False,
            delay=0.0 if live else PLAIN_SECONDS,
            mininterval=LIVE_SECONDS if live else PLAIN_SECONDS,
            miniters=0,
            smoothing=0,
            dynamic_ncols=live,
            ascii="-#",
            bar_format=_LIVE if live else _PLAIN,
        )

    def update(self, index: int, fraction: float, last: bool = False, skipped: bool = False) -> None:
        """Set the finished `fraction` of a file; `last` marks its end, `skipped` a file that needed no work."""
        step = self._sizes[index] * (fraction - self._fractions[index])
        self._fractions[index] = fraction
        self._ended += last
        self._computed += last and not skipped
        if self._bar.disable:
            return
        if skipped:
            self._bar.initial += self._sizes[index]  # the estimate of the remaining time ignores it
        if len(self._sizes) > 1:
            text = f"{self._ended} of {len(self._sizes)} files"
            elapsed = self._bar.format_dict["elapsed"]
            if self._computed and elapsed > 0:
                text += f", {self._computed / elapsed:.3g} files/s"
            self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(step)

    def message(self, text: str) -> None:
        """Write a line that remains above the live line."""
        self._bar.clear()
        self._stream.write(printable(text) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Remove the live line."""
        self._bar.close()


class _LineWriter:
    """Text file for tqdm that writes each new state of the bar as a line of its own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        if line := text.strip():
            self._stream.write(f"{line}\n")

    def flush(self) -> None:
        self._stream.flush()
