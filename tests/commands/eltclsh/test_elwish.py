"""elwish: eltclsh with Tk, on a virtual display."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.commands.eltclsh.conftest import Run, environment
from tests.terminal import Terminal


@pytest.fixture
def display(home: Path) -> Iterator[str]:
    """Start a virtual display and return its name."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed; scripts/install --tests brings it")
    command = ["Xvfb", "-displayfd", "1", "-nolisten", "tcp", "-screen", "0", "640x480x24"]
    with harness.Process(command, environment(home)) as server:
        yield ":" + harness.wait_for(lambda: server.out.strip(), what=lambda: f"a display of {server}")


def test_a_missing_display_is_reported(run: Run) -> None:
    done = run(shell="elwish", stdin="puts here\n", DISPLAY="")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == 'elwish: couldn\'t connect to display ""\n'


def test_a_script_with_tk(run: Run, home: Path, tmp_path: Path, display: str) -> None:
    (home / ".elwishrc").write_text("set greeting hello\n")
    (home / ".eltclshrc").write_text("error wrong\n")
    (tmp_path / "script.tcl").write_text(
        "puts [list [wm state .] [winfo class .] $greeting $argv [package present Tk]]\n"
        "button .b -text press -command {set pressed 1}\npack .b\nwm deiconify .\nupdate\n"
        ".b invoke\nputs [list [winfo ismapped .b] $pressed]\nexit 3\n"
    )
    done = run("script.tcl", "a b", shell="elwish", DISPLAY=display)
    assert (done.stdout.splitlines()[0].rsplit(" ", 1)[0], done.stderr) == ("withdrawn Script.tcl hello {{a b}}", "")
    assert done.stdout.splitlines()[1:] == ["1 1"]
    assert done.returncode == 3


def test_window_events_are_processed_while_the_prompt_waits(home: Path, display: str) -> None:
    env = {**environment(home), "DISPLAY": display}
    with Terminal([str(harness.SCRIPTS / "elwish")], env) as terminal:
        terminal.expect("elwish > ")
        terminal.run("bind . <Destroy> {puts gone}", "elwish > ")
        terminal.press("bind . <Map> {puts mapped; after 1 {destroy .}}; wm deiconify .\r", "mapped\n")
        terminal.expect("gone\n")
        terminal.press("exit 5\r")
        assert terminal.end() == 5
