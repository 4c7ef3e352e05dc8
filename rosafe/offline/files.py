"""`process_file`: a sound file of any length to a file of results, in memory that does not grow with it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs, check_parameters
from rosafe.offline.chain import Chain, needed
from rosafe.offline.formats import Format, check_format, format_of, read
from rosafe.offline.process import DEFAULT_BLOCK
from rosafe.offline.result_metadata import Contents
from rosafe.offline.sounds import SoundReader, open_sound
from rosafe.output import OutputError, new_folder, new_path
from rosafe.representations import STAGES
from rosafe.sound.audiofile import AudioFileError
from rosafe.tree import sizes
from rosafe.tree.block import Block
from rosafe.version import VERSION

OUTPUTS = ("ild", "ratemap", "crossCorrelation")  # by default: those of the original that are in frames
_TOO_LARGE = (
    "one block of output would take {taken:.1f} GB, allowed are {limit:.1f} GB; "
    "take fewer channels or lags, or a smaller --block"
)


class FileResult(NamedTuple):
    """What came of a file."""

    seconds: float  # of sound
    size: int  # of the output, in bytes
    skipped: bool = False  # it was complete already
    not_finite: int = 0  # samples that were NaN or infinite


def process_file(
    source: str | Path,
    target: str | Path,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int = DEFAULT_BLOCK,
    outputs: Sequence[str] | None = None,
    replace: bool = False,
    progress: Callable[[int, int], None] = lambda done, frames: None,
    *,
    channels: tuple[int, int] | None = None,
    topic: str | None = None,
    resume: bool = False,
) -> FileResult:
    """Compute the auditory representations of a sound file, block by block, as they come into a file.

    The numbers are those of `rosafe.process` on the file's int32 samples, and of the node on the same samples, bit
    for bit. The file holds what `rosafe.load` returns.
    Nothing of the name `target` is there before it is complete.

    Parameters
    ----------
    source : path
        Sound file of two channels, left and right ear, or a rosbag (.bag).
    target : path
        The file of results; the end of its name (.npz, .h5, .mat, .zarr, .csv) is the format. Where it exists it is
        left alone, unless `replace`.
    parameters, outputs
        As of `rosafe.process`, but that `ild`, `ratemap` and `crossCorrelation` are the default; `in_doNormalize` is
        True by default.
    block_frames : int
        Frames that are read at a time; small blocks are processed together. The output for one takes at most 1 GiB.
    progress : callable
        Called now and then with the frames that are done and those that there are. What it raises ends the work.
    channels : tuple of two int, optional
        Which channels of the file (from 1) are the left and the right ear; ``(1, 1)`` for mono.
    topic : str, optional
        The port Audio in a bag; /bass/Audio by default, or the only one.
    resume : bool
        Leave `target` alone where it is complete already, and replace it where it is damaged, or older than `source`.

    Returns
    -------
    Done
        Seconds of sound and bytes of output, and whether it was there already.

    Raises
    ------
    AudioFileError
        The file cannot be read, or has not two channels.
    ValueError
        Parameters or outputs that cannot be, for this file's sample rate or at all, or for this format.
    OutputError
        The output is there already, or (with `resume`) was made otherwise, or there is no room for it, or it cannot be
        written.
    """
    values, wanted = check_parameters(parameters), check_outputs(OUTPUTS if outputs is None else outputs)
    form = format_of(target)
    check_format(form, wanted)
    about: dict[str, Any] = {
        "rosafe_version": VERSION,
        "source": os.fsencode(os.path.basename(source)).decode("utf-8", "backslashreplace"),
        "block_frames": block_frames,
        **({"channels": list(channels)} if channels else {}),
        **({"topic": topic} if topic else {}),
    }
    if resume and os.path.lexists(target):
        if _complete(form, Path(target), about, values, wanted) and not _source_modified(source, target):
            return FileResult(0.0, 0, True)
        replace = True
    with closing(open_sound(source, channels, topic)) as sound:
        if os.path.exists(target) and os.path.samefile(sound.path, target):
            raise OutputError(f"{target} is the input itself")
        place: AbstractContextManager[Path] = (
            new_folder(target, replace, form.folder) if form.folder else new_path(target, replace)
        )
        with place as path:
            _stream(sound, path, form, about, values, wanted, progress)
            size = sum(part.stat().st_size for part in path.rglob("*")) if form.folder else path.stat().st_size
        return FileResult(sound.frames / sound.sample_rate, size, False, sound.not_finite)


def _complete(
    form: Format, target: Path, about: Mapping[str, Any], values: Mapping[str, Any], wanted: Sequence[str]
) -> bool:
    """Whether the output is there and whole; OutputError where it is something else."""
    try:
        there = read(form, target, arrays=False)
    except ValueError:
        if form.is_one(target):
            return False
        raise OutputError(f"{target} is no result of rosafe process; --force replaces it") from None
    except OSError as problem:
        raise OutputError(f"{target}: {problem.strerror or problem}") from None
    names = {name for kind in wanted for name in KINDS[kind].outputs}
    rate = there.get("sample_rate")
    if isinstance(rate, (int, float)):
        about = {**about, "parameters": _parameters(values, wanted, rate)}
    other = [name for name in about if there.get(name) != _as_loaded(about[name])]
    other += [name for name in ("channels", "topic") if name in there and name not in about]
    other += ["outputs"] if set(there["axes"]) != names else []
    if other:
        raise OutputError(f"{target} was made with other {other[0]}; take another -o, or --force computes it again")
    return True


def _source_modified(source: str | Path, target: str | Path) -> bool:
    """Whether the input has been written since; one that has gone, or is from the future, has not."""
    return os.path.exists(source) and os.stat(target).st_mtime_ns < os.stat(source).st_mtime_ns <= time.time_ns()


def _parameters(values: Mapping[str, Any], wanted: Sequence[str], sample_rate: float) -> dict[str, Any]:
    """All parameters as they are in force, where `values` are given; what follows the rate only where it matters."""
    told = {p.name: p.default for kind in KINDS.values() for p in kind.parameters if not p.follows_rate} | dict(values)
    for kind in needed(wanted):
        mine = {p.name: values.get(p.name, p.default) for p in KINDS[kind].parameters}
        told |= STAGES[kind].resolve_rate_defaults(mine, values.keys(), sample_rate)
    return told


def _as_loaded(value: Any) -> Any:
    """As it comes back from a file: tuples are lists."""
    if isinstance(value, Mapping):
        return {name: _as_loaded(one) for name, one in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _stream(
    sound: SoundReader,
    path: Path,
    form: Format,
    about: Mapping[str, Any],
    values: Mapping[str, Any],
    wanted: list[str],
    progress: Callable[[int, int], None],
) -> None:
    done = dict.fromkeys(wanted, 0)
    telling = threading.Lock()

    def keep(kind: str, branch: int, block: Block) -> None:
        for name, data in zip(KINDS[kind].outputs, block.parts, strict=True):
            writer.append(name, data)
        with telling:
            done[kind] = block.next_index
            progress(min(done.values()), sound.frames)

    block_frames = about["block_frames"]
    with Chain(_blocks(sound, block_frames), sound.sample_rate, values, wanted, keep) as chain:
        kind, taken = chain.largest_block(min(block_frames, sound.frames))
        sizes.check_memory(sizes.MAX_BYTES, taken, f"{kind}: {_TOO_LARGE}", 1e9)  # several are under way at a time
        rate = {"sample_rate": sound.sample_rate, "parameters": _parameters(values, wanted, sound.sample_rate)}
        contents = _contents(chain, {**rate, **about}, wanted, sound.frames)
        made = form.writer(contents)
        _check_room(path, made.size(contents))
        with closing(made(path, contents)) as writer:
            chain.run(together=True)
            writer.finish()


def _contents(chain: Chain, about: dict[str, Any], wanted: Sequence[str], frames: int) -> Contents:
    parts = {name: part for kind in wanted for name, part in KINDS[kind].outputs.items()}
    described = chain.describe()
    words = {name: value for name, value in described.items() if isinstance(value, list)}
    times = {f"{kind}_time": chain.times(kind, frames) for kind in wanted if f"{kind}_frameRate" in described}
    return Contents(
        {name: shape for kind in wanted for name, (shape,) in chain.shapes(kind, frames).items()},
        {name: part.axes for name, part in parts.items()},
        {name: part.unit for name, part in parts.items()},
        {**{name: value for name, value in described.items() if name not in words}, **times},
        {**about, **words},
    )


def _blocks(sound: SoundReader, block_frames: int) -> Iterator[np.ndarray]:
    for at in range(0, sound.frames, block_frames):
        wanted = min(block_frames, sound.frames - at)
        block = sound.read(wanted)
        if block.shape[1] != wanted:
            raise AudioFileError(f"{sound.path} is cut off: {at + block.shape[1]} of {sound.frames} frames are there")
        yield block


def _check_room(path: Path, size: int) -> None:
    """OutputError where the disk has less than `size` bytes left, before hours of work."""
    disk = os.statvfs(path)
    free = disk.f_bavail * disk.f_frsize
    if size > free:
        raise OutputError(
            f"the output would take {_bytes_text(size)}, {_bytes_text(free)} are free there; name fewer --outputs"
        )


def _bytes_text(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e8 else f"{count / 1e6:.3f} MB"
