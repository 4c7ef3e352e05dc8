"""What `import rosafe` offers: all of it is told by `dir`, and nothing is loaded before it is asked for."""

from __future__ import annotations

import inspect
import subprocess

import rosafe
from tests.harness import PYTHON, ROOT


def test_dir_tells_all_and_all_of_it_has_help() -> None:
    assert set(rosafe.__all__) <= set(dir(rosafe))
    for name in set(dir(rosafe)) - {"__doc__", "__version__"}:
        text = inspect.getdoc(getattr(rosafe, name)) or ""
        assert "Parameters\n----------" in text, name


def test_nothing_is_loaded_before_it_is_asked_for() -> None:
    program = (
        "import sys, rosafe; dir(rosafe); print([m for m in ('numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    program += "; rosafe.plot; rosafe.to_xarray; print('matplotlib' in sys.modules, 'xarray' in sys.modules)"
    done = subprocess.run([PYTHON, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "[]\nFalse False\n"
