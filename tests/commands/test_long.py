"""`rosafe process` on long files: constant memory, progress, and interruptions."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe import load, process
from tests.commands.command import ROSAFE, environment, noise, rosafe, start, write
from tests.harness import ROOT, proc, run_program, wait_for

pytestmark = pytest.mark.long

RATE = 16000
ONE_CHANNEL = ("--set", "fb_cfHz=1000")
OUTPUTS = ("--outputs", "input,ihc,ild")  # of one channel: 32 bytes per frame


def write_long(path: Path, seconds: int) -> Path:
    """Write noise that repeats every second."""
    second = np.int16(noise(RATE).T * 2**15)
    with soundfile.SoundFile(path, "w", RATE, 2, "PCM_16") as file:
        for _ in range(seconds):
            file.write(second)
    return path


def peak_kilobytes(*arguments: str | Path) -> int:
    """Return the peak memory of the command and its children."""
    program = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    done = run_program(
        ["/usr/bin/python3", "-c", program, str(ROSAFE), *map(str, arguments)], env=environment(), check=True
    )
    return int(done.stdout)


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """Four minutes need as much memory as ten seconds, although the output has 120 MB."""
    short, long = (write_long(tmp_path / f"{seconds}.wav", seconds) for seconds in (10, 240))
    more = (*ONE_CHANNEL, *OUTPUTS, "--format", "h5")
    peaks = {path: peak_kilobytes("process", "-q", path, *more) for path in (short, long)}
    assert long.with_suffix(".h5").stat().st_size > 120e6
    assert peaks[long] < peaks[short] + 25_000, peaks
    assert peaks[long] < 350_000, peaks

    # and the numbers are right at the beginning and at the end
    mapped, loaded = load(long.with_suffix(".h5")), load(short.with_suffix(".h5"))
    assert mapped["ihc"].shape == (2, 1, 240 * RATE)
    assert mapped["ild"].shape == (1, 240 * 100 - 1)
    np.testing.assert_array_equal(mapped["ihc"][..., : 10 * RATE], loaded["ihc"])
    np.testing.assert_array_equal(mapped["ild"][:, :999], loaded["ild"])
    second = soundfile.read(short, RATE, dtype="int32")[0].T
    np.testing.assert_array_equal(mapped["input"][:, -RATE:], second / (2**31 - 1))
    # For a periodic signal the filter has the same state after four minutes as after ten seconds.
    np.testing.assert_allclose(mapped["ihc"][..., -RATE:], mapped["ihc"][..., 9 * RATE : 10 * RATE], rtol=0, atol=1e-12)
    expected = process(np.tile(second, 2), RATE, parameters={"fb_cfHz": [1000.0]}, outputs=["ihc"])["ihc"]
    np.testing.assert_array_equal(mapped["ihc"][..., : 2 * RATE], expected)
    for path in tmp_path.iterdir():
        path.unlink()  # pytest keeps folders


# --- interruptions ---


@pytest.fixture
def long_file(tmp_path: Path) -> Path:
    """A sparse file of half an hour, whose processing is always interrupted."""
    path = write(tmp_path / "in.wav", noise(RATE))
    head = path.read_bytes()[:44]
    size = 4 * RATE * 1800
    with open(path, "r+b") as file:
        file.write(head[:4] + (36 + size).to_bytes(4, "little") + head[8:40] + size.to_bytes(4, "little"))
        file.truncate(44 + size)
    return path


def begun(part: Path) -> Callable[[], bool]:
    """Return a condition: the output has been started."""
    return part.exists


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals(long_file: Path, number: int, code: int) -> None:
    with start("process", long_file.name, "--outputs", "ild", cwd=long_file.parent) as command:
        wait_for(begun(long_file.with_name("in.npz.part")), what=lambda: str(command))
        assert command.stop(number) == code
        assert command.err == "rosafe process: interrupted; unfinished results were removed\n"
    assert [path.name for path in long_file.parent.iterdir()] == ["in.wav"]


def test_ctrl_c_at_the_terminal(long_file: Path) -> None:
    """The terminal sends the signal to the command and its children; several files; two key presses."""
    for name in ("b", "c"):
        os.link(long_file, long_file.with_name(f"{name}.wav"))
    here = long_file.parent
    with start("process", "in.wav", "b.wav", "c.wav", "--jobs", "2", "--outputs", "ild", cwd=here) as command:
        wait_for(lambda: begun(here / "in.npz.part")() and begun(here / "b.npz.part")(), what=lambda: str(command))
        children = _children(command.pid)
        assert len(children) == 2
        for _ in range(2):
            os.killpg(command.pid, signal.SIGINT)
        assert command.wait() == 130
        assert command.err == "rosafe process: interrupted; unfinished results were removed\n"
    assert {path.name for path in here.iterdir()} == {"in.wav", "b.wav", "c.wav"}
    assert not any(proc(child).exists() for child in children)


def test_a_child_that_ends_first_by_the_same_signal_has_not_failed() -> None:
    program = """
