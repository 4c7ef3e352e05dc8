"""Runs Octave scripts without a display in the graph of a test, and returns the values that they print."""

from __future__ import annotations

import json
import shutil
import textwrap
from pathlib import Path
from typing import Any

import pytest

from tests.web.genomix.world import World

COMMAND = ("octave-cli", "--norc", "--quiet", "--no-history")


def script(name: str) -> str:
    """Return a script in the folder `scripts`."""
    return (Path(__file__).with_name("scripts") / f"{name}.m").read_text("utf-8")


def require_program(program: str = "octave-cli") -> None:
    """Skip the test if Octave, or a program for its plots, is not installed."""
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed; scripts/install --tests brings it")


def environment(world: World) -> dict[str, str]:
    """Return environment variables with the address of genomixd."""
    return {"GENOMIXD": f"127.0.0.1:{world.port}", "LANG": "C.UTF-8", "DISPLAY": ""}


def command(folder: Path, text: str) -> tuple[str, ...]:
    """Return the command that runs a script in `folder`.

    The script may call ``show(name, value)``, and ``message(@() ...)``, which returns identifier and text of an error.
    """
    require_program()
    for name in ("show", "message"):
        (folder / f"{name}.m").write_text(script(name))
    path = folder / "script.m"
    path.write_text(textwrap.dedent(text), "utf-8")
    return ("sh", "-c", 'cd "$1" && shift && exec "$@"', "sh", str(folder), *COMMAND, path.name)


def values(output: str) -> dict[str, Any]:
    """Parse the values that a script has printed, by name."""
    lines = (line.partition("=") for line in output.splitlines())
    return {name: json.loads(text) for name, equals, text in lines if equals}


def run(world: World, script: str, timeout: float = 120.0, folder: Path | None = None) -> str:
    """Run `script` and return its output; raise AssertionError if it fails."""
    words = command(folder or world.graph.home, script)
    return world.graph.run(*words, timeout=timeout, check=True, stdin="", **environment(world)).stdout


def run_and_parse(world: World, script: str, timeout: float = 120.0, folder: Path | None = None) -> dict[str, Any]:
    """Run `script` and return the values that it prints, by name."""
    return values(run(world, script, timeout, folder))
