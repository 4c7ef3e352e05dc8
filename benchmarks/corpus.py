"""Use of the cores by `rosafe process` on a corpus of short files.

    /usr/bin/python3 benchmarks/corpus.py [--files 1000] [--seconds 1] [--rounds 3] [--dask]

Creates a corpus of speech-like noise. Compares one run on the whole corpus (one job per core) with simultaneous runs on
its parts (`--jobs 1`, one part per core). Prints files per second from the start of the commands to the end of the last
one, and the ratio with and without the start of a process, which is the time of a run on a single frame. Rounds
alternate; the results are medians. The goal is a ratio of at least 0.9."""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import soundfile

ROSAFE = Path(__file__).resolve().parents[1] / "scripts" / "rosafe"
RATE = 16000
OPTIONS = ("--set", "fb_highFreqHz=7000", "-q")


def create_corpus(folder: Path, files: int, seconds: float, parts: int) -> list[Path]:
    """Create the corpus, with one folder for each part, and return the folders."""
    random = np.random.default_rng(1)
    for number in range(files):
        path = folder / f"part{number % parts}" / f"{number:06}.wav"
        path.parent.mkdir(parents=True, exist_ok=True)
        envelope = np.sin(np.pi * np.arange(int(seconds * RATE)) / RATE * 4) ** 2
        soundfile.write(path, envelope[:, np.newaxis] * random.normal(0, 0.1, (len(envelope), 2)), RATE)
    return [folder / f"part{part}" for part in range(parts)]


def run(*commands: tuple[str | Path, ...]) -> float:
    """Run commands at the same time; return the seconds until all have ended."""
    begun = time.monotonic()
    running = [subprocess.Popen([ROSAFE, "process", *map(str, command), *OPTIONS]) for command in commands]
    codes = [process.wait() for process in running]  # wait for all before the check
    if any(codes):
        raise SystemExit("a run of rosafe process has failed")
    return time.monotonic() - begun


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=1.0, help="length of each file")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--dask", action="store_true", help="measure --dask local as well")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        folder, out = Path(name), Path(name, "out")
        parts = create_corpus(folder / "corpus", options.files, options.seconds, cores)
        create_corpus(folder / "one", 1, 0.02, 1)
        variants = {
            "one run": [(folder / "corpus", "-o", out)],
            f"{cores} runs": [(part, "-o", f"{out}{part.name}", "--jobs", "1") for part in parts],
        }
        if options.dask:
            variants["Dask"] = [(folder / "corpus", "-o", out, "--dask", "local")]
        durations: dict[str, list[float]] = {variant: [] for variant in variants}
        starts = []
        for _ in range(options.rounds):
            for variant, commands in variants.items():
                durations[variant].append(run(*commands))
                for result in folder.glob("out*"):
                    shutil.rmtree(result)
            starts.append(run((folder / "one", "-o", out)))
            shutil.rmtree(out)
        start = statistics.median(starts)
        print(f"{options.files} files of {options.seconds:g} s on {cores} cores; a start takes {start:.2f} s")
        median = {variant: statistics.median(seconds) for variant, seconds in durations.items()}
        base = median[f"{cores} runs"]
        for variant, seconds in median.items():
            speed = options.files / seconds
            ratio, without = base / seconds, (base - start) / (seconds - start)
            sound = options.files * options.seconds / seconds
            print(f"{variant:10} {seconds:7.2f} s  {speed:6.1f} files/s  {sound:5.1f} x real time", end="  ")
            print(f"{ratio:.2f} of {cores} runs, {without:.2f} without the start")


if __name__ == "__main__":
    main()
