"""A recording by `rosbag record` reproduces the representations of the live run, by `rosbag play`."""

from __future__ import annotations

import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import rosgraph
import soundfile

from rosafe.interface import CORE_REPRESENTATIONS
from tests.audio import bags
from tests.harness import Graph, Process, wait_for
from tests.ros1.afe.session import RATE, Session, assert_holds, expected, noise, own_node, windowed

CHUNK, CHUNKS, BLOCK, FRAMES = RATE // 20, 20, RATE // 4, 3 * RATE // 4
SECONDS = FRAMES / RATE
VALUES = {"fb_nERBs": 3.0, "pp_bRemoveDC": True}
REQUESTS = [kind.request for kind in CORE_REPRESENTATIONS.values() if kind.parent]


class Recorded(NamedTuple):
    """The recording of a live run."""

    bag: Path
    sound: np.ndarray  # int32, (2, FRAMES)
    result: Any  # computed by rosafe.process


def prepare(node: Session, topic: str, *requests: str) -> None:
    """Build a tree on a silent stream, and connect it with the stream to come."""
    node.build(*requests, block=BLOCK, bufferSize_s_port=SECONDS, **VALUES)
    node.ok("connect_port", local="Audio", remote=topic)


def assert_same(node: Session, recorded: Recorded) -> None:
    """Check that all ports are bit-identical to the result for the whole signal, with the same frame indices."""
    for kind in CORE_REPRESENTATIONS:
        rate = float(recorded.result.get(f"{kind}_frameRate", RATE))
        message = node.read(kind, index=FRAMES + 1)
        assert_holds(message, kind, windowed(recorded.result[kind], SECONDS, rate))


def acquire(graph: Graph, device: str) -> None:
    answer = graph.call("/bass/Acquire", device=device, sampleRate=RATE, nFramesPerChunk=CHUNK, nChunksOnPort=CHUNKS)
    assert answer.genom_success


@pytest.fixture(scope="module")
def recorded(graph: Graph, bass: Process, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Send a file through bass and rosAFE while `rosbag record` is running."""
    folder = tmp_path_factory.mktemp("replay")
    sound = noise(FRAMES)
    soundfile.write(folder / "a.wav", sound.T, RATE, subtype="PCM_32")
    recorded = Recorded(folder / "live.bag", sound, expected(sound, BLOCK, VALUES))
    with (
        own_node(graph, name="live") as node,
        graph.start("rosbag", "record", "-O", str(recorded.bag), "/bass/Audio", "__name:=recorder") as recorder,
    ):
        prepare(node, "bass/Audio", *REQUESTS)
        graph.wait_until_read(["/bass/Audio"], ["/recorder"])
        acquire(graph, f"file:{folder / 'a.wav'}")
        assert_same(node, recorded)
        # As by `rosnode kill`; a signal would end rosbag before its child has closed the bag.
        address = rosgraph.Master("/test", master_uri=graph.uri).lookupNode("/recorder")
        xmlrpc.client.ServerProxy(address).shutdown("/test", "")
        recorder.wait()
    return recorded


@contextmanager
def replay(graph: Graph, bag: Path, name: str, requests: list[str], *options: str) -> Iterator[Session]:
    """Start a new rosAFE that is connected to `rosbag play`, which waits for it and ends after the test."""
    topic = f"/{name}/Audio"
    command = ("rosbag", "play", "--wait-for-subscribers", *options, str(bag), f"/bass/Audio:={topic}")
    with own_node(graph, name=name) as node, graph.start(*command) as player:
        wait_for(lambda: topic in graph.topics(), what=lambda: str(player))
        prepare(node, topic, *requests)
        yield node
        assert player.wait() == 0, player


def test_played_by_rosbag_without_bass(graph: Graph, recorded: Recorded) -> None:
    with replay(graph, recorded.bag, "replayed", REQUESTS, "--clock") as node:
        assert_same(node, recorded)


def test_played_from_the_middle_and_with_a_loss(graph: Graph, recorded: Recorded, tmp_path: Path) -> None:
    """Frame indices are preserved; frames that are in no window are zeros."""
    # The windows with frames 6001 to 9000 are missing, and the recording starts with frame 1001.
    window = 4 * CHUNK
    indexes = [i for i in range(1000 + window, FRAMES + 1, CHUNK) if not 6000 < i < 9000 + window]
    messages = [bags.message(recorded.sound, i, window, RATE, CHUNK) for i in indexes]
    end = FRAMES - (FRAMES - 1000) % BLOCK  # end of the last complete block
    gap = bags.write(tmp_path / "gap.bag", messages)
    with replay(graph, gap, "gap", []) as node:
        message = node.read("input", index=end + 1)
        entries = node.health(lambda entries: int(entries["lost"]) > 0)
    assert entries["lost"] == "3000" and entries["gaps"] == "1"
    signal = recorded.sound.copy()
    signal[:, 6000:9000] = 0
    result = expected(signal[:, 1000:end], BLOCK, VALUES)["input"]
    np.testing.assert_array_equal(np.stack((message.left, message.right))[:, -result.shape[1] :], result)
