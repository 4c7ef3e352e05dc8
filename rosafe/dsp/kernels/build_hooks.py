"""For pip, which pyproject.toml tells of it: puts the compiled kernels into a wheel where there is a compiler."""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools.command.build_py import build_py

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # before setuptools 70.1
    from wheel.bdist_wheel import bdist_wheel

COMPILES = bool(shutil.which("gcc")) and platform.system() == "Linux" and platform.machine() in ("x86_64", "aarch64")


class BuildPy(build_py):  # type: ignore[misc]
    """The modules, and the libraries beside their sources; where that fails, it is tried again at first use."""

    def run(self) -> None:
        """Build."""
        if not self.editable_mode:
            shutil.rmtree(self.build_lib, ignore_errors=True)  # what is gone by now, older builds still have
        super().run()
        if COMPILES and not self.editable_mode:
            built = Path(self.build_lib, "rosafe", "dsp", "kernels")
            subprocess.run([sys.executable, built / "build.py", built], stdout=subprocess.DEVNULL, check=False)
            (built / "kernels.lock").unlink(missing_ok=True)


class Wheel(bdist_wheel):  # type: ignore[misc]
    """Of one platform if anything is compiled, and for any Python 3: the libraries are not linked with it."""

    def initialize_options(self) -> None:
        """Tell the other commands."""
        super().initialize_options()
        self.distribution.has_ext_modules = lambda: COMPILES

    def get_tag(self) -> tuple[str, str, str]:
        """Python, its ABI, the platform."""
        return "py3", "none", super().get_tag()[2]
