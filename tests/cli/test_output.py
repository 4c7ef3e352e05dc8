"""What the product writes is complete or not there, and never two writers' mixture, whatever they and others do."""

from __future__ import annotations

import errno
import multiprocessing
import os
import re
import signal
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from rosafe import output
from rosafe.bass.sources.scene import Scene
from rosafe.output import AtomicOutput, OutputError, new_file
from tests.bass import bags
from tests.cli.command import refused, rosafe, start
from tests.harness import Process, wait_for

RATE = 8000
SCENE = ("--device", "scene:", "--rate", str(RATE), "--chunk", "400")


def written(path: Path) -> np.ndarray:
    """The samples of a recording, (2, frames)."""
    if path.suffix == ".bag":
        windows = [np.stack((message.left, message.right)) for message in bags.read(path, "/bass/Audio")]
        return np.concatenate([windows[0], *(window[:, -400:] for window in windows[1:])], axis=1)
    return np.asarray(soundfile.read(path, dtype="int32")[0].T)


def begun(path: Path, recording: Process) -> None:
    part = path.with_name(f"{path.name}.part")
    wait_for(lambda: part.exists() and part.stat().st_size > 20_000, what=lambda: str(recording))


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


# --- two recorders ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.wav", "a.bag"])
@pytest.mark.parametrize("force", [(), ("--force",)], ids=["", "force"])
def test_the_second_recorder_is_told_who_has_the_file(tmp_path: Path, name: str, force: tuple[str, ...]) -> None:
    path = tmp_path / name
    if force:
        path.write_text("of yesterday")
    with start("record", name, *SCENE, *force, cwd=tmp_path) as first:
        begun(path, first)
        for device in ("scene:?seed=1", "nosuch"):  # whatever it would listen to
            second = rosafe("record", name, "--device", device, "--rate", str(RATE), *force, cwd=tmp_path)
            refused(second, f"cannot write {name}: process {first.pid} (", f"rosafe record {name} ", "is writing it")
        if force:
            assert path.read_text() == "of yesterday"  # until the new one is complete
        else:
            assert not path.exists()
        assert first.stop(signal.SIGINT) == 0, first
    assert os.listdir(tmp_path) == [name]
    samples = written(path)
    assert samples.shape[1] > 2000 and np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))


@pytest.mark.parametrize("force", [(), ("--force",)], ids=["", "force"])
def test_many_at_the_same_time(tmp_path: Path, force: tuple[str, ...]) -> None:
    commands = [
        ("record", "a.wav", "--device", f"scene:?seed={seed}", *SCENE[2:], "--seconds", "1") for seed in range(5)
    ]
    with ExitStack() as stack:
        running = [stack.enter_context(start(*command, *force, cwd=tmp_path)) for command in commands]
        codes = [recording.wait(60) for recording in running]
        assert codes.count(0) >= 1 and (force or codes.count(0) == 1), running
        for code, recording in zip(codes, running, strict=True):
            assert code == 0 or re.search(
                r"a\.wav(: process \d+ \(.*\) is writing it| is there already)", recording.err
            )
    assert os.listdir(tmp_path) == ["a.wav"]
    samples = written(tmp_path / "a.wav")
    own = [np.array_equal(samples, Scene(RATE, seed=seed).frames(RATE)) for seed in range(5)]
    assert own.count(True) == 1 and codes[own.index(True)] == 0


def test_killed_recorders_leave_nothing_under_the_name(tmp_path: Path) -> None:
    """And their sound under another, which nobody overwrites unasked."""
    (tmp_path / "old.wav").write_text("of yesterday")
    with ExitStack() as stack:
        running = {
            name: stack.enter_context(start("record", name, *SCENE, *options, cwd=tmp_path))
            for name, options in {"new.wav": (), "new.bag": (), "old.wav": ("--force",)}.items()
        }
        for name, recording in running.items():
            begun(tmp_path / name, recording)
            recording.stop(signal.SIGKILL)
    assert sorted(os.listdir(tmp_path)) == ["new.bag.part", "new.wav.part", "old.wav", "old.wav.part"]
    assert (tmp_path / "old.wav").read_text() == "of yesterday"
    left = (tmp_path / "new.wav.part").read_bytes()
    done = rosafe("record", "new.wav", *SCENE, "--seconds", "1", cwd=tmp_path)
    refused(done, "new.wav.part is what an interrupted recording has left: rename or remove it; --force replaces it")
    refused(rosafe("record", "new.wav", "--force", "--device", "file:none.wav", cwd=tmp_path), "No such file")
    assert (tmp_path / "new.wav.part").read_bytes() == left
    (tmp_path / "new.wav.part").rename(tmp_path / "kept.wav")
    samples = written(tmp_path / "kept.wav")
    assert np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))
    done = rosafe("record", "old.wav", "--force", *SCENE, "--seconds", "0.5", cwd=tmp_path)
    assert done.returncode == 0 and written(tmp_path / "old.wav").shape[1] == RATE // 2
    assert not (tmp_path / "old.wav.part").exists()


