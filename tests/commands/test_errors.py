"""Refused inputs of `rosafe process`: one clear line, the right exit code, no leftover and no lost file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.commands.command import SMALL, noise, refused, rosafe, write


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the sound file in.wav."""
    write(tmp_path / "in.wav", noise(3000))
    return tmp_path


def assert_untouched(folder: Path, *others: str) -> None:
    assert {path.name for path in folder.iterdir()} == {"in.wav", *others}


# --- the input ---


def test_damaged_in_the_middle(folder: Path) -> None:
    """The damage is detected after half of the output was written."""
    content = bytearray(write(folder / "bad.flac", noise(200000)).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 30000] = bytes(30000)
    (folder / "bad.flac").write_bytes(content)
    # -q: on a busy machine, a line of progress would precede the error
    refused(rosafe("process", "-q", "bad.flac", *SMALL, "--outputs", "ild", cwd=folder), "bad.flac")
    assert_untouched(folder, "bad.flac")


def test_missing_folder_and_unreadable(folder: Path) -> None:
    refused(rosafe("process", "nothing.wav", cwd=folder), "nothing.wav", "No such file")
    refused(rosafe("process", ".", cwd=folder), ". is a folder", "-o")
    assert_untouched(folder)


# --- parameters and outputs ---


def test_parameters(folder: Path) -> None:
    """The checks of `rosafe.process`, which has tests of all of them, apply to texts."""
    refused(rosafe("process", "in.wav", "--set", "fb_cfHz=100,abc", cwd=folder), "fb_cfHz", "abc")
    assert_untouched(folder)


def test_a_parameter_given_twice(folder: Path) -> None:
    settings = ["--set", "fb_nChannels=4", "--set", "fb_nChannels=8"]
    refused(rosafe("process", "in.wav", *settings, cwd=folder), "fb_nChannels: expected one value, got two")
    assert_untouched(folder)


@pytest.mark.parametrize("outputs", ["ild,rms", ""])
def test_outputs(folder: Path, outputs: str) -> None:
    refused(rosafe("process", "in.wav", "--outputs", outputs, cwd=folder), "outputs: expected a known output, got ")
    assert_untouched(folder)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--block", "0", "in.wav"],
        ["--jobs", "0", "in.wav"],
        ["in.wav", "--set"],
        ["in.wav", "--set", "fb_nChannels"],
        ["in.wav", "--nonsense"],
        ["in.wav", "--resume", "--force"],
        ["in.wav", "--format", "txt"],
        ["in.wav", "-o", "x.h5", "--format", "npz"],
        ["in.wav", "--channels", "0,1"],
        ["in.wav", "--dask", "http://x"],
    ],
)
def test_usage(folder: Path, arguments: list[str]) -> None:
    refused(rosafe("process", *arguments, cwd=folder), "rosafe process", "-h lists the options", code=2)
    assert_untouched(folder)


# --- the output ---


def test_output_beside_the_input_is_not_replaced_unless_forced(folder: Path) -> None:
    (folder / "in.npz").write_text("precious")
    refused(rosafe("process", "in.wav", *SMALL, cwd=folder), "in.npz already exists", "--force")
    (folder / "results").mkdir()
    (folder / "results" / "in.npz").write_text("precious")
    refused(rosafe("process", "in.wav", *SMALL, "-o", "results", cwd=folder), "in.npz already exists", "--force")
    assert (folder / "in.npz").read_text() == (folder / "results" / "in.npz").read_text() == "precious"
    assert rosafe("process", "in.wav", *SMALL, "--force", cwd=folder).returncode == 0
    with np.load(folder / "in.npz") as loaded:
        assert "ild" in loaded
    assert_untouched(folder, "in.npz", "results")


def test_unwritable_outputs(folder: Path) -> None:
    content = (folder / "in.wav").read_bytes()
    (folder / "link.npz").symlink_to("in.wav")
    for out, words in {
        "nowhere/out.npz": ["nowhere/out.npz", "does not exist"],
        "in.wav/": ["-o in.wav: ", "File exists"],
        "in.wav/deep/": ["-o in.wav/deep: ", "Not a directory"],
        "results": ["-o: expected a name ending in .npz, .h5, .mat, .csv", "/"],
        "out.zarr": ["-o: expected a name ending in .npz", "; rosafe.load(RESULT).to_xarray().to_zarr(PATH) writes"],
        "out.wav": ["-o: expected a name ending in .npz"],
        "in.wav/out.npz": ["in.wav/out.npz", "Not a directory"],
        "in.wav": ["-o: expected a name ending in .npz"],
        "link.npz": ["link.npz: expected another file than the input, got the same"],
        "x" * 300 + ".npz": ["File name too long"],
    }.items():
        refused(rosafe("process", "in.wav", *SMALL, "--force", "-o", out, cwd=folder), *words)
    assert (folder / "in.wav").read_bytes() == content
    assert_untouched(folder, "link.npz")


def test_two_outputs_with_one_name(folder: Path) -> None:
    write(folder / "in.flac", noise(100))
    refused(rosafe("process", "in.wav", "in.wav", cwd=folder), "in.wav and in.wav would both be written to in.wav.npz")
    (folder / "link").symlink_to(folder)
    refused(
        rosafe("process", "in.wav", "link/in.wav", cwd=folder),
        "in.wav and link/in.wav would both be written to link/in.",
    )
    (folder / "link").unlink()
    refused(
        rosafe("process", "in.wav", "in.flac", "-o", "out.npz", cwd=folder), "expected an existing folder", "'out.npz'"
    )
    assert_untouched(folder, "in.flac")


def test_missing_disk_space_is_reported_before_processing(folder: Path) -> None:
    """2000 s at 192 kHz with 1000 channels: terabytes. The file itself is sparse."""
    write(folder / "in.wav", np.zeros((2, 10)), 192000, "PCM_U8")
    head = (folder / "in.wav").read_bytes()[:-20]
    size = 2 * 192000 * 2000
    with open(folder / "in.wav", "wb") as file:
        file.write(head[:4] + (36 + size).to_bytes(4, "little") + head[8:40] + size.to_bytes(4, "little"))
        file.truncate(len(head) + size)
    done = rosafe("process", "in.wav", "--set", "fb_nChannels=1000", cwd=folder)
    refused(done, "in.wav", "B (free on the disk), got ", "TB; name fewer", "--outputs")
    assert_untouched(folder)


@pytest.mark.parametrize(
    "settings", [["cc_maxDelaySec=10", "--block", "3000"], ["fb_nChannels=1024", "fb_cfHz=" + "100," * 1024]]
)
def test_blocks_that_exceed_the_memory(folder: Path, settings: list[str]) -> None:
    write(folder / "in.wav", np.zeros((2, 100_000)))
    done = rosafe(
        "process", "in.wav", "--block", "10000000", "--outputs", "crossCorrelation", "--set", *settings, cwd=folder
    )
    refused(done, "in.wav: ", ": expected at most 1024 MiB", "MiB for one block", "--block")
    assert_untouched(folder)


@pytest.mark.skipif(os.getuid() == 0, reason="root may read and write everywhere")
def test_permissions(folder: Path) -> None:
    (folder / "in.wav").chmod(0)
    refused(rosafe("process", "in.wav", cwd=folder), "in.wav", "Permission denied")
    (folder / "in.wav").chmod(0o600)
    folder.chmod(0o500)
    refused(rosafe("process", "in.wav", *SMALL, cwd=folder), "in.npz", "Permission denied")
    folder.chmod(0o700)
    assert_untouched(folder)
