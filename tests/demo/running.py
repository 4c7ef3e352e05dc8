"""Runs scripts/demo, checks its output, and finds its processes."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib.image
import numpy as np

from tests.harness import SCRIPTS, Process, proc, wait_for

DEMO_SECONDS = 240.0  # for a complete run on a busy machine
PORTS = {
    "inputProcPort": "TimeDomain",
    "preProcPort/preProc": "TimeDomain",
    "gammatonePort/gammatone": "TimeFrequency",
    "ihcPort/ihc": "TimeFrequency",
    "ildPort/ild": "TimeFrequency",
    "ratemapPort/ratemap": "TimeFrequency",
    "crossCorrelationPort/crosscorrelation": "CrossCorrelation",
}


def new_mark() -> str:
    """Return the name of an environment variable that identifies a process and all its descendants."""
    return f"ROSAFE_TEST_{uuid.uuid4().hex}"


def marked_processes(mark: str) -> dict[int, str]:
    """Return the command lines of all running processes with this mark, by process id; empty without /proc."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        except OSError:  # it has ended, or belongs to another user
            continue
    return found


class Demo(Process):
    """A running demonstration; a variable in its environment identifies its children."""

    def __init__(
        self,
        *arguments: str | Path,
        cwd: Path | None = None,
        script: Path = SCRIPTS / "demo",
        env: dict[str, str] | None = None,
    ) -> None:
        self.mark = new_mark()
        base = {k: v for k, v in os.environ.items() if not k.startswith("ROS_") and k != "DISPLAY"}
        super().__init__([str(script), *map(str, arguments)], {**base, **(env or {}), self.mark: "1"}, cwd)

    def __enter__(self) -> Demo:
        return self

    def processes(self) -> dict[int, str]:
        """Return all running processes of the demonstration; skip the test if /proc is not available."""
        proc()
        return marked_processes(self.mark)

    def wait_for_output(self, text: str, timeout: float = DEMO_SECONDS) -> None:
        """Wait until it has printed a text."""
        wait_for(lambda: text in self.out or not self.alive, timeout, lambda: f"{text!r} from {self}")
        assert text in self.out, f"it has ended without {text!r}: {self}"

    def assert_gone(self) -> None:
        """Wait until all its processes have ended."""
        wait_for(lambda: not marked_processes(self.mark), what=lambda: f"end of {marked_processes(self.mark)}")


@contextmanager
def demo(*arguments: str | Path, cwd: Path | None = None, **env: str) -> Iterator[Demo]:
    """Run a demonstration until the end of the block."""
    with Demo(*arguments, cwd=cwd, env=env) as running:
        yield running


def table(text: str) -> dict[str, tuple[str, float, int, int, int]]:
    """Parse the table of ports: type, messages per second, frames, frames per second and lost frames by topic."""
    rows = re.findall(r"^/rosAFE/(\S+) +rosAFE_(\w+)SignalPortStruct +(\S+) +(\d+) +(\d+) +(\d+)$", text, re.MULTILINE)
    return {row[0]: (row[1], float(row[2]), int(row[3]), int(row[4]), int(row[5])) for row in rows}


def path(text: str) -> list[list[float]]:
    """Parse the path of the source: time and azimuths (degrees; NaN without a source) of each line."""
    lines = re.findall(r"^ *([\d.]+) s +\|[-+ETX]+\| +(.*)$", text, re.MULTILINE)
    return [[float(time), *map(azimuth, re.split(r"  +", azimuths.strip()))] for time, azimuths in lines]


def azimuth(text: str) -> float:
    """Parse an azimuth such as `41 deg left`."""
    if text in ("ahead", "no source"):
        return 0.0 if text == "ahead" else float("nan")
    degrees, _, side = text.split()
    return float(degrees) * {"left": 1, "right": -1}[side]


def check_final_direction(text: str) -> tuple[float, float]:
    """Check the last line, which has the direction of the talker; return the estimate and its error (degrees)."""
    found = re.fullmatch(
        r"at [\d.]+ s: the talker is (.*), estimate (.*) \(confidence [01]\.\d\d\), error (\d+) deg",
        text.splitlines()[-1],
    )
    assert found is not None, text
    estimate, error = azimuth(found[2]), float(found[3])
    assert abs(abs(azimuth(found[1]) - estimate) - error) <= 1  # all three are rounded
    return estimate, error


def check_table(text: str, sample_rate: int, block: int, seconds: float) -> None:
    """Check that the table has seven ports, no losses, and the expected number of frames and messages."""
    rows = table(text)
    assert {topic: row[0] for topic, row in rows.items()} == PORTS
    for topic, (_, message_rate, frames, frame_rate, lost) in rows.items():
        framed = topic.split("Port")[0] in ("ild", "ratemap", "crossCorrelation")
        assert frame_rate == (100 if framed else sample_rate), topic
        assert lost == 0, topic
        # The recording ends when the slowest port has all frames; others may be some blocks ahead.
        assert seconds - 0.1 < frames / frame_rate < seconds + 10 * block / sample_rate
        assert 0.4 < message_rate / (sample_rate / block) < 2.5, topic  # a busy machine delays single messages
    assert re.search(
        r"^according to /diagnostics, bass lost 0 frames \(0 overruns\) and rosAFE 0 \(0 gaps\)$", text, re.M
    )


def check_picture(file: Path) -> None:
    """Check that an image has a plausible size and content."""
    image = matplotlib.image.imread(file)[..., :3]
    assert image.shape[0] > 800 and image.shape[1] > 1000
    assert 20_000 < file.stat().st_size < 2_000_000
    assert len(np.unique((image * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 500


def check_walk(text: str) -> None:
    """Check the output for the built-in scene, 10 s: the estimate follows a source that moves from left to right.

    The recorded sound may be some blocks longer, in which the source moves back.
    """
    check_table(text, 44100, 12000, 10.0)
    azimuths = np.array([line for line in path(text) if line[0] <= 10])
    assert len(azimuths) >= 9  # one a second if the recording is longer than 10.5 s, else two
    _, estimate, truth = azimuths.T
    assert estimate[0] > 65 and estimate[-1] < -65
    assert (np.diff(estimate) < 5).all()
    assert np.abs(estimate - truth).max() < 8
    final, error = check_final_direction(text)
    assert final < -50 and error < 10
    errors = re.search(r"^RMS error ([\d.]+) deg, largest (\d+) deg$", text, re.M)
    assert errors is not None and float(errors[1]) < 4
    commands = re.findall(r"^\$ rosservice call (\S+) \"(.*)\"$", text, re.M)
    assert [service for service, _ in commands[:3]] == ["/rosAFE/connect_port", "/bass/Acquire", "/rosAFE/InputProc"]
    assert commands[0][1] == "{local: Audio, remote: bass/Audio}"
