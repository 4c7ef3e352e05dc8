"""The Debian packages, without a build: dependencies, messages, and arguments of scripts/make-deb."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rosafe.system import missing
from tests import fork_server, harness
from tests.harness import PYTHON, ROOT
from tests.packaging.clone import environment, run
from tests.packaging.test_deb import assert_same_messages

NOT_AT_RUN_TIME = {"gcc", "libc6-dev", "python3-dev", "libasound2-dev", "ca-certificates"}  # of scripts/install
NOT_AT_RUN_TIME |= {"python3-pip", "python3-setuptools", "python3-wheel"}


def array(text: str, name: str) -> set[str]:
    """Return the words of the arrays `name` in a shell script, without comments."""
    found = re.findall(rf"^{name}\+?=\((.*?)\)", text, re.MULTILINE | re.DOTALL)
    assert found
    return set(re.sub(r"#.*", "", " ".join(f"{part}\n" for part in found)).split())


def test_dependencies() -> None:
    """All packages of scripts/install are dependencies, except those that only builds need."""
    packages = (ROOT / "debian" / "control").read_text("utf-8").partition("\nPackage: ")[2]
    lists = re.findall(r"^Depends:\n((?: .*\n)+)", packages, re.MULTILINE)
    names = set(re.findall(r"^ ([a-z][a-z0-9.-]+)", "".join(lists), re.MULTILINE))
    needed = array((ROOT / "scripts" / "install").read_text("utf-8"), "run") - NOT_AT_RUN_TIME
    assert len(lists) == 2 and needed <= names
    assert not {name for name in names if name.startswith(("ros-", "python3-ros"))} - needed - {"python3-rosafe"}


def test_messages_equal_those_of_the_checkout(tmp_path: Path) -> None:
    done = run(PYTHON, "-m", "debian.messages", tmp_path, env=environment(PYTHONPATH=str(ROOT)))
    assert done.returncode == 0, done.stderr
    for package in ("rosAFE", "bass"):
        assert_same_messages(tmp_path / "python", tmp_path / "share", package)
        assert not [path for path in (tmp_path / "share" / package).rglob("*") if path.is_symlink()]


def test_manual_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each command has one, with its whole help, and rosafe with that of each subcommand.

    The commands are forks of a process that has imported rosafe.
    """

    def forked(command: list[str], env: dict[str, str], **options: Any) -> subprocess.CompletedProcess[str]:
        if command[0] != "scripts/rosafe":
            return real_run(command, env=env, **options)
        done = fork_server.shared().run([str(ROOT / command[0]), *command[1:]], env, None, "", harness.PATIENCE)
        assert (done.returncode, done.stderr) == (0, "")
        return done

    spec = importlib.util.spec_from_file_location("manpages", ROOT / "debian" / "manpages.py")
    assert spec and spec.loader
    manpages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(manpages)
    real_run = subprocess.run
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    monkeypatch.setattr(manpages, "subprocess", SimpleNamespace(run=forked, PIPE=subprocess.PIPE))
    manpages.main(tmp_path / "man")
    pages = {path.stem: path.read_text("utf-8") for path in (tmp_path / "man").iterdir()}
    installed = (ROOT / "debian" / f"{name}.manpages" for name in ("rosafe", "python3-rosafe"))
    assert {Path(line).stem for path in installed for line in path.read_text("utf-8").splitlines()} == set(pages)
    for program, page in pages.items():
        assert page.startswith(f".TH {program} 1 2023-11-14 ") and f"usage: {program} [" in page.replace("\\-", "-")
    subcommands = re.findall(r"^\.SS rosafe (\S+)\n\.nf\nusage: rosafe \1 ", pages["rosafe"], re.MULTILINE)
    assert subcommands == sorted(path.stem for path in (ROOT / "rosafe" / "commands").glob("[!_]*.py"))


@pytest.mark.parametrize("git", [False, True])
def test_exported_permissions_do_not_depend_on_those_of_the_checkout(tmp_path: Path, git: bool) -> None:
    """As root, tar keeps those that git stores in an archive; for other users it applies the umask."""
    checkout, exported = tmp_path / "a checkout", tmp_path / "exported"
    (checkout / "scripts").mkdir(parents=True)
    for name in ("export-sources", "checkout.sh"):
        shutil.copy(ROOT / "scripts" / name, checkout / "scripts")
    (checkout / "CHANGELOG.md").write_text("0.3.0")
    if git:
        commit = ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x"]
        for arguments in (["init", "-q"], ["add", "."], commit):
            assert run("git", *arguments, env=environment(), cwd=checkout).returncode == 0
    (checkout / "CHANGELOG.md").chmod(0o660)
    (checkout / "scripts" / "export-sources").chmod(0o700)
    done = run(checkout / "scripts" / "export-sources", exported, env=environment())
    assert done.returncode == 0, done.stderr
    modes = {path.name: path.stat().st_mode & 0o777 for path in exported.rglob("*") if ".git" not in path.parts}
    assert modes == {"CHANGELOG.md": 0o644, "scripts": 0o755, "export-sources": 0o755, "checkout.sh": 0o644}


@pytest.mark.parametrize("arguments", [["-x"], ["--folder"], ["a", "b"]])
def test_wrong_arguments(arguments: list[str]) -> None:
    done = run(ROOT / "scripts" / "make-deb", *arguments, env=environment())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("usage: scripts/make-deb [FOLDER]")


def test_build_without_pip_names_it(tmp_path: Path) -> None:
    """Its error was that of an absent network."""
    (tmp_path / "pip.py").write_text("raise ModuleNotFoundError\n", "utf-8")
    done = run(ROOT / "scripts" / "make-deb", tmp_path / "packages", env=environment(PYTHONPATH=str(tmp_path)))
    if "command not found" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 1
    assert done.stderr == "scripts/make-deb: pip is not installed; run scripts/install --tests\n"


def test_advice_about_missing_packages_names_those_of_debian(monkeypatch: pytest.MonkeyPatch) -> None:
    """`apt install rosafe` would fail: Debian does not have that package."""
    assert missing.install("matplotlib") == missing.install("rospy") == "run scripts/install"
    monkeypatch.setattr(missing, "_DEBIAN_DIR", ROOT)
    assert missing.install("matplotlib.pyplot") == "apt install python3-matplotlib"
    assert {missing.install(name) for name in ("rospy", "aiohttp", "tkinter", "bass.msg")} == {
        "install the Debian package rosafe"
    }
