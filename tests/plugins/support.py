"""Python processes with folders of plugins."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from tests.harness import PYTHON, ROOT, run_program, wait_for
from tests.web.genomix import world as worlds

# For code of `python`: check_representation tries shorter sounds. tests/plugins/test_faults.py tries the usual ones.
SHORT = "from rosafe import testing\ntesting._LONG_SECONDS, testing._COST_SECONDS = 2.0, 0.1\n"


def python(code: str, folder: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a new process whose plugins are in `folder`."""
    return run_program(
        [PYTHON, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT), "ROSAFE_PLUGINS": str(folder), **env}
    )


@contextmanager
def world_with(folder: Path) -> Iterator[worlds.World]:
    """Run nodes with the plugins of a folder, and sound of a scene; their home is the parent of the folder."""
    with mock.patch.dict(os.environ, ROSAFE_PLUGINS=str(folder)), worlds.world(folder.parent) as world:
        world.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
        world.http.send("bass/Acquire", ["scene:", 20000, 1000])
        wait_for(lambda: "/bass/Audio" in world.graph.topics())
        yield world
