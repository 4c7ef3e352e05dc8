"""A process in which sanitizers check the kernels: python3 -m tests.dsp.sanitized FOLDER LEVELS COMMAND [ARGUMENT...]

tests/dsp/test_sanitizers.py builds the kernels in FOLDER and starts this program. COMMAND:

    pytest ARGUMENT...   run pytest
    fuzz CASES           process random blocks with the kernels of the newest level
    overflow             write beyond an array, which the sanitizer must report
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rosafe.declarations.idl import SCALARS, element
from rosafe.declarations.parameter import Parameter
from rosafe.dsp import kernels
from rosafe.dsp.kernels import build, loader
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage, parts_of
from rosafe.representations import STAGES

FloatArray = NDArray[np.float64]

RATES = (8000.0, 16000.0, 44100.0)  # Hz
MAX_SECONDS = 0.03  # of windows and delays
MAX_COUNT = 24  # channels, and values of integer parameters
SPECIAL_VALUES = (np.nan, np.inf, -np.inf, 5e-324, -1e-310, 0.0, -0.0, 1e308, -1e300, 1e-160)


def select_libraries(folder: Path, levels: list[int]) -> None:
    """Make this process use the kernels in `folder`, which has only these `levels`."""
    names = build.ISA_LEVELS[platform.machine()]
    build.ISA_LEVELS = {platform.machine(): {level: names[level] for level in levels}}
    build.place = lambda: folder


# --- random stages ----------------------------------------------------------------------------------------------


def number(rng: np.random.Generator, parameter: Parameter, idl: str) -> Any:
    """Draw a number within the range of a parameter: an end, or one between them."""
    if idl == "boolean":
        return bool(rng.integers(2))
    low = -100.0 if parameter.minimum is None else parameter.minimum
    high = 10000.0 if parameter.maximum is None else parameter.maximum
    if parameter.unit == "s":
        high = max(low, min(high, MAX_SECONDS))
    if SCALARS[idl].bounds is not None:
        return int(rng.integers(int(low), min(int(high), int(low) + MAX_COUNT) + 1))
    way = rng.random()
    if way < 0.1:
        return low
    if way < 0.2:
        return high
    if way < 0.6 and low >= 0:
        return float(np.geomspace(max(low, 1e-4), max(high, 1e-4), 1000)[rng.integers(1000)])
    return float(rng.uniform(low, high))


def value(rng: np.random.Generator, parameter: Parameter) -> Any:
    """Draw a value for a parameter; it may be invalid in combination with others."""
    if parameter.choices:
        return str(rng.choice(parameter.choices))
    if of := element(parameter.idl):
        count = int(rng.integers(parameter.least, min(parameter.most, MAX_COUNT) + 1))
        return sorted(number(rng, parameter, of) for _ in range(count))
    return number(rng, parameter, parameter.idl)


def some_parameters(rng: np.random.Generator, stage: type[Stage]) -> dict[str, Any]:
    """Draw values for some parameters of a stage. Windows and delays are always short, since long ones take long."""
    declared = [p for p in stage.REPRESENTATION.parameters if p.idl in SCALARS or element(p.idl) in SCALARS]
    chosen = [p for p in declared if p.idl != "string" or p.choices]
    return {p.name: value(rng, p) for p in chosen if rng.random() < (0.6 if p.unit == "s" else 0.3)}


def stage_of(rng: np.random.Generator, kind: str) -> tuple[Stage, tuple[int, ...]] | None:
    """Return a random stage and the shape of its input without the time axis; None if the parameters do not fit."""
    chain = [kind]
    while parent := STAGES[chain[0]].REPRESENTATION.parent:
        chain.insert(0, parent)
    given: SignalFormat | float = float(rng.choice(RATES))
    rows: tuple[int, ...] = (2,)
    for above in chain[:-1]:
        parameters = {"fb_nChannels": int(rng.integers(1, MAX_COUNT))} if above == "gammatone" else {}
        stage = STAGES[above](given, **parameters)
        given, rows = stage.output_format, stage.part_rows(rows)[0]
    try:
        return STAGES[kind](given, **some_parameters(rng, STAGES[kind])), rows
    except ValueError:
        return None


def block_of(rng: np.random.Generator, rows: tuple[int, ...]) -> FloatArray:
    """Draw a block: any length, contiguous or a view with other strides, with or without special values."""
    count = int(rng.choice([0, 1, 2, 3, 7, 64, rng.integers(1, 1500)]))
    block = rng.standard_normal((*rows, count)) * 10.0 ** rng.integers(-160, 4)
    if rng.random() < 0.3:
        block[rng.random(block.shape) < 10.0 ** rng.uniform(-3, 0)] = rng.choice(SPECIAL_VALUES)
    views: tuple[Callable[[], FloatArray], ...] = (
        lambda: np.asfortranarray(block),
        lambda: block[..., ::-1],
        lambda: np.repeat(block, 2, axis=-1)[..., ::2],
        lambda: np.broadcast_to(block[..., :1], block.shape),
    )
    return views[rng.integers(len(views))]() if rng.random() < 0.3 else block


def process(rng: np.random.Generator, stage: Stage, block: FloatArray) -> None:
    """Process a block, with an output array in place of the block or larger than necessary."""
    arguments: dict[str, Any] = {}
    if stage.required_extra:
        arguments["extra"] = np.abs(block)
    if stage.EXTRAS:
        stage.provide = frozenset(stage.EXTRAS if rng.random() < 0.5 else ())
    if stage.TAKES_OUT and rng.random() < 0.5:
        if stage.SUPPORTS_IN_PLACE and block.flags.c_contiguous and rng.random() < 0.5:
            arguments["out"] = block
        else:
            shape = (*stage.output_rows(block.shape[:-1]), block.shape[-1])
            arguments["out"] = np.empty((*shape[:-1], shape[-1] + int(rng.integers(3))))[..., : shape[-1]]
    for part in parts_of(stage.process(block, **arguments)):
        part.sum()  # reads each element


def fuzz(cases: int) -> None:
    """Process random blocks by random stages. Invalid combinations of parameters and NaN as input are refused."""
    done = dict.fromkeys(STAGES, 0)
    refused = 0
    for case in range(cases):
        rng = np.random.default_rng(case)
        kind = list(STAGES)[case % len(STAGES)]
        print(f"case {case}: {kind}", file=sys.stderr)  # a report of the sanitizer follows the line of its case
        made = stage_of(rng, kind)
        if made is None:
            refused += 1
            continue
        stage, rows = made
        for _ in range(int(rng.integers(1, 6))):
            try:
                process(rng, stage, block_of(rng, rows))
                if rng.random() < 0.2:
                    stage.configure(**some_parameters(rng, STAGES[kind]))
                done[kind] += 1
            except ValueError:
                refused += 1
        pieces = [rng.standard_normal((*rows, int(n))) for n in rng.integers(0, 40, rng.integers(1, 5))]
        whole = np.empty((*rows, sum(piece.shape[-1] for piece in pieces)))
        kernels.concatenate(pieces, whole)
        likelihood = rng.random((int(rng.integers(0, 40)), kernels.DIRECTIONS), np.float32)
        kernels.mixture(likelihood, 3, np.full(kernels.DIRECTIONS + 1, 0.01, np.float32)).sum()
        evidence(rng, *rng.integers(1, 9, 2))
    assert all(done.values()), f"kinds without a processed block: {[kind for kind in done if not done[kind]]}"
    print(f"{sum(done.values())} blocks, {refused} refusals, {time.process_time():.0f} s", flush=True)


def evidence(rng: np.random.Generator, frames: int, channels: int) -> None:
    """Look up cues in tables of one row for each channel and class."""
    tables = [rng.random((3 * channels, kernels.DIRECTIONS)).astype(np.float32) for _ in range(2)]
    late = [rng.random(3 * channels).astype(np.float32) for _ in range(2)]
    tables_of = kernels.EvidenceTables(tables[0], tables[1], late[0], late[1], 1, 1, 3, 2.0)
    rows = np.tile(3 * np.arange(channels), (frames, 1))
    valid = rng.random(rows.shape) < 0.5
    cues = rows, rows.copy(), rng.uniform(-5, 10, rows.shape), valid
    sums, floor, all_frames = np.zeros((channels, kernels.DIRECTIONS)), np.zeros(channels), np.arange(frames)
    tables_of.add(sums, cues, floor, all_frames, rng.random(channels) < 0.5, -1.0)
    factors = rng.random((2, channels, 1)).astype(np.float32)
    tables_of.units(cues, floor, all_frames, int(valid.sum()), factors).sum()


def overflow() -> None:
    """Write two numbers into an array for one, by a kernel."""
    block, table = np.ones((1, 2)), np.zeros((2, 1), np.int64)
    table[:] = [[block.ctypes.data], [2]]
    small = np.empty(1)
    library = loader.loaded()[0]
    assert library is not None
    library.rosafe_concatenate(1, table[0].ctypes.data, table[1].ctypes.data, 1, small.ctypes.data, 2)


def main(arguments: list[str]) -> int:
    """Run one of the commands."""
    folder, levels, command, *rest = arguments
    select_libraries(Path(folder), [int(level) for level in levels.split(",")])
    np.seterr(all="ignore")
    if command == "pytest":
        return int(pytest.main(rest))
    assert kernels.compiled(), kernels.status().detail
    assert folder in kernels.status().detail
    if command == "fuzz":
        fuzz(int(rest[0]))
    else:
        overflow()
    return 0


if __name__ == "__main__":
    sys.stdout.flush()
    status = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(status)  # the libraries of some packages report errors at exit
