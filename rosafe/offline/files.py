"""`process_file`: a sound file of any length to an .npz, in memory that does not grow with it."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs, check_parameters
from rosafe.offline.chain import Chain
from rosafe.offline.npz import NpzWriter
from rosafe.offline.process import DEFAULT_BLOCK
from rosafe.output import OutputError, new_file
from rosafe.sound.audiofile import AudioFile, AudioFileError
from rosafe.tree import sizes
from rosafe.tree.block import Block

_TOO_LARGE = (
    "one block of output would take {taken:.1f} GB, allowed are {limit:.1f} GB; "
    "take fewer channels or lags, or a smaller --block"
)
_DEFAULTS = {p.name: p.default for kind in KINDS.values() for p in kind.parameters if not p.follows_rate}


def process_file(
    source: str | Path,
    target: str | Path,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int = DEFAULT_BLOCK,
    outputs: Sequence[str] | None = None,
    replace: bool = False,
    progress: Callable[[int, int], None] = lambda done, frames: None,
) -> tuple[float, int]:
    """Compute the auditory representations of a sound file, block by block, as they come into an .npz.

    The numbers are those of `rosafe.process` on the file's int32 samples, and of the node on the same samples and
    blocks, bit for bit. The .npz holds what that returns, and `sample_rate` (Hz), `block_frames` and `parameters` (all
    of them with their values, as a JSON object that `rosafe.process` takes).
    Nothing of the name `target` is there before it is complete.

    Parameters
    ----------
    source : path
        Sound file of two channels, left and right ear.
    target : path
        The .npz; where it exists it is left alone, unless `replace`.
    parameters, outputs
        As of `rosafe.process`; `in_doNormalize` is True by default.
    block_frames : int
        Frames that are read and processed at a time; the output for them takes at most 1 GiB.
    progress : callable
        Called now and then with the frames that are done and those that there are. What it raises ends the work.

    Returns
    -------
    tuple
        Seconds of sound and bytes of output.

    Raises
    ------
    AudioFileError
        The file cannot be read, or has not two channels.
    ValueError
        Parameters or outputs that cannot be, for this file's sample rate or at all.
    OutputError
        The output is there already, or there is no room for it, or it cannot be written.
    """
    values, wanted = check_parameters(parameters), check_outputs(outputs)
    file = AudioFile(source)
    try:
        if os.path.exists(target) and os.path.samefile(file.path, target):
            raise OutputError(f"{target} is the input itself")
        if file.channels != 2:
            kind = "is mono (one channel)" if file.channels == 1 else f"has {file.channels} channels"
            raise AudioFileError(f"{file.path} {kind}; wanted are two: left and right ear")
        with new_file(target, replace) as descriptor:
            return _stream(file, descriptor, values, block_frames, wanted, progress)
    finally:
        file.close()


def _stream(
    file: AudioFile,
    descriptor: int,
    values: Mapping[str, Any],
    block_frames: int,
    wanted: list[str],
    progress: Callable[[int, int], None],
) -> tuple[float, int]:
    done = dict.fromkeys(wanted, 0)
    telling = threading.Lock()

    def keep(kind: str, block: Block) -> None:
        for name, data in zip(KINDS[kind].outputs, block.parts, strict=True):
            writer.append(name, data)
        with telling:
            done[kind] = block.next_index
            progress(min(done.values()), file.frames)

    with Chain(_blocks(file, block_frames), file.sample_rate, values, wanted, keep) as chain:
        kind, taken = chain.largest_block(min(block_frames, file.frames))
        sizes.refuse_over(sizes.MAX_BYTES, taken, f"{kind}: {_TOO_LARGE}", 1e9)  # several are under way at a time
        writer = NpzWriter(
            descriptor,
            {
                "sample_rate": file.sample_rate,
                "block_frames": block_frames,
                "parameters": json.dumps({**_DEFAULTS, **values}),
                **chain.describe(),
            },
            {name: shape for kind in wanted for name, shape in chain.shapes(kind, file.frames).items()},
        )
        _check_room(descriptor, writer.size)
        chain.run()
        writer.finish()
    return file.frames / file.sample_rate, os.fstat(descriptor).st_size


def _blocks(file: AudioFile, block_frames: int) -> Iterator[np.ndarray]:
    for at in range(0, file.frames, block_frames):
        wanted = min(block_frames, file.frames - at)
        block = file.read(wanted)
        if block.shape[1] != wanted:
            raise AudioFileError(f"{file.path} is cut off: {at + block.shape[1]} of {file.frames} frames are there")
        yield block


def _check_room(descriptor: int, size: int) -> None:
    """OutputError where the disk has less than `size` bytes left, before hours of work."""
    disk = os.fstatvfs(descriptor)
    free = disk.f_bavail * disk.f_frsize
    if size > free:
        raise OutputError(
            f"the output would take {size / 1e9:.1f} GB, {free / 1e9:.1f} GB are free there; name fewer --outputs"
        )
