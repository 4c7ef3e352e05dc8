"""What fails on the server is seen on the page, and in the log once; column numbers beyond 32 bits are shown."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from tests import harness
from tests.harness import Graph, wait_for
from tests.live.world import Live, Page, page

pytestmark = pytest.mark.ros

LEVELS = {"what": "levels"}
OFFSET = 2**40  # columns: 350 years of sound
BROKEN = f"""
import sys
sys.path.insert(0, {str(harness.ROOT)!r})
from pathlib import Path
from rosafe.live import components, views
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
    """A live page whose server fails if the file `broken` exists, or if it is asked for devices."""

    def __init__(self, live: Live, broken: Path) -> None:
        self.live, self.broken = live, broken

    def closed(self, count: int) -> str:
        """What the log says of `count` closed connections, once it does."""
        log = self.live.process
        wait_for(lambda: log.err.count("a page's connection is closed") >= count, what=lambda: repr(log))
        return log.err


@pytest.fixture(scope="module")
def world(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """With a bass that acquires."""
    broken = tmp_path_factory.mktemp("live") / "broken"
    command = (harness.PYTHON, "-c", BROKEN, str(broken), "live", "--port", "0", "--no-browser")
    with graph.node("bass-ros"), graph.start(*command) as process:
        assert graph.call("/bass/Acquire", device="scene:?seconds=5", sampleRate=16000).genom_success
        yield World(Live(process), broken)


async def end_of(client: Page) -> tuple[int | None, Any]:
    """Code and reason with which the server closes a connection."""
    while True:
        message = await client.socket.receive(timeout=harness.PATIENCE)
        if message.type == aiohttp.WSMsgType.CLOSE:
            return message.data, message.extra


def test_an_exception_while_sending_closes_the_connection_with_its_reason(world: World) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client, page(world.live) as other:
            (view,) = await client.look(LEVELS)
            while not client.pieces.get(view["number"]):
                await client.hear()
            assert all(first >= OFFSET for first, *_ in client.pieces[view["number"]])
            world.broken.touch()
            try:
                ended = await end_of(client)
            finally:
                world.broken.unlink()
            await other.until("status")  # which looks at nothing
            return ended

    before = world.live.process.err.count("the ring is broken")
    assert asyncio.run(scenario()) == (1011, "sending failed: RuntimeError: the ring is broken")
    told = world.closed(1)
    assert told.count("a page's connection is closed: sending failed: RuntimeError: the ring is broken") == 1
    assert before == 0


def test_an_exception_while_answering_closes_the_connection_with_its_reason(world: World) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client:
            await client.socket.send_json({"id": 1, "do": "devices"})
            return await end_of(client)

    begun = world.live.process.err.count("no devices today")
    assert asyncio.run(scenario()) == (1011, "devices failed: RuntimeError: no devices today")
    told = wait_for(lambda: world.live.process.err.count("devices failed: RuntimeError: no devices today"))
    assert (begun, told) == (0, 1)


@pytest.mark.parametrize(
    ("sent", "code", "reason"),
    [
        ("nonsense", 1003, "expected a request with id and do"),
        (b"bytes", 1003, "expected a request as text, got bytes"),
        (None, 1007, "expected a text in UTF-8"),
    ],
    ids=["text", "bytes", "encoding"],
)
def test_what_is_no_request_is_told_why(world: World, sent: str | bytes | None, code: int, reason: str) -> None:
    async def scenario() -> tuple[int | None, Any]:
        async with page(world.live) as client:
            if isinstance(sent, str):
                await client.socket.send_str(sent)
            elif sent is not None:
                await client.socket.send_bytes(sent)
            else:
                await client.socket._writer._send_frame(b"\xff", aiohttp.WSMsgType.TEXT)
            return await end_of(client)

    assert asyncio.run(scenario()) == (code, reason)


# What link.js makes of a message with one column of the given number.
READ = """
const [low, high] = arguments;
class Socket extends EventTarget { constructor() { super(); Socket.one = this; } }
const real = window.WebSocket;
window.WebSocket = Socket;
return import("/link.js").then(({ Link }) => {
  const link = new Link();
  link.open();
  window.WebSocket = real;
  const buffer = new ArrayBuffer(56), bytes = new DataView(buffer);
  bytes.setUint16(0, 2, true); bytes.setUint16(2, 1, true);
  bytes.setUint32(8, 7, true); bytes.setUint16(12, 1, true); bytes.setUint16(14, 1, true);
  bytes.setUint32(16, low, true); bytes.setUint32(20, high, true); bytes.setFloat64(24, 12.5, true);
  bytes.setUint8(40, 1); bytes.setUint8(41, 3); bytes.setFloat32(48, 0.25, true);
  let got = null;
  link.addEventListener("columns", ({ detail }) => { got = { ...detail, values: [...detail.values], first: String(detail.first) }; });
  Socket.one.dispatchEvent(new MessageEvent("message", { data: buffer }));
  return got;
});
"""  # noqa: E501  # JavaScript


def test_the_page_shows_late_columns_and_the_reason_of_an_end(world: World) -> None:
    pytest.importorskip("selenium", reason="python3-selenium is not installed: scripts/install --tests")
    from tests.live.browser import browser

    with browser() as one:
        one.driver.get(world.live.url)
        for number in (2**32 + 1, 2**52 + 1, 2**53 - 1):
            read = one.run(READ, number % 2**32, number // 2**32)
            assert read == {"number": 7, "first": str(number), "count": 1, "size": 1, "stride": 3, "end": 12.5,
                            "values": [0.25]}  # fmt: skip
        # The page asks for the devices when it opens.
        one.until("return document.getElementById('state').textContent.includes('no devices today')")
        text = one.run("return document.getElementById('state').textContent")
        assert "reload" in text
