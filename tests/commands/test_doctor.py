"""`rosafe doctor`: findings on a complete installation and on incomplete ones."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rosafe.commands import doctor
from rosafe.ros1.transport import paths
from tests.commands.command import environment, rosafe, rosafe_alone
from tests.harness import PYTHON, ROOT, Graph, free_port, run_program

EVERYTHING = ["python", "numbers", "kernels", "plugins", "sound files", "ROS", "messages", "ROS 2", "master", "address"]
EVERYTHING += ["alsaaudio", "speech", "sound devices", "HTTP server", "Tcl", "plots", "extras"]


def findings(done: subprocess.CompletedProcess[str]) -> dict[str, dict[str, str]]:
    """Return the checks by name, and assert that the exit code fits them."""
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["ok"] == (done.returncode == 0) == all(check["state"] != "MISSING" for check in report["checks"])
    return {check["name"]: check for check in report["checks"]}


def check(name: str, before: str = "", **env: str) -> doctor.Finding:
    """Return the finding of one check, in a new process that runs `before` first."""
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{before}\nimport json; from rosafe.commands import doctor\n"
        f"print(json.dumps(doctor.CHECKS[{name!r}]()))"
    )
    done = run_program([PYTHON, "-c", program], env=environment(**env), check=True)
    return doctor.Finding(*json.loads(done.stdout))


def test_complete_installation() -> None:
    done = rosafe("doctor", "--json", ROS_MASTER_URI=f"http://127.0.0.1:{free_port()}")
    assert done.returncode == 0, done
    found = findings(done)
    assert list(found) == EVERYTHING
    assert platform.python_version() in found["python"]["detail"] and "/usr/bin/python3" in found["python"]["detail"]
    assert "numpy" in found["numbers"]["detail"] and "scipy" in found["numbers"]["detail"]
    assert found["alsaaudio"]["state"] == "ok" and str(paths.PYPI_DIR) in found["alsaaudio"]["detail"]
    assert found["master"]["state"] == "note" and "roscore" in found["master"]["detail"]


def test_one_line_per_check() -> None:
    done = rosafe("doctor", ROS_MASTER_URI=f"http://127.0.0.1:{free_port()}")
    lines = done.stdout.splitlines()
    assert (done.returncode, done.stderr, len(lines)) == (0, "", len(EVERYTHING))
    for name, line in zip(EVERYTHING, lines, strict=True):
        state, rest = line.split(maxsplit=1)
        assert state in ("ok", "note")
        assert rest.startswith(name)


def test_running_master(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", graph.uri)
    assert doctor.CHECKS["master"]()[:2] == (doctor.OK, f"answers at {graph.uri}")


@pytest.mark.parametrize(
    ("ip", "hostname", "master", "why"),
    [
        ("203.0.113.7", "", "", "ROS_IP is 203.0.113.7, which is not an address of this machine"),
        ("127.0.0.1", "nobody.invalid", "", "ROS_HOSTNAME is nobody.invalid, neither an address nor a name"),
        ("127.0.0.1", "", "http://203.0.113.7:11311", "but the master is at http://203.0.113.7:11311"),
        ("203.0.113.7", "127.0.0.1", "", ""),
        ("", "", "", ""),
    ],
)
def test_unreachable_address(monkeypatch: pytest.MonkeyPatch, ip: str, hostname: str, master: str, why: str) -> None:
    """ROS_HOSTNAME (which takes precedence) or ROS_IP is not of this machine, or not reachable from the master."""
    address = master or "http://127.0.0.1:11311"
    for name, value in {"ROS_MASTER_URI": address, "ROS_IP": ip, "ROS_HOSTNAME": hostname}.items():
        monkeypatch.setenv(name, value)
    found = doctor.CHECKS["address"]()
    if why:
        assert found.state == doctor.MISSING
        assert why in found.detail and "unset it or set it to " in found.todo
    else:
        assert found.state == doctor.OK and "is 127.0.0.1" in found.detail


def test_messages_of_this_shell(graph: Graph, tmp_path: Path) -> None:
    """Three environments: after env.sh, without it, and after env.sh of another checkout."""
    paths_of_env = graph.env["PYTHONPATH"]
    found = check("messages", PYTHONPATH=paths_of_env)
    assert found.state == doctor.OK and found.detail.startswith("up to date")
    found = check("messages")
    assert found.state == doctor.NOTE and found.todo == f". {ROOT}/scripts/env.sh"
    (tmp_path / "rosAFE" / "msg").mkdir(parents=True)
    (tmp_path / "rosAFE" / "msg" / "__init__.py").touch()
    found = check("messages", PYTHONPATH=f"{tmp_path}:{paths_of_env}")
    assert found.state == doctor.NOTE and f"this shell uses others, in {tmp_path}" in found.detail


def test_empty_installation() -> None:
    """Python without Debian's packages; messages cannot be generated either."""
    done = rosafe_alone("doctor", "--json")
    assert done.returncode == 1, done
    found = findings(done)
    assert list(found) == EVERYTHING
    for name, package in {
        "numbers": "python3-numpy",
        "sound files": "python3-soundfile",
        "ROS": "python3-rospy",
        "HTTP server": "python3-aiohttp",
        "plots": "python3-matplotlib",
    }.items():
        assert found[name]["state"] == "MISSING"
        assert package in found[name]["detail"]
        assert found[name]["todo"] == f"run {ROOT}/scripts/install"
    assert found["messages"]["state"] == "MISSING"
    assert "Traceback" not in done.stderr


