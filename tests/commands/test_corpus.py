"""`rosafe process` on folders: nested, linked and faulty ones, killed and resumed runs, concurrent runs."""

from __future__ import annotations

import csv
import fcntl
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rosafe import load, process
from rosafe.processing.corpus import find
from tests.commands.command import (
    ROSAFE,
    SMALL,
    SMALL_PARAMETERS,
    as_int32,
    environment,
    ild_in,
    noise,
    refused,
    rosafe,
    start,
    write,
)
from tests.harness import wait_for
from tests.terminal import Terminal

RATE = 16000
STRICT = "utf-8:strict"  # in most locales stdout raises an error for bytes that are not UTF-8
OPTIONS = (*SMALL, "--outputs", "ild")


def corpus(folder: Path, count: int, frames: int = 3000) -> dict[str, np.ndarray]:
    """Write sounds in folders below `folder`; return them by their relative names without .wav."""
    made = {}
    for number in range(count):
        place = ("", "sub dir/", "sub dir/ünï/")[number % 3] + f"s{number}"
        path = folder / f"{place}.wav"
        path.parent.mkdir(parents=True, exist_ok=True)
        made[place] = noise(frames, number)
        write(path, made[place], RATE)
    return made


def assert_results(folder: Path, sounds: dict[str, np.ndarray], extension: str = ".npz") -> None:
    """Assert that the folder contains the correct results of these sounds and, at most, failed.csv."""
    there = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert there - {"failed.csv"} == {f"{name}{extension}" for name in sounds}
    for name, sound in sounds.items():
        expected = process(as_int32(sound), RATE, parameters=SMALL_PARAMETERS, outputs=["ild"])
        np.testing.assert_array_equal(ild_in(folder / f"{name}{extension}"), expected["ild"], err_msg=name)


def failed(folder: Path) -> dict[str, str]:
    with open(folder / "failed.csv", encoding="utf-8", errors="surrogateescape", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["input", "why"]
    return dict(rows)


def test_nested_folders(tmp_path: Path) -> None:
    sounds = corpus(tmp_path / "corpus", 7)
    (tmp_path / "corpus" / "notes.txt").write_text("no sound")
    (tmp_path / "corpus" / "._s0.wav").write_text("what some systems leave")
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--format", "h5", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.startswith("7 files: 7 done; 1.3 s of sound, "), done
    assert done.stderr.count("\n") == 1
    assert_results(tmp_path / "out", sounds, ".h5")
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--format", "h5", "--resume", "-v", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.endswith("\n7 files: 0 done, 7 already complete\n"), done
    assert done.stderr.count(": already complete\n") == 7


def test_several_sounds_with_one_name(tmp_path: Path) -> None:
    here = tmp_path / "corpus"
    sounds = corpus(here, 1)
    for name in ("a.wav", "a.flac", "a.wav.aiff", "failed.wav"):
        sounds[name.removesuffix(".aiff")] = noise(3000, len(name))
        write(here / name, sounds[name.removesuffix(".aiff")])
    sounds["a.wav.aiff"] = sounds["a.wav"]
    sounds["a.wav"] = noise(3000, len("a.wav"))
    sounds["a.wav.aiff"] = noise(3000, len("a.wav.aiff"))
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--format", "csv", cwd=tmp_path)
    assert done.returncode == 0, done
    assert_results(tmp_path / "out", sounds, ".csv")


def test_several_folders(tmp_path: Path) -> None:
    sounds = {f"{name}/{place}": sound for name in "ab" for place, sound in corpus(tmp_path / name, 2).items()}
    assert rosafe("process", "a", "b/", "-o", "out", *OPTIONS, cwd=tmp_path).returncode == 0
    assert_results(tmp_path / "out", sounds)
    refused(
        rosafe("process", "a", tmp_path / "a", "-o", "other", *OPTIONS, cwd=tmp_path), "would both be written to other"
    )
    refused(rosafe("process", "a", *OPTIONS, cwd=tmp_path), "a is a folder; name a folder for its results with -o")
    refused(
        rosafe("process", "a", "-o", "x.npz", *OPTIONS, cwd=tmp_path), "for several files, expected an existing folder"
    )
    refused(
        rosafe("process", "a", "-o", "x.v2", *OPTIONS, cwd=tmp_path), "for several files, expected an existing folder"
    )


def test_results_within_the_corpus(tmp_path: Path) -> None:
    sounds = corpus(tmp_path, 3)
    for _ in range(2):
        done = rosafe("process", ".", "-o", "out", *OPTIONS, "--resume", cwd=tmp_path)
        assert done.returncode == 0 and done.stderr.startswith("3 files: "), done
        (tmp_path / "out" / "heard.wav").write_bytes((tmp_path / "s0.wav").read_bytes())  # not an input
    (tmp_path / "out" / "heard.wav").unlink()
    assert_results(tmp_path / "out", sounds)


def test_links(tmp_path: Path) -> None:
    """Links are followed, except to a folder that has been searched already."""
    sounds = corpus(tmp_path / "elsewhere", 2)
    here = tmp_path / "corpus"
    here.mkdir()
    (here / "linked").symlink_to(tmp_path / "elsewhere")
    (here / "one.wav").symlink_to("linked/s0.wav")
    (tmp_path / "elsewhere" / "up").symlink_to(here)
    (here / "nowhere.wav").symlink_to("nothing.wav")
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path)
    assert done.returncode == 1
    required = {f"linked/{name}": sound for name, sound in sounds.items()} | {"one": sounds["s0"]}
    assert_results(tmp_path / "out", required)
    assert failed(tmp_path / "out") == {"corpus/nowhere.wav": "corpus/nowhere.wav: No such file or directory"}


