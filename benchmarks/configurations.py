"""What other configurations cost per unit of work, and what else there is to know: first block, memory, silence."""

from __future__ import annotations

import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rosafe.dsp import STAGES, InnerHairCell, Stage
from rosafe.dsp.haircell import METHODS

RATE = 44100
BLOCK = 12000


class Case(NamedTuple):
    """One stage in one configuration."""

    kind: str
    text: str
    parameters: dict[str, Any]
    channels: int = 31
    rate: int = RATE
    block: int = BLOCK
    times: float = 1.0  # units of work for one of `kind`'s default configuration: what it may cost in proportion


def cases() -> list[Case]:
    """What is measured; the first of each kind is the default."""
    found = []
    for kind in ("gammatone", "ihc", "ild", "ratemap", "crossCorrelation"):
        found.append(Case(kind, "default", {}))
        found += [
            Case(kind, f"{n} channels", _channels(kind, n), n, times=n / 31) for n in (1, 2, 3, 4, 8, 16, 64, 128, 256)
        ]
        for rate in (16000, 48000):
            found.append(Case(kind, f"{rate} Hz", _rate(kind, rate), rate=rate, times=_work(kind, rate)))
        found += [Case(kind, f"blocks of {n}", {}, block=n) for n in (441, 882, 4096, 44100)]
    found += [Case("gammatone", f"{n} poles", {"fb_nGamma": n}, times=max(n, 4) / 4) for n in (1, 2, 5, 8, 16, 64)]
    found += [Case("ihc", method, {"ihc_method": method}) for method in METHODS]
    for prefix, kind in (("ild", "ild"), ("rm", "ratemap"), ("cc", "crossCorrelation")):
        for size, hop in ((20, 1), (20, 5), (20, 7), (20, 15), (20, 50), (5, 2), (100, 50), (500, 10)):
            parameters = {f"{prefix}_wSizeSec": size / 1000, f"{prefix}_hSizeSec": hop / 1000}
            found.append(Case(kind, f"{size} ms every {hop} ms", parameters, times=max(1, size / hop / 2)))
        found.append(Case(kind, "blackman", {f"{prefix}_wname": "blackman"}))
    found.append(Case("ratemap", "magnitude", {"rm_scaling": "magnitude"}))
    for delay in (0.02, 0.1, 0.5, 2, 5, 10, 15, 20):
        lags = 2 * np.ceil(delay / 1000 * RATE) + 1
        parameters = {"cc_maxDelaySec": delay / 1000}
        found.append(Case("crossCorrelation", f"{lags:.0f} lags", parameters, times=max(1, lags / 99)))
    return found


def _channels(kind: str, number: int) -> dict[str, Any]:
    return {"fb_nChannels": number} if kind == "gammatone" else {}


def _rate(kind: str, rate: int) -> dict[str, Any]:
    return {"fb_highFreqHz": 7000.0} if kind == "gammatone" and rate == 16000 else {}


def _work(kind: str, rate: int) -> float:
    """Samples per second; for the correlation, times lags."""
    return (rate / RATE) ** (2 if kind == "crossCorrelation" else 1)


def measure() -> dict[str, Any]:
    """ms per second of sound of each case, and what a unit of work costs for one of the default configuration."""
    result: dict[str, Any] = {}
    for case in cases():
        found = result.setdefault(case.kind, {})
        found[case.text] = {"ms": _cost(case)}
        found[case.text]["per unit"] = found[case.text]["ms"] / found["default"]["ms"] / case.times
    return result


def _cost(case: Case) -> float:
    stage = STAGES[case.kind](case.rate, **case.parameters)
    rng = np.random.default_rng(0)
    shape = (2, case.block) if case.kind == "gammatone" else (2, case.channels, case.block)
    block = rng.standard_normal(shape)
    times = []
    enough = time.perf_counter() + 0.4
    while len(times) < 5 or (time.perf_counter() < enough and len(times) < 200):
        begin = time.thread_time()
        _process(stage, block)
        times.append(time.thread_time() - begin)
    return float(np.median(times[2:])) * 1000 * case.rate / case.block


def _process(stage: Stage, block: np.ndarray) -> np.ndarray:
    if isinstance(stage, InnerHairCell) and stage.needs_envelope:
        return stage.process(block, np.abs(block))
    return stage.process(block)


# --- the rest ---

_FIRST = """
import sys, time
begin = time.perf_counter()
import numpy as np
from rosafe.dsp import STAGES, kernels
kernels.compiled()
loaded = time.perf_counter()
taken = np.ones((2, 12000), np.int32)
for kind, stage in STAGES.items():
    out = stage(44100).process(taken)
    if kind in ("input", "preProc", "gammatone", "ihc"):
        taken = out
print(loaded - begin, time.perf_counter() - loaded)
"""


def first_block() -> dict[str, float]:
    """Seconds of a new process: to load everything, and then from the request to the first block of 12000."""
    root = Path(__file__).resolve().parents[1]
    runs = []
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", _FIRST], cwd=root, capture_output=True, text=True, check=True)
        runs.append([float(word) for word in done.stdout.split()])
    load, first = np.median(runs, axis=0)
    return {"load": float(load), "from request to block": float(first)}


def _chain() -> dict[str, Stage]:
    return {kind: stage(RATE) for kind, stage in STAGES.items()}


def _through(stages: dict[str, Stage], block: np.ndarray) -> None:
    taken = block
    for kind, stage in stages.items():
        out = stage.process(taken)
        if kind in ("input", "preProc", "gammatone", "ihc"):
            taken = out


def memory() -> dict[str, float]:
    """Of the default chain: what it holds between blocks, and the most at any time less the block in and out."""
    tracemalloc.start()
    stages = _chain()
    block = np.ones((2, BLOCK), np.int32)
    for _ in range(5):
        _through(stages, block)
    held = tracemalloc.get_traced_memory()[0]
    peaks = []
    taken = block
    for kind, stage in stages.items():
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        out = stage.process(taken)
        peaks.append(tracemalloc.get_traced_memory()[1] - before - out.nbytes)
        if kind in ("input", "preProc", "gammatone", "ihc"):
            taken = out
    tracemalloc.stop()
    return {"state": held / 1e6, "scratch": max(peaks) / 1e6}


def silence() -> float:
    """What silence after sound costs, for what sound costs."""
    stages = _chain()
    noise = (np.random.default_rng(0).standard_normal((2, BLOCK)) * 2e8).astype(np.int32)
    spent = {}
    for name, block in (("sound", noise), ("silence", np.zeros_like(noise))):
        times = []
        for _ in range(20):
            begin = time.thread_time()
            _through(stages, block)
            times.append(time.thread_time() - begin)
        # of silence, the first blocks are the ones that decay: all count
        spent[name] = float(np.mean(times[:10]) if name == "silence" else np.median(times[2:]))
    return spent["silence"] / spent["sound"]
