"""The limit of the chain's arithmetic on one core: its instructions, at the rate at which the core can execute them.

Used by benchmarks/chain.py. Counted are products and sums of registers that the kernels compute in the default
configuration; a fused product and sum is one. Bounds, loads, stores, and the transposition of rows are not counted.
"""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from rosafe.dsp import kernels
from rosafe.dsp.kernels import build

ROWS = 62  # 31 channels of two ears
FRAME_SECONDS, HOP_SECONDS, DELAY_SECONDS = 0.02, 0.01, 0.0011  # defaults of the frames and of cc_maxDelaySec
SECONDS = 0.2  # of each measurement
SOURCE = """
#include "vector.h"
int64_t numbers_per_register(void) { return LANES; }
double fused_products(int64_t times) {
    vec sums[12] = {};
    UNROLL for (int k = 0; k < 12; k++) sums[k] = all(k);
    for (int64_t i = 0; i < times; i++) {
        UNROLL for (int k = 0; k < 12; k++) sums[k] = fused(sums[k], all(0.5), all(1.0));
        __asm__ volatile("");
    }
    UNROLL for (int k = 1; k < 12; k++) sums[0] += sums[k];
    return sums[0][0];
}
"""


def instructions(rate: float) -> dict[str, float]:
    """Return the products and sums of each stage for a second of sound, as if a register had one number."""
    per_sample = {
        "gammatone": 2 + 4 * 2 + 2,  # rotation, four poles, rotation back
        "ihc": 5,  # one section
        "ild": 2 * 2,  # square and weight, in two frames
        "ratemap": 4 + 2 * 2,  # integration; square and weight, in two frames
    }
    frame, lags = round(FRAME_SECONDS * rate), 2 * int(np.ceil(DELAY_SECONDS * rate)) + 1
    ninth, ninth_lags = -(-frame // 9), -(-lags // 9)
    of_frame = 25 * ninth * ninth_lags  # products of a ninth of the samples and lags
    of_frame += (3 + 5) * 9 * (ninth + ninth_lags - 1) + (3 + 5) * 6 * ninth  # their inputs
    of_frame += (5 + 3) * 12 * ninth_lags + 2 * lags  # their combination, and the normalisation
    of_frame += 2 * 2 * frame  # window and energy
    found = {stage: count * ROWS * rate for stage, count in per_sample.items()}
    return {**found, "crossCorrelation": of_frame * ROWS / 2 / HOP_SECONDS}


def limits(rate: float, rounds: int) -> dict[str, float]:
    """Return the time in ms in which one core executes the instructions of each stage for a second of sound."""
    levels = build.ISA_LEVELS[platform.machine()]
    level = next(level for level, name in levels.items() if name in kernels.status().detail)
    with tempfile.TemporaryDirectory() as folder:
        library, source = Path(folder, "peak.so"), Path(folder, "peak.c")
        source.write_text(SOURCE)
        compiler = next(name for name in build.COMPILERS if shutil.which(name))
        options = (f"-march={levels[level]}", f"-I{build.HERE}", "-Wno-unused")
        subprocess.run([compiler, *build.FLAGS, *options, source, "-o", library], check=True)
        peak = ctypes.CDLL(str(library))
        run = peak.fused_products
        run.argtypes, run.restype = [ctypes.c_int64], ctypes.c_double
        rates = []
        for _ in range(rounds):
            done, begin = 0, time.thread_time()
            while time.thread_time() - begin < SECONDS:
                run(100000)
                done += 12 * 100000
            rates.append(done / (time.thread_time() - begin))
        per_ms = np.median(rates) / 1000 * peak.numbers_per_register()
    return {stage: count / per_ms for stage, count in instructions(rate).items()}
