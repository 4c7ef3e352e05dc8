"""The README: all commands work as printed, and all links have a target."""

from __future__ import annotations

import os
import re
import shlex
import signal
from pathlib import Path

import numpy as np
import pytest
import soundfile

import rosafe
from rosafe import interface
from rosafe.localization import training
from rosafe.ros1.transport.master import is_local
from tests.demo.conftest import SCENE_RATE, Learn
from tests.demo.running import check_picture, check_walk, marked_processes, new_mark
from tests.harness import PYTHON, ROOT, SCRIPTS, Process, free_port, wait_for
from tests.web.genomix import world as worlds

RATE = 16000
README = (ROOT / "README.md").read_text("utf-8")
WHOLE_SUITE = "scripts/test"  # runs this test; .ci/run runs it from a clean clone
START_SECONDS = 120  # of both nodes on a busy machine
SESSION_SECONDS = 500.0  # on a busy machine; usually a tenth of it

WAIT = """
import os, time, xmlrpc.client

def registered():
    try:
        state = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"]).getSystemState("/wait")[2]
    except OSError:
        return set()
    return {name for name, _ in state[2]}
"""


def blocks(language: str) -> list[str]:
    """Return the code blocks of the README in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def link_checkout(folder: Path) -> dict[str, str]:
    """Fill `folder` with links to the checkout, and return an environment for the commands of the README.

    Wrappers in its PATH act as a user does: they set the port of roscore, end `rostopic hz`, and wait for the nodes.
    """
    for entry in ROOT.iterdir():
        if entry.name not in ("rosafe-demo", ".git"):
            (folder / entry.name).symlink_to(entry)
    port = free_port()
    tools = folder / "wrappers"
    tools.mkdir()
    services = {f"/{c.name}/{service.name}" for c in interface.COMPONENTS.values() for service in c.on_graph}
    (tools / "wait.py").write_text(f"{WAIT}\nwhile not {services} <= registered():\n    time.sleep(0.05)\n")
    wrappers = {
        "roscore": f"exec /usr/bin/roscore -p {port}",
        "rostopic": """[ "$1" = hz ] || exec /usr/bin/rostopic "$@"
PYTHONUNBUFFERED=1 /usr/bin/rostopic "$@" | grep -m 3 rate
""",
        "rosservice": f"""cd {tools}
