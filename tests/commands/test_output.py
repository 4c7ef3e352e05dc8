"""Output files are complete or absent, and never a mixture of two writers."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe.audio.devices.scene import Scene
from rosafe.commands.__main__ import main
from rosafe.system import output
from rosafe.system.output import AtomicOutput, OutputError, new_file
from tests.audio import bags
from tests.commands import forked
from tests.commands.command import refused, rosafe, start
from tests.harness import Process, wait_for

RATE = 8000
SCENE = ("--device", "scene:", "--rate", str(RATE), "--chunk", "400")


def written(path: Path) -> np.ndarray:
    """Return the samples of a recording, (2, frames)."""
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


@pytest.mark.parametrize(("name", "force"), [("a.wav", ()), ("a.bag", ("--force",))])
def test_the_second_recorder_is_refused(tmp_path: Path, name: str, force: tuple[str, ...]) -> None:
    path = tmp_path / name
    if force:
        path.write_text("old recording")
    with start("record", name, *SCENE, *force, cwd=tmp_path) as first:
        begun(path, first)
        for device in ("scene:?seed=1", "nosuch"):  # with any device
            second = rosafe("record", name, "--device", device, "--rate", str(RATE), *force, cwd=tmp_path)
            refused(second, f"cannot write {name}: another process is writing it")
        if force:
            assert path.read_text() == "old recording"  # until the new one is complete
        else:
            assert not path.exists()
        assert first.stop(signal.SIGINT) == 0, first
    assert sorted(os.listdir(tmp_path)) == (["a.truth.csv", name] if name == "a.wav" else [name])
    samples = written(path)
    assert samples.shape[1] > 2000 and np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))


def test_killed_recorders_leave_nothing_under_the_name(tmp_path: Path) -> None:
    """Their sound is in a file of another name, which is not overwritten without --force."""
    (tmp_path / "old.wav").write_text("old recording")
    with ExitStack() as stack:
        running = {
            name: stack.enter_context(start("record", name, *SCENE, *options, cwd=tmp_path))
            for name, options in {"new.wav": (), "new.bag": (), "old.wav": ("--force",)}.items()
        }
        for name, recording in running.items():
            begun(tmp_path / name, recording)
            recording.stop(signal.SIGKILL)
    assert sorted(os.listdir(tmp_path)) == ["new.bag.part", "new.wav.part", "old.wav", "old.wav.part"]
    assert (tmp_path / "old.wav").read_text() == "old recording"
    left = (tmp_path / "new.wav.part").read_bytes()
    done = rosafe("record", "new.wav", *SCENE, "--seconds", "1", cwd=tmp_path)
    refused(done, "new.wav.part was left by an interrupted recording; rename or remove it, or replace it with --force")
    refused(rosafe("record", "new.wav", "--force", "--device", "file:none.wav", cwd=tmp_path), "No such file")
    assert (tmp_path / "new.wav.part").read_bytes() == left
    (tmp_path / "new.wav.part").rename(tmp_path / "kept.wav")
    samples = written(tmp_path / "kept.wav")
    assert np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))
    done = rosafe("record", "old.wav", "--force", *SCENE, "--seconds", "0.5", cwd=tmp_path)
    assert done.returncode == 0 and written(tmp_path / "old.wav").shape[1] == RATE // 2
    assert not (tmp_path / "old.wav.part").exists()


def test_a_file_created_meanwhile_and_the_recording_are_both_kept(tmp_path: Path) -> None:
    with start("record", "a.wav", *SCENE, cwd=tmp_path) as recording:
        begun(tmp_path / "a.wav", recording)
        (tmp_path / "a.wav").write_text("foreign text")
        assert recording.stop(signal.SIGINT) == 1
        why = f"a.wav was created meanwhile; the recording is {tmp_path}/a.wav.part"
        assert recording.err == f"rosafe record: {why}\n"
    assert (tmp_path / "a.wav").read_text() == "foreign text"
    (tmp_path / "a.wav.part").rename(tmp_path / "b.wav")
    samples = written(tmp_path / "b.wav")
    assert samples.shape[1] > 2000 and np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))


def test_a_truth_that_exists_is_kept(tmp_path: Path) -> None:
    """A scene is recorded with its truth beside it, which replaces a file only with --force."""
    (tmp_path / "a.truth.csv").write_text("foreign text")
    refused(rosafe("record", "a.wav", *SCENE, "--seconds", "0.5", cwd=tmp_path), "a.truth.csv already exists; --force")
    assert content(tmp_path) == {"a.truth.csv": "foreign text"}
    assert rosafe("record", "a.wav", "--force", *SCENE, "--seconds", "0.5", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.truth.csv").read_text().startswith("time_s,")


def test_the_truth_of_a_replaced_recording_is_removed(tmp_path: Path) -> None:
    """It would seem to be that of the new recording. A bag of the same name has no truth, and does not affect it."""
    for name in ("in.wav", "a.wav"):
        assert rosafe("record", name, *SCENE, "--seconds", "0.5", cwd=tmp_path).returncode == 0
    assert rosafe("record", "a.bag", *SCENE, "--seconds", "0.5", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.truth.csv").exists()
    refused(rosafe("record", "a.wav", "--device", "file:in.wav", cwd=tmp_path), "a.wav already exists")
    assert (tmp_path / "a.truth.csv").exists()
    assert rosafe("record", "a.wav", "--force", "--device", "file:in.wav", cwd=tmp_path).returncode == 0
    assert sorted(os.listdir(tmp_path)) == ["a.bag", "a.wav", "in.truth.csv", "in.wav"]
    (tmp_path / "b.truth.csv").write_text("foreign text")
    refused(rosafe("record", "b.wav", "--device", "file:in.wav", cwd=tmp_path), "b.truth.csv already exists")


def test_the_truth_is_complete_before_the_lock_of_the_recording_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, it could belong to the recording of another process with the same name."""
    monkeypatch.chdir(tmp_path)
    seen: list[list[str]] = []
    complete = AtomicOutput.complete

    def observed(part: AtomicOutput) -> None:
        if part.target.suffix == ".wav":
            seen.append(sorted(os.listdir(tmp_path)))
        complete(part)

    monkeypatch.setattr(AtomicOutput, "complete", observed)
    assert main(["record", "a.wav", *SCENE, "--seconds", "0.1", "--quiet"]) == 0
    assert seen == [["a.truth.csv", "a.wav.part"]] and sorted(os.listdir(tmp_path)) == ["a.truth.csv", "a.wav"]
    monkeypatch.setattr(
        AtomicOutput, "complete", lambda part: complete(part) if part.target.suffix == ".csv" else 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        main(["record", "b.wav", *SCENE, "--seconds", "0.1", "--quiet"])
    assert not (tmp_path / "b.truth.csv").exists()


def test_an_empty_recording_leaves_no_file(tmp_path: Path) -> None:
    refused(rosafe("record", "a.bag", "--device", "nosuch", cwd=tmp_path), "Unknown PCM nosuch")
    assert os.listdir(tmp_path) == []


# --- any file ---------------------------------------------------------------------------------------------------


def test_readers_always_see_a_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    writers = [forked.start(forked.write_again_and_again, path, letter, 100) for letter in "abc"]
    looks = set()
    while any(writer.is_alive() for writer in writers):
        if path.exists():
            looks.add(path.read_text())
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    assert looks and looks <= {letter * 10_000 for letter in "abc"}
    assert os.listdir(tmp_path) == ["a"]


def test_an_error_while_writing_changes_no_file(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    for name, replace in (("old", True), ("new", False)):
        for problem, seen in ((KeyboardInterrupt(), KeyboardInterrupt), (OSError(28, "No space left"), OutputError)):
            with pytest.raises(seen), new_file(tmp_path / name, replace) as descriptor:
                os.write(descriptor, b"half")
                raise problem
    assert content(tmp_path) == {"old": "old"}


def test_existing_targets(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("there")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "there")
    for name, replace, why in (
        ("there", False, "already exists; --force replaces it"),
        ("link", False, "already exists"),
        ("folder", True, "not a regular file"),
        ("fifo", True, "not a regular file"),
        ("no/such/folder", True, "does not exist"),
        ("there/file", True, "Not a directory"),
        ("x" * 300, True, "File name too long"),
        ("a\0b", True, "null"),
    ):
        with pytest.raises(OutputError, match=why):
            AtomicOutput(tmp_path / name, replace)
    assert sorted(os.listdir(tmp_path)) == ["fifo", "folder", "link", "there"]


@pytest.mark.parametrize("replace", [False, True])
def test_the_part_file_never_replaces_a_foreign_file(tmp_path: Path, replace: bool) -> None:
    (tmp_path / "precious").write_text("precious")
    os.mkfifo(tmp_path / "a.part")
    os.link(tmp_path / "precious", tmp_path / "b.part")
    (tmp_path / "c.part").symlink_to(tmp_path / "precious")
    (tmp_path / "d.part").mkdir()
    for name in "abcd":
        with pytest.raises(OutputError, match=f"cannot write .*/{name}: "), new_file(tmp_path / name, replace):
            raise AssertionError("it went on")
    assert (tmp_path / "precious").read_text() == "precious"


def test_links_to_the_file(tmp_path: Path) -> None:
    """Two names of one file are regarded as one target."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "a")
    with new_file(tmp_path / "link", replace=False) as descriptor:
        with pytest.raises(OutputError, match="is writing it"):
            AtomicOutput(tmp_path / "deep" / "a", replace=False)
        os.write(descriptor, b"whole")
    assert (tmp_path / "link").is_symlink() and content(tmp_path / "deep") == {"a": "whole"}


def test_a_part_file_that_is_removed(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="has been removed"), new_file(tmp_path / "a", replace=False):
        (tmp_path / "a.part").rename(tmp_path / "b")
        (tmp_path / "a.part").write_text("foreign text")
    assert content(tmp_path) == {"b": "", "a.part": "foreign text"}


def test_files_that_belong_together_appear_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    targets = [tmp_path / name for name in ("a.csv", "b.csv")]
    (tmp_path / "b.csv").write_text("old")
    with pytest.raises(OutputError, match=r"b\.csv already exists; --force replaces it"):
        output.write_files(dict.fromkeys(targets, b"new"), False)
    with monkeypatch.context() as patch:
        patch.setattr(output, "_write", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left")))
        with pytest.raises(OutputError, match=r"cannot write .*a\.csv: No space left"):
            output.write_files(dict.fromkeys(targets, b"new"), True)
    assert [path.name for path in tmp_path.iterdir()] == ["b.csv"] and targets[1].read_text() == "old"
    output.write_files(dict.fromkeys(targets, b"new"), True)
    assert {path.read_text() for path in targets} == {"new"} and len(list(tmp_path.iterdir())) == 2


def test_a_check_of_a_target_leaves_nothing(tmp_path: Path) -> None:
    output.check_target(tmp_path / "new", False)
    assert not list(tmp_path.iterdir())
    for target, message in ((tmp_path / "none" / "new", "does not exist"), (tmp_path, "not a regular file")):
        with pytest.raises(OutputError, match=message):
            output.check_target(target, True)
    (tmp_path / "old").write_text("old")
    output.check_target(tmp_path / "old", True)
    assert (tmp_path / "old").read_text() == "old"


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF])
def test_outputs_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """On file systems such as NFS and Lustre."""

    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    for replace in (False, True):
        output.write_files({tmp_path / "a": b"whole"}, replace)
    with pytest.raises(output.OutputError, match="already exists"):
        output.check_target(tmp_path / "a", False)
    assert (tmp_path / "a").read_text() == "whole" and len(list(tmp_path.iterdir())) == 1
