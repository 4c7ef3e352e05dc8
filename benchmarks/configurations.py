"""Cost per unit of work in other configurations; cost of the first block, memory, cost of silence."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.dsp.stage import Stage
from rosafe.representations import STAGES
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.haircell import METHODS, InnerHairCell
from rosafe.representations.registry import CORE_KINDS

RATE = 44100
BLOCK = 12000


class Case(NamedTuple):
    """A stage in a configuration."""

    kind: str
    text: str
    parameters: dict[str, Any]
    channels: int = 31
    rate: int = RATE
    block: int = BLOCK
    times: float = 1.0  # units of work relative to the default configuration; the expected relative cost


# The unit of work of each stage, to which the time should be proportional.
UNITS = {
    "gammatone": "a sample of eight channels of an ear (which are filtered at a time) through four poles",
    "ihc": "a sample of eight rows (channels of an ear); four samples for bernstein, which needs a power",
    "ild": "a sample, or its product with a window if there are more than two products per sample",
    "ratemap": "a sample, or its product with a window if there are more than two products per sample",
    "crossCorrelation": "a product of two samples of a frame; a sample's window costs as much as sixty",
}
ROWS_AT_ONCE = 8
WINDOWING = 60


def cases() -> list[Case]:
    """Return all cases to measure; the first of each kind is the default."""
    found = []
    for kind in UNITS:
        found.append(Case(kind, "default", {}))
        found += [
            Case(kind, f"{n} channels", _channels(kind, n), n, times=_rows(kind, n))
            for n in (1, 2, 3, 4, 8, 16, 64, 128, 256)
        ]
        for rate in (16000, 48000, 96000, 192000):
            found.append(Case(kind, f"{rate} Hz", _rate(kind, rate), rate=rate, times=_work(kind, rate)))
        found += [Case(kind, f"blocks of {n}", {}, block=n) for n in (882, 4096, 44100)]
    found += [Case("gammatone", f"{n} poles", {"fb_nGamma": n}, times=max(n, 4) / 4) for n in (1, 2, 5, 8, 16, 64)]
    found += [Case("ihc", m, {"ihc_method": m}, times=4 if m == "bernstein" else 1) for m in METHODS]
    for prefix, kind in (("ild", "ild"), ("rm", "ratemap"), ("cc", "crossCorrelation")):
        for size, hop in ((20, 1), (20, 5), (20, 7), (20, 15), (20, 50), (5, 2), (100, 50), (500, 10)):
            parameters = {f"{prefix}_wSizeSec": size / 1000, f"{prefix}_hSizeSec": hop / 1000}
            products = size / hop / 2
            times = products if kind == "crossCorrelation" else max(1, products)
            found.append(Case(kind, f"{size} ms every {hop} ms", parameters, times=times))
        found.append(Case(kind, "blackman", {f"{prefix}_wname": "blackman"}))
    found.append(Case("ratemap", "magnitude", {"rm_scaling": "magnitude"}))
    for delay in (0.02, 0.1, 0.5, 2, 5, 10, 15, 20):
        parameters = {"cc_maxDelaySec": delay / 1000}
        found.append(Case("crossCorrelation", f"{_lags(delay, RATE)} lags", parameters, times=_products(delay, RATE)))
    return found


def _channels(kind: str, number: int) -> dict[str, Any]:
    return {"fb_nChannels": number} if kind == "gammatone" else {}


def _rate(kind: str, rate: int) -> dict[str, Any]:
    return {"fb_highFreqHz": 7000.0} if kind == "gammatone" and rate == 16000 else {}


def _rows(kind: str, channels: int) -> float:
    """Return rows relative to the default; for kernels with one row per lane, whole registers."""
    if kind not in ("gammatone", "ihc", "ratemap"):
        return channels / 31
    ears_at_once = 1 if kind == "gammatone" else 2
    registers, default = (-(-ears_at_once * n // ROWS_AT_ONCE) for n in (channels, 31))
    return registers / default


def _lags(delay: float, rate: int) -> int:
    return 2 * math.ceil(delay / 1000 * rate) + 1


def _products(delay: float, rate: int) -> float:
    return (_lags(delay, rate) + WINDOWING) / (_lags(1.1, RATE) + WINDOWING)


def _work(kind: str, rate: int) -> float:
    """Return samples per second relative to the default; for the correlation, products."""
    return rate / RATE * (_products(1.1, rate) if kind == "crossCorrelation" else 1)


def measure() -> dict[str, Any]:
    """Measure ms per second of sound of each case, and the cost per unit of work relative to the default."""
    result: dict[str, Any] = {}
    for case in cases():
        found = result.setdefault(case.kind, {})
        found[case.text] = {"ms": _cost(case)}
        found[case.text]["per unit"] = found[case.text]["ms"] / found["default"]["ms"] / case.times
    return result


def _cost(case: Case) -> float:
    step, block = _prepared(case)
    times: list[float] = []
    enough = time.perf_counter() + 0.4
    while len(times) < 5 or (time.perf_counter() < enough and len(times) < 200):
        begin = time.thread_time()
        step(block)
        times.append(time.thread_time() - begin)
    return float(np.median(times[2:])) * 1000 * case.rate / case.block


def _prepared(case: Case) -> tuple[Callable[[np.ndarray], Any], np.ndarray]:
    stage = STAGES[case.kind](case.rate, **case.parameters)
    shape = (2, case.block) if case.kind == "gammatone" else (2, case.channels, case.block)
    block = np.random.default_rng(0).standard_normal(shape)
    if isinstance(stage, InnerHairCell) and stage.required_extra:
        hair_cell, envelope = stage, np.abs(block)
        return lambda block: hair_cell.process(block, envelope), block
    return stage.process, block


SMALL_BLOCKS = (1, 20, 50, 100, 200, 400, 800)


def small_blocks() -> dict[str, dict[str, float]]:
    """Measure microseconds per block of each stage for each of `SMALL_BLOCKS`: fixed and proportional cost."""
    result: dict[str, dict[str, float]] = {}
    for kind in UNITS:
        found = result.setdefault(kind, {})
        for size in SMALL_BLOCKS:
            step, block = _prepared(Case(kind, "", {}, block=size))
            blocks = max(200, 40 * 441 // size)  # many blocks: most small blocks complete no frame
            means = []
            for _ in range(5):
                begin = time.thread_time()
                for _ in range(blocks):
                    step(block)
                means.append((time.thread_time() - begin) / blocks)
            found[str(size)] = float(np.median(means)) * 1e6
    return result


# --- start-up, memory, silence ---

_FIRST = """
import sys, time
begin = time.perf_counter()
import numpy as np
from rosafe.dsp import kernels
from rosafe.representations import STAGES
from rosafe.representations.registry import CORE_KINDS
kernels.compiled()
loaded = time.perf_counter()
data = np.ones((2, 12000), np.int32)
for kind in CORE_KINDS:
    out = STAGES[kind](44100).process(data)
    if kind in ("input", "preProc", "gammatone", "ihc"):
        data = out
