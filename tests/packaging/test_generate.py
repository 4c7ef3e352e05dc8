"""Message generation: complete, once for concurrent starts, up to date, and never partial."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT, Graph, run_together
from tests.packaging.clone import environment, fresh_copy, generate, keep_few_definitions, run, without_rights

IMPORT = (
    "from rosafe.ros1.component import generate; generate.ensure_messages(); "
    "import rosAFE.msg, rosAFE.srv, bass.msg, bass.srv; "
    "print(rosAFE.msg.__file__, rosAFE.msg.InputProcAction._md5sum, bass.srv.Acquire._md5sum)"
)
MD5_OF_INPUTPROC_ACTION = "2dc56590e981689aa1ab72a9e6db474e"


@pytest.fixture
def copy() -> Iterator[Path]:
    with fresh_copy() as path:
        keep_few_definitions(path)  # test_rosmsg_and_rossrv_list_all_types uses all
        yield path


def generations(base: Path) -> list[str]:
    return sorted(p.name for p in base.iterdir() if p.is_dir() and not p.is_symlink())


def imported(copy: Path, done: subprocess.CompletedProcess[str]) -> Path:
    """Return the path of the messages of rosAFE that a process running IMPORT has found."""
    assert done.returncode == 0, done.stderr
    *path, action, _ = done.stdout.split()
    assert action == MD5_OF_INPUTPROC_ACTION
    return Path(" ".join(path))


def test_concurrent_starts_in_a_new_tree(copy: Path) -> None:
    def start(index: int) -> subprocess.CompletedProcess[str]:
        return run(PYTHON, "-c", IMPORT, env=environment(PYTHONPATH=str(copy)))

    paths = {imported(copy, done) for done in run_together(5, start)}
    assert len(paths) == 1
    assert paths.pop().is_relative_to(copy / ".generated")
    assert len(generations(copy / ".generated")) == 1


def test_generated_once(copy: Path) -> None:
    assert run(*generate(copy), env=environment()).returncode == 0
    before = {p: p.stat().st_mtime_ns for p in (copy / ".generated").rglob("*")}
    assert run(*generate(copy), env=environment()).returncode == 0
    assert {p: p.stat().st_mtime_ns for p in (copy / ".generated").rglob("*")} == before


def test_generated_again_when_a_message_changes(copy: Path) -> None:
    message = copy / "msg" / "rosAFE_signalOneD.msg"
    show = [PYTHON, "-c", f"{IMPORT}; print(rosAFE.msg.rosAFE_signalOneD.__slots__)"]
    assert run(*show, env=environment(PYTHONPATH=str(copy))).stdout.endswith("['data']\n")
    original = message.read_text()
    message.write_text(original + "string extra\n")
    assert run(*show, env=environment(PYTHONPATH=str(copy))).stdout.endswith("['data', 'extra']\n")
    current = (copy / ".generated" / "current").resolve()
    message.write_text(original)
    assert run(*show, env=environment(PYTHONPATH=str(copy))).stdout.endswith("['data']\n")
    assert (copy / ".generated" / "current").resolve() != current
    assert len(generations(copy / ".generated")) == 2, "a running node may still need the other one"


def test_old_generations_are_removed(copy: Path) -> None:
    message = copy / "msg" / "rosAFE_signalOneD.msg"
    for number in range(5):
        message.write_text(f"# version {number}\nfloat64[] data\n")
        assert run(*generate(copy), env=environment()).returncode == 0
    assert len(generations(copy / ".generated")) == 3


def test_new_file_is_detected(copy: Path) -> None:
    assert run(*generate(copy), env=environment()).returncode == 0
    (copy / "bass" / "srv" / "Extra.srv").write_text("uint8 a\n---\n")
    done = run(PYTHON, "-c", f"{IMPORT}; print(bass.srv.Extra)", env=environment(PYTHONPATH=str(copy)))
    assert "bass.srv._Extra.Extra" in done.stdout


def test_moved_tree_is_generated_again(copy: Path) -> None:
    """The links for rosrun contain the path of the tree."""
    assert run(*generate(copy), env=environment()).returncode == 0
    moved = copy.rename(copy.with_name("moved"))
    assert run(*generate(moved), env=environment()).returncode == 0
    link = moved / ".generated" / "current" / "share" / "rosAFE" / "scripts"
    assert link.resolve() == moved / "scripts"


@pytest.mark.parametrize("delay", [0.08, 0.3])
def test_killed_generator(copy: Path, delay: float) -> None:
    build = subprocess.Popen(list(map(str, generate(copy))), env=environment(), cwd="/")
    try:
        build.wait(delay)
    except subprocess.TimeoutExpired:
        build.send_signal(signal.SIGKILL)
    build.wait()
    imported(copy, run(PYTHON, "-c", IMPORT, env=environment(PYTHONPATH=str(copy))))
    assert len(generations(copy / ".generated")) == 1, "leftovers of the killed generator are removed"


@contextmanager
def read_only(copy: Path) -> Iterator[None]:
    """Make the copy read-only for all users except root."""
    for path in [copy, *copy.rglob("*")]:
        if not path.is_symlink():
            path.chmod(path.stat().st_mode & ~0o222)
    try:
        yield
    finally:
        for path in [copy, *copy.rglob("*")]:
            if path.is_dir() and not path.is_symlink():
                path.chmod(0o755)


def world_writable(path: Path, mode: int = 0o777) -> Path:
    """Create a folder in which every user can write."""
    path.mkdir()
    path.chmod(mode)
    return path


def test_read_only_tree_uses_the_users_cache(copy: Path) -> None:
    home = world_writable(copy.with_name("home"))
    with read_only(copy):
        command = without_rights("env", f"PYTHONPATH={copy}", PYTHON, "-c", IMPORT)
        for _ in range(2):
            path = imported(copy, run(*command, env=environment(HOME=str(home))))
            assert path.is_relative_to(home / ".cache" / "rosafe" / "messages")
        assert not (copy / ".generated").exists()


def test_read_only_tree_and_home_use_a_private_folder(copy: Path) -> None:
    temporary = world_writable(copy.with_name("tmp"), 0o1777)
    with read_only(copy):
        command = without_rights("env", f"PYTHONPATH={copy}", PYTHON, "-c", IMPORT)
        paths = {imported(copy, run(*command, env=environment(TMPDIR=str(temporary)))) for _ in range(2)}
        assert len(paths) == 1, "the same at every start"
        (private,) = temporary.iterdir()
        assert paths.pop().is_relative_to(private)
        assert private.stat().st_mode & 0o777 == 0o700


@pytest.mark.skipif(os.getuid() != 0, reason="creating another user's folder needs root")
@pytest.mark.parametrize("outer", [0o700, 0o755])
def test_messages_generated_by_root_with_umask_077(copy: Path, outer: int) -> None:
    """All users can read them, unless the surrounding folder forbids it: then other users generate their own."""
    (copy / ".generated").mkdir(mode=outer)
    assert run("sh", "-c", 'umask 077; exec "$@"', "-", *generate(copy), env=environment()).returncode == 0
    home = world_writable(copy.with_name("home"))
    command = without_rights("env", f"PYTHONPATH={copy}", PYTHON, "-c", IMPORT)
    path = imported(copy, run(*command, env=environment(HOME=str(home))))
    own = home / ".cache" / "rosafe" / "messages"
    assert path.is_relative_to(own if outer == 0o700 else copy / ".generated")


@pytest.mark.skipif(os.getuid() != 0, reason="creating another user's folder needs root")
def test_private_folder_of_another_user_is_rejected(copy: Path) -> None:
    temporary = world_writable(copy.with_name("tmp"), 0o1777)
    (temporary / "rosafe-65534").mkdir(mode=0o777)
    with read_only(copy):
        command = without_rights(*generate(copy))
        done = run(*command, env=environment(TMPDIR=str(temporary)))
    assert done.returncode == 1
    assert "private to this user" in done.stderr and done.stderr.count("\n") == 1


INVALID = (
    ("msg/rosAFE_signalOneD.msg", "nonsense data\n", "nonsense"),
    ("msg/rosAFE_signalOneD.msg", "float64[ data\n", "float64["),
    ("srv/Stop.srv", "string a\n---\nnowhere/Nothing b\n", "nowhere"),
    ("action/IhcProc.action", "string a\n---\nbool b\n", "expected goal, result and feedback, got 2 parts"),
)


def test_invalid_definition_is_one_line_and_keeps_the_last_generation(copy: Path) -> None:
    assert run(*generate(copy), env=environment()).returncode == 0
    current = (copy / ".generated" / "current").resolve()
    for path, text, reason in INVALID:
        valid = (copy / path).read_text()
        (copy / path).write_text(text)
        done = run(*generate(copy), env=environment())
        assert done.returncode == 1
        assert reason in done.stderr and done.stderr.count("\n") == 1, done.stderr
        assert (copy / ".generated" / "current").resolve() == current
        assert generations(copy / ".generated") == [current.name]
        (copy / path).write_text(valid)


@pytest.mark.forks
def test_rosmsg_and_rossrv_list_all_types(graph: Graph) -> None:
    for package, folder in (("rosAFE", ROOT), ("bass", ROOT / "bass")):
        listed = graph.run("rosmsg", "package", package).stdout.split()
        actions = [p.stem for p in (folder / "action").iterdir()]
        parts = ("Action", "Goal", "ActionGoal", "Result", "ActionResult", "Feedback", "ActionFeedback")
        expected = [p.stem for p in (folder / "msg").iterdir()] + [a + part for a in actions for part in parts]
        assert sorted(listed) == sorted(f"{package}/{name}" for name in expected)
        services = graph.run("rossrv", "package", package).stdout.split()
        assert sorted(services) == sorted(f"{package}/{p.stem}" for p in (folder / "srv").iterdir())
    shown = graph.run("rosmsg", "show", "rosAFE/InputProcAction").stdout  # needs std_msgs and actionlib_msgs
    assert "actionlib_msgs/GoalID goal_id" in shown and "string frame_id" in shown
    assert "float64[] data" in graph.run("rosmsg", "show", "rosAFE_TimeDomainSignalPortStruct").stdout
    assert graph.run("rosmsg", "md5", "rosAFE/InputProcAction").stdout.strip() == MD5_OF_INPUTPROC_ACTION


def test_rosrun_finds_the_executables(graph: Graph) -> None:
    for package, program in (("rosAFE", "rosAFE-ros"), ("bass", "bass-ros")):
        assert graph.run("rosrun", package, program, "--version").stdout.startswith(package)


def test_quick_if_up_to_date(copy: Path) -> None:
    """genpy is not imported: its import alone would take longer than the rest."""
    assert run(*generate(copy), env=environment()).returncode == 0
    ensure = "from rosafe.ros1.component import generate; generate.ensure_messages()"
    code = f"import sys; {ensure}; print('genpy' in sys.modules)"
    assert run(PYTHON, "-c", code, env=environment(PYTHONPATH=str(copy))).stdout == "False\n"
