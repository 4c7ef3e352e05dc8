"""What the fourteen further representations cost, beside plain numpy and scipy, and that both agree."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import plain

from rosafe.dsp.stage import Stage
from rosafe.representations import KINDS, STAGES

RATE = 44100
SECONDS = 2.5  # of sound; a piece of five seconds that is remembered is not complete, for either side
BLOCKS = (12000, 882)
# Bounds in ms for a second of sound; everything else together has one of its own.
BOUNDS = {"adaptation": 60.0, "autocorrelation": 120.0, "amsFeatures": 25.0, "precedence": 100.0}
REST, REST_BOUND = "everything else", 30.0
MAX_APART = 1e-6  # of the largest number; maps and pitch decide, and may decide otherwise now and then
DECIDING = ("pitch", "onsetMap", "offsetMap", "precedence", "itd")
FEW = 0.02  # of the decisions


def sound() -> np.ndarray:
    """A voice in syllables, which reaches the right ear a little later and softer, over faint noise of either ear."""
    rng = np.random.default_rng(0)
    count = round(SECONDS * RATE)
    at = np.arange(count) / RATE
    voice = np.sign(np.sin(2 * np.pi * 140 * at)) * 0.1 + 0.02 * rng.standard_normal(count)
    voice *= np.clip(np.sin(2 * np.pi * 4 * at), 0, None) ** 2
    return np.stack((voice, 0.7 * np.roll(voice, 20))) + 1e-3 * rng.standard_normal((2, count))


def _blocks(kind: str, block: int) -> list[tuple[np.ndarray, ...]]:
    """What the stage of `kind` takes, as its parents make it of blocks of so many samples."""
    above: list[str] = []
    while parent := KINDS[above[0] if above else kind].parent:
        above.insert(0, parent)
    stages: list[Stage] = []
    for one in above:
        stages.append(STAGES[one](stages[-1].output_format if stages else RATE, **_values(one)))
    needs = STAGES[kind](stages[-1].output_format).required_extra
    stages[-1].provide = frozenset({needs} - {""})
    signal, taken = sound(), []
    for first in range(0, signal.shape[1], block):
        data: Any = signal[:, first : first + block]
        for stage in stages:
            data = stage.process(data)
        taken.append((data, stages[-1].provided[needs]) if needs else (data,))
    return taken


def _values(kind: str) -> dict[str, Any]:
    return {"in_doNormalize": False} if kind == "input" else {}


def _given(kind: str) -> Any:
    parent = KINDS[kind].parent
    return STAGES[parent](_given(parent), **_values(parent)).output_format if parent else RATE


def one(kind: str, rounds: int) -> dict[str, float]:
    """ms per second of sound: plain, ours in blocks of each size, and by how much they differ."""
    given, blocks = _given(kind), {block: _blocks(kind, block) for block in BLOCKS}
    whole = np.concatenate([data for data, *_ in blocks[BLOCKS[0]]], axis=-1)
    times: dict[str, list[float]] = {"plain": [], **{str(block): [] for block in BLOCKS}}
    for turn in range(rounds):
        if turn < 3:  # some take seconds, and they are as long each time
            begin = time.thread_time()
            wanted = plain.PLAIN[kind](whole, given)
            times["plain"].append(time.thread_time() - begin)
        for block in BLOCKS:
            stage, made = STAGES[kind](given), []
            begin = time.thread_time()
            for taken in blocks[block]:
                output = stage.process(*taken)
                made.append(output[0] if isinstance(output, tuple) else output)
            times[str(block)].append(time.thread_time() - begin)
    got = np.concatenate(made, axis=-1)
    found = {name: 1000 * float(np.median(spent)) / SECONDS for name, spent in times.items()}
    return {**found, "apart": _apart(kind, got, wanted)}


def _apart(kind: str, got: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference in parts of the largest number, or the share of decisions that differ."""
    count = min(got.shape[-1], wanted.shape[-1])
    got, wanted = got[..., :count], wanted[..., :count]
    if kind in DECIDING:
        return float(np.mean(~np.isclose(got, wanted, rtol=1e-6, atol=1e-12, equal_nan=True)))
    return float(np.max(np.abs(got - wanted)) / np.max(np.abs(wanted)))


def agrees(kind: str, found: dict[str, float]) -> bool:
    """Whether both sides have made the same."""
    return found["apart"] <= (FEW if kind in DECIDING else MAX_APART)


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Of each kind, and last of those together that have no bound of their own."""
    found = {kind: one(kind, rounds) for kind in plain.PLAIN}
    rest = [cost for kind, cost in found.items() if kind not in BOUNDS]
    found[REST] = {name: sum(cost[name] for cost in rest) for name in ("plain", *map(str, BLOCKS))}
    return found


def table(found: dict[str, dict[str, float]]) -> list[list[str]]:
    """A row for each, the head first."""
    rows = [
        ["representation", "plain", *(f"blocks of {block}" for block in BLOCKS), "times as fast", "bound", "differ"]
    ]
    for kind, cost in found.items():
        bound = {**BOUNDS, REST: REST_BOUND}.get(kind)
        ours = [cost[str(block)] for block in BLOCKS]
        verdict = "" if bound is None else f"{bound:.0f}" + ("" if max(ours) <= bound else " (over)")
        apart = "" if kind == REST else f"{cost['apart']:.0e}" + ("" if agrees(kind, cost) else " (too much)")
        rows.append(
            [
                kind,
                f"{cost['plain']:.2f}",
                *(f"{ms:.2f}" for ms in ours),
                f"{cost['plain'] / ours[0]:.1f}",
                verdict,
                apart,
            ]
        )
    return rows
