"""Learned models: kept with the head, and on disk in `$XDG_CACHE_HOME/rosafe` (default `~/.cache/rosafe`)."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rosafe.localization import cues
from rosafe.localization.direction_model import FORMAT, DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.training import Progress, learn_head
from rosafe.system.output import OutputError
from rosafe.system.trust import foreign, user_cache

VERSION = 8  # of the method; another one makes models on disk obsolete
_models: weakref.WeakKeyDictionary[Head, dict[str, DirectionModel]] = weakref.WeakKeyDictionary()
_by_key: weakref.WeakValueDictionary[str, DirectionModel] = weakref.WeakValueDictionary()  # for equal heads


def folder() -> Path | None:
    """Return the folder of learned models; None if there is none, or if other users can write it."""
    found = user_cache()
    return None if found is None or foreign(found) else found


def model_of(
    head: Head, sample_rate: float, parameters: Mapping[str, Any] | None, progress: Progress | None = None
) -> DirectionModel:
    """Return the model of a head, learned if there is none yet.

    A cache that cannot be read or written, or that other users can write, is ignored.
    """
    sample_rate = float(sample_rate)  # 44100 and 44100.0 have the same model
    described = cues.describe(sample_rate, parameters)
    values = cues.model_parameters(described)
    text = json.dumps([FORMAT, VERSION, head.key, sample_rate, values], sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:32]
    known = _models.setdefault(head, {})
    if key not in known:
        cache = folder()
        path = cache / f"head-{key}.npz" if cache else None
        known[key] = _by_key[key] = (
            _by_key.get(key)
            or _from_disk(path, head, sample_rate, values)
            or _learn(head, sample_rate, parameters, path, progress)
        )
    return known[key]


def _from_disk(path: Path | None, head: Head, sample_rate: float, values: Mapping[str, Any]) -> DirectionModel | None:
    if path is None or path.is_symlink() or foreign(path):
        return None
    with contextlib.suppress(ValueError, OSError):
        model = DirectionModel.load(path)
        if (model.head, model.sample_rate, model.parameters) == (head.key, sample_rate, values):
            return model
    return None


def _learn(
    head: Head, sample_rate: float, parameters: Mapping[str, Any] | None, path: Path | None, progress: Progress | None
) -> DirectionModel:
    model = learn_head(head, sample_rate, parameters, progress or terminal_progress(head.name))
    if path is not None:
        with contextlib.suppress(OSError, OutputError):
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            if path.is_symlink():
                path.unlink()
            model.save(path)
    return model


def terminal_progress(name: str) -> Progress | None:
    """Return a function that shows the progress of learning on standard error, if that is a terminal."""
    stream = sys.stderr
    if stream is None or not stream.isatty():
        return None
    due = 0.0

    def show(part: float) -> None:
        nonlocal due
        if part >= 1.0:
            stream.write("\r\x1b[K")
        elif time.monotonic() >= due:
            due = time.monotonic() + 0.1
            stream.write(f"\r\x1b[Klearning the directions of {os.path.basename(name)}: {100 * part:.0f} %"[:100])
        stream.flush()

    return show
