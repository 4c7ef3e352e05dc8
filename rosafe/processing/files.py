"""`process_file`: compute a result file from a sound file of any length, in constant memory."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.audio.files.audiofile import AudioFileError
from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK
from rosafe.declarations.text import bytes_text
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs, check_parameters
from rosafe.processing.chain import Chain, FrameLimiter, computed_ears, effective_parameters
from rosafe.processing.signals import of_ears
from rosafe.processing.sounds import SoundReader, open_sound
from rosafe.results.formats import Format, check_format, format_of, options_in
from rosafe.results.readers import READERS, read
from rosafe.results.result_metadata import Contents
from rosafe.results.writers import ResultWriter
from rosafe.system.output import OutputError, new_path
from rosafe.system.version import VERSION
from rosafe.tree import sizes
from rosafe.tree.block import Block

OUTPUTS = ("ild", "ratemap", "crossCorrelation")  # the default: framed outputs of the original
_MONO_ADVICE = "--channels 1,1 uses it for both, and --outputs ratemap needs one"
_OPTIONS = ("channels", "topic", "pad", "clip")  # entries of a file that may be absent


class FileResult(NamedTuple):
    """Summary of a processed file."""

    seconds: float  # of sound
    size: int  # bytes of the output
    skipped: bool = False  # because the output was complete
    not_finite: int = 0  # NaN or infinite samples
    clipped: int = 0  # samples that were limited to full scale
    empty: tuple[str, ...] = ()  # outputs without frames
    remark: str = ""  # one line about sound that was not read


def process_file(
    source: str | Path,
    target: str | Path,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int = DEFAULT_FRAMES_PER_BLOCK,
    outputs: Sequence[str] | None = None,
    replace: bool = False,
    progress: Callable[[int, int], None] = lambda done, frames: None,
    *,
    channels: tuple[int, int] | None = None,
    topic: str | None = None,
    resume: bool = False,
    pad: bool = False,
    clip: bool = True,
) -> FileResult:
    """Compute the auditory representations of a sound file, block by block, and write them to a file.

    The numbers are those of `rosafe.process` on the file's int32 samples, and of the node on the same samples, bit
    for bit. `rosafe.load` reads .npz and .h5. `target` does not exist before it is complete.

    Parameters
    ----------
    source : path
        Sound file of two channels, left and right ear, or a rosbag (.bag). A mono file is accepted if `outputs` are
        given and none of them compares two ears.
    target : path
        The result file. The end of its name (.npz, .h5, .mat, .csv) is the format. An existing file is an error unless
        `replace`.
    parameters, outputs
        As in `rosafe.process`, except that `ild`, `ratemap` and `crossCorrelation` are the default outputs, and
        `in_doNormalize` is True by default.
    block_frames : int
        Frames that are read at a time; small blocks are merged. The output of a block takes at most 1 GiB.
    progress : callable
        Called repeatedly with the number of processed frames and that of all frames. An exception from it ends the
        processing.
    channels : tuple of two int, optional
        The channels of the file (from 1) for the left and the right ear; ``(1, 1)`` for mono.
    topic : str, optional
        The port Audio in a bag; /bass/Audio by default, or the only one.
    resume : bool
        Skip `target` if it is complete; replace it if it is damaged or older than `source`. A .mat or .csv is complete
        if it begins as `process_file` has written it with the same options.
    pad : bool
        Whether the last frames are completed by zeros, as in `rosafe.process`.
    clip : bool
        Whether samples of float files are converted to int32, which limits them to full scale, as the node does. If
        not, they are processed as they are, and `in_doNormalize` is False by default.

    Returns
    -------
    FileResult

    Raises
    ------
    AudioFileError
        The file cannot be read, or does not have two channels.
    ValueError
        Invalid parameters or outputs, or ones that do not fit the sample rate or the format.
    OutputError
        The output exists, or (with `resume`) was computed with other options, or the disk is full, or it cannot be
        written.
    """
    values, kinds = check_parameters(parameters), check_outputs(OUTPUTS if outputs is None else outputs)
    file_format = format_of(target)
    check_format(file_format, kinds)
    about = _options_of(source, block_frames, channels, topic, pad, clip)
    if file_format.extension not in READERS:
        options = json.dumps([about, values, sorted(kinds)], sort_keys=True, default=list)
        about = {"options": hashlib.sha256(options.encode()).hexdigest()[:32], **about}
    if resume and os.path.lexists(target):
        if _complete(file_format, Path(target), about, values, kinds) and not _source_modified(source, target):
            return FileResult(0.0, 0, True)
        replace = True
    one_ear = outputs is not None and not any(KINDS[kind].binaural for kind in kinds)
    with closing(open_sound(source, channels, topic, one_ear, clip, _MONO_ADVICE)) as sound:
        if os.path.exists(target) and os.path.samefile(sound.path, target):
            raise OutputError(f"{target}: expected another file than the input, got the same")
        if sound.floats:
            values.setdefault("in_doNormalize", False)
        with new_path(target, replace) as path:
            empty = _FileRun(sound, path, file_format, about, values, kinds, progress).run()
            size = path.stat().st_size
        seconds = sound.frames / sound.sample_rate
        return FileResult(seconds, size, False, sound.not_finite, sound.clipped, empty, sound.remark)


def _options_of(
    source: str | Path, block_frames: int, channels: tuple[int, int] | None, topic: str | None, pad: bool, clip: bool
) -> dict[str, Any]:
    """Return the entries of the result that describe the options."""
    return {
        "rosafe_version": VERSION,
        "source": os.fsencode(os.path.basename(source)).decode("utf-8", "backslashreplace"),
        "block_frames": block_frames,
        **({"channels": list(channels)} if channels else {}),
        **({"topic": topic} if topic else {}),
        **({"pad": 1} if pad else {}),
        **({} if clip else {"clip": 0}),
    }


def _complete(
    file_format: Format, target: Path, about: Mapping[str, Any], values: Mapping[str, Any], kinds: Sequence[str]
) -> bool:
    """Return whether the output exists and is complete; OutputError if it is a different file."""
    try:
        if file_format.extension in READERS:
            different = _differences(read(target, arrays=False), about, values, kinds)
        else:
            different = [] if options_in(target) == about["options"] else ["options"]
    except ValueError:
        if file_format.is_one(target):
            return False
        raise OutputError(
            f"{target}: expected a result of rosafe process, got another file; --force replaces it"
        ) from None
    except OSError as problem:
        raise OutputError(f"{target}: {problem.strerror or problem}") from None
    if different:
        raise OutputError(
            f"{target} was computed with other {different[0]}; choose another -o, or --force computes it again"
        )
    return True


def _differences(
    existing: Mapping[str, Any], about: Mapping[str, Any], values: Mapping[str, Any], kinds: Sequence[str]
) -> list[str]:
    """Return the names of the options with which an existing result was not computed."""
    names = {name for kind in kinds for name in KINDS[kind].outputs}
    if "clip" in about:  # whether the file contains floats is not known here
        values = {"in_doNormalize": existing["parameters"].get("in_doNormalize"), **values}
    about = {**about, "parameters": effective_parameters(values, kinds, existing["sample_rate"])}
    different = [name for name in about if existing.get(name) != about[name]]
    different += [name for name in _OPTIONS if name in existing and name not in about]
    return [*different, *(["outputs"] if set(existing["axes"]) != names else [])]


def _source_modified(source: str | Path, target: str | Path) -> bool:
    """Return whether the source is newer than the result. False if the source is missing or dated in the future."""
    return os.path.exists(source) and os.stat(target).st_mtime_ns < os.stat(source).st_mtime_ns <= time.time_ns()


@dataclass
class _FileRun:
    """The computation of one file."""

    sound: SoundReader
    path: Path
    file_format: Format
    about: Mapping[str, Any]
    values: Mapping[str, Any]
    kinds: list[str]
    progress: Callable[[int, int], None]

    def __post_init__(self) -> None:
        self._padding = 0
        self._limiter = FrameLimiter(self.sound.frames)
        self._done = dict.fromkeys(self.kinds, 0)
        self._lock = threading.Lock()
        self._writer: ResultWriter

    def run(self) -> tuple[str, ...]:
        """Compute and write everything. Return the names of outputs without frames."""
        sound, kinds = self.sound, self.kinds
        ears = computed_ears(sound.channels, kinds)
        with Chain(self._blocks(ears), sound.sample_rate, self.values, kinds, self._write, ears=ears) as chain:
            kind, taken = chain.largest_block(min(self.about["block_frames"], sound.frames))
            advice = "take fewer channels or lags, or a smaller --block"
            sizes.check_memory(kind, sizes.MAX_BYTES, taken, advice, content="one block")  # several exist at a time
            self._padding = chain.padding(sound.frames) if "pad" in self.about else 0
            contents = self._contents(chain)
            writer_class = self.file_format.writer(contents)
            _check_disk_space(self.path, writer_class.size(contents))
            with closing(writer_class(self.path, contents)) as self._writer:
                chain.run(merge=True)
                contents.about["clipped"] = sound.clipped
                self._writer.finish()
        return tuple(name for name, shape in contents.shapes.items() if not shape[-1])

    def _blocks(self, ears: int) -> Iterator[np.ndarray]:
        sound, length = self.sound, self.about["block_frames"]
        for first in range(0, sound.frames, length):
            count = min(length, sound.frames - first)
            block = sound.read(count)
            if block.shape[1] != count:
                raise AudioFileError(
                    f"{sound.path}: expected {sound.frames} frames, got {first + block.shape[1]}; the file is truncated"
                )
            yield np.broadcast_to(block, (ears, count))
        for first in range(0, self._padding, length):
            yield np.zeros((ears, min(length, self._padding - first)), np.float64 if sound.floats else np.int32)

    def _write(self, kind: str, branch: int, block: Block) -> None:
        kept = self._limiter.kept(kind, branch, block)
        for (name, part), data in zip(KINDS[kind].outputs.items(), block.parts, strict=True):
            self._writer.append(name, of_ears(self.sound.channels, part.axes, data)[..., :kept])
        with self._lock:
            self._done[kind] = min(block.next_index, self.sound.frames)
            self.progress(min(self._done.values()), self.sound.frames)

    def _contents(self, chain: Chain) -> Contents:
        frames, kinds, pad = self.sound.frames, self.kinds, "pad" in self.about
        parts = {name: part for kind in kinds for name, part in KINDS[kind].outputs.items()}
        described = chain.describe()
        names = {name: value for name, value in described.items() if isinstance(value, list)}
        framed = [kind for kind in kinds if f"{kind}_frameRate" in described]
        times = {f"{kind}_time": chain.times(kind, frames, pad) for kind in framed}
        shapes = {}
        for kind in kinds:
            for name, (shape,) in chain.shapes(kind, frames, pad).items():
                ears = (self.sound.channels,) if parts[name].axes[0] == "ear" else shape[:1]
                shapes[name] = (*ears, *shape[1:]) if len(shape) > 1 else shape
        rate = self.sound.sample_rate
        parameters = effective_parameters(self.values, kinds, rate)
        return Contents(
            shapes,
            {name: part.axes for name, part in parts.items()},
            {name: part.unit for name, part in parts.items()},
            {**{name: value for name, value in described.items() if name not in names}, **times},
            {**self.about, "sample_rate": rate, "parameters": parameters, **names, "clipped": 0},
        )


def _check_disk_space(path: Path, size: int) -> None:
    """Raise OutputError if less than `size` bytes are free on the disk, before hours of computation."""
    disk = os.statvfs(path)
    free = disk.f_bavail * disk.f_frsize
    if size > free:
        raise OutputError(
            f"output: expected at most {bytes_text(free)} (free on the disk), got {bytes_text(size)}; "
            "name fewer --outputs"
        )
