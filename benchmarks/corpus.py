"""How well `rosafe process` uses the cores on a corpus of short files.

    /usr/bin/python3 benchmarks/corpus.py [--files 1000] [--seconds 1] [--rounds 3] [--dask]

Makes a corpus of speech-like noise, and compares one run on all of it (`--jobs` as many as cores) with one run on each
of its parts at the same time (`--jobs 1`, a part for each core). Files per second of the whole from the start of the
commands to the end of the last one; and the same without the start of a process, which is what a run on one file of a
frame takes. Rounds alternate; the medians count. At least 0.9 is wanted."""

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


def make(folder: Path, files: int, seconds: float, parts: int) -> list[Path]:
    """The corpus, in a folder for each part."""
    random = np.random.default_rng(1)
    for number in range(files):
        path = folder / f"part{number % parts}" / f"{number:06}.wav"
        path.parent.mkdir(parents=True, exist_ok=True)
        envelope = np.sin(np.pi * np.arange(int(seconds * RATE)) / RATE * 4) ** 2
        soundfile.write(path, envelope[:, np.newaxis] * random.normal(0, 0.1, (len(envelope), 2)), RATE)
    return [folder / f"part{part}" for part in range(parts)]


def run(*commands: tuple[str | Path, ...]) -> float:
    """Seconds until all of them have ended."""
    begun = time.monotonic()
    running = [subprocess.Popen([ROSAFE, "process", *map(str, command), *OPTIONS]) for command in commands]
    codes = [process.wait() for process in running]  # all of them
    if any(codes):
        raise SystemExit("a run has failed")
    return time.monotonic() - begun


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each file")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--dask", action="store_true", help="measure --dask local as well")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        folder, out = Path(name), Path(name, "out")
        parts = make(folder / "corpus", options.files, options.seconds, cores)
        make(folder / "one", 1, 0.02, 1)
        ways = {
            "one run": [(folder / "corpus", "-o", out)],
            f"{cores} runs": [(part, "-o", f"{out}{part.name}", "--jobs", "1") for part in parts],
        }
        if options.dask:
            ways["Dask"] = [(folder / "corpus", "-o", out, "--dask", "local")]
        took: dict[str, list[float]] = {way: [] for way in ways}
        starts = []
        for _ in range(options.rounds):
            for way, commands in ways.items():
                took[way].append(run(*commands))
                for made in folder.glob("out*"):
                    shutil.rmtree(made)
            starts.append(run((folder / "one", "-o", out)))
            shutil.rmtree(out)
        start = statistics.median(starts)
        print(f"{options.files} files of {options.seconds:g} s on {cores} cores; a start takes {start:.2f} s")
        median = {way: statistics.median(seconds) for way, seconds in took.items()}
        base = median[f"{cores} runs"]
        for way, seconds in median.items():
            speed = options.files / seconds
            ratio, without = base / seconds, (base - start) / (seconds - start)
            sound = options.files * options.seconds / seconds
            print(f"{way:10} {seconds:7.2f} s  {speed:6.1f} files/s  {sound:5.1f} x real time", end="  ")
            print(f"{ratio:.2f} of {cores} runs, {without:.2f} without the start")


if __name__ == "__main__":
    main()
