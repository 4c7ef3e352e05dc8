"""Running scripts/demo, reading and checking what it prints, and finding every process that it has left."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from tests.harness import SCRIPTS, Process, proc, wait_for

DEMO_SECONDS = 240.0  # all of it, on a busy machine
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
    """The name of an environment variable by which a process and all its descendants can be known."""
    return f"ROSAFE_TEST_{uuid.uuid4().hex}"


def family(mark: str) -> dict[int, str]:
    """All living processes with this mark: number and command line. None are seen where /proc is not mounted."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        except OSError:  # it has ended meanwhile, or is another user's
            continue
    return found


class Demo(Process):
    """A running demonstration; its environment carries a mark by which its children are known."""

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

    def family(self) -> dict[int, str]:
        """All living processes that descend from it, itself included; the test is skipped where nobody knows them."""
        proc()
        return family(self.mark)

    def says(self, words: str, timeout: float = DEMO_SECONDS) -> None:
        """Wait until it has printed `words`."""
        wait_for(lambda: words in self.out or not self.alive, timeout, lambda: f"{words!r} from {self}")
        assert words in self.out, f"it has ended without {words!r}: {self}"

    def assert_gone(self) -> None:
        """Nothing of it is left, after a moment for the kernel."""
        wait_for(lambda: not family(self.mark), what=lambda: f"end of {family(self.mark)}")


@contextmanager
def demo(*arguments: str | Path, cwd: Path | None = None, **env: str) -> Iterator[Demo]:
    """A demonstration that ends with the block."""
    with Demo(*arguments, cwd=cwd, env=env) as running:
        yield running


def table(text: str) -> dict[str, tuple[str, float, int, int, int]]:
    """The table of ports: by topic the type, messages per second, frames, frames per second and lost frames."""
    rows = re.findall(r"^/rosAFE/(\S+) +rosAFE_(\w+)SignalPortStruct +(\S+) +(\d+) +(\d+) +(\d+)$", text, re.MULTILINE)
    return {row[0]: (row[1], float(row[2]), int(row[3]), int(row[4]), int(row[5])) for row in rows}


def path(text: str) -> list[list[float]]:
    """Where the source was: for each line the time and the azimuths (degrees; NaN for nobody)."""
    lines = re.findall(r"^ *([\d.]+) s +\|[-+ICX]+\| +(.*)$", text, re.MULTILINE)
    return [[float(time), *map(azimuth, re.split(r"  +", words.strip()))] for time, words in lines]


def azimuth(words: str) -> float:
    """The number that `41 deg left` and the like stand for."""
    if words in ("ahead", "nobody"):
        return 0.0 if words == "ahead" else float("nan")
    degrees, _, side = words.split()
    return float(degrees) * {"left": -1, "right": 1}[side]


def check_table(text: str, sample_rate: int, block: int, seconds: float) -> None:
    """Seven ports, nothing lost, and as much of everything as the time allows."""
    rows = table(text)
    assert {topic: row[0] for topic, row in rows.items()} == PORTS
    for topic, (_, message_rate, frames, frame_rate, lost) in rows.items():
        framed = topic.split("Port")[0] in ("ild", "ratemap", "crossCorrelation")
        assert frame_rate == (100 if framed else sample_rate), topic
        assert lost == 0, topic
        # It ends when the last of the stages has come so far; the first ones may be some blocks ahead.
        assert seconds - 0.1 < frames / frame_rate < seconds + 10 * block / sample_rate
        assert message_rate == pytest.approx(sample_rate / block, rel=0.25), topic
    assert re.search(r"^by their own count bass lost 0 frames \(0 overruns\) and rosAFE 0 \(0 gaps\)$", text, re.M)


def check_picture(file: Path) -> None:
    """A picture of decent size with something on it."""
    image = matplotlib.image.imread(file)[..., :3]
    assert image.shape[0] > 800 and image.shape[1] > 1000
    assert 20_000 < file.stat().st_size < 2_000_000
    assert len(np.unique((image * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 500


def check_walk(text: str) -> None:
    """The built-in scene from its beginning to its end, 10 s: both cues see a source that goes from left to right."""
    check_table(text, 44100, 12000, 10.0)
    course = np.array(path(text))
    assert len(course) >= 19
    for estimate in course[:, 1:3].T:
        assert estimate[0] < -75 and estimate[-1] > 75
        assert (np.diff(estimate) > -5).all()
        assert np.abs(estimate - course[:, 3]).max() < 8
    assert "agree on the side in 100 % of the frames" in text
    commands = re.findall(r"^\$ rosservice call (\S+) \"(.*)\"$", text, re.M)
    assert [service for service, _ in commands[:3]] == ["/rosAFE/connect_port", "/bass/Acquire", "/rosAFE/InputProc"]
    assert commands[0][1] == "{local: Audio, remote: bass/Audio}"
