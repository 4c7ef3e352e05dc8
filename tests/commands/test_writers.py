"""Two writers of one result, and full disks: results are complete or absent."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from tests.commands import forked
from tests.commands.command import SMALL_PARAMETERS, as_int32, ild_in, noise, write
from tests.commands.forked import process
from tests.harness import PYTHON, ROOT, run_program

EXTENSIONS = [".npz", ".h5", ".mat", ".csv"]


class Other:
    """`process` in a child process."""

    def __init__(self, source: Path, target: Path, replace: bool) -> None:
        self._answer = forked.queue()
        self._process = forked.start(forked.answer_of_process, self._answer, source, target, replace)

    def result(self) -> str:
        self._process.join(60)
        assert self._process.exitcode == 0
        return str(self._answer.get())


def sounds(folder: Path, count: int) -> tuple[list[Path], list[np.ndarray]]:
    """Write sound files; return their paths and the ILD of each."""
    signals = [noise(4000, seed) for seed in range(count)]
    paths = [write(folder / f"{seed}.wav", signal) for seed, signal in enumerate(signals)]
    options: dict[str, Any] = {"parameters": SMALL_PARAMETERS, "outputs": ["ild"], "block_frames": 500}
    return paths, [rosafe.process(as_int32(signal), 16000, **options)["ild"] for signal in signals]


# --- two writers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extension", "replace"),
    [(".npz", True), (".h5", False), (".mat", True), (".csv", False)],
)
def test_the_second_writer_is_refused_while_the_first_one_writes(tmp_path: Path, extension: str, replace: bool) -> None:
    (first, second), (expected, _) = sounds(tmp_path, 2)
    target = tmp_path / "out" / f"a{extension}"
    target.parent.mkdir()
    if replace:
        process(second, target)
    refusals: list[str] = []

    def meanwhile(done: int, frames: int) -> None:
        if done in (0, frames) or not refusals:
            refusals.append(Other(second, target, replace).result())

    assert process(first, target, replace, meanwhile) == "done"
    assert refusals and set(refusals) == {f"cannot write {target}: another process is writing it"}
    np.testing.assert_array_equal(ild_in(target), expected)
    assert os.listdir(target.parent) == [target.name]


# --- full disks ---------------------------------------------------------------------------------------------------

_FILLED = """
import os, sys
from pathlib import Path
from rosafe.processing import files
from rosafe.system.output import OutputError

source, room, how, *extensions = sys.argv[1:]
room = Path(room)
files._check_disk_space = lambda path, size: None  # otherwise the output is refused before the computation


def fill(left=0):
    disk = os.statvfs(room)
    with open(room / "filler", "ab", buffering=0) as file:
        rest = disk.f_bavail * disk.f_frsize - left
        try:
            while rest > 0:
                rest -= file.write(bytes(min(rest, 2**20)))
        except OSError:
            pass


def run(extension, progress=lambda done, frames: None):
    target = room / f"out{extension}"
    try:
        files.process_file(
            source, target, {"fb_cfHz": [200.0, 800.0, 2000.0]}, 500,
            ["ild"] if extension == ".csv" else ["ild", "gammatone"], progress=progress,
        )
    except OutputError as problem:
        assert str(problem).startswith(f"cannot write {target}: "), problem
        assert "No space left" in str(problem) or "File too large" in str(problem), problem
        assert not set(os.listdir(room)) - {"filler"}, os.listdir(room)
        return False
    assert set(os.listdir(room)) - {"filler"} == {target.name}
    os.remove(target)
    return True


for extension in extensions:
    if how == "limit":
        import resource
        for limit in (0, 1, 2000, 4096, 30000, 100000, 200000, resource.RLIM_INFINITY):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            written = run(extension)
            assert not (limit == 0 and written)
        assert written
        continue
    for at in (0.0, 0.5, 1.0):  # while the output is written
        assert not run(extension, lambda done, frames: fill() if done >= at * frames else None), (extension, at)
        os.remove(room / "filler")
    lefts = [*(pages * 4096 for pages in (0, 1, 2, 4, 7, 11, 40, 160)), 3_000_000]
    written = []
    for left in lefts:
        fill(left)
        written.append(run(extension))
        os.remove(room / "filler")
    assert not written[0] and written[-1] and written == sorted(written), (extension, written)
print("ended well")
"""


def filled(tmp_path: Path, how: str, room: Path, before: Sequence[str] = ()) -> None:
    source = write(tmp_path / "in.wav", noise(8000))
    done = run_program(
        [*before, PYTHON, "-c", _FILLED, str(source), str(room), how, *EXTENSIONS],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0 and done.stdout == "ended well\n" and done.stderr == "", done


def test_disks_that_become_full_at_any_point(tmp_path: Path, small_disk: tuple[Path, list[str]]) -> None:
    folder, before = small_disk
    filled(tmp_path, "disk", folder, before)


def test_limited_file_size(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    filled(tmp_path, "limit", tmp_path / "room")