def test_a_file_that_comes_into_being_meanwhile_stays_and_so_does_the_recording(tmp_path: Path) -> None:
    with start("record", "a.wav", *SCENE, cwd=tmp_path) as recording:
        begun(tmp_path / "a.wav", recording)
        (tmp_path / "a.wav").write_text("somebody else's")
        assert recording.stop(signal.SIGINT) == 1
        why = f"a.wav has come into being meanwhile; the recording is {tmp_path}/a.wav.part"
        assert recording.err == f"rosafe record: {why}\n"
    assert (tmp_path / "a.wav").read_text() == "somebody else's"
    (tmp_path / "a.wav.part").rename(tmp_path / "b.wav")
    samples = written(tmp_path / "b.wav")
    assert samples.shape[1] > 2000 and np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))


def test_nothing_recorded_leaves_nothing(tmp_path: Path) -> None:
    refused(rosafe("record", "a.bag", "--device", "nosuch", cwd=tmp_path), "Unknown PCM nosuch")
    assert os.listdir(tmp_path) == []


# --- any file ---------------------------------------------------------------------------------------------------


def _write_again_and_again(path: Path, letter: str, rounds: int) -> None:
    for _ in range(rounds):
        try:
            with new_file(path, replace=True) as descriptor:
                for _ in range(10):
                    os.write(descriptor, letter.encode() * 1000)
        except OutputError as problem:
            assert "is writing it" in str(problem), problem


def test_whoever_looks_sees_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_write_again_and_again, args=(path, letter, 200)) for letter in "abc"]
    for writer in writers:
        writer.start()
    looks = set()
    while any(writer.is_alive() for writer in writers):
        if path.exists():
            looks.add(path.read_text())
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    assert looks and looks <= {letter * 10_000 for letter in "abc"}
    assert os.listdir(tmp_path) == ["a"]


def test_an_error_on_the_way_leaves_things_as_they_were(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    for name, replace in (("old", True), ("new", False)):
        for problem, seen in ((KeyboardInterrupt(), KeyboardInterrupt), (OSError(28, "No space left"), OutputError)):
            with pytest.raises(seen), new_file(tmp_path / name, replace) as descriptor:
                os.write(descriptor, b"half")
                raise problem
    assert content(tmp_path) == {"old": "old"}


def test_places_that_are_taken(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("there")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "there")
    for name, replace, why in (
        ("there", False, "is there already; --force replaces it"),
        ("link", False, "is there already"),
        ("folder", True, "not a regular file"),
        ("fifo", True, "not a regular file"),
        ("no/such/folder", True, "there is no folder"),
        ("there/file", True, "Not a directory"),
        ("x" * 300, True, "File name too long"),
        ("a\0b", True, "null"),
    ):
        with pytest.raises(OutputError, match=why):
            AtomicOutput(tmp_path / name, replace)
    assert sorted(os.listdir(tmp_path)) == ["fifo", "folder", "link", "there"]


@pytest.mark.parametrize("replace", [False, True])
def test_the_part_is_never_somebody_elses_file(tmp_path: Path, replace: bool) -> None:
    (tmp_path / "precious").write_text("precious")
    os.mkfifo(tmp_path / "a.part")
    os.link(tmp_path / "precious", tmp_path / "b.part")
    (tmp_path / "c.part").symlink_to(tmp_path / "precious")
    (tmp_path / "d.part").mkdir()
    for name in "abcd":
        with pytest.raises(OutputError, match=f"cannot write .*/{name}: "), new_file(tmp_path / name, replace):
            raise AssertionError("it went on")
    assert (tmp_path / "precious").read_text() == "precious"


def test_links_lead_to_the_file(tmp_path: Path) -> None:
    """Two names of one place are one place."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "a")
    with new_file(tmp_path / "link", replace=False) as descriptor:
        with pytest.raises(OutputError, match="is writing it"):
            AtomicOutput(tmp_path / "deep" / "a", replace=False)
        os.write(descriptor, b"whole")
    assert (tmp_path / "link").is_symlink() and content(tmp_path / "deep") == {"a": "whole"}


def test_a_part_that_is_taken_away(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is not there any more"), new_file(tmp_path / "a", replace=False):
        (tmp_path / "a.part").rename(tmp_path / "b")
        (tmp_path / "a.part").write_text("somebody else's")
    assert content(tmp_path) == {"b": "", "a.part": "somebody else's"}


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOSYS, errno.EACCES])
def test_file_systems_that_cannot_rename_to_nothing_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, there: bool
) -> None:
    def renameat2(*_: object) -> int:
        if there:
            (tmp_path / "a").write_text("somebody else's")
        return -1

    library = SimpleNamespace(renameat2=renameat2)
    fake = SimpleNamespace(CDLL=lambda name, use_errno: library, get_errno=lambda: number)
    monkeypatch.setattr(output, "ctypes", fake)
    try:
        with new_file(tmp_path / "a", replace=False) as descriptor:
            os.write(descriptor, b"mine")
    except OutputError as problem:
        expected = "Permission denied" if number == errno.EACCES else "it has come into being meanwhile"
        assert (there or number == errno.EACCES) and expected in str(problem)
    else:
        assert not there
    assert content(tmp_path) == ({"a": "somebody else's"} if there else {} if number == errno.EACCES else {"a": "mine"})


def test_a_holder_of_whom_nothing_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output.glob, "iglob", lambda pattern: iter(()))  # as where it is another user's
    with new_file(tmp_path / "a", replace=False), pytest.raises(OutputError, match="another process is writing it"):
        AtomicOutput(tmp_path / "a", replace=False)
