"""scripts/env.sh in bash, dash and zsh: it works from any folder and when called twice, and fails without effects."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.packaging.clone import environment, fresh_copy, keep_few_definitions, run

SHELLS = pytest.mark.parametrize("shell", ["bash", "dash", "zsh"])
VARIABLES = (
    *("PATH", "PYTHONPATH", "ROS_PACKAGE_PATH", "TCLLIBPATH", "OCTAVE_PATH", "MATLABPATH"),
    *("ROS_MASTER_URI", "ROS_IP", "ROS_HOSTNAME"),
)
SHOW = "; ".join(f'echo "${{{name}-unset}}"' for name in VARIABLES)


@pytest.fixture(scope="module")
def copy() -> Iterator[Path]:
    with few_definitions() as path:
        yield path


@contextmanager
def few_definitions() -> Iterator[Path]:
    """Yield a copy of the checkout with few messages, which are generated quickly."""
    with fresh_copy() as path:
        keep_few_definitions(path)
        yield path


def sourced(
    shell: str, commands: str, cwd: Path = Path("/"), env: dict[str, str] | None = None, within: bool = False
) -> subprocess.CompletedProcess[str]:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed; run scripts/install --tests")
    if shell == "dash" and not within and not Path("/proc/self/fd").exists():
        pytest.skip("without /proc, dash finds env.sh only inside the checkout")
    return run(shell, "-c", commands, env=env or environment(), cwd=cwd)


def variables(done: subprocess.CompletedProcess[str]) -> dict[str, str]:
    """Return the variables printed by SHOW, the last command."""
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return dict(zip(VARIABLES, done.stdout.splitlines()[-len(VARIABLES) :], strict=True))


def source(copy: Path) -> str:
    return f". {shlex.quote(str(copy / 'scripts' / 'env.sh'))}"


@SHELLS
def test_sets_the_paths(copy: Path, shell: str) -> None:
    found = variables(sourced(shell, f"{source(copy)}; {SHOW}"))
    generated = copy / ".generated" / "current"
    assert found["PATH"] == f"{copy}/scripts:{environment()['PATH']}"
    assert found["PYTHONPATH"].split(":")[:3] == [f"{generated}/python", str(copy), f"{copy}/python"]
    assert found["ROS_PACKAGE_PATH"] == f"{generated}/share"
    assert found["TCLLIBPATH"] == f"{{{copy}/tcl}}"  # a Tcl list, and the path has a blank
    assert found["OCTAVE_PATH"] == found["MATLABPATH"] == f"{copy}/matlab"
    assert found["ROS_MASTER_URI"] == "http://127.0.0.1:11311"
    assert found["ROS_IP"] == "127.0.0.1"
    assert found["ROS_HOSTNAME"] == "unset"
    assert (generated / "python" / "rosAFE" / "msg" / "__init__.py").is_file()


@SHELLS
def test_second_call_has_no_effect(copy: Path, shell: str) -> None:
    once = variables(sourced(shell, f"{source(copy)}; {SHOW}"))
    assert variables(sourced(shell, f"{source(copy)}; {source(copy)}; {source(copy)}; {SHOW}")) == once


@SHELLS
@pytest.mark.parametrize(
    ("folder", "command"),
    [
        ("", ". scripts/env.sh"),
        ("", ". ./scripts/env.sh"),
        ("scripts", ". ./env.sh"),
        ("rosafe/ros1/afe", ". ../../../scripts/env.sh"),
        ("", "(. scripts/env.sh && {show})"),  # in a subshell
        ("", "set -eu; . scripts/env.sh"),
    ],
)
def test_from_any_folder(copy: Path, shell: str, folder: str, command: str) -> None:
    commands = command.replace("{show}", SHOW) if "{show}" in command else f"{command}; {SHOW}"
    done = sourced(shell, commands, copy / folder, within=True)
    assert variables(done)["PATH"].split(":")[0] == f"{copy}/scripts"


@SHELLS
def test_through_a_symbolic_link(copy: Path, shell: str, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(copy)
    found = variables(sourced(shell, f". {tmp_path}/link/scripts/env.sh; {SHOW}"))
    assert found["PATH"].split(":")[0] == f"{copy}/scripts"


@SHELLS
def test_surrounding_checkout_is_ignored(copy: Path, shell: str) -> None:
    """The sourced file determines the checkout, not the working directory."""
    with few_definitions() as other:
        found = variables(sourced(shell, f"{source(copy)}; {SHOW}", cwd=other))
        assert found["PYTHONPATH"].startswith(f"{copy}/.generated/")
        assert not (other / ".generated").exists()
        both = variables(sourced(shell, f"{source(copy)}; {source(other)}; {SHOW}"))
        assert both["PATH"].split(":")[:2] == [f"{other}/scripts", f"{copy}/scripts"]


@SHELLS
def test_keeps_variables_of_the_user(copy: Path, shell: str) -> None:
    user = {
        "ROS_MASTER_URI": "http://robot:11311",
        "PYTHONPATH": "/mine/python",
        "ROS_PACKAGE_PATH": "/mine/ros",
        "TCLLIBPATH": "{/my tcl} /mine",
    }
    found = variables(sourced(shell, f"{source(copy)}; {source(copy)}; {SHOW}", env=environment(**user)))
    assert found["ROS_MASTER_URI"] == "http://robot:11311"
    assert found["ROS_IP"] == "unset", "the robot could not call back to loopback"
    assert found["PYTHONPATH"].split(":")[-1] == "/mine/python"
    assert found["ROS_PACKAGE_PATH"].split(":")[-1] == "/mine/ros"
    assert found["TCLLIBPATH"].endswith("/tcl} {/my tcl} /mine")
    for user in ({"ROS_IP": "10.0.0.7"}, {"ROS_HOSTNAME": "desk"}):
        found = variables(sourced(shell, f"{source(copy)}; {SHOW}", env=environment(**user)))
        assert {name: found[name] for name in user} == user
        assert found["ROS_IP"] == user.get("ROS_IP", "unset")


@SHELLS
def test_defines_no_other_names(copy: Path, shell: str) -> None:
    done = sourced(shell, f"{source(copy)}; set | grep -c '^_rosafe'")
    assert done.stdout == "0\n"


@pytest.fixture(scope="module")
def broken() -> Iterator[Path]:
    """A copy with a message that cannot be generated."""
    with few_definitions() as path:
        (path / "msg" / "rosAFE_signalOneD.msg").write_text("nonsense data\n")
        yield path


@SHELLS
def test_failure_is_one_line_and_changes_nothing(broken: Path, shell: str) -> None:
    done = sourced(shell, f"{source(broken)}; echo $?; {SHOW}; set | grep -c '^_rosafe'")
    assert done.stdout.splitlines() == ["1", environment()["PATH"], *["unset"] * (len(VARIABLES) - 1), "0"]
    assert done.stderr.startswith("rosafe: ") and done.stderr.count("\n") == 1


@pytest.mark.skipif(os.getuid() != 0, reason="a separate mount namespace needs root")
def test_dash_without_proc(copy: Path) -> None:
    def hidden(commands: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        command = f"mount -t tmpfs none /proc && exec dash -c {shlex.quote(commands)}"
        return run("unshare", "--mount", "sh", "-c", command, env=environment(PATH=os.environ["PATH"]), cwd=cwd)

    probe = hidden("true", Path("/"))
    if probe.returncode != 0:
        pytest.skip(f"no mount namespace here: {probe.stderr}")
    for folder in (copy, copy / "rosafe" / "ros1" / "afe"):
        assert variables(hidden(f"{source(copy)}; {SHOW}", folder))["PATH"].startswith(f"{copy}/scripts:")
    done = hidden(f"{source(copy)}; echo $?", Path("/"))
    assert done.stdout == "1\n"
    assert "change into the checkout" in done.stderr and done.stderr.count("\n") == 1


def test_commands_work_after_it(copy: Path, tmp_path: Path) -> None:
    """In one shell: `test_sets_the_paths` compares the variables in all of them."""
    commands = "bass-ros --version && rosrun bass bass-ros --version && rosmsg show rosAFE/rosAFE_signalOneD"
    done = sourced("bash", f"{source(copy)} && {commands}", env=environment(HOME=str(tmp_path)))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("bass ") == 2 and "float64[] data\n" in done.stdout