def test_folders_that_link_to_each_other(tmp_path: Path) -> None:
    """Each real folder is searched once, by its own name if it is in the corpus."""
    names = [f"f{number}" for number in range(9)]
    sounds = {}
    for number, name in enumerate(names):
        (tmp_path / "corpus" / name).mkdir(parents=True)
        sounds[f"{name}/s"] = noise(3000, number)
        write(tmp_path / "corpus" / name / "s.wav", sounds[f"{name}/s"])
        for other in names:
            (tmp_path / "corpus" / name / f"0{other}").symlink_to(Path("..", other))
    items, problems = find([tmp_path / "corpus"])
    assert [str(item.place) for item in items] == [f"{name}.wav" for name in sounds] and not problems
    items, problems = find([tmp_path / "corpus" / "f1"])  # the others are elsewhere
    assert sorted(str(item.place) for item in items) == sorted(
        ["s.wav", *(f"0{name}/s.wav" for name in names if name != "f1")]
    )
    assert not problems
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.startswith("9 files: 9 done; "), done
    assert_results(tmp_path / "out", sounds)


def nest(folder: Path, name: str, levels: int, every: int) -> None:
    """Create nested folders with a copy of `s.wav` at each `every`-th level. The paths are too long for the system."""
    sound = (folder / "s.wav").read_bytes()
    at = os.open(folder, os.O_RDONLY)
    for level in range(1, levels + 1):
        os.mkdir(name, dir_fd=at)
        below = os.open(name, os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = below
        if level % every == 0:
            with open(os.open("s.wav", os.O_CREAT | os.O_WRONLY, 0o644, dir_fd=at), "wb") as file:
                file.write(sound)
    os.close(at)


def test_very_deep_folders(tmp_path: Path) -> None:
    here = tmp_path / "corpus"
    here.mkdir()
    write(here / "s.wav", noise(3000))
    try:
        nest(here, "d", 1500, 500)
        done = rosafe("process", here, "-o", tmp_path / "out", *OPTIONS)
        assert done.returncode == 0 and done.stderr.startswith("4 files: 4 done; "), done.stderr[-500:]
        results = [tmp_path / "out" / ("d/" * depth) / "s.npz" for depth in (0, 500, 1000, 1500)]
        for result in results[1:]:
            np.testing.assert_array_equal(load(result)["ild"], load(results[0])["ild"])
    finally:
        subprocess.run(["rm", "-rf", here, tmp_path / "out"], check=True)  # shutil.rmtree is recursive


def test_folders_whose_paths_are_too_long(tmp_path: Path) -> None:
    """The folder is reported in one line, and the others are processed. A name that is too long leaves no file."""
    here = tmp_path / "corpus"
    here.mkdir()
    write(here / "s.wav", noise(3000))
    try:
        nest(here, "d" * 250, 20, 15)
        done = rosafe("process", here, "-o", tmp_path / "out", *OPTIONS)
        summary, *lines = done.stderr.splitlines()
        assert done.returncode == 1 and summary.startswith("3 files: 2 done, 1 failed; "), summary
        assert len(lines) == 1 and lines[0].endswith(": File name too long")
        assert len(failed(tmp_path / "out")) == 1
        longer = "/".join(["e" * 250] * 15)
        done = rosafe("process", here, "-o", tmp_path / "other" / longer, *OPTIONS, "-q")
        assert done.returncode == 1 and done.stderr.count(": File name too long\n") == 2, done.stderr[-500:]
        done = rosafe("process", here, "-o", tmp_path / "none" / longer / longer, *OPTIONS)
        assert done.returncode == 1 and done.stderr.endswith(": File name too long\n") and done.stderr.count("\n") == 1
        assert not (tmp_path / "none").exists()
    finally:
        subprocess.run(["rm", "-rf", here, tmp_path / "out", tmp_path / "other"], check=True)


@pytest.mark.parametrize("extension", [".npz", ".h5", ".mat", ".csv"])
def test_names_that_are_not_utf8(tmp_path: Path, extension: str) -> None:
    """Such files are read, written, resumed and plotted. Results contain the name as text, failed.csv as bytes."""
    here = tmp_path / "corp\udcffus"
    here.mkdir()
    sound = noise(3000)
    write(tmp_path / "s.wav", sound)
    (tmp_path / "s.wav").rename(here / "s\udcfe.wav")
    (here / "bad\udcff.wav").write_text("no sound")
    options = ("-o", "out\udcff", *OPTIONS, "--format", extension[1:])
    done = rosafe("process", here.name, *options, cwd=tmp_path, PYTHONIOENCODING=STRICT)
    assert done.returncode == 1 and r"corp\xffus/bad\xff.wav" in done.stderr, done
    result = tmp_path / "out\udcff" / f"s\udcfe{extension}"
    assert_named_as_text(result, sound)
    assert list(failed(tmp_path / "out\udcff")) == ["corp\udcffus/bad\udcff.wav"]
    done = rosafe("process", here.name, *options, "--resume", "-v", cwd=tmp_path, PYTHONIOENCODING=STRICT)
    assert r"s\xfe.wav -> " in done.stderr and done.stderr.count(": already complete\n") == 1, done
    if extension == ".npz":
        done = rosafe("plot", result, "-o", tmp_path / "p\udcff.png", PYTHONIOENCODING=STRICT)
        assert done.returncode == 0 and not done.stderr and (tmp_path / "p\udcff.png").stat().st_size, done


def assert_named_as_text(result: Path, sound: np.ndarray) -> None:
    expected = process(as_int32(sound), RATE, parameters=SMALL_PARAMETERS, outputs=["ild"])
    np.testing.assert_array_equal(ild_in(result), expected["ild"])
    if result.suffix in (".npz", ".h5"):
        assert load(result)["source"] == r"s\xfe.wav"
    else:
        assert b"s\\xfe.wav" in result.read_bytes().replace(b"\\\\", b"\\")  # escaped in JSON


def test_failures_are_listed_and_the_others_are_processed(tmp_path: Path) -> None:
    here = tmp_path / "corpus"
    sounds = corpus(here, 4)
    (here / "empty.wav").write_bytes(b"")
    write(here / "none.wav", np.zeros((2, 0)))
    write(here / "new\nline.wav", noise(100)[:1])
    (here / os.fsdecode(b"\xff.wav")).write_bytes(b"RIFF")
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path)
    assert done.returncode == 1
    summary, *lines = done.stderr.splitlines()
    assert summary.startswith("8 files: 4 done, 4 failed; ")
    assert [line.split(" ", 4)[:3] for line in lines] == [["rosafe", "process:", line.split()[2]] for line in lines]
    assert lines[0] == "rosafe process: corpus/empty.wav: expected a sound file, got an empty file"
    assert (
        any("new\\nline.wav: expected two channels" in line for line in lines)
        and "none.wav: expected samples, got none" in done.stderr
    )
    assert len(failed(tmp_path / "out")) == 4 and "corpus/new\nline.wav" in failed(tmp_path / "out")
    assert_results(tmp_path / "out", sounds)
    for bad in ("none.wav", "new\nline.wav", os.fsdecode(b"\xff.wav")):
        (here / bad).unlink()
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--resume", cwd=tmp_path)
    assert done.returncode == 1 and list(failed(tmp_path / "out")) == ["corpus/empty.wav"]
    sounds["empty"] = noise(500)
    write(here / "empty.wav", sounds["empty"])
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--resume", cwd=tmp_path)
    assert (done.returncode, (tmp_path / "out" / "failed.csv").exists()) == (0, False), done
    assert_results(tmp_path / "out", sounds)


