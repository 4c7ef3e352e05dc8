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


def run(world: World, script: str, timeout: float = 60.0, folder: Path | None = None) -> str:
    """What `script` prints; AssertionError where it ends with an error.

    It may call ``show(name, value)``, and ``message(@() ...)`` for the identifier and message of an error, or ''.
    """
    needed()
    folder = folder or world.graph.home
    (folder / "show.m").write_text(SHOW)
    (folder / "message.m").write_text(MESSAGE)
    path = folder / "script.m"
    path.write_text(textwrap.dedent(script), "utf-8")
    in_folder = ("sh", "-c", 'cd "$1" && shift && exec "$@"', "sh", str(folder))
    done = world.graph.run(*in_folder, *COMMAND, path.name, timeout=timeout, check=True, stdin="", **environment(world))
    return done.stdout


def shown(world: World, script: str, timeout: float = 60.0, folder: Path | None = None) -> dict[str, Any]:
    """The values that `script` shows, by name."""
    lines = run(world, script, timeout, folder).splitlines()
    return {name: json.loads(text) for name, equals, text in (line.partition("=") for line in lines) if equals}