import os, signal
from rosafe.commands._workers import Interrupted, Interrupts, run_parallel

def work(progress):
    os.kill(os.getppid(), signal.SIGINT)
    raise Interrupted(signal.SIGINT)

run_parallel([work], 1, (), lambda index, task: print(task), Interrupts())
"""
    done = run_program(["/usr/bin/python3", "-c", program], env=environment(), cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_killed(long_file: Path) -> None:
    """The children end with the command, and their leftovers do not disturb the next run."""
    here, part = long_file.parent, long_file.with_name("in.npz.part")
    with start("process", "in.wav", "--outputs", "ild", cwd=here) as command:
        wait_for(begun(part), what=lambda: str(command))
        (child,) = _children(command.pid)
        command.stop(signal.SIGKILL)
        wait_for(lambda: not proc(child).exists(), what="end of the child")
    assert not (here / "in.npz").exists()
    part.write_bytes(b"left by one that could not clean up" * 1000)
    write(long_file, noise(3000))
    assert rosafe("process", "in.wav", *ONE_CHANNEL, cwd=here).returncode == 0
    assert {path.name for path in here.iterdir()} == {"in.wav", "in.npz"}
    assert load(here / "in.npz")["ild"].shape == (1, 17)


def test_a_killed_child_is_reported(long_file: Path) -> None:
    here = long_file.parent
    with start("process", "in.wav", "--outputs", "ild", cwd=here) as command:
        wait_for(begun(here / "in.npz.part"), what=lambda: str(command))
        (child,) = _children(command.pid)
        os.kill(child, signal.SIGKILL)
        assert command.wait() == 1
        assert command.err == "rosafe process: in.wav: the process ended too early, with signal 9\n"
    assert not (here / "in.npz").exists()


def _children(pid: int) -> list[int]:
    return [int(child) for child in proc(pid, "task", pid, "children").read_text().split()]


# --- progress ---


def test_few_lines_without_a_terminal(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(5 * RATE))
    done = rosafe("process", path, "--block", "100", *ONE_CHANNEL, "--outputs", "ild")
    assert done.returncode == 0
    assert "\r" not in done.stderr and "\x1b" not in done.stderr
    assert done.stderr.startswith(f"{path} -> {path.with_suffix('.npz')}: 5.0 s of sound, ")
    assert done.stderr.count("\n") <= 3


@pytest.mark.exploration
def test_the_reader_of_messages_ends(long_file: Path) -> None:
    """`rosafe process ... 2>&1 | head`: no traceback and no leftovers."""
    read, write_end = os.pipe()
    os.close(read)
    short = write(long_file.with_name("short.wav"), noise(3000))
    process_ = subprocess.run(
        [str(ROSAFE), "process", "in.wav", short.name, "--outputs", "ild"],
        cwd=long_file.parent,
        env=environment(),
        stderr=write_end,
        stdout=write_end,
        timeout=120,
        check=False,
    )
    os.close(write_end)
    assert process_.returncode == 141
    assert not list(long_file.parent.glob("*.part"))
