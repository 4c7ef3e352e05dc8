"""pip: a wheel and an sdist are built, and the library works in an environment without ROS and optional packages.

The environment has only the dependencies of the wheel: links to Debian's packages instead of downloads from PyPI. The
tests need no network, and all other packages are absent.
"""

from __future__ import annotations

import email
import filecmp
import json
import os
import re
import shutil
import subprocess
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe.dsp.kernels import build
from rosafe.system.version import VERSION
from tests.harness import PYTHON, ROOT
from tests.packaging.clone import environment, fresh_copy, run

DEBIAN = Path("/usr/lib/python3/dist-packages")
NEEDED = ["numpy", "scipy", "tqdm", "soundfile.py", "_soundfile.py", "cffi", "_cffi_backend*.so", "pycparser", "ply"]
FOR_TESTS = ["pytest", "_pytest", "py", "py.py", "pluggy", "iniconfig", "packaging", "attr", "attrs", "hypothesis"]
FOR_TESTS += ["sortedcontainers"]
BUILD = "import setuptools.build_meta as backend, sys; getattr(backend, sys.argv[1])(sys.argv[2])"


class Venv:
    """A virtual environment with the wheel."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        self.folder = folder
        subprocess.run([PYTHON, "-m", "venv", "--without-pip", folder], check=True, capture_output=True)
        (self.packages,) = folder.glob("lib/python3*/site-packages")
        for pattern in (*NEEDED, *FOR_TESTS):
            for found in DEBIAN.glob(pattern):
                (self.packages / found.name).symlink_to(found)
        pip = [PYTHON, "-m", "pip", "--python", folder, "install", "--no-deps", "--no-index", "--quiet", wheel]
        subprocess.run([*map(str, pip)], check=True, capture_output=True, env=environment())

    def run(self, *command: str | Path, cwd: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment, without access to this checkout."""
        name, *arguments = command
        path = f"{self.folder / 'bin'}:/usr/bin:/bin"
        variables = environment(**{"PATH": path, **env})
        return run(self.folder / "bin" / name, *arguments, env=variables, cwd=cwd or self.folder)

    def python(self, program: str, **env: str) -> str:
        """Run Python code and return its output."""
        done = self.run("python", "-c", program, cwd=None, **env)
        assert (done.returncode, done.stderr) == (0, ""), done
        return done.stdout.strip()


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """The sdist of a new copy of this checkout, and the wheel that is built from it, with Debian's setuptools."""
    yield build_both(tmp_path_factory.mktemp("built"))


def build_both(folder: Path) -> dict[str, Path]:
    with fresh_copy() as copy:
        done = run(copy / "scripts" / "make-wheel", folder, env=environment(SOURCE_DATE_EPOCH="1700000000"))
    assert done.returncode == 0, done.stdout + done.stderr
    sdist, wheel = map(Path, done.stdout.splitlines())
    assert sorted(folder.iterdir()) == sorted([sdist, wheel])
    return {"sdist": sdist, "wheel": wheel}


@pytest.fixture(scope="module")
def venv(built: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Venv:
    return Venv(tmp_path_factory.mktemp("venv") / "of a user", built["wheel"])


def files_of_the_package() -> set[str]:
    return {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "rosafe").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.endswith((".so", ".lock"))
    }


