"""A running live page, and a client of its protocol."""

from __future__ import annotations

import asyncio
import json
import re
import struct
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from tests.harness import PATIENCE, Graph, Process, wait_for

PIECE = struct.Struct("<IHHQdffBB6x")  # as described in docs/live.md
TREE = ("ratemap", "ild", "itd", "ic")
GRID = np.radians(np.arange(-175, 181, 5))  # of a posterior


def script(name: str) -> str:
    """Return a script for the browser, of the folder `scripts`."""
    return (Path(__file__).with_name("scripts") / f"{name}.js").read_text("utf-8")


class Live:
    """A running `rosafe live`."""

    def __init__(self, process: Process) -> None:
        self.process = process
        wait_for(lambda: "?token=" in process.out, what=lambda: f"address of {process}")
        found = re.search(r"(http://(\S+?)/)\?token=(\S+)", process.out)
        assert found is not None
        self.root, self.address, self.token = found[1], found[2], found[3]
        self.port = int(self.address.rpartition(":")[2])
        self.url = found[0]


@contextmanager
def live(graph: Graph, *arguments: str) -> Iterator[Live]:
    """Start `rosafe live` on a free port."""
    with graph.start("rosafe", "live", "--port", "0", "--no-browser", *arguments) as process:
        yield Live(process)


def build(graph: Graph, live: Live) -> None:
    """Start the capture of the scene, and build the tree with requests of the page."""
    assert graph.call("/bass/Acquire", device="scene:?seconds=5", sampleRate=16000).genom_success

    async def build_all() -> None:
        async with page(live) as client:
            for kind in TREE:
                answer = await client.request("build", representation=kind, nFramesPerBlock=1600, fb_highFreqHz=6000)
                assert "ok" in answer, answer

    asyncio.run(build_all())


class Page:
    """A client that behaves as a page."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.latest: dict[str, dict[str, Any]] = {}  # message on each subject
        self.answers: dict[int, dict[str, Any]] = {}
        self.pieces: dict[int, list[tuple[int, int, float, np.ndarray]]] = {}  # first, stride, end, columns
        self.messages = self.bytes = 0  # with columns
        self._number = 0

    async def receive(self) -> None:
        """Receive one message."""
        message = await self.socket.receive(timeout=PATIENCE)
        if message.type == aiohttp.WSMsgType.TEXT:
            content = json.loads(message.data)
            if content["about"] == "answer":
                self.answers[content["id"]] = content
            else:
                self.latest[content["about"]] = content
        elif message.type == aiohttp.WSMsgType.BINARY:
            self.messages += 1
            self.bytes += len(message.data)
            self._decode(message.data)
        else:
            raise ConnectionError(f"closed: {message}")

    def _decode(self, data: bytes) -> None:
        form, count, _ = struct.unpack_from("<HHI", data)
        assert form == 2
        at = 8
        for _ in range(count):
            number, columns, size, first, end, low, high, kind, stride = PIECE.unpack_from(data, at)
            at += PIECE.size
            steps = np.frombuffer(data, np.uint8 if kind == 0 else "<f4", columns * size, at)
            values = steps.astype(float)
            if kind == 0:
                values = np.where(steps == 255, np.nan, low + values * (high - low) / 254)
            self.pieces.setdefault(number, []).append((first, stride, end, values.reshape(columns, size).T))
            at += -(-steps.nbytes // 8) * 8
        assert at == len(data)

    async def request(self, action: str, **values: Any) -> dict[str, Any]:
        """Send a request and return the answer."""
        self._number += 1
        number = self._number
        await self.socket.send_json({"id": number, "do": action, "with": values})
        while number not in self.answers:
            await self.receive()
        return self.answers.pop(number)

    async def subscribe(self, *keys: dict[str, Any], resend: bool = False) -> list[dict[str, Any]]:
        """Subscribe to these views and return their descriptions."""
        self.latest.pop("views", None)
        assert "ok" in await self.request("look", keys=list(keys), anew=resend)
        while not self._has_views(len(keys)):
            await self.receive()
        return list(self.latest.get("views", {"views": ()})["views"])

    def _has_views(self, count: int) -> bool:
        """Return whether all views are described; the server updates its tree once per second, which may be later."""
        views = self.latest.get("views", {"views": ()})["views"]
        return len(views) == count and all("number" in view or view["key"]["name"] == "missing" for view in views)

    async def until(self, subject: str) -> dict[str, Any]:
        """Return the newest message on a subject, or wait for the first one."""
        while subject not in self.latest:
            await self.receive()
        return self.latest[subject]


@contextmanager
def localizer(graph: Graph, offset: float = 0.0) -> Iterator[None]:
    """Publish the messages of a localizer in a running scene: source 7 at the true azimuth plus `offset` (degrees).

    Source 8 is improbable. The posterior is a Gaussian around source 7.
    """
    import rospy
    from rosAFE.msg import DirectionPosterior, SoundSource, SoundSources
    from std_msgs.msg import Header

    from bass.msg import SceneTruth

    graph.client()
    sources = rospy.Publisher("/localizer/sources", SoundSources, queue_size=10)
    posterior = rospy.Publisher("/localizer/posterior", DirectionPosterior, queue_size=10)

    delayed: deque[Any] = deque(maxlen=4)  # a localizer needs some time as well: 0.15 s

    def publish(newest: Any) -> None:
        delayed.append(newest)
        truth = delayed[0]
        header = Header(stamp=truth.stamp, frame_id="head")
        azimuth = truth.azimuths[0] + np.radians(offset)
        found = SoundSource(id=7, azimuth=azimuth, azimuth_std=0.05, probability=0.9, speech=0.8)
        improbable = SoundSource(id=8, azimuth=-2.0, azimuth_std=0.5, probability=0.2, speech=np.nan)
        sources.publish(SoundSources(header, [improbable, found]))
        shape = np.exp(-(((GRID - azimuth + np.pi) % (2 * np.pi) - np.pi) ** 2) / 0.02)
        posterior.publish(DirectionPosterior(header, GRID, shape / shape.sum()))

    scene = rospy.Subscriber("/bass/sceneTruth", SceneTruth, publish)
    try:
        yield
    finally:
        for topic in (scene, sources, posterior):
            topic.unregister()


@asynccontextmanager
async def page(live: Live) -> AsyncIterator[Page]:
    """Open one page."""
    async with aiohttp.ClientSession() as session:
        headers = {"Origin": live.root.rstrip("/")}
        async with session.ws_connect(f"{live.root}socket?token={live.token}", headers=headers) as socket:
            yield Page(socket)
