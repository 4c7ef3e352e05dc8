"""Batches of sounds: the files in folders, the path of each result, and the list of failures."""

from __future__ import annotations

import contextlib
import csv
import os
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from io import StringIO, TextIOWrapper
from itertools import takewhile
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from rosafe.processing.sounds import SOUNDS
from rosafe.system.input import open_regular
from rosafe.system.output import OutputError, write_whole

FAILED = "failed.csv"
_HEADER = ["input", "why"]
_MAX_FAILED = 2**26  # bytes


class FileJob(NamedTuple):
    """A sound, and the path of its result relative to the folder of results, without the suffix of a format."""

    source: Path
    place: PurePath


def compute(
    source: Path, target: Path, options: Mapping[str, Any], make_folders: bool, progress: Callable[[int, int], None]
) -> Any:
    """Call `process_file` with `options`, for a target whose folder may be missing with `make_folders`."""
    from rosafe.processing.files import process_file

    try:
        if make_folders:
            make_folder(target.parent)
    except OSError as problem:
        raise OutputError(f"cannot write {target}: {problem.strerror}") from None
    return process_file(source, target, progress=progress, **options)


# --- input files ------------------------------------------------------------------------------------------------


def find(inputs: Sequence[Path], excluded: Path | None = None) -> tuple[list[FileJob], list[tuple[Path, str]]]:
    """Return the sounds in files and folders, and a list of problems, each with its path.

    Folders are searched recursively, including symbolic links, each real folder once. Names that begin with a dot are
    skipped. Result paths are relative to a single input folder; with several inputs they begin with the folder's name.

    Parameters
    ----------
    inputs : sequence of Path
        Files, of any name, and folders.
    excluded : Path, optional
        A folder that is not searched: that of the results.
    """
    items: list[FileJob] = []
    problems: list[tuple[Path, str]] = []
    for path in inputs:
        if not os.path.isdir(path):
            items.append(FileJob(path, PurePath(path.name or "_")))
            continue
        root = PurePath() if len(inputs) == 1 else PurePath(Path(os.path.abspath(path)).name)
        count = len(items) + len(problems)
        for found in _sounds(path, excluded, problems):
            items.append(FileJob(found, root / found.relative_to(path)))
        if len(items) + len(problems) == count:
            problems.append((path, f"{path}: this folder contains no sound files"))
    return items, problems


def _sounds(folder: Path, excluded: Path | None, problems: list[tuple[Path, str]]) -> list[Path]:
    """Return the sounds below a folder, sorted. The search is iterative, so that folders may be nested to any depth.

    Links are followed last, and only to folders that were not reached without them.
    """
    found: list[Path] = []
    waiting, links = [folder], deque[Path]()
    seen = _identity(excluded) - _identity(folder)
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
    """Return device and inode of a folder; empty if it does not exist."""
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


# --- output paths -----------------------------------------------------------------------------------------------


def output_paths(items: Sequence[FileJob], folder: Path, extension: str) -> list[Path]:
    """Return the path of each result. The suffix of the sound is kept if two results would have one name without it.

    ValueError if two results would have one path nevertheless.
    """
    names = [str(item.place.with_name(item.place.stem)) for item in items]
    while True:
        taken = Counter([*names, *([FAILED.removesuffix(extension)] if FAILED.endswith(extension) else [])])
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
            raise ValueError(f"{other} and {item.source} would both be written to {target}")
    return targets


# --- failures ---------------------------------------------------------------------------------------------------


def write_failed(folder: Path, inputs: Sequence[Path], failed: Mapping[str, str]) -> None:
    """Update the list of failures in a folder of results. An empty list is deleted.

    Parameters
    ----------
    folder : Path
        The folder of results.
    inputs : sequence of Path
        Files and folders that were processed now. Entries of others are kept.
    failed : mapping
        The reason by the name of the input.
    """
    path = folder / FAILED
    processed = set(map(str, inputs))
    kept: dict[str, str] = {}
    if path.exists():
        with TextIOWrapper(open_regular(path), "utf-8", "surrogateescape", newline="") as file:
            rows = csv.reader(file)
            try:
                if os.fstat(file.fileno()).st_size > _MAX_FAILED or next(rows, None) != _HEADER:
                    raise csv.Error
                pairs = (row for row in rows if len(row) == 2)
                kept = {name: why for name, why in pairs if not processed & {name, *map(str, PurePath(name).parents)}}
            except csv.Error:
                raise OutputError(f"{path} is not a list of failures; it is left unchanged") from None
    rest = {**kept, **failed}
    if not rest:
        path.unlink(missing_ok=True)
        return
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([_HEADER, *rest.items()])
    write_whole(path, text.getvalue().encode("utf-8", "surrogateescape"))