[ -e up ] || timeout {START_SECONDS} {PYTHON} wait.py || exit 1
touch up
exec /usr/bin/rosservice "$@"
""",
    }
    for name, text in wrappers.items():
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    env = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "PYTHONPATH"))}
    uri = f"http://127.0.0.1:{port}"
    assert is_local(uri)
    return {
        **env,
        "PATH": f"{tools}:/usr/local/bin:/usr/bin:/bin",
        "ROS_MASTER_URI": uri,
        "HOME": str(folder),
    }


def test_all_shell_commands(tmp_path: Path, learn: Learn) -> None:
    """Run the commands in one bash that stops at the first error."""
    learn(SCENE_RATE)
    commands = [line for block in blocks("sh") for line in block.splitlines() if line != WHOLE_SUITE]
    assert commands[0] == "scripts/demo" and WHOLE_SUITE in README
    assert ". scripts/env.sh" in commands and "roscore & bass-ros & rosAFE-ros &" in commands
    mark = new_mark()
    env = {**link_checkout(tmp_path), mark: "1"}
    try:
        with Process(["bash", "-c", "\n".join(["set -e", *map(_with_echo, commands), "wait"])], env, tmp_path) as shell:
            code, output = shell.wait(SESSION_SECONDS), shell.out
            last = output.rpartition("+ ")[2].splitlines()[0]
            assert code == 0, f"exit {code} at or after {last!r}: {shell}"
        wait_for(lambda: not marked_processes(mark), what=lambda: f"end of {marked_processes(mark)}")
    finally:
        for pid in marked_processes(mark):  # the master has its own session
            os.kill(pid, signal.SIGKILL)
    check_walk(output.partition("+ . scripts/env.sh")[0])
    assert [entry.name for entry in (tmp_path / "rosafe-demo").iterdir()] == ["rosafe-demo.png"]
    check_picture(tmp_path / "rosafe-demo" / "rosafe-demo.png")
    calls = [command for command in commands if command.startswith("rosservice call")]
    of_nodes = output.partition(f"+ {calls[0]}")[2]
    assert of_nodes.count("genom_success: True") == len(calls) >= 12
    assert "genom_success: False" not in output
    rates = re.findall(r"average rate: ([\d.]+)", output)
    assert rates and float(rates[-1]) == pytest.approx(44100 / 12000, rel=0.5)
    assert "/rosAFE/crossCorrelationPort/crosscorrelation" in output
    for name in ("input", "preProc", "gammatone", "ihc", "ratemap"):
        assert re.search(rf"^ *- {name}$", output, re.MULTILINE)


def _with_echo(command: str) -> str:
    """Print a command before it runs."""
    return f"echo + {shlex.quote(command)}\n{command.partition('    #')[0]}"


@pytest.mark.parametrize("shell", ["dash", "bash"])
def test_the_command_that_sets_the_environment(shell: str, tmp_path: Path) -> None:
    env = link_checkout(tmp_path)
    line = next(line for block in blocks("sh") for line in block.splitlines() if line.startswith(". "))
    with Process([shell, "-c", f"{line} && command -v rosAFE-ros && rossrv show rosAFE/Stop"], env, tmp_path) as done:
        assert done.wait() == 0, done
        assert done.out.startswith(f"{tmp_path}/scripts/rosAFE-ros\n") or done.out.startswith(f"{SCRIPTS}/rosAFE-ros\n")
        assert done.out.endswith("---\nbool genom_success\nstring genom_exdetail\n\n")


def test_the_python_example(tmp_path: Path) -> None:
    """The example runs in the environment of the README and prints the documented output."""
    (code,) = (block for block in blocks("python") if "rosafe.process" in block)
    env = link_checkout(tmp_path)
    line = f". scripts/env.sh && exec {PYTHON} -c {shlex.quote(code)}"
    with Process(["bash", "-c", line], env, tmp_path) as done:
        assert done.wait() == 0, done
        assert re.match(r"\(16, 99\) \[  80\.  (.*\n)+\(2, \d+, 99\) \[  80\. ", done.out) and done.err == ""


def test_three_lines_from_a_sound_to_a_direction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the model of the KEMAR head, learned from less sound than usual."""
    (code,) = (block for block in blocks("python") if "rosafe.localize" in block)
    head = re.findall(r'head="([^"]*)"', code)[0]
    if not Path(head).exists():
        pytest.skip("Debian's libmysofa1 is not installed")
    assert len(code.splitlines()) == 3
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(training, "SOUND_SECONDS", 60.0)
    noise = 0.1 * np.random.default_rng(1).standard_normal(RATE)
    soundfile.write("take.wav", rosafe.Head.from_sofa(head).render(noise, RATE, 40.0).T, RATE)
    exec(code, {})
    assert float(capsys.readouterr().out.split()[-1].rstrip("]")) == 40.0


@pytest.mark.forks
def test_the_tcl_example(tmp_path: Path) -> None:
    """The example runs as a script, with a genomixd on a free port."""
    (script,) = blocks("tcl")
    with worlds.world(tmp_path) as world:
        printed = world.lines(f"set env(GENOMIXD) $address\n{script}")
        assert printed[-1] == "dependencies {0 input 1 preProc 2 gammatone}"


def test_links_have_a_target() -> None:
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", document.read_text("utf-8")):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_the_figure_is_small() -> None:
    assert 20_000 < (ROOT / "docs" / "demo.png").stat().st_size < 200_000


def test_listed_folders_exist() -> None:
    """Those of the two tables of layers."""
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8").split("## Layers")[1].split("\n## ")[0]
    named = re.findall(r"`([\w/]+)`", "".join(re.findall(r"^\| `.*?\|", text, re.MULTILINE)))
    assert len(named) > 15
    for name in named:
        assert (ROOT / "rosafe" / name).exists() or (ROOT / "rosafe" / f"{name}.py").exists(), name