def test_alsaaudio_of_debian_cannot_capture(tmp_path: Path) -> None:
    (tmp_path / "alsaaudio.py").write_text("PCM_CAPTURE = 1\n")
    before = "import pathlib; from rosafe.ros1.transport import paths"
    found = check("alsaaudio", f"{before}; paths.PYPI_DIR = pathlib.Path({str(tmp_path)!r})")
    assert found.state == doctor.MISSING and "0.8, which cannot capture" in found.detail
    assert "scripts/install" in found.todo


def test_plugins(tmp_path: Path) -> None:
    """A valid plugin and a faulty one."""
    page = (ROOT / "docs" / "own-representation.md").read_text("utf-8")
    (tmp_path / "zerocrossings.py").write_text(page.split("```python\n")[1].split("```")[0])
    assert check("plugins", ROSAFE_PLUGINS=str(tmp_path))[:2] == (doctor.OK, "zeroCrossings")
    (tmp_path / "broken.py").write_text("1 / 0\n")
    found = check("plugins", ROSAFE_PLUGINS=str(tmp_path))
    assert found.state == doctor.NOTE and f"left out: {tmp_path}/broken.py: ZeroDivisionError" in found.detail
    assert "rosafe check" in found.todo


def test_broken_package(tmp_path: Path) -> None:
    (tmp_path / "soundfile.py").write_text("raise OSError('sndfile library\\nnot found')\n")
    found = check("sound files", PYTHONPATH=str(tmp_path))
    assert found[:2] == (doctor.MISSING, "soundfile (python3-soundfile): sndfile library not found")


def test_another_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/opt/python3.13")
    found = doctor.CHECKS["python"]()
    assert found.state == doctor.MISSING and PYTHON in found.todo


def test_a_machine_with_ros_2_only(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Parts that only ROS 1, sound cards or pictures need are notes, which name the use."""
    lost = doctor.Finding(doctor.MISSING, "it is not installed; help", "install it")
    for name in doctor.CHECKS:
        finding = lost if name in ("ROS", "alsaaudio", "plots") else doctor.Finding(doctor.OK, "here")
        monkeypatch.setitem(doctor.CHECKS, name, lambda one=finding: one)  # type: ignore[misc]
    code = doctor.run(argparse.Namespace(json=True))
    found = findings(subprocess.CompletedProcess([], code, capsys.readouterr().out))
    needed = {
        "ROS": "by nodes of ROS 1 and their clients",
        "alsaaudio": "for sound cards",
        "plots": "by rosafe plot",
    }
    for name, use in needed.items():
        assert found[name]["state"] == "note" and found[name]["detail"] == f"needed only {use}: it is not installed"
