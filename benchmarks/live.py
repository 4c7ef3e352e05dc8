"""Cost of the live page: processor time of `rosafe live` and bytes per page, with one page and with twenty.

    /usr/bin/python3 benchmarks/live.py [--seconds 20]

Starts a master, both nodes and the page on free ports, with the scene at 44100 Hz and the default tree.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rosafe.ros1.component import generate
from tests.harness import shared_graph
from tests.web.live.world import Live, live, page

KEYS = (
    {"what": "levels"},
    {"what": "picture", "name": "ratemap_0"},
    {"what": "picture", "name": "ild_0"},
    {"what": "picture", "name": "crosscorrelation_0"},
    {"what": "directions"},
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    generate.ensure_messages()
    with tempfile.TemporaryDirectory() as home, ExitStack() as stack:
        graph = stack.enter_context(shared_graph(Path(home)))
        stack.enter_context(graph.node("bass-ros"))
        stack.enter_context(graph.node("rosAFE-ros"))
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        for kind in ("ratemap", "ild", "crossCorrelation"):  # the default tree
            graph.run("rosafe", "request", kind)
        one = stack.enter_context(live(graph))
        print("pages  % of a core  kB/s per page  messages/s per page")
        for pages in (1, 20):
            share, rate, messages = asyncio.run(measure(one, pages, seconds))
            print(f"{pages:5}  {100 * share:11.1f}  {rate / 1e3:13.1f}  {messages:19.1f}")


async def measure(one: Live, pages: int, seconds: float) -> tuple[float, float, float]:
    """Measure the share of a core, and bytes and messages per second of a page."""

    async def follow() -> tuple[int, int]:
        async with page(one) as client:
            await client.subscribe(*KEYS)
            await asyncio.sleep(0)
            end = time.monotonic() + 3
            while time.monotonic() < end:  # exclude the retained frames that a new page gets first
                await client.receive()
            begun, before = client.bytes, client.messages
            spent.append(_processor_seconds(one))
            while time.monotonic() < end + seconds:
                await client.receive()
            spent.append(_processor_seconds(one))
            return client.bytes - begun, client.messages - before

    spent: list[float] = []
    received = await asyncio.gather(*(follow() for _ in range(pages)))
    share = (max(spent) - min(spent)) / seconds
    return (
        share,
        sum(size for size, _ in received) / pages / seconds,
        sum(count for _, count in received) / pages / seconds,
    )


def _processor_seconds(one: Live) -> float:
    """Return the processor time of the server in seconds."""
    fields = Path(f"/proc/{one.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
