"""The README: every command that it shows works as it stands, and what it links to is there."""

from __future__ import annotations

import os
import re
import shlex
import signal
from pathlib import Path

import pytest

from rosafe.transport.master import is_local
from tests.demo.running import check_picture, check_walk, family, new_mark
from tests.genomix import world as worlds
from tests.harness import PYTHON, ROOT, SCRIPTS, Process, free_port, wait_for

README = (ROOT / "README.md").read_text("utf-8")
WHOLE_SUITE = "scripts/test"  # is what runs this; .ci/run runs it from a clean clone
START_SECONDS = 120  # of both nodes, on such a machine
SESSION_SECONDS = 500.0  # on a machine with much other work; a tenth of that elsewhere


def blocks(language: str) -> list[str]:
    """The code that README shows in one language, block by block."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def place_like_the_checkout(folder: Path) -> dict[str, str]:
    """Make `folder` look like the checkout, for commands that write beside it; the environment to run them in.

    roscore takes its port from the command line only, `rostopic hz` has no end of its own, and a person waits until the
    nodes are up: that is what stands in for the person here. The commands themselves are those of the README.
    """
    for entry in ROOT.iterdir():
        if entry.name not in ("rosafe-demo", ".git"):
            (folder / entry.name).symlink_to(entry)
    port = free_port()
    tools = folder / "hands"
    tools.mkdir()
    stand_ins = {
        "roscore": f"exec /usr/bin/roscore -p {port}",
        "rostopic": """[ "$1" = hz ] || exec /usr/bin/rostopic "$@"
PYTHONUNBUFFERED=1 /usr/bin/rostopic "$@" | grep -m 3 rate
""",
        "rosservice": f"""cd {tools}
up='until [ "$(/usr/bin/rosservice list 2>/dev/null | grep -c /kill)" = 2 ]; do :; done'
[ -e up ] || timeout {START_SECONDS} sh -c "$up" || exit 1
touch up
exec /usr/bin/rosservice "$@"
""",
    }
    for name, text in stand_ins.items():
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    env = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "PYTHONPATH"))}
    uri = f"http://127.0.0.1:{port}"
    assert is_local(uri)
    return {**env, "PATH": f"{tools}:/usr/local/bin:/usr/bin:/bin", "ROS_MASTER_URI": uri, "HOME": str(folder)}


def test_every_command_of_the_shell(tmp_path: Path) -> None:
    """The commands in their order, in one bash that stops at the first that fails."""
    commands = [line for block in blocks("sh") for line in block.splitlines() if line != WHOLE_SUITE]
    assert commands[0] == "scripts/demo" and WHOLE_SUITE in README
    assert ". scripts/env.sh" in commands and "roscore & bass-ros & rosAFE-ros &" in commands
    mark = new_mark()
    env = {**place_like_the_checkout(tmp_path), mark: "1"}
    try:
        with Process(["bash", "-c", "\n".join(["set -e", *map(_announced, commands), "wait"])], env, tmp_path) as shell:
            code, said = shell.wait(SESSION_SECONDS), shell.out
            last = said.rpartition("+ ")[2].splitlines()[0]
            assert code == 0, f"exit {code} at or after {last!r}: {shell}"
        wait_for(lambda: not family(mark), what=lambda: f"end of {family(mark)}")
    finally:
        for pid in family(mark):  # a master has a session of its own
            os.kill(pid, signal.SIGKILL)
    check_walk(said.partition("+ . scripts/env.sh")[0])
    assert [entry.name for entry in (tmp_path / "rosafe-demo").iterdir()] == ["rosafe-demo.png"]
    check_picture(tmp_path / "rosafe-demo" / "rosafe-demo.png")
    calls = [command for command in commands if command.startswith("rosservice call")]
    by_hand = said.partition(f"+ {calls[0]}")[2]
    assert by_hand.count("genom_success: True") == len(calls) >= 12
    assert "genom_success: False" not in said
    rates = re.findall(r"average rate: ([\d.]+)", said)
    assert rates and float(rates[-1]) == pytest.approx(44100 / 12000, rel=0.25)
    assert "/rosAFE/crossCorrelationPort/crosscorrelation" in said
    for name in ("input", "preProc", "gammatone", "ihc", "ratemap"):
        assert re.search(rf"^ *- {name}$", said, re.MULTILINE)


def _announced(command: str) -> str:
    """`command`, said before it runs."""
    return f"echo + {shlex.quote(command)}\n{command.partition('    #')[0]}"


@pytest.mark.parametrize("shell", ["dash", "bash"])
def test_sourcing_line(shell: str, tmp_path: Path) -> None:
    env = place_like_the_checkout(tmp_path)
    line = next(line for block in blocks("sh") for line in block.splitlines() if line.startswith(". "))
    with Process([shell, "-c", f"{line} && command -v rosAFE-ros && rossrv show rosAFE/Stop"], env, tmp_path) as done:
        assert done.wait() == 0, done
        assert done.out.startswith(f"{tmp_path}/scripts/rosAFE-ros\n") or done.out.startswith(f"{SCRIPTS}/rosAFE-ros\n")
        assert done.out.endswith("---\nbool genom_success\nstring genom_exdetail\n\n")


def test_python(tmp_path: Path) -> None:
    """The example runs in the shell that the README has set up, and prints what it promises."""
    (code,) = blocks("python")
    env = place_like_the_checkout(tmp_path)
    line = f". scripts/env.sh && exec {PYTHON} -c {shlex.quote(code)}"
    with Process(["bash", "-c", line], env, tmp_path) as done:
        assert done.wait() == 0, done
        assert done.out.startswith("(16, 99) [  80.  ") and done.err == ""
    statements = [line for line in code.splitlines() if line]
    assert len(statements) == 5


def test_tcl(tmp_path: Path) -> None:
    """The example as a script, with a genomixd on a port that is free."""
    (script,) = blocks("tcl")
    with worlds.world(tmp_path) as world:
        printed = world.lines(f"set env(GENOMIXD) $address\n{script}")
        assert printed[-1] == "dependencies {0 input 1 preProc 2 gammatone}"


def test_links_lead_somewhere() -> None:
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", document.read_text("utf-8")):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_picture_is_small() -> None:
    assert 20_000 < (ROOT / "docs" / "demo.png").stat().st_size < 200_000


def test_folders_are_those_that_there_are() -> None:
    named = re.findall(r"`(\w[\w/.]*)`", "".join(re.findall(r"^\| `.*?\|", README, re.MULTILINE)))
    named += re.findall(r"\b(msg|srv|action)/", README)
    assert len(named) > 10
    for name in named:
        assert (ROOT / name).exists(), name
