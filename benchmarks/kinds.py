"""Cost of the fourteen other representations compared with plain numpy and scipy, and agreement of both."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import plain

from rosafe.dsp.stage import Stage
from rosafe.representations import KINDS, STAGES

RATE = 44100
SECONDS = 2.5  # length of the sound; histories of 5 s are not yet full in either implementation
BLOCKS = (12000, 882)
# Limits in ms per second of sound, and a common limit for all other kinds.
LIMITS = {"adaptation": 60.0, "autocorrelation": 120.0, "amsFeatures": 25.0, "precedence": 100.0}
REST, REST_LIMIT = "everything else", 30.0
MAX_DIFFERENCE = 1e-6  # relative to the largest number; decisions (maps, pitch) may occasionally differ
DECIDING = ("pitch", "onsetMap", "offsetMap", "precedence", "itd")
MAX_DIFFERENT_SHARE = 0.02  # of decisions


def sound() -> np.ndarray:
    """Return a syllabic voice, later and softer in the right ear, with faint independent noise in both ears."""
    rng = np.random.default_rng(0)
    count = round(SECONDS * RATE)
    at = np.arange(count) / RATE
    voice = np.sign(np.sin(2 * np.pi * 140 * at)) * 0.1 + 0.02 * rng.standard_normal(count)
    voice *= np.clip(np.sin(2 * np.pi * 4 * at), 0, None) ** 2
    return np.stack((voice, 0.7 * np.roll(voice, 20))) + 1e-3 * rng.standard_normal((2, count))


def _blocks(kind: str, block: int) -> list[tuple[np.ndarray, ...]]:
    """Return the input blocks of the stage of `kind`, computed by its ancestors from blocks of `block` samples."""
    ancestors: list[str] = []
    while parent := KINDS[ancestors[0] if ancestors else kind].parent:
        ancestors.insert(0, parent)
    stages: list[Stage] = []
    for ancestor in ancestors:
        stages.append(STAGES[ancestor](stages[-1].output_format if stages else RATE, **_values(ancestor)))
    extra = STAGES[kind](stages[-1].output_format).required_extra
    stages[-1].provide = frozenset({extra} - {""})
    signal, blocks = sound(), []
    for first in range(0, signal.shape[1], block):
        data: Any = signal[:, first : first + block]
        for stage in stages:
            data = stage.process(data)
        blocks.append((data, stages[-1].provided[extra]) if extra else (data,))
    return blocks


def _values(kind: str) -> dict[str, Any]:
    return {"in_doNormalize": False} if kind == "input" else {}


def _input_format(kind: str) -> Any:
    parent = KINDS[kind].parent
    return STAGES[parent](_input_format(parent), **_values(parent)).output_format if parent else RATE


def one(kind: str, rounds: int) -> dict[str, float]:
    """Measure ms per second of sound, plain and by rosafe in blocks of each size, and their difference."""
    input_format, blocks = _input_format(kind), {block: _blocks(kind, block) for block in BLOCKS}
    whole = np.concatenate([data for data, *_ in blocks[BLOCKS[0]]], axis=-1)
    times: dict[str, list[float]] = {"plain": [], **{str(block): [] for block in BLOCKS}}
    for turn in range(rounds):
        if turn < 3:  # some take seconds, with little variation
            begin = time.thread_time()
            expected = plain.PLAIN[kind](whole, input_format)
            times["plain"].append(time.thread_time() - begin)
        for block in BLOCKS:
            stage, outputs = STAGES[kind](input_format), []
            begin = time.thread_time()
            for arguments in blocks[block]:
                output = stage.process(*arguments)
                outputs.append(output[0] if isinstance(output, tuple) else output)
            times[str(block)].append(time.thread_time() - begin)
    got = np.concatenate(outputs, axis=-1)
    found = {name: 1000 * float(np.median(spent)) / SECONDS for name, spent in times.items()}
    return {**found, "difference": _difference(kind, got, expected)}


def _difference(kind: str, got: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference relative to the largest number, or the share of different decisions."""
    count = min(got.shape[-1], expected.shape[-1])
    got, expected = got[..., :count], expected[..., :count]
    if kind in DECIDING:
        return float(np.mean(~np.isclose(got, expected, rtol=1e-6, atol=1e-12, equal_nan=True)))
    return float(np.max(np.abs(got - expected)) / np.max(np.abs(expected)))


def agrees(kind: str, found: dict[str, float]) -> bool:
    """Return whether both implementations agree."""
    return found["difference"] <= (MAX_DIFFERENT_SHARE if kind in DECIDING else MAX_DIFFERENCE)


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Measure each kind; the last entry is the sum of the kinds without a separate limit."""
    found = {kind: one(kind, rounds) for kind in plain.PLAIN}
    rest = [cost for kind, cost in found.items() if kind not in LIMITS]
    found[REST] = {name: sum(cost[name] for cost in rest) for name in ("plain", *map(str, BLOCKS))}
    return found


def table(found: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return a table with a head and a row for each kind."""
    rows = [
        ["representation", "plain", *(f"blocks of {block}" for block in BLOCKS), "times as fast", "limit", "differ"]
    ]
    for kind, cost in found.items():
        limit = {**LIMITS, REST: REST_LIMIT}.get(kind)
        times = [cost[str(block)] for block in BLOCKS]
        verdict = "" if limit is None else f"{limit:.0f}" + ("" if max(times) <= limit else " (over)")
        difference = "" if kind == REST else f"{cost['difference']:.0e}" + ("" if agrees(kind, cost) else " (too much)")
        rows.append(
            [
                kind,
                f"{cost['plain']:.2f}",
                *(f"{ms:.2f}" for ms in times),
                f"{cost['plain'] / times[0]:.1f}",
                verdict,
                difference,
            ]
        )
    return rows
