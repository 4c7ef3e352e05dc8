"""Isolation of the import of plugins, the search path, and files that are not plugins."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.harness import ROOT, run_program

from .support import python
from .test_declarations import GOOD

SHOW = """
import json, os, sys
from rosafe.representations import BUILTIN, PLUGINS, PROBLEMS, STAGES, WARNINGS
print(json.dumps([sorted(set(STAGES) - BUILTIN), PROBLEMS, WARNINGS, os.getcwd(), os.environ.get("PATH"), sys.path]))
"""


def good(kind: str, first: str = "") -> str:
    """Return a plugin with further code at the top."""
    return f"{first}\n{GOOD.format(kind=kind)}"


def rosafe(*words: str, folder: Path, **env: str) -> subprocess.CompletedProcess[str]:
    return run_program(
        [str(ROOT / "scripts" / "rosafe"), *words], env={**os.environ, "ROSAFE_PLUGINS": str(folder), **env}
    )


def test_side_effects_of_an_import_are_undone(tmp_path: Path) -> None:
    """Output, working directory, environment, search path and error handling do not affect the next plugin."""
    mischief = (
        "import os, sys, numpy\nprint('PRINTED')\nos.system('echo PRINTED')\nos.write(1, b'PRINTED')\n"
        "os.chdir('/')\nos.environ['PATH'] = ''\nsys.path.insert(0, '/nowhere')\nnumpy.seterr(all='raise')\n"
    )
    (tmp_path / "a.py").write_text(good("mischief", mischief))
    (tmp_path / "b.py").write_text(good("second", "import os\nassert os.environ['PATH'] and os.getcwd() != '/'"))
    done = python(SHOW + "import numpy; assert numpy.geterr()['divide'] == 'warn'", tmp_path)
    assert done.returncode == 0, done.stderr
    kinds, problems, _, where, path, search = json.loads(done.stdout)
    assert (kinds, problems) == (["mischief", "second"], [])
    assert (where, path) == (os.getcwd(), os.environ["PATH"])
    assert "/nowhere" not in search
    assert done.stderr.count("PRINTED") == 3


def test_output_of_plugins_is_not_evaluated_by_the_shell(tmp_path: Path) -> None:
    touched = [tmp_path / name for name in ("one", "two", "three")]
    first = (
        f"import os, atexit\nprint('touch {touched[0]}')\nos.system('echo touch {touched[1]}')\n"
        f"atexit.register(print, 'touch {touched[2]}')"
    )
    (tmp_path / "prints.py").write_text(good("prints", first))
    show = "import rosAFE.srv; print(hasattr(rosAFE.srv, 'PrintsProc'))"
    done = run_program(
        ["bash", "-c", f'. {ROOT}/scripts/env.sh && /usr/bin/python3 -c "{show}"'],
        env={**os.environ, "ROSAFE_PLUGINS": str(tmp_path)},
    )
    assert done.stdout == "True\n", done
    assert not any(path.exists() for path in touched)
    assert all(f"touch {path}" in done.stderr for path in touched)


def test_files_that_are_not_plugins(tmp_path: Path) -> None:
    """Helper modules are found, last on the path, and not reported; dataclasses find their module; two equal names."""
    (tmp_path / "helper.py").write_text("VALUE = 3\n")
    (tmp_path / "json.py").write_text("raise RuntimeError('it replaced a module of Python')\n")
    for name in (".hidden", "_private", "test_it"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('it was imported')\n")
    first = (
        "from __future__ import annotations\nimport dataclasses, helper, json\nassert json.dumps(helper.VALUE) == '3'\n"
        "@dataclasses.dataclass\nclass Held:\n    value: int\n    kind: dataclasses.InitVar[int] = 0\n"
    )
    (tmp_path / "uses.py").write_text(good("uses", first))
    other = tmp_path / "other"
    other.mkdir()
    (other / "uses.py").write_text(good("also"))
    folders = f"{tmp_path}{os.pathsep}{other}"
    kinds, problems, _, _, _, search = json.loads(python(SHOW, tmp_path, ROSAFE_PLUGINS=folders).stdout)
    assert kinds == ["also", "uses"]
    assert [line for line in problems if "/json.py: " not in line] == []
    assert search[-2:] == [str(tmp_path), str(other)]


def test_entry_points_name_modules_or_classes(tmp_path: Path) -> None:
    site = tmp_path / "site"
    (site / "crossings-1.0.dist-info").mkdir(parents=True)
    (site / "whole.py").write_text(good("whole"))
    (site / "single.py").write_text(good("single") + "\n\nNUMBER = 5\n")
    (site / "crossings-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: crossings\nVersion: 1.0\n")
    points = "[rosafe.representations]\na = whole\nb = single:Mine\nc = single:NUMBER\nd = single:Nothing\ne = none\n"
    (site / "crossings-1.0.dist-info" / "entry_points.txt").write_text(points)
    done = python(SHOW, tmp_path, ROSAFE_PLUGINS="", PYTHONPATH=f"{site}:{ROOT}")
    kinds, problems, *_ = json.loads(done.stdout)
    assert kinds == ["single", "whole"]
    reasons = "c (single:NUMBER): 5: REPRESENTATION: expected", "d (single:Nothing): AttributeError", "e (none): Module"
    for line, reason in zip(sorted(problems), reasons, strict=True):
        assert reason in line


def test_folders_that_others_can_write_are_reported(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(good("mine"))
    tmp_path.chmod(0o755)
    assert json.loads(python(SHOW, tmp_path).stdout)[2] == []
    tmp_path.chmod(0o777)
    (tmp_path / "mine.py").chmod(0o666)
    kinds, _, warnings, *_ = json.loads(python(SHOW, tmp_path).stdout)
    assert kinds == ["mine"]
    assert [line.partition(", and plugins run")[0] for line in warnings] == [
        f"{tmp_path}: can be changed by all users",
        f"{tmp_path}/mine.py: can be changed by all users",
    ]


def test_a_folder_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    _, problems, *_ = json.loads(python(SHOW, loop).stdout)
    assert problems[0].startswith(f"{loop}: ROSAFE_PLUGINS: expected a readable folder, got: ")
    file = tmp_path / "file"
    file.write_text("")
    _, problems, *_ = json.loads(python(SHOW, file).stdout)
    assert "Not a directory" in problems[0]


def test_a_boolean_with_the_default_true_gives_a_warning(tmp_path: Path) -> None:
    text = good("flagged").replace('"double", 1.0, "Gain", minimum=0.0, maximum=2.0', '"boolean", True, "Flag"')
    (tmp_path / "flagged.py").write_text(text)
    _, problems, (warning,), *_ = json.loads(python(SHOW, tmp_path).stdout)
    assert problems == []
    assert "flagged_gain has the default True" in warning
    assert "declare the inverse parameter" in warning
    done = rosafe("check", str(tmp_path / "flagged.py"), folder=tmp_path)
    assert done.returncode == 0
    assert "flagged_gain has the default True" in done.stdout


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["nonsense"], ["record", "--help"], ["trace", "--help"]])
def test_commands_without_computation_import_no_plugins(tmp_path: Path, words: list[str]) -> None:
    seen = tmp_path / "seen"
    (tmp_path / "mine.py").write_text(good("mine", f"open({str(seen)!r}, 'w')"))
    rosafe(*words, folder=tmp_path)
    assert not seen.exists()


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        ("import os; os._exit(7)", "ended with exit status 7"),
        ("import ctypes; ctypes.string_at(0)", "ended with signal SIGSEGV"),
        ("import signal; signal.pause()", "did not end within 10 s"),
    ],
)
def test_doctor_and_check_survive_the_import(tmp_path: Path, first: str, reason: str) -> None:
    file = tmp_path / "ends.py"
    file.write_text(good("ends", first))
    done = rosafe("check", str(file), folder=Path())
    assert done.returncode == 1
    assert f"{file}: " in done.stdout and reason in done.stdout
    if "7" in first:
        reported = rosafe("doctor", folder=tmp_path).stdout
        assert f"{file}: " in reported and reason in reported and "Traceback" not in reported


def test_check_reports_failures_and_successes(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    empty = tmp_path / "empty"
    empty.mkdir()
    file.write_text(good("mine", "print('noise')"))
    done = rosafe("check", str(file), folder=empty)
    assert (done.returncode, done.stdout.split()[:3]) == (0, ["ok", f"{file}:", "mine:"])
    assert "mine takes " in done.stdout  # its running time
    file.write_text(good("ild"))
    done = rosafe("check", str(file), folder=tmp_path)
    assert done.returncode == 1
    assert done.stdout.startswith(f"ERROR   {file}: ild: ")
    file.write_text("")
    done = rosafe("check", str(file), folder=empty)
    assert done.returncode == 1 and "expected a class with a REPRESENTATION" in done.stdout
    done = rosafe("check", str(tmp_path / "none.py"), folder=empty)
    assert done.returncode == 1 and "expected a Python file" in done.stderr
