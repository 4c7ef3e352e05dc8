"""Build hooks for pip, named in pyproject.toml: they add the compiled kernels to a wheel if there is a compiler."""

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
    """Adds the libraries to the modules; if the build fails, the first use of the kernels tries again."""

    def run(self) -> None:
        """Copy the modules and build the libraries."""
        if not self.editable_mode:
            shutil.rmtree(self.build_lib, ignore_errors=True)  # may contain deleted modules of older builds
        super().run()
        if COMPILES and not self.editable_mode:
            built = Path(self.build_lib, "rosafe", "dsp", "kernels")
            subprocess.run([sys.executable, built / "build.py", built], stdout=subprocess.DEVNULL, check=False)
            (built / "kernels.lock").unlink(missing_ok=True)


class Wheel(bdist_wheel):  # type: ignore[misc]
    """A wheel for one platform if it contains libraries, and for any Python 3, as they are not linked with Python."""

    def initialize_options(self) -> None:
        """Mark the distribution as platform-specific for the other commands."""
        super().initialize_options()
        self.distribution.has_ext_modules = lambda: COMPILES

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of Python, ABI and platform."""
        return "py3", "none", super().get_tag()[2]
