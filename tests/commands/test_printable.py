"""Names of files and texts of other programs cannot send control characters to the terminal."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from rosafe.commands.__main__ import main
from rosafe.system.terminal import printable
from rosafe.tree.setups import Setup
from rosafe.tree.setups.setup import AcquireSettings
from rosafe.tree.setups.state_file import TreeStateFile
from tests.commands.command import SMALL, noise, rosafe, write
from tests.harness import PYTHON, SCRIPTS, Graph

EVIL = (
    "e\x1b[31m\x07\n\r\x9b1m\u202e\udcff"  # colour, bell, lines, 8-bit escape, right to left, a byte that is not UTF-8
)
SHOWN = r"e\x1b[31m\x07\n\r\x9b1m\u202e\xff"
STRICT = "utf-8:strict"  # as in most locales: stdout raises an error for undecodable bytes


def test_printable() -> None:
    assert printable(EVIL) == SHOWN
    assert printable("Übung ☂.wav") == "Übung ☂.wav"
    assert printable(Path("a\tb")) == r"a\tb"
    assert printable("one\ntwo\r", keep="\n") == "one\ntwo\\r"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with valid and damaged files that have hostile names."""
    here = tmp_path_factory.mktemp("names")
    write(here / "good.wav", noise(2000))
    shutil.copy(here / "good.wav", here / f"{EVIL}.wav")
    (here / f"bad{EVIL}.wav").write_text("no sound")
    (here / f"bad{EVIL}.npz").write_text("no result")
    (here / f"bad{EVIL}.yaml").write_text("processors: [nonsense")
    (here / f"folder{EVIL}").mkdir()
    shutil.copy(here / "good.wav", here / f"folder{EVIL}" / f"{EVIL}.wav")
    (here / f"folder{EVIL}" / f"bad{EVIL}.wav").write_text("no sound")
    return here


def assert_escaped(done: subprocess.CompletedProcess[str], code: int) -> None:
    """Assert the exit code, and that the name was printed in escaped form."""
    output = done.stdout + done.stderr
    assert done.returncode == code and "Traceback" not in output, done
    assert r"e\x1b[31m\x07\n\r\x9b1m\u202e" in output, output
    assert all(line.isprintable() for line in output.split("\n")), output


@pytest.mark.parametrize(
    ("code", "command"),
    [
        (1, ["process", "good.wav", "-o", f"{EVIL}.txt"]),
        (1, ["process", "good.wav", "--set", f"{EVIL}=1"]),
        (2, ["process", "good.wav", f"--{EVIL}"]),
        (2, ["process", "good.wav", "--channels", EVIL]),
        (1, ["plot", f"bad{EVIL}.wav"]),
        (1, ["plot", f"bad{EVIL}.npz"]),
        (1, ["plot", "good.wav", "-o", f"none/{EVIL}.png"]),
        (0, ["trace", f"{EVIL}.wav", "-o", f"{EVIL}.json", "--force"]),
        (1, ["trace", f"bad{EVIL}.wav"]),
        (1, ["trace", "--node", EVIL]),
        (1, ["setup", "load", f"bad{EVIL}.yaml"]),
        (1, ["up", f"none{EVIL}.yaml"]),
        (1, ["request", EVIL]),
        (1, ["request", "ild", f"{EVIL}=1"]),
        (2, ["live", "--port", EVIL]),
        (2, [EVIL]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_names_in_commands(
    folder: Path,
    code: int,
    command: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    try:
        ended = main(command)
    except SystemExit as end:
        ended = int(str(end.code))
    assert_escaped(subprocess.CompletedProcess(command, ended, *capsys.readouterr()), code)


@pytest.mark.parametrize(
    ("code", "command"),
    [
        (1, ["process", f"folder{EVIL}", "-o", f"out{EVIL}/", *SMALL, "--outputs", "ild", "-v"]),
        (0, ["record", f"{EVIL}.bag", "--device", "file:good.wav"]),
        (1, ["record", "--device", f"file:bad{EVIL}.wav"]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_names_in_commands_that_take_signals(folder: Path, code: int, command: list[str]) -> None:
    assert_escaped(rosafe(*command, cwd=folder, PYTHONIOENCODING=STRICT), code)


def test_doctor(folder: Path) -> None:
    evil = EVIL.replace("\n", "").replace("\r", "")  # doctor joins lines
    plugins = folder / f"plugins{evil}"
    plugins.mkdir()
    (plugins / f"bad{evil}.py").write_text("raise ValueError('\\x1b[31m')\n")
    done = rosafe("doctor", cwd=folder, ROSAFE_PLUGINS=str(plugins), PYTHONIOENCODING=STRICT)
    assert r"plugins" + printable(evil) in done.stdout and all(map(str.isprintable, done.stdout.split("\n"))), done


@pytest.mark.parametrize(
    ("code", "program", "options"),
    [
        (1, "rosafe", ["setup", "save", "tree.yaml", "-i", EVIL]),
        (1, "genomixd", ["-p", "0", "--host", EVIL]),
        (1, "rosAFE-ros", ["--keep", f"bad{EVIL}.yaml", "-i", "printable"]),
        (1, "bass-ros", ["-i", EVIL]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_names_in_programs_of_a_graph(graph: Graph, folder: Path, code: int, program: str, options: list[str]) -> None:
    with graph.start(str(SCRIPTS / program), *options, cwd=folder, PYTHONIOENCODING=STRICT) as process:
        process.wait()
        done = subprocess.CompletedProcess(options, process.wait(), process.out, process.err)
    assert_escaped(done, code)


def test_logs_of_a_node(graph: Graph) -> None:
    script = (
        "import rospy; from rosafe.ros1.component import startup\n"
        "startup.become_node('teller'); rospy.logwarn('told: %s', 'a\\x1b[31m\\x9b\\udcff'); rospy.loginfo('\\x07')\n"
    )
    done = graph.run(PYTHON, "-c", script, PYTHONPATH=f"{SCRIPTS.parent}:{graph.env['PYTHONPATH']}")
    assert r"told: a\x1b[31m\x9b\xff" in done.stderr and r"\x07" in done.stderr
    assert all(line.isprintable() for line in done.stderr.split("\n")), done.stderr


def test_errors_of_a_saved_tree(tmp_path: Path) -> None:
    reports: list[str] = []
    state_file = TreeStateFile(
        tmp_path / EVIL / "tree.yaml", lambda: Setup(AcquireSettings({"device": "scene:"})), reports.append
    )
    state_file.save()
    assert SHOWN in state_file.problem and state_file.problem.isprintable()
    assert reports == [f"the tree is not kept: {state_file.problem}"]
