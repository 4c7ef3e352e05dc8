"""`rosafe record` as a command: from devices without ROS, from a running bass, and its end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe.audio.devices.scene import Scene
from rosafe.commands.__main__ import main
from tests.audio import bags
from tests.commands.command import ROSAFE, environment, refused, rosafe, start
from tests.harness import PATIENCE, Graph, Process, free_port, run_program, wait_for
from tests.terminal import Terminal

RATE = 8000


def samples_of(path: Path) -> np.ndarray:
    return np.asarray(soundfile.read(path, dtype="int32")[0].T)


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, text
    return float(found[1])


# --- without ROS ---


@pytest.fixture(scope="module")
def wav(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a quarter of a second of full-range noise."""
    path = tmp_path_factory.mktemp("in") / "in.wav"
    soundfile.write(path, bags.stream(2000).T, RATE, subtype="PCM_32")
    return path


def test_through_a_bag_into_a_wav(wav: Path, tmp_path: Path) -> None:
    """The samples do not depend on the chunk length; the last chunk is padded."""
    done = rosafe("record", "a.bag", "--device", f"file:{wav}", "--chunk", "300", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr == "", done
    assert done.stdout.startswith("a.bag: 0.263 s at 8000 Hz, highest peaks left -0.0, right ")
    done = rosafe("record", "a.wav", "--device", "bag:a.bag", "--seconds", "0.25", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr == "", done
    assert np.array_equal(samples_of(tmp_path / "a.wav"), samples_of(wav))


def test_levels_without_output(tmp_path: Path) -> None:
    tone = np.sin(2 * np.pi * 100 * np.arange(RATE) / RATE)
    soundfile.write(tmp_path / "a.wav", np.stack((0.5 * tone, 1.5 * tone), axis=1), RATE, subtype="PCM_16")
    done = rosafe("record", "--device", "file:a.wav", "--chunk", "400", cwd=tmp_path)
    line, summary, end = done.stdout.splitlines()
    assert done.returncode == 0 and end == "file:a.wav has ended"
    clipped = 10 * np.log10(np.mean(np.clip(1.5 * tone, -1, 1) ** 2))
    assert re.sub(" +", " ", line) == f" 0:01 L peak -6.0 rms -9.0 R peak 0.0 rms {clipped:.1f} CLIP lost 0"
    assert summary.startswith("sound: 1.000 s at 8000 Hz") and number(r"(\d+) samples clipped", summary) > 4000
    assert os.listdir(tmp_path) == ["a.wav"]


def direct_result(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Return the error of the command, run in this process, for errors that are detected before sound is read."""
    if threading.current_thread() is not threading.main_thread():  # pytest-xdist; commands handle signals
        return rosafe("record", *arguments)
    try:
        code = main(["record", *map(str, arguments)])
    except SystemExit as ended:
        code = int(ended.code or 0)
    return subprocess.CompletedProcess(arguments, code, *capsys.readouterr())


def test_invalid_arguments_change_nothing(wav: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = tmp_path / "kept.wav"
    kept.write_text("precious")
    (tmp_path / "folder.wav").mkdir()
    device = ("--device", f"file:{wav}")
    refused(direct_result(capsys, kept, *device), "already exists; --force replaces it")
    refused(direct_result(capsys, kept, "--force", "--device", f"file:{kept}?loop=1"), "is also the input")
    (tmp_path / "left.wav.part").write_text("precious")
    for_left = ("--force", "--device", f"file:{tmp_path}/left.wav.part")
    refused(direct_result(capsys, tmp_path / "left.wav", *for_left), "left.wav.part is also the input")
    (tmp_path / "left.wav.part").unlink()
    refused(direct_result(capsys, tmp_path / "folder.wav", "--force", *device), "not a regular file")
    refused(direct_result(capsys, tmp_path / "no" / "a.wav", *device), "does not exist")
    refused(direct_result(capsys, tmp_path / "a.mp3", *device), "ends in .wav or .bag", code=2)
    seconds = "expected a number of seconds from 1e-06 to 1e+07, got 'nan'"
    refused(direct_result(capsys, *device, "--seconds", "nan"), seconds, code=2)
    refused(
        direct_result(capsys, *device, "--rate", "-5"), "expected a whole number from 1 to 768000, got '-5'", code=2
    )
    refused(direct_result(capsys, *device, "--topic", "/x"), "not allowed with", code=2)
    refused(rosafe("record", kept, "--force", "--device", "file:missing.wav"), "missing.wav: No such file")
    refused(rosafe("record", kept, "--force", *device, "--rate", "44100"), "expected 44100 Hz, got 8000 Hz")
    uri = f"http://127.0.0.1:{free_port()}"
    refused(rosafe("record", ROS_MASTER_URI=uri), f"no ROS master at {uri}", "or record from a --device without ROS")
    assert kept.read_text() == "precious"
    assert sorted(os.listdir(tmp_path)) == ["folder.wav", "kept.wav"]
    done = rosafe("record", kept, "--force", "-q", *device)
    assert done.returncode == 0 and samples_of(kept).shape[1] >= 2000


def test_signals_leave_a_complete_file(tmp_path: Path) -> None:
    """Signals that request the end, and SIGKILL."""
    numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGKILL)
    options = ("--device", "scene:", "--rate", str(RATE), "--chunk", "400")
    with ExitStack() as stack:
        running = [stack.enter_context(start("record", f"{n}.wav", *options, cwd=tmp_path)) for n in numbers]
        for recording in running:
            wait_for(lambda: "L peak" in recording.out, what=lambda: str(recording))  # noqa: B023  # called immediately
        codes = [recording.stop(number) for number, recording in zip(numbers, running, strict=True)]
        assert codes == [0, 0, -signal.SIGKILL]
        for number, recording in zip(numbers[:2], running, strict=False):
            assert re.search(rf"^{number}\.wav: [\d.]+ s at 8000 Hz, ", recording.out, re.MULTILINE)
            assert recording.err == ""
    for number in numbers:
        samples = samples_of(tmp_path / (f"{number}.wav" + ".part" * (number == signal.SIGKILL)))
        assert samples.shape[1] >= RATE and np.array_equal(samples, Scene(RATE).frames(samples.shape[1]))


def test_full_disk(wav: Path, tmp_path: Path) -> None:
    """Simulated by a limit of the file size; the recording up to that point is kept."""
    done = run_program(
        ["prlimit", "--fsize=10003", str(ROSAFE), "record", "a.wav", "--device", f"file:{wav}", "--chunk", "100"],
        cwd=tmp_path,
        env=environment(),
    )
    assert done.returncode == 1 and done.stderr == "rosafe record: cannot write a.wav: File too large\n"
    samples = samples_of(tmp_path / "a.wav")
    assert samples.shape[1] == (10003 - 80) // 8 and np.array_equal(samples, samples_of(wav)[:, : samples.shape[1]])


def test_live_line_on_a_terminal(tmp_path: Path) -> None:
    command = [str(ROSAFE), "record", "a.wav", "--device", "scene:", "--seconds", "1.4", "--chunk", "441"]
    with Terminal(command, environment(), cwd=tmp_path, columns=80) as terminal:
        assert terminal.end() == 0
        text = terminal.sent
    looks = text.split("\r\x1b[K")
    assert len(looks) > 4
    assert re.search(r"0:01  L \[#+-*\|?-*\] +-[\d.]+/ *-[\d.]+ +R \[.*\] .*  lost 0$", looks[-2])
    assert max(map(len, looks[:-1])) == 79 and looks[-1].startswith("a.wav: 1.400 s")


def test_reader_of_the_meter_closes_the_pipe(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [str(ROSAFE), "record", "a.wav", "--device", "scene:", "--rate", str(RATE), "--chunk", "400"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment(), stdout=write, stderr=subprocess.PIPE, timeout=PATIENCE, check=False
    )
    os.close(write)
    assert done.returncode == 141 and done.stderr == b""
    assert samples_of(tmp_path / "a.wav").shape[1] == RATE  # wait for the first line


# --- from a running bass ---


@pytest.fixture(scope="module")
def capturing(graph: Graph) -> Iterator[Process]:
    with graph.node("bass-ros", "-i", "recorded") as bass:
        yield bass


def acquire(graph: Graph, device: str = "scene:") -> None:
    assert graph.call("/recorded/Acquire", device=device, sampleRate=RATE, nFramesPerChunk=400).genom_success


def find(samples: np.ndarray) -> int:
    """Return the position of these samples in the scene."""
    scene = Scene(RATE).frames(60 * RATE)
    (places,) = np.nonzero(scene[0, : -samples.shape[1]] == samples[0, 0])
    return next(int(at) for at in places if np.array_equal(scene[:, at : at + samples.shape[1]], samples))


def test_topic_to_wav_and_bag(graph: Graph, capturing: Process, tmp_path: Path) -> None:
    acquire(graph)
    to_wav = (str(ROSAFE), "record", "a.wav", "--topic", "/recorded/Audio", "--seconds", "0.5")
    to_bag = (str(ROSAFE), "record", "a.bag", "--topic", "recorded/Audio", "--seconds", "0.5")
    with graph.start(*to_wav, cwd=tmp_path) as wav, graph.start(*to_bag, cwd=tmp_path) as bag:
        assert wav.wait() == 0 and bag.wait() == 0, (wav, bag)
        assert "a.wav: 0.500 s at 8000 Hz" in wav.out and "0 frames lost" in wav.out and wav.err == ""
    assert find(samples_of(tmp_path / "a.wav")) % 400 == 0
    messages = bags.read(tmp_path / "a.bag", "/recorded/Audio")
    newest = [int(message.lastFrameIndex) for message in messages]
    at = find(np.stack([messages[-1].left[-400:], messages[-1].right[-400:]]))
    assert newest[-1] == at + 400 and np.all(np.diff(newest) == 400)  # frame indices of the stream
