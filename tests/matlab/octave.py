"""Octave without a display, in the graph of a test: scripts run to their end, and what they show comes back."""

from __future__ import annotations

import json
import shutil
import textwrap
from pathlib import Path
from typing import Any

import pytest

from tests.genomix.world import World

COMMAND = ("octave-cli", "--norc", "--quiet", "--no-history")
SHOW = """\
function show(name, value)
  printf('%s=%s\\n', name, jsonencode(value));
end
"""
MESSAGE = """\
function text = message(work)
  text = '';
  try
    work();
  catch problem
    text = [problem.identifier ' ' problem.message];
  end
end
"""


def needed(program: str = "octave-cli") -> None:
    """Skip the test where Octave, or what it draws with, is missing."""
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed; scripts/install --tests brings it")


def environment(world: World) -> dict[str, str]:
    """What points Octave to the world's genomixd."""
    return {"GENOMIXD": f"127.0.0.1:{world.port}", "LANG": "C.UTF-8", "DISPLAY": ""}


def command(folder: Path, script: str) -> tuple[str, ...]:
    """The command that runs `script` in `folder`.

    The script may call ``show(name, value)``, and ``message(@() ...)``: the identifier and message of an error, or ''.
    """
    needed()
    (folder / "show.m").write_text(SHOW)
    (folder / "message.m").write_text(MESSAGE)
    path = folder / "script.m"
    path.write_text(textwrap.dedent(script), "utf-8")
    return ("sh", "-c", 'cd "$1" && shift && exec "$@"', "sh", str(folder), *COMMAND, path.name)


def values(printed: str) -> dict[str, Any]:
    """The values that a script has shown, by name."""
    lines = (line.partition("=") for line in printed.splitlines())
    return {name: json.loads(text) for name, equals, text in lines if equals}


def run(world: World, script: str, timeout: float = 120.0, folder: Path | None = None) -> str:
    """What `script` prints; AssertionError where it ends with an error."""
    words = command(folder or world.graph.home, script)
    return world.graph.run(*words, timeout=timeout, check=True, stdin="", **environment(world)).stdout


def shown(world: World, script: str, timeout: float = 120.0, folder: Path | None = None) -> dict[str, Any]:
    """The values that `script` shows, by name."""
    return values(run(world, script, timeout, folder))
