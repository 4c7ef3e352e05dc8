"""A robot with its live page, and clients of the page's protocol."""

from __future__ import annotations

import asyncio
import json
import re
import struct
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import aiohttp
import numpy as np

from tests.harness import PATIENCE, Graph, Process, wait_for

PIECE = struct.Struct("<IHHQdffBB6x")  # as docs/live.md has it
TREE = ("ratemap", "ild", "itd", "ic")


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
    """`rosafe live` on a free port, up."""
    with graph.start("rosafe", "live", "--port", "0", "--no-browser", *arguments) as process:
        yield Live(process)


def build(graph: Graph, live: Live) -> None:
    """What the page shows, of the scene; built by the page."""
    assert graph.call("/bass/Acquire", device="scene:?seconds=5", sampleRate=16000).genom_success

    async def build_all() -> None:
        async with page(live) as client:
            for kind in TREE:
                answer = await client.ask("build", representation=kind, nFramesPerBlock=1600, fb_highFreqHz=6000)
                assert "ok" in answer, answer

    asyncio.run(build_all())


class Page:
    """A page, as far as the server sees it."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.said: dict[str, dict[str, Any]] = {}  # the newest message about each subject
        self.answers: dict[int, dict[str, Any]] = {}
        self.pieces: dict[int, list[tuple[int, int, float, np.ndarray]]] = {}  # first, stride, end, columns
        self.pictures = self.bytes = 0
        self._number = 0

    async def hear(self) -> None:
        """Take one message."""
        message = await self.socket.receive(timeout=PATIENCE)
        if message.type == aiohttp.WSMsgType.TEXT:
            said = json.loads(message.data)
            if said["about"] == "answer":
                self.answers[said["id"]] = said
            else:
                self.said[said["about"]] = said
        elif message.type == aiohttp.WSMsgType.BINARY:
            self.pictures += 1
            self.bytes += len(message.data)
            self._take(message.data)
        else:
            raise ConnectionError(f"closed: {message}")

    def _take(self, data: bytes) -> None:
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

    async def ask(self, what: str, **given: Any) -> dict[str, Any]:
        """The answer to a request."""
        self._number += 1
        number = self._number
        await self.socket.send_json({"id": number, "do": what, "with": given})
        while number not in self.answers:
            await self.hear()
        return self.answers.pop(number)

    async def look(self, *keys: dict[str, Any], anew: bool = False) -> list[dict[str, Any]]:
        """Look at these; what the server says of the views."""
        self.said.pop("views", None)
        assert "ok" in await self.ask("look", keys=list(keys), anew=anew)
        while not self._sees(len(keys)):
            await self.hear()
        return list(self.said.get("views", {"views": ()})["views"])

    def _sees(self, count: int) -> bool:
        """Whether all that was asked for is there; the tree is looked at once a second, and may be an old one first."""
        views = self.said.get("views", {"views": ()})["views"]
        return len(views) == count and all("number" in view or view["key"]["name"] == "nobody" for view in views)

    async def until(self, subject: str) -> dict[str, Any]:
        """The newest message about a subject, or the next one."""
        while subject not in self.said:
            await self.hear()
        return self.said[subject]


@asynccontextmanager
async def page(live: Live) -> AsyncIterator[Page]:
    """One page that is open."""
    async with aiohttp.ClientSession() as session:
        headers = {"Origin": live.root.rstrip("/")}
        async with session.ws_connect(f"{live.root}socket?token={live.token}", headers=headers) as socket:
            yield Page(socket)
