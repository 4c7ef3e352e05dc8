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

from rosafe.localization import training
from rosafe.localization.direction_model import FORMAT, DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.training import Progress, learn_head
from rosafe.output import OutputError

VERSION = 3  # of the method; another one makes models on disk obsolete
_models: weakref.WeakKeyDictionary[Head, dict[str, DirectionModel]] = weakref.WeakKeyDictionary()


def folder() -> Path:
    """Return the folder of learned models."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "rosafe"


def model_of(
    head: Head, sample_rate: float, parameters: Mapping[str, Any] | None, progress: Progress | None = None
) -> DirectionModel:
    """Return the model of a head, learned if there is none yet.

    A cache that cannot be read or written is ignored.
    """
    sample_rate = float(sample_rate)  # 44100 and 44100.0 have the same model
    described = training.describe(sample_rate, parameters)
    values = training.model_parameters(described)
    text = json.dumps([FORMAT, VERSION, head.key, sample_rate, values], sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:32]
    known = _models.setdefault(head, {})
    if key not in known:
        path = folder() / f"head-{key}.npz"
        known[key] = _from_disk(path, sample_rate, values) or _learn(head, sample_rate, parameters, path, progress)
    return known[key]


def _from_disk(path: Path, sample_rate: float, values: Mapping[str, Any]) -> DirectionModel | None:
    with contextlib.suppress(ValueError, OSError):
        model = DirectionModel.load(path)
        if model.sample_rate == sample_rate and model.parameters == values:
            return model
    return None


def _learn(
    head: Head, sample_rate: float, parameters: Mapping[str, Any] | None, path: Path, progress: Progress | None
) -> DirectionModel:
    model = learn_head(head, sample_rate, parameters, progress or terminal_progress(head.name))
    with contextlib.suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
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
