"""Many sounds at once: which files there are in folders, where the result of each goes, and which have failed."""

from __future__ import annotations

import contextlib
import csv
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO, TextIOWrapper
from itertools import takewhile
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from rosafe.input import open_regular
from rosafe.offline.sounds import SOUNDS
from rosafe.output import OutputError, write_whole

FAILED = "failed.csv"
_HEAD = ["input", "why"]


class FileJob(NamedTuple):
    """A sound, and its place below the folder of results, before its name gets the end of a format."""

    source: Path
    place: PurePath


@dataclass(frozen=True)
class Settings:
    """What is done with each, as `process_file` takes it."""

    parameters: Mapping[str, Any]
    outputs: Sequence[str]
    block_frames: int
    channels: tuple[int, int] | None = None
    topic: str | None = None
    replace: bool = False
    resume: bool = False
    make_folders: bool = False


def compute(source: Path, target: Path, settings: Settings, progress: Callable[[int, int], None]) -> Any:
    """`process_file`, by `settings`."""
    from rosafe.offline.files import process_file

    try:
        if settings.make_folders:
            make_folder(target.parent)
    except OSError as problem:
        raise OutputError(f"cannot write {target}: {problem.strerror}") from None
    return process_file(
        source,
        target,
        settings.parameters,
        settings.block_frames,
        settings.outputs,
        settings.replace,
        progress,
        channels=settings.channels,
        topic=settings.topic,
        resume=settings.resume,
    )


# --- what there is ----------------------------------------------------------------------------------------------


def find(inputs: Sequence[Path], besides: Path | None = None) -> tuple[list[FileJob], list[tuple[Path, str]]]:
    """The sounds that are meant by files and folders, and what is wrong with some of these.

    Folders are searched all the way down, symbolic links followed, each real folder once; names that begin with a dot
    are left out. Of one folder the places are what lies below it; of several inputs those of a folder begin with its
    name.

    Parameters
    ----------
    inputs : sequence of Path
        Files, of any name, and folders.
    besides : Path, optional
        A folder that is not searched, where it lies below one that is: that of the results.
    """
    items: list[FileJob] = []
    problems: list[tuple[Path, str]] = []
    for path in inputs:
        if not os.path.isdir(path):
            items.append(FileJob(path, PurePath(path.name or "_")))
            continue
        root = PurePath() if len(inputs) == 1 else PurePath(Path(os.path.abspath(path)).name)
        before = len(items) + len(problems)
        for found in _sounds(path, besides, problems):
            items.append(FileJob(found, root / found.relative_to(path)))
        if len(items) + len(problems) == before:
            problems.append((path, f"{path}: there is no sound file in this folder"))
    return items, problems


def _sounds(folder: Path, besides: Path | None, problems: list[tuple[Path, str]]) -> list[Path]:
    """The sounds below a folder, sorted. Folders are searched without recursion: they may be nested to any depth.

    Each real folder is searched once: links are followed last, and only to folders that were not reached without them.
    """
    found: list[Path] = []
    waiting, links = [folder], deque[Path]()
    seen = _identity(besides) - _identity(folder)
    while waiting or links:
        path = waiting.pop() if waiting else links.popleft()
        try:
            status = path.stat()
            if (identity := (status.st_dev, status.st_ino)) in seen:
                continue
            seen.add(identity)
            entries = sorted(os.scandir(path), key=lambda entry: entry.name)
        except OSError as problem:
            problems.append((path, f"{path}: {problem.strerror}"))
            continue
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_dir(follow_symlinks=False):
                waiting.append(path / entry.name)
            elif entry.is_symlink() and os.path.isdir(entry.path):
                links.append(path / entry.name)
            elif PurePath(entry.name).suffix.lower() in SOUNDS:
                found.append(path / entry.name)
    return sorted(found, key=lambda path: path.parts)


def _identity(folder: Path | None) -> set[tuple[int, int]]:
    """Device and inode of a folder; empty if there is none."""
    try:
        status = os.stat(folder or "")
    except OSError:
        return set()
    return {(status.st_dev, status.st_ino)}


def make_folder(folder: Path) -> None:
    """Create a folder and those above it, at any depth (`Path.mkdir` is recursive); OSError if that fails."""
    with contextlib.suppress(FileNotFoundError):
        os.stat(folder)  # a name that is too long is an error before anything has been created
    missing = list(takewhile(lambda path: not os.path.isdir(path), (folder, *folder.parents)))
    for path in reversed(missing):
        path.mkdir(exist_ok=True)


# --- where it goes ----------------------------------------------------------------------------------------------


def output_paths(items: Sequence[FileJob], folder: Path, extension: str) -> list[Path]:
    """The result of each: its name without its end, or with it where two of a folder would get one name.

    ValueError where two would go to one place all the same.
    """
    names = [str(item.place.with_name(item.place.stem)) for item in items]
    while True:
        taken: dict[str, int] = {FAILED.removesuffix(extension): 1} if FAILED.endswith(extension) else {}
        for name in names:
            taken[name] = taken.get(name, 0) + 1
        changed = False
        for index, item in enumerate(items):
            if taken[names[index]] > 1 and names[index] != str(item.place):
                names[index], changed = str(item.place), True
        if not changed:
            break
    targets = [folder / f"{name}{extension}" for name in names]
    seen: dict[str, Path] = {}
    for item, target in zip(items, targets, strict=True):
        other = seen.setdefault(os.path.realpath(target), item.source)
        if other is not item.source:
            raise ValueError(f"{other} and {item.source} would both go to {target}")
    return targets


# --- what has failed --------------------------------------------------------------------------------------------


def write_failed(folder: Path, inputs: Sequence[Path], failed: Mapping[str, str]) -> None:
    """Bring the list of what has failed in a folder of results up to date; it goes where nothing is left on it.

    Parameters
    ----------
    folder : Path
        Of the results.
    inputs : sequence of Path
        Files and folders that were tried now; others on the list stay there.
    failed : mapping
        Why, by the name of the input.
    """
    path = folder / FAILED
    tried = set(map(str, inputs))
    kept: dict[str, str] = {}
    if path.exists():
        with TextIOWrapper(open_regular(path), "utf-8", "surrogateescape", newline="") as file:
            rows = csv.reader(file)
            try:
                if next(rows, None) != _HEAD:
                    raise csv.Error
                kept = {row[0]: row[1] for row in rows if len(row) == 2 and not tried & {row[0], *_folders(row[0])}}
            except csv.Error:
                raise OutputError(f"{path} is something else, and stays as it is") from None
    rest = {**kept, **failed}
    if not rest:
        path.unlink(missing_ok=True)
        return
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([_HEAD, *rest.items()])
    write_whole(path, text.getvalue().encode("utf-8", "surrogateescape"))


def _folders(name: str) -> set[str]:
    return set(map(str, PurePath(name).parents))
