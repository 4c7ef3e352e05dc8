"""Python processes with folders of plugins."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from tests.harness import PATIENCE, PYTHON, ROOT

# For code of `python`: check_representation tries shorter sounds. tests/plugins/test_faults.py tries the usual ones.
SHORT = "from rosafe import testing\ntesting._LONG_SECONDS, testing._COST_SECONDS = 2.0, 0.1\n"


def python(code: str, folder: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a new process whose plugins are in `folder`."""
    return subprocess.run(
        [PYTHON, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT), "ROSAFE_PLUGINS": str(folder), **env},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
