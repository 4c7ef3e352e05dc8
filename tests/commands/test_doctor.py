"""`rosafe doctor`: findings on a complete installation and on incomplete ones."""

from __future__ import annotations

import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rosafe.ros1.transport import paths
from tests.commands.command import environment, rosafe, rosafe_alone
from tests.harness import ROOT, Graph, free_port

EVERYTHING = ["python", "numbers", "kernels", "plugins", "sound files", "ROS", "messages", "ROS 2", "master", "address"]
EVERYTHING += ["alsaaudio", "speech", "sound devices", "HTTP server", "Tcl", "plots", "extras"]


def findings(done: subprocess.CompletedProcess[str]) -> dict[str, dict[str, str]]:
    """Return the checks by name, and assert that the exit code fits them."""
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["ok"] == (done.returncode == 0) == all(check["state"] != "MISSING" for check in report["checks"])
    return {check["name"]: check for check in report["checks"]}


def python(program: str, *options: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run a Python program that has the checkout on its path."""
    return subprocess.run(
        ["/usr/bin/python3", *options, "-c", program],
        env=environment(PYTHONPATH=str(ROOT), **env),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


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


def test_running_master(graph: Graph) -> None:
    found = findings(rosafe("doctor", "--json", ROS_MASTER_URI=graph.uri))
    assert (found["master"]["state"], found["master"]["detail"]) == ("ok", f"answers at {graph.uri}")


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
def test_unreachable_address(graph: Graph, ip: str, hostname: str, master: str, why: str) -> None:
    """ROS_HOSTNAME (which takes precedence) or ROS_IP is not of this machine, or not reachable from the master."""
    done = rosafe("doctor", "--json", ROS_MASTER_URI=master or graph.uri, ROS_IP=ip, ROS_HOSTNAME=hostname)
    found = findings(done)["address"]
    if why:
        assert (done.returncode, found["state"]) == (1, "MISSING")
        assert why in found["detail"] and "unset it or set it to " in found["todo"]
    else:
        assert found["state"] == "ok" and "is 127.0.0.1" in found["detail"]


def test_messages_of_this_shell(graph: Graph, tmp_path: Path) -> None:
    """Three environments: after env.sh, without it, and after env.sh of another checkout."""
    paths_of_env = graph.env["PYTHONPATH"]
    found = findings(rosafe("doctor", "--json", PYTHONPATH=paths_of_env))["messages"]
    assert found["state"] == "ok" and found["detail"].startswith("up to date")
    found = findings(rosafe("doctor", "--json"))["messages"]
    assert found["state"] == "note" and found["todo"] == f". {ROOT}/scripts/env.sh"
    (tmp_path / "rosAFE" / "msg").mkdir(parents=True)
    (tmp_path / "rosAFE" / "msg" / "__init__.py").touch()
    found = findings(rosafe("doctor", "--json", PYTHONPATH=f"{tmp_path}:{paths_of_env}"))["messages"]
    assert found["state"] == "note" and f"this shell uses others, in {tmp_path}" in found["detail"]


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
    program = (
        "import pathlib, sys; from rosafe.commands import __main__ as cli; from rosafe.ros1.transport import paths;"
        f"paths.PYPI_DIR = pathlib.Path({str(tmp_path)!r}); sys.exit(cli.main(['doctor', '--json']))"
    )
    done = python(program)
    assert done.returncode == 1, done
    found = findings(done)["alsaaudio"]
    assert found["state"] == "MISSING" and "0.8, which cannot capture" in found["detail"]
    assert "scripts/install" in found["todo"]


def test_plugins(tmp_path: Path) -> None:
    """A valid plugin and a faulty one."""
    page = (ROOT / "docs" / "own-representation.md").read_text("utf-8")
    (tmp_path / "zerocrossings.py").write_text(page.split("```python\n")[1].split("```")[0])
    found = findings(rosafe("doctor", "--json", ROSAFE_PLUGINS=str(tmp_path)))["plugins"]
    assert (found["state"], found["detail"]) == ("ok", "zeroCrossings")
    (tmp_path / "broken.py").write_text("1 / 0\n")
    found = findings(rosafe("doctor", "--json", ROSAFE_PLUGINS=str(tmp_path)))["plugins"]
    assert found["state"] == "note" and f"left out: {tmp_path}/broken.py: ZeroDivisionError" in found["detail"]
    assert "rosafe check" in found["todo"]


def test_broken_package(tmp_path: Path) -> None:
    (tmp_path / "soundfile.py").write_text("raise OSError('sndfile library\\nnot found')\n")
    done = rosafe("doctor", "--json", PYTHONPATH=str(tmp_path))
    assert done.returncode == 1, done
    found = findings(done)["sound files"]
    assert found["detail"] == "soundfile (python3-soundfile): sndfile library not found"


def test_another_python(tmp_path: Path) -> None:
    program = (
        "import sys; sys.executable = '/opt/python3.13'; from rosafe.commands import __main__ as cli;"
        "sys.exit(cli.main(['doctor', '--json']))"
    )
    found = findings(python(program))["python"]
    assert found["state"] == "MISSING" and "/usr/bin/python3" in found["todo"]


def test_a_machine_with_ros_2_only() -> None:
    """Parts that only ROS 1, sound cards or pictures need are notes, which name the use."""
    program = """
import argparse
from rosafe.commands import doctor
lost = doctor.Finding(doctor.MISSING, "it is not installed; help", "install it")
found = doctor.Finding(doctor.OK, "here")
for name in doctor.CHECKS:
    doctor.CHECKS[name] = (lambda: lost) if name in ("ROS", "alsaaudio", "plots") else lambda: found
raise SystemExit(doctor.run(argparse.Namespace(json=True)))
"""
    found = findings(python(program))
    needed = {
        "ROS": "by nodes of ROS 1 and their clients",
        "alsaaudio": "for sound cards",
        "plots": "by rosafe plot",
    }
    for name, use in needed.items():
        assert found[name]["state"] == "note" and found[name]["detail"] == f"needed only {use}: it is not installed"
