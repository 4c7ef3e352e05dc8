"""Runs scripts/demo, checks its output, and finds its processes."""

from __future__ import annotations

import os
import re
import uuid
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


class RunningDemo(Process):
    """A running demonstration; a variable in its environment identifies its children."""

    def __init__(self, *arguments: str | Path, cwd: Path, script: Path = SCRIPTS / "demo", **env: str) -> None:
        self.mark = new_mark()
        base = {k: v for k, v in os.environ.items() if not k.startswith("ROS_") and k != "DISPLAY"}
        super().__init__([str(script), *map(str, arguments)], {**base, **env, self.mark: "1"}, cwd)

    def __enter__(self) -> RunningDemo:
        return self

    def processes(self) -> dict[int, str]:
        """Return all running processes of the demonstration; skip the test if /proc is not available."""
        proc()
        return marked_processes(self.mark)

    def wait_for_output(self, text: str) -> None:
        """Wait until it has printed a text."""
        wait_for(lambda: text in self.out or not self.alive, DEMO_SECONDS, lambda: f"{text!r} from {self}")
        assert text in self.out, f"it has ended without {text!r}: {self}"

    def assert_ends(self, code: int, error: str = "") -> None:
        """Wait until it and all its processes have ended; it prints one line for an error."""
        assert self.wait(DEMO_SECONDS) == code, self
        assert self.err.startswith(error) and self.err.count("\n") == bool(error), self.err
        wait_for(lambda: not marked_processes(self.mark), what=lambda: f"end of {marked_processes(self.mark)}")


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


def check_table(text: str, sample_rate: int, block: int, seconds: float) -> None:
    """Check that the table has seven ports, no losses, and the expected number of frames and messages."""
    row = r"^/rosAFE/(\S+) +rosAFE_(\w+)SignalPortStruct +(\S+) +(\d+) +(\d+) +(\d+)$"
    rows = {name: rest for name, *rest in re.findall(row, text, re.MULTILINE)}
    assert {topic: row[0] for topic, row in rows.items()} == PORTS
    for topic, (_, message_rate, frames, frame_rate, lost) in rows.items():
        framed = topic.split("Port")[0] in ("ild", "ratemap", "crossCorrelation")
        assert (int(frame_rate), lost) == (100 if framed else sample_rate, "0"), topic
        # A message may contain the frames of several blocks.
        assert seconds - 0.1 < int(frames) / int(frame_rate) < seconds + 10 * block / sample_rate
        assert 0 < float(message_rate) / (sample_rate / block) < 2.5, topic  # a busy machine skips some


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
    check_table(text, 44100, 4410, 10.0)
    azimuths = np.array([line for line in path(text) if line[0] <= 10])
    assert len(azimuths) >= 9  # one a second if the recording is longer than 10.5 s, otherwise two
    _, estimate, truth = azimuths.T
    assert estimate[0] > 65 and estimate[-1] < -65
    assert (np.diff(estimate) < 5).all() and np.abs(estimate - truth).max() < 8
    last = r"at [\d.]+ s: estimate (.*) \(confidence [01]\.\d\d\), the source is (.*), error (\d+) deg"
    found = re.fullmatch(last, text.splitlines()[-1])
    assert found is not None, text
    assert azimuth(found[1]) < -50 and float(found[3]) < 10
    assert abs(abs(azimuth(found[1]) - azimuth(found[2])) - float(found[3])) <= 1  # all three are rounded
    errors = re.search(r"^RMS error ([\d.]+) deg, largest (\d+) deg$", text, re.M)
    assert errors is not None and float(errors[1]) < 4
