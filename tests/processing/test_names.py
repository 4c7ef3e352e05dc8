"""The names of `import rosafe`: `dir` lists them, and each is imported on first use."""

from __future__ import annotations

import inspect
import subprocess

import rosafe
from tests.harness import PYTHON, ROOT


def test_dir_lists_all_names_and_each_has_help() -> None:
    assert set(rosafe.__all__) <= set(dir(rosafe))
    # a mapping, and a class with several constructors
    for name in set(dir(rosafe)) - {"__doc__", "__version__", "PRESETS", "Head", "Result"}:
        text = inspect.getdoc(getattr(rosafe, name)) or ""
        assert "Parameters\n----------" in text, name


def test_modules_are_imported_on_first_use() -> None:
    program = "import sys, rosafe; from rosafe import system"
    program += "; print([m for m in ('numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    program += "; rosafe.plot; rosafe.to_xarray; print('matplotlib' in sys.modules, 'xarray' in sys.modules)"
    done = subprocess.run([PYTHON, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "[]\nFalse False\n"
