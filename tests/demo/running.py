"""Running scripts/demo, reading what it prints, and finding every process that it has left."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.harness import SCRIPTS, Process, proc, wait_for

DEMO_SECONDS = 120.0  # all of it, on a busy machine
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
        wait_for(lambda: not family(self.mark), 5.0, lambda: f"end of {family(self.mark)}")


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