def test_empty_folders_and_a_foreign_list_of_failures(tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    done = rosafe("process", "nothing", "-o", "out", *OPTIONS, cwd=tmp_path)
    refused(done, "nothing: this folder contains no sound files")
    sounds = corpus(tmp_path / "corpus", 1)
    (tmp_path / "out" / "failed.csv").write_text("my own list\n")
    done = rosafe("process", "corpus", "nothing", "-o", "out", *OPTIONS, cwd=tmp_path)
    assert done.returncode == 1 and "failed.csv is not a list of failures" in done.stderr
    assert (tmp_path / "out" / "failed.csv").read_text() == "my own list\n"
    (tmp_path / "out" / "failed.csv").unlink()
    assert_results(tmp_path / "out", {f"corpus/{name}": sound for name, sound in sounds.items()})


def test_existing_results_are_kept_unless_resume_is_given(tmp_path: Path) -> None:
    sounds = corpus(tmp_path / "corpus", 2)
    assert rosafe("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path).returncode == 0
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path)
    assert done.returncode == 1 and done.stderr.count("already exists; --resume keeps it, --force replaces it") == 2
    done = rosafe(
        "process", "corpus", "-o", "out", "--set", "fb_cfHz=500", "--outputs", "ild", "--resume", cwd=tmp_path
    )
    assert done.returncode == 1 and done.stderr.count("was computed with other parameters; choose another -o") == 2
    assert_results(tmp_path / "out", sounds)


def is_locked(path: Path) -> bool:
    """Return whether a process has locked the file, also a killed one that the kernel has not ended yet."""
    with open(path, encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_killed_and_resumed(tmp_path: Path) -> None:
    """All results are complete whenever the command is killed, and in the end none is missing."""
    sounds = corpus(tmp_path / "corpus", 40)
    out = tmp_path / "out"
    for required in (5, 20):
        with start("process", "corpus", "-o", "out", *OPTIONS, "--resume", cwd=tmp_path) as command:
            wait_for(lambda: len(list(out.rglob("*.npz"))) >= required, what=lambda: str(command))  # noqa: B023
            os.killpg(command.pid, signal.SIGKILL)
            command.wait()
        wait_for(lambda: not any(map(is_locked, out.rglob("*.part"))), what="the end of all killed processes")
        for path in out.rglob("*.npz"):
            assert load(path)["ild"].shape == (3, 17)
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--resume", cwd=tmp_path)
    assert done.returncode == 0 and "already complete" in done.stderr, done
    assert_results(out, sounds)


def test_interrupted(tmp_path: Path) -> None:
    corpus(tmp_path / "corpus", 60)
    out = tmp_path / "out"
    with start("process", "corpus", "-o", "out", *OPTIONS, cwd=tmp_path) as command:
        wait_for(lambda: len(list(out.rglob("*.npz"))) >= 3, what=lambda: str(command))
        os.killpg(command.pid, signal.SIGINT)
        assert command.wait() == 130
    assert command.err == "rosafe process: interrupted; unfinished results were removed; continue with --resume\n"
    assert not list(out.rglob("*.part"))


def test_the_progress_bar_shows_files_and_the_remaining_time(tmp_path: Path) -> None:
    corpus(tmp_path / "corpus", 60)
    command = [str(ROSAFE), "process", "corpus", "-o", "out", *OPTIONS, "--jobs", "1"]
    with Terminal(command, environment(), cwd=tmp_path, columns=100) as terminal:
        terminal.expect(" files/s")
        text = terminal.sent
        terminal.press("\x03")
        terminal.end()
    line = text.split("\r")[-1]
    assert "\n" not in text and line.startswith("[") and " of 60 files, " in line