print(loaded - begin, time.perf_counter() - loaded)
"""


def first_block() -> dict[str, float]:
    """Measure a new process: seconds to import everything, and to set up the chain and compute a block of 12000."""
    root = Path(__file__).resolve().parents[1]
    runs = []
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", _FIRST], cwd=root, capture_output=True, text=True, check=True)
        runs.append([float(word) for word in done.stdout.split()])
    load, first = np.median(runs, axis=0)
    return {"load": float(load), "first block": float(first)}


def _chain() -> dict[str, Stage]:
    return {kind: STAGES[kind](RATE) for kind in CORE_KINDS}


def _through(stages: dict[str, Stage], block: Any) -> None:
    data = block
    hair_cell, filterbank = stages["ihc"], stages["gammatone"]
    assert isinstance(hair_cell, InnerHairCell) and isinstance(filterbank, Filterbank)
    filterbank.provide = frozenset({hair_cell.required_extra} - {""})
    for kind, stage in stages.items():
        envelope = filterbank.provided.get(hair_cell.required_extra)
        out: Any = hair_cell.process(data, envelope) if stage is hair_cell else stage.process(data)
        if kind in ("input", "preProc", "gammatone", "ihc"):
            data = out


def memory() -> dict[str, float]:
    """Measure memory of the default chain between blocks, and its peak without the input and output blocks, in MB."""
    tracemalloc.start()
    stages = _chain()
    block = np.ones((2, BLOCK), np.int32)
    for _ in range(5):
        _through(stages, block)
    held = tracemalloc.get_traced_memory()[0]
    peaks = []
    data: Any = block
    for kind, stage in stages.items():
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        out = stage.process(data)
        peaks.append(tracemalloc.get_traced_memory()[1] - before - out.nbytes)
        if kind in ("input", "preProc", "gammatone", "ihc"):
            data = out
    tracemalloc.stop()
    return {"state": held / 1e6, "scratch": max(peaks) / 1e6}


# Chains whose filters have tails: all alternatives for each filter.
TAILS: dict[str, dict[str, dict[str, Any]]] = {
    "default": {},
    **{f"ihc_method {method}": {"ihc": {"ihc_method": method}} for method in METHODS},
    "drnl": {"gammatone": {"fb_type": "drnl"}},
    "pp_bRemoveDC": {"preProc": {"pp_bRemoveDC": True}},
    "pp_bNormalizeRMS": {"preProc": {"pp_bNormalizeRMS": True}},
    "pp_bMiddleEarFiltering": {"preProc": {"pp_bMiddleEarFiltering": True}},
}


def silence(implementation: str, names: Sequence[str] = tuple(TAILS)) -> dict[str, float]:
    """Measure the cost of silence after sound relative to sound, including the blocks in which the filters decay."""
    os.environ["ROSAFE_KERNELS"] = "0" if implementation == "numpy" else "4"
    noise = (np.random.default_rng(0).standard_normal((2, BLOCK)) * 2e8).astype(np.int32)
    result = {}
    for name in names:
        stages = {kind: STAGES[kind](RATE, **TAILS[name].get(kind, {})) for kind in CORE_KINDS}
        ratios = []
        for _ in range(5):
            sound = [_timed(stages, noise) for _ in range(8)]
            still = [_timed(stages, np.zeros_like(noise)) for _ in range(8)]
            ratios.append(np.mean(still) / np.mean(sound[2:]))
        result[name] = float(np.median(ratios))
    return result


def _timed(stages: dict[str, Stage], block: np.ndarray) -> float:
    begin = time.thread_time()
    _through(stages, block)
    return time.thread_time() - begin
