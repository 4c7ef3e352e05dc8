"""Benchmarks: a busy machine is rejected or reported, the references are correct, and short runs succeed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT

FOLDER = ROOT / "benchmarks"
TIMED = ("all", "blocks", "capture", "chain", "everything", "latency", "matlab", "ports", "streams")
CHEAP = ("itd", "ic", "onsetStrength", "offsetStrength", "spectralFeatures", "pitch", "onsetMap", "gabor", "moc")


def benchmark(name: str, *arguments: object, load: float = 0.1) -> subprocess.CompletedProcess[str]:
    env = {key: value for key, value in os.environ.items() if not key.startswith("ROS_")}
    env["ROSAFE_BENCHMARK_LOAD"] = str(load)
    command = [PYTHON, str(FOLDER / f"{name}.py"), *map(str, arguments)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)


# Runs the scripts that are its arguments, one after another, which imports the libraries once.
RUN_EACH = """
import runpy, sys
for path in sys.argv[1:]:
    sys.argv = [path]
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        print(end.code)
"""


def test_busy_machine_is_rejected() -> None:
    scripts = [str(FOLDER / f"{name}.py") for name in TIMED]
    env = {key: value for key, value in os.environ.items() if not key.startswith("ROS_")}
    env |= {"ROSAFE_BENCHMARK_LOAD": "0.51", "PYTHONPATH": f"{FOLDER}:{ROOT}"}
    command = [PYTHON, "-c", RUN_EACH, *scripts]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["1"] * len(TIMED)), done.stderr
    for name, line in zip(TIMED, done.stderr.splitlines(), strict=True):
        assert re.fullmatch(rf"{name}\.py: the load is 0\.51, above 0\.5: .*--loaded", line)


@pytest.mark.exploration
def test_load_is_printed_first(tmp_path: Path) -> None:
    """Both in the output and in the file. The run is short, with few trees."""
    short = ("--most", 1, "--trial", 1.5, "--seconds", 1.5, "--processes", 1, "--results", tmp_path)
    done = benchmark("streams", "--loaded", *short, load=7.25)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("* load before: 7.25, above 0.5: measured with --loaded")
    text = (tmp_path / "streams.md").read_text("utf-8")
    assert text.splitlines()[4].startswith("* load before: 7.25, above 0.5")
    assert re.search(r"^\d trees \(goal 60\) ran for 1\.5 s", text, re.MULTILINE)


@pytest.mark.parametrize(
    "wrong",
    [("streams", "--seconds", "0"), ("streams", "--most", "0"), ("everything", "--seconds", "-1")],
    ids=" ".join,
)
def test_impossible_arguments_are_rejected(wrong: tuple[str, ...]) -> None:
    done = benchmark(*wrong)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith(f"{wrong[0]}.py: error: --")


@pytest.mark.parametrize("kind", CHEAP)
def test_reference_agrees_with_the_representation(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    import kinds  # type: ignore[import-not-found]

    found = kinds.one(kind, 1)
    assert kinds.agrees(kind, found), found


def test_listed_benchmarks_are_those_of_the_document() -> None:
    listed = re.findall(r"benchmarks/(\w+\.py) ", benchmark("all", "--list").stdout)
    rows = re.findall(r"^\| (`benchmarks/.*?) \|", (ROOT / "docs" / "speed.md").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(re.findall(r"benchmarks/(\w+\.py)", " ".join(rows)))


def test_optimisations_are_in_the_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each can be removed by replacing text."""
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    import tricks  # type: ignore[import-not-found]

    for one in tricks.OPTIMISATIONS:
        source = (ROOT / "rosafe" / "dsp" / "kernels" / one.source).read_text("utf-8")
        assert all(old in source for old, _ in one.without), one.text
