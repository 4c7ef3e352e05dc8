"""A localizer with rosAFE and bass in one graph, and its messages."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tests.harness import PYTHON, SCRIPTS, Graph, Process, wait_for
from tests.ros1.afe.session import diagnosed

PRESENT = 0.5


@contextmanager
def running_localizer(graph: Graph, *options: str, name: str = "localizer", **env: str) -> Iterator[Localizer]:
    """Run `rosafe localize`; yield when its topics are registered."""
    graph._forget(f"/{name}")
    command = (str(SCRIPTS / "rosafe"), "localize", "--name", name, *options)
    with graph.start(*command, cwd=None, **env) as process:
        wait_for(
            lambda: "ready" in process.err or not process.alive, what=lambda: f"the start of the localizer: {process}"
        )
        assert process.alive, process.err
        yield Localizer(graph, process, name)
    graph._forget(f"/{name}")


class Localizer:
    """A running localizer."""

    def __init__(self, graph: Graph, process: Process, name: str = "localizer") -> None:
        self.graph, self.process, self.name = graph, process, name

    def sources(self, accept: Callable[[Any], bool] = lambda message: True) -> Any:
        """Return the first message on ~sources for which `accept` is true."""
        return self.graph.message(f"/{self.name}/sources", sources_class(), accept)

    @contextmanager
    def collect(self) -> Iterator[list[Any]]:
        """Collect the messages on ~sources."""
        with self.graph.collect(f"/{self.name}/sources", sources_class()) as messages:
            wait_for(lambda: messages, what="a message of the localizer")
            yield messages

    def wait_present(self, azimuth: float, tolerance: float = 10.0) -> Any:
        """Wait until a source within `tolerance` degrees of an azimuth is present; return the message."""
        return self.sources(lambda message: any(abs(a - azimuth) < tolerance for a in present(message)))

    def wait_silent(self) -> Any:
        """Wait until no source is present."""
        return self.sources(lambda message: not present(message))

    def block(self) -> int:
        """Return the frames of a block of rosAFE."""
        return int(self.state(lambda entries: "block of rosAFE (frames)" in entries)["block of rosAFE (frames)"])

    def log(self, text: str) -> None:
        """Wait until the log contains a text."""
        wait_for(lambda: text in self.process.err, what=lambda: f"{text!r} in {self.process.err[-2000:]}")

    def state(self, accept: Callable[[dict[str, str]], bool]) -> dict[str, str]:
        """Return the entries of /diagnostics, with level and message, as soon as `accept` is true for them."""
        return diagnosed(self.graph, f"{self.name}: localization", accept)


# Prints the time and the azimuths in degrees of the present sources of each message.
WATCHER = """
import math, rospy
from rosAFE.msg import SoundSources
def show(m):
    print(m.header.stamp.to_sec(), *(math.degrees(s.azimuth) for s in m.sources if s.probability > 0.5), flush=True)
rospy.init_node("watcher", anonymous=True)
rospy.Subscriber("localizer/sources", SoundSources, show)
rospy.spin()
"""


def watcher(graph: Graph, namespace: str = "/") -> Process:
    """Start a process that prints the messages on localizer/sources of a private graph."""
    return graph.start(PYTHON, "-c", WATCHER, ROS_NAMESPACE=namespace)


def watched(process: Process) -> list[list[float]]:
    """Return the time and the azimuths of the messages that the watcher has printed."""
    return [[float(word) for word in line.split()] for line in process.out.splitlines() if line]


def sources_class() -> Any:
    """Return the class of messages on ~sources."""
    return importlib.import_module("rosAFE.msg").SoundSources


def present(message: Any) -> list[float]:
    """Return the azimuths of present sources in degrees."""
    return [float(np.degrees(source.azimuth)) for source in message.sources if source.probability > PRESENT]


def scene_file(folder: Path, text: str) -> str:
    """Write a scene; return the device."""
    path = folder / "scene.yaml"
    path.write_text(text)
    return f"scene:{path}"


def acquire(graph: Graph, device: str, chunk: int = 800, rate: int = 0) -> None:
    """Start the capture."""
    response = graph.call("/bass/Acquire", device=device, sampleRate=rate, nFramesPerChunk=chunk, nChunksOnPort=20)
    assert response.genom_success, response.genom_exdetail


def wait_played(bass: Process, path: Path, sources: list[Any]) -> None:
    """Wait for the end of the acquired file, and until a second of ~sources without a source has followed it."""
    end = f"file:{path}: end of the source"
    wait_for(lambda: end in bass.err.rpartition("acquiring from")[2], what=lambda: f"the end of {path}: {bass}")
    ended = len(sources)
    wait_for(
        lambda: len(sources) >= ended + 10 and not any(message.sources for message in sources[-10:]), what="silence"
    )


def names_of(graph: Graph, node: str = "rosAFE") -> set[str]:
    """Return the names of all processors."""
    return {processor.name for processor in graph.call(f"/{node}/getProcessors").processors}
