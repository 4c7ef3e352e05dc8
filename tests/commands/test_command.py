"""The command itself: help, version, usage, locations of the checkout, and adding a command."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from rosafe import __version__, commands
from rosafe.commands.__main__ import main
from rosafe.declarations import plugins
from rosafe.interface import KINDS
from rosafe.ros1.component import generate
from rosafe.ros1.transport import master
from tests.commands.command import ROSAFE, environment, refused, rosafe, rosafe_alone
from tests.harness import ROOT, run_program


def test_version() -> None:
    done = rosafe("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"rosafe {__version__}\n", "")


def test_help_shows_the_commands_and_an_example() -> None:
    done = rosafe("-h")
    assert (done.returncode, done.stderr) == (0, "")
    for words in ("process  ", "doctor  ", "example", "rosafe process speech.wav"):
        assert words in done.stdout
    assert done.stdout == rosafe("--help").stdout


@pytest.mark.parametrize(
    "arguments", [[], ["frobnicate"], ["--nonsense"], ["-x", "process"], ["doctor", "too", "much"]]
)
def test_usage(arguments: list[str]) -> None:
    refused(rosafe(*arguments), "-h lists the options", code=2)


def test_help_of_process_lists_every_parameter() -> None:
    done = rosafe("process", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    text = " ".join(done.stdout.split())
    for kind in KINDS.values():
        assert kind.kind in text
        for parameter in kind.parameters:
            assert f" {parameter.name}=" in text
            assert parameter.doc in text
            assert parameter.range_text in text
    for shown in ("fb_nERBs=1.0 (above 0, at most 100)", "in_doNormalize=true", "fb_cfHz={}", "ihc_method=dau"):
        assert shown in text
    assert max(map(len, done.stdout.splitlines())) <= 120


@pytest.mark.parametrize("name", sorted(p.stem for p in Path(commands.__file__).parent.glob("[a-z]*.py")))
def test_help_of_every_command_has_an_example(name: str) -> None:
    done = rosafe(name, "-h")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"  rosafe {name}" in done.stdout[done.stdout.index("example") :]


def test_help_of_request_names_every_representation() -> None:
    listed = re.split(r"[\s,]+", rosafe("request", "-h").stdout)
    assert {kind.word for kind in KINDS.values()} - set(listed) == set()


def test_help_into_a_closed_pipe() -> None:
    done = run_program(["/bin/bash", "-o", "pipefail", "-c", f"{ROSAFE} process -h | true"], env=environment())
    assert done.stderr == ""
    assert done.returncode in (0, 141)  # depends on which process is first


def test_symbolic_link_to_the_command(tmp_path: Path) -> None:
    (tmp_path / "there").symlink_to(ROSAFE)
    assert rosafe("--version", program=tmp_path / "there", cwd=tmp_path).stdout == f"rosafe {__version__}\n"


@pytest.mark.parametrize("place", ["bin", "lib/rosAFE"])
def test_in_an_install_space(tmp_path: Path, place: str) -> None:
    (tmp_path / place).mkdir(parents=True)
    program = tmp_path / place / "rosafe"
    shutil.copy(ROSAFE, program)
    packages = tmp_path / "lib/python3/dist-packages"
    shutil.copytree(ROOT / "rosafe", packages / "rosafe", ignore=shutil.ignore_patterns("__pycache__"))
    done = rosafe("--version", program=program, cwd=tmp_path, PYTHONDONTWRITEBYTECODE="1")
    assert done.stdout == f"rosafe {__version__}\n", done


def test_a_module_adds_a_command(tmp_path: Path) -> None:
    (tmp_path / "say_hello.py").write_text(
        '"""Say hello to a person."""\n'
        "from rosafe.commands import CommandError\n"
        "def configure(parser):\n    parser.add_argument('name')\n"
        "def run(options):\n"
        "    if options.name == 'unknown':\n        raise CommandError('there is no person')\n"
        "    print('hello', options.name)\n    return 3\n"
    )
    (tmp_path / "_part.py").write_text("raise RuntimeError('not a command')\n")
    program = "import sys, rosafe.commands, rosafe.commands.__main__; rosafe.commands.__path__.append(sys.argv.pop(1));"

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return run_program(
            [
                "/usr/bin/python3",
                "-c",
                program + "sys.exit(rosafe.commands.__main__.main())",
                str(tmp_path),
                *arguments,
            ],
            env=environment(PYTHONPATH=str(ROOT)),
        )

    assert "say-hello Say hello to a person" in " ".join(run("-h").stdout.split())
    done = run("say-hello", "world")
    assert (done.returncode, done.stdout) == (3, "hello world\n")
    done = run("say-hello", "unknown")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "rosafe say-hello: there is no person\n")
    refused(run("say-hello"), "rosafe say-hello", "name", code=2)


def test_without_debians_packages() -> None:
    """Each command names the missing packages (-S hides all of them), and the list of commands still works."""
    done = rosafe_alone("-h")
    assert done.returncode == 0 and "Check the installation and report" in done.stdout, done
    for arguments in (["-h"], ["sound.wav"]):
        refused(rosafe_alone("process", *arguments), "rosafe process", "numpy is not installed; run scripts/install")


@pytest.mark.parametrize("arguments", [["trace"], ["request", "ild"], ["live"], ["localize", "--check"]])
def test_messages_that_cannot_be_generated(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise generate.GenerationError("genpy is not installed")

    monkeypatch.setattr(generate, "ensure_messages", fail)
    monkeypatch.setattr(master, "check_master", lambda *_: None)
    monkeypatch.setattr(plugins, "_disabled", False)  # restored, because some commands set it
    for name in ("ROS_MASTER_URI", "ROS_IP", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    assert main(arguments) == 1
    assert capsys.readouterr().err == f"rosafe {arguments[0]}: genpy is not installed\n"