def test_wheel_and_sdist_have_all_files(built: dict[str, Path]) -> None:
    """This fails for a new folder or type of file that is missing in them."""
    with zipfile.ZipFile(built["wheel"]) as wheel:
        names = {name for name in wheel.namelist() if name.startswith("rosafe/") and not name.endswith("/")}
        metadata = email.message_from_bytes(wheel.read(f"rosafe-{VERSION}.dist-info/METADATA"))
    libraries = {name for name in names if name.endswith(".so")}
    sums = {name for name in names if name.endswith(f"/{build.SUMS}")}
    assert names - libraries - sums == files_of_the_package() and len(sums) == bool(libraries)
    if shutil.which("gcc") and os.uname().machine == "x86_64":
        assert {Path(name).stem for name in libraries} == set(build.ISA_LEVELS["x86_64"].values())
        # auditwheel determines the manylinux tag from the symbols that the libraries need of the C library.
        assert re.fullmatch(rf"rosafe-{re.escape(VERSION)}-py3-none-manylinux_2_\d+_x86_64.whl", built["wheel"].name)
    assert (metadata["Name"], metadata["Version"]) == ("rosafe", VERSION)
    assert metadata["Requires-Python"] == ">=3.10" and metadata["Summary"] and metadata["Author-email"]
    expected = {"plot", "files", "dask", "notebook", "torch", "speech", "all"}
    assert set(metadata.get_all("Provides-Extra", [])) == expected
    with tarfile.open(built["sdist"]) as sdist:
        sources = {name.partition("/")[2] for name in sdist.getnames()}
    assert files_of_the_package() | {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"} <= sources
    for folder in ("docs", "examples"):
        own = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*") if path.is_file()}
        assert {name for name in own if "__pycache__" not in name} <= sources
    assert not any(name.endswith((".so", ".pyc")) or name.startswith(("tests", "build")) for name in sources)


@pytest.mark.exploration
def test_two_builds_are_equal(built: dict[str, Path], tmp_path: Path) -> None:
    for kind, path in build_both(tmp_path).items():
        assert filecmp.cmp(path, built[kind], shallow=False), path.name


def test_version_is_defined_once() -> None:
    assert VERSION not in (ROOT / "pyproject.toml").read_text("utf-8")


@pytest.mark.exploration
def test_library_tests_in_the_environment(venv: Venv, tmp_path: Path) -> None:
    """A part of this suite without a checkout: arguments and the reference numbers."""
    (tmp_path / "tests").mkdir()
    modules = ("__init__.py", "harness.py", "fork_server.py")
    for source in (
        ROOT / "tests" / name
        for name in (*modules, "processing", "results", "dsp", "representations", "tree", "vectors")
    ):
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / "tests" / source.name)
    (tmp_path / "pytest.ini").write_text(
        "[pytest]\naddopts = --import-mode=importlib -p no:cacheprovider\npythonpath=.\n"
    )
    tests = ["tests/processing/test_arguments.py", "tests/vectors"]
    done = venv.run("python", "-m", "pytest", "-q", *tests, cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    assert " passed" in done.stdout
    assert not (tmp_path / "rosafe").exists()


def test_results_of_the_wheel(venv: Venv) -> None:
    """With its kernels and with numpy, the numbers are those of the checkout."""
    program = (
        "import json, numpy, rosafe; from rosafe.dsp import kernels; "
        "x = numpy.random.default_rng(1).standard_normal((2, 4000)); "
        "r = rosafe.process(x, 16000, parameters={'fb_cfHz': [200.0, 1000.0]}, outputs=['ild', 'ratemap']); "
        "print(json.dumps([rosafe.__file__, kernels.compiled(), float(r['ild'].sum()), float(r['ratemap'].sum())]))"
    )
    expected = json.loads(run(PYTHON, "-c", program, env=environment(PYTHONPATH=str(ROOT))).stdout)
    kernels, numpy = json.loads(venv.python(program)), json.loads(venv.python(program, ROSAFE_KERNELS="0"))
    assert Path(kernels[0]).is_relative_to(venv.packages)
    assert kernels[1:] == expected[1:]
    assert not numpy[1] and numpy[2:] == pytest.approx(expected[2:], rel=1e-9)


@pytest.mark.exploration
def test_command_reports_missing_packages(venv: Venv, tmp_path: Path) -> None:
    assert venv.run("rosafe", "--version").stdout == f"rosafe {VERSION}\n"
    sound = tmp_path / "x.wav"
    assert venv.run("rosafe", "record", sound, "--device", "scene:", "--seconds", "0.2", "-q").returncode == 0
    done = venv.run("rosafe", "process", sound, "-o", tmp_path / "x.npz", "--outputs", "ild")
    assert done.returncode == 0 and (tmp_path / "x.npz").stat().st_size > 0, done
    doctor = venv.run("rosafe", "doctor", "--json")
    report = json.loads(doctor.stdout)
    assert doctor.returncode == 0 and report["ok"], doctor
    state = {check["name"]: check for check in report["checks"]}
    assert (state["python"]["state"], state["ROS"]["state"], state["plots"]["state"]) == ("ok", "note", "note")
    assert "x86-64" in state["kernels"]["detail"] or "numpy and scipy: " in state["kernels"]["detail"]
    cases: list[tuple[list[str | Path], str]] = [
        (["plot", sound], "matplotlib is not installed; pip install '.[plot]' in a checkout"),
        (["record", "--seconds", "1"], "is not installed; pip does not install it: run scripts/install of a checkout"),
        (["trace"], "is not installed; pip does not install it"),
        (["request", "ratemap"], "genpy is not installed; pip does not install it: run scripts/install of a checkout"),
        (["live"], "genpy is not installed; pip does not install it"),
        (["up"], "yaml is not installed; pip does not install it"),
        (["setup", "save", "x.yaml"], "yaml is not installed; pip does not install it"),
    ]
    for arguments, message in cases:
        done = venv.run("rosafe", *arguments)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done
        assert message in done.stderr


def test_tests_for_other_interpreters_exist() -> None:
    """tests/packaging/pythons is not part of the suite."""
    script = (ROOT / "tests" / "packaging" / "pythons").read_text("utf-8")
    copied = [f"tests/{name}" for name in re.findall(r"^cp -r (.*) \"", script, re.MULTILINE)[0].split()]
    named = copied + re.findall(r"tests/[\w/]+(?:\.py)?", script)
    assert len(named) > 8 and all((ROOT / path).exists() for path in named), named


@pytest.mark.exploration
def test_a_compiler_that_fails(tmp_path: Path) -> None:
    """pip would install a package that is slower; a wheel for others needs its kernels."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "gcc").write_text("#!/bin/sh\necho 'gcc: fatal error: no space' >&2\nexit 1\n")
    (programs / "gcc").chmod(0o755)
    with fresh_copy() as copy:
        done = run(copy / "scripts" / "make-wheel", tmp_path, env=environment(PATH=f"{programs}:/usr/bin:/bin"))
    assert done.returncode == 1 and done.stdout == ""
    assert "scripts/make-wheel: rosafe: gcc cannot build the kernels: gcc: fatal error: no space" in done.stderr


@pytest.mark.exploration
def test_without_a_compiler(tmp_path: Path) -> None:
    """The wheel is built for any machine, and the status reports that numpy and scipy are used."""
    programs = tmp_path / "bin"
    programs.mkdir()
    env = environment(PATH=str(programs))
    with fresh_copy() as copy:
        done = run(PYTHON, "-c", BUILD, "build_wheel", tmp_path, env=env, cwd=copy)
        assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"rosafe-{VERSION}-py3-none-any.whl"
    venv = Venv(tmp_path / "venv", wheel)
    done = venv.run("rosafe", "doctor", PATH=str(programs))
    (line,) = [line for line in done.stdout.splitlines() if "kernels" in line]
    assert line.startswith("note") and "numpy and scipy: " in line and "install gcc" in line
    assert done.returncode == 0, done
