"""Only regular files are read: all readers of files reject a FIFO, a socket or a device by name, at once."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import rosafe
from rosafe.audio.files.audiofile import AudioFile, AudioFileError
from rosafe.audio.files.bagsound import BagSoundError, Recording
from rosafe.commands import CommandError
from rosafe.commands.setup import read_file
from rosafe.interface import ComponentError
from rosafe.localization import results
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.noise import NoiseCalibration
from rosafe.processing.corpus import write_failed
from rosafe.processing.files import process_file
from rosafe.system import input as inputs
from rosafe.system.input import open_descriptor, open_regular, read_regular
from rosafe.tree.setups import Setup
from rosafe.tree.setups.state_file import TreeStateFile
from tests.harness import PYTHON, SCRIPTS, Graph, proc, run_program

BY_SUFFIX: dict[str, Callable[[Path], object]] = {
    ".npz": rosafe.load,
    ".h5": rosafe.load,
    ".sofa": rosafe.Head.from_sofa,
    ".head": DirectionModel.load,
    ".json": NoiseCalibration.load,
    ".csv": results.read_yaw,
}
ERRORS = (OSError, ValueError, AudioFileError, BagSoundError, ComponentError, CommandError)
READERS: dict[str, Callable[[Path], object]] = {
    "sound": AudioFile,
    "bag": lambda path: Recording(path, None, threading.Event()),
    "setup": lambda path: read_file(str(path)),
    "kept": lambda path: TreeStateFile(path, Setup, print).saved(),
    "offline": lambda path: process_file(path, path.with_name("out.npz")),
    "failed.csv": lambda path: write_failed(path.parent, [], {"a": "b"}),
    **BY_SUFFIX,
}


@pytest.fixture(params=["FIFO", "socket", "character device"])
def special_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "special"
    if request.param == "FIFO":
        os.mkfifo(path)
    elif request.param == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))
    else:
        path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize("reader", READERS)
def test_special_file_is_rejected(special_file: Path, reader: str) -> None:
    name = reader if reader == "failed.csv" else f"special{reader}" if reader in BY_SUFFIX else "special"
    path = special_file.with_name(name)
    if path != special_file:
        special_file.rename(path)
    with pytest.raises(ERRORS) as refusal:
        READERS[reader](path)
    text = str(refusal.value)
    assert "\n" not in text
    assert path.name in text
    assert "expected a regular file, got a" in text


def test_regular_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"content")
    with open_regular(path) as file:
        assert file.read() == b"content"
    assert read_regular(path, 3) == b"con"
    with pytest.raises(IsADirectoryError, match="got a directory"):
        open_descriptor(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_descriptor(tmp_path / "missing")


def test_file_replaced_while_it_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A FIFO replaces the file between the check and the opening."""
    opened = proc("self", "fd")
    path = tmp_path / "file"
    path.touch()
    check = inputs._check

    def exchange(status: os.stat_result, name: Path) -> None:
        check(status, name)
        path.unlink()
        os.mkfifo(path)

    monkeypatch.setattr(inputs, "_check", exchange)
    descriptors = len(os.listdir(opened))
    with pytest.raises(OSError, match="got a FIFO") as refusal:
        open_descriptor(path)
    assert refusal.value.errno == errno.EINVAL
    assert len(os.listdir(opened)) == descriptors


def test_sound_file_opens_no_other_file(tmp_path: Path) -> None:
    """Given a name, libsndfile opens the resource fork beside an unknown file, and would block on this FIFO."""
    path = tmp_path / "noise.wav"
    path.write_bytes(b"no sound " * 100)
    os.mkfifo(tmp_path / "._noise.wav")
    with pytest.raises(AudioFileError, match="expected a sound file, got another file"):
        AudioFile(path)


@pytest.mark.parametrize("extension", [".vox", ".gsm"])
def test_extension_makes_no_sound_file(tmp_path: Path, extension: str) -> None:
    """With formats without a header, any file would be sound."""
    path = tmp_path / f"secret{extension}"
    path.write_bytes(b"a secret " * 1000)
    with pytest.raises(AudioFileError, match="expected a sound file, got another file"):
        AudioFile(path)


def test_commands(graph: Graph, tmp_path: Path) -> None:
    """The commands exit with one line that names the file."""
    fifo = tmp_path / "fifo.yaml"
    os.mkfifo(fifo)
    kept = graph.run("rosAFE-ros", "--keep", str(fifo), check=False)
    loaded = graph.run("rosafe", "setup", "load", str(fifo), check=False)
    for done in (kept, loaded):
        assert done.returncode == 1
        lines = [line for line in done.stderr.splitlines() if str(fifo) in line]
        assert len(lines) == 1
        assert f"{fifo}: expected a regular file, got a FIFO" in lines[0]


def test_standard_input_can_be_a_pipe(graph: Graph) -> None:
    """The error for invalid content shows that `-` is read from the pipe."""
    done = run_program([PYTHON, str(SCRIPTS / "rosafe"), "setup", "load", "-"], input="nothing: here\n", env=graph.env)
    assert (done.returncode, "unknown 'nothing'" in done.stderr) == (1, True)
