"""Failures of the server are shown by the page and logged once; column numbers may exceed 32 bits."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from tests import harness
from tests.harness import Graph, wait_for
from tests.web.live.world import Live, Page, page, script

pytestmark = pytest.mark.ros

LEVELS = {"what": "levels"}
DEADLINE = 1.5  # s, for a complete request
OFFSET = 2**40  # columns: 350 years of audio
BROKEN = f"""
import dataclasses, sys
sys.path.insert(0, {str(harness.ROOT)!r})
from pathlib import Path
from rosafe.web.live import components, server, views
server.LIMITS = dataclasses.replace(server.LIMITS, request_seconds={DEADLINE})
append, piece = views.View.append, views.View.piece
def late(view, first, columns, end):
    append(view, first if first >= {OFFSET} else first + {OFFSET}, columns, end + {OFFSET} / view.rate)
def failing(view, *arguments):
    if Path(broken).exists():
        raise RuntimeError("the ring is broken")
    return piece(view, *arguments)
async def no_devices(self, arguments):
    raise RuntimeError("no devices today")
broken = sys.argv.pop(1)
views.View.append, views.View.piece = late, failing
components.ComponentFacade.devices = no_devices
from rosafe.commands.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


class World:
    """A live page whose server fails if the file `broken` exists, and at each request for devices."""

    def __init__(self, live: Live, broken: Path) -> None:
        self.live, self.broken = live, broken

    def log_of_closed(self, count: int) -> str:
        """Wait until the log reports `count` closed connections, and return it."""
        log = self.live.process
        wait_for(lambda: log.err.count("a page's connection is closed") >= count, what=lambda: repr(log))
        return log.err


@pytest.fixture(scope="module")
def world(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Start bass with a capture, and the failing live page."""
    broken = tmp_path_factory.mktemp("live") / "broken"
    command = (harness.PYTHON, "-c", BROKEN, str(broken), "live", "--port", "0", "--no-browser")
    with graph.node("bass-ros"), graph.start(*command) as process:
        assert graph.call("/bass/Acquire", device="scene:?seconds=5", sampleRate=16000).genom_success
        yield World(Live(process), broken)


async def closing_frame(client: Page) -> tuple[int | None, Any]:
    """Wait until the server closes the connection, and return its code and reason."""
    while True:
        message = await client.socket.receive(timeout=harness.PATIENCE)
        if message.type == aiohttp.WSMsgType.CLOSE:
            return message.data, message.extra


def test_an_exception_while_sending_closes_the_connection_with_its_reason(world: World) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client, page(world.live) as other:
            (view,) = await client.subscribe(LEVELS)
            while not client.pieces.get(view["number"]):
                await client.receive()
            assert all(first >= OFFSET for first, *_ in client.pieces[view["number"]])
            world.broken.touch()
            try:
                ended = await closing_frame(client)
            finally:
                world.broken.unlink()
            await other.until("status")  # the page without views stays connected
            return ended

    before = world.live.process.err.count("the ring is broken")
    assert asyncio.run(scenario()) == (1011, "sending failed: RuntimeError: the ring is broken")
    assert (
        world.log_of_closed(1).count("a page's connection is closed: sending failed: RuntimeError: the ring is broken")
        == 1
    )
    assert before == 0


def test_a_page_stays_open_beyond_the_deadline_of_its_request(world: World) -> None:
    async def scenario() -> list[float]:
        loop = asyncio.get_running_loop()
        async with page(world.live) as client:
            begin = loop.time()
            while loop.time() < begin + 2 * DEADLINE:
                client.latest.pop("status", None)
                await client.until("status")
            return [loop.time() - begin]

    (seconds,) = asyncio.run(scenario())
    assert seconds >= 2 * DEADLINE


def test_an_exception_while_answering_closes_the_connection_with_its_reason(world: World) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client:
            await client.socket.send_json({"id": 1, "do": "devices"})
            return await closing_frame(client)

    before = world.live.process.err.count("no devices today")
    assert asyncio.run(scenario()) == (1011, "devices failed: RuntimeError: no devices today")
    after = wait_for(lambda: world.live.process.err.count("devices failed: RuntimeError: no devices today"))
    assert (before, after) == (0, 1)


@pytest.mark.parametrize(
    ("data", "code", "reason"),
    [
        *(
            (text, 1003, "expected a request with id and do")
            for text in ("nonsense", "[]", '{"id": 1}', '{"id": "x", "do": "look"}', "[" * 50_000)
        ),
        (b"bytes", 1003, "expected a request as text, got bytes"),
        (None, 1007, "expected a text in UTF-8"),
    ],
    ids=["text", "list", "half", "number", "deep", "bytes", "encoding"],
)
def test_a_malformed_request_closes_the_connection_with_a_reason(
    world: World, data: str | bytes | None, code: int, reason: str
) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client, page(world.live) as other:
            if isinstance(data, str):
                await client.socket.send_str(data)
            elif data is not None:
                await client.socket.send_bytes(data)
            else:
                writer: Any = client.socket._writer
                send = getattr(writer, "send_frame", None) or writer._send_frame  # Debian 12's version has the second
                await send(b"\xff", aiohttp.WSMsgType.TEXT)
            closed = await closing_frame(client)
            assert "unknown request" in (await other.request("explode"))["error"]
            return closed

    assert asyncio.run(scenario()) == (code, reason)


READ = script("decoded_columns")


def test_the_page_decodes_large_column_numbers_and_shows_why_it_was_closed(world: World) -> None:
    pytest.importorskip("selenium", reason="python3-selenium is not installed: scripts/install --tests")
    from tests.web.live.browser import browser

    with browser() as one:
        one.driver.get(world.live.url)
        for number in (2**32 + 1, 2**52 + 1, 2**53 - 1):
            read = one.run(READ, number % 2**32, number // 2**32)
            assert read == {"number": 7, "first": str(number), "count": 1, "size": 1, "stride": 3, "end": 12.5,
                            "values": [0.25]}  # fmt: skip
        # The page requests the devices when it opens.
        one.until("return document.getElementById('state').textContent.includes('no devices today')")
        text = one.run("return document.getElementById('state').textContent")
        assert "reload" in text
