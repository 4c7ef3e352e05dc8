"""Start all that a robot needs to hear: a ROS master, bass, rosAFE, genomixd, a setup, and the page.

What runs already is used, and stays; what was started here ends with Ctrl-C. With a FILE.yaml, which
`rosafe setup save` writes and docs/setups.md describes, sound and processors are there as well."""

from __future__ import annotations

import argparse
import asyncio
import os
import shutil
import sys
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rosafe.commands import CommandError
from rosafe.interface import ComponentError
from rosafe.setups import Setup

if TYPE_CHECKING:
    from rosafe.client.component_client import ComponentClient
    from rosafe.client.graph import Graph
    from rosafe.commands._launcher import Launcher, ManagedProcess

PERIOD = 1.0  # seconds between two looks at all


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = "rosafe up [FILE.yaml] [--live] [--keep FILE] [--port PORT] [--live-port PORT] [--no-browser]"
    parser.add_argument("file", metavar="FILE.yaml", nargs="?", help="the setup to load (default: none)")
    parser.add_argument("--live", action="store_true", help="serve the page too, as `rosafe live` does")
    parser.add_argument(
        "--keep",
        metavar="FILE",
        default="",
        help="as rosAFE-ros takes it, where that is started here; FILE.yaml then gives the sound, and the first tree",
    )
    parser.add_argument("--port", type=_port, default=8080, help="of genomixd (default: 8080)")
    parser.add_argument("--live-port", type=_port, default=8090, metavar="PORT", help="of the page (default: 8090)")
    parser.add_argument("--no-browser", action="store_true", help="open no browser")
    parser.epilog = (
        "exit status: 0 ended as it was told to, 1 something did not start or has ended, 2 wrong command line\n\n"
        "examples:\n"
        "  rosafe up\n"
        "  rosafe up setups/scene.yaml --live     # the built-in scene, and what comes of it\n"
        "  rosafe up tree.yaml"
    )


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < int(text[:10]) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is no port: 1 to 65535")
    return int(text)


def run(options: argparse.Namespace) -> int:
    """Start everything, show how it is, and end what was started."""
    from rosafe.commands._launcher import Launcher, environment
    from rosafe.commands.setup import read_file, without_saved_tree
    from rosafe.component import generate
    from rosafe.transport import master

    # What is wrong with it is told before anything starts.
    setup = without_saved_tree(read_file(options.file), options.keep) if options.file else None
    try:
        env = environment()
        master.check_address(env["ROS_MASTER_URI"])
        generate.ensure_messages()
    except (generate.GenerationError, master.MasterError) as problem:
        raise CommandError(str(problem)) from None
    with Launcher(env) as stack:
        asyncio.run(_Session(options, setup, stack).run())
        if sys.stdout.isatty():
            print("ending what was started here", flush=True)
        refused = any(part.state == "refused" for part in stack.parts.values())
        return int(refused or bool(stack.ended))


class _Session:
    """One run of the command."""

    def __init__(self, options: argparse.Namespace, setup: Setup | None, stack: Launcher) -> None:
        self._options = options
        self._setup = setup
        self._stack = stack
        self._screen = _Screen(sys.stdout.isatty())
        self._end = asyncio.Event()

    async def run(self) -> None:
        """Until a signal comes."""
        from rosafe.component import startup

        loop = asyncio.get_running_loop()
        for number in startup.ending_signals():
            loop.add_signal_handler(number, self._end.set)
        work = asyncio.create_task(self._work())
        end = asyncio.create_task(self._end.wait())
        show = asyncio.create_task(self._show())
        try:
            await asyncio.wait({work, end}, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                work.result()  # raises what has failed
        finally:
            for task in (work, end, show):
                task.cancel()
            await asyncio.gather(work, end, show, return_exceptions=True)
            self._screen.show(self._stack.lines())

    async def _show(self) -> None:
        while True:
            for part in self._stack.parts.values():
                part.look()
            self._screen.show(self._stack.lines())
            await asyncio.sleep(PERIOD / 4)

    async def _work(self) -> None:
        options, stack = self._options, self._stack
        await stack.start_master()
        async with _graph() as graph:
            keep = ("--keep", options.keep) if options.keep else ()
            bass, afe, _ = await asyncio.gather(
                stack.start_node(graph, "bass"),
                stack.start_node(graph, "rosAFE", *keep),
                stack.start_genomixd(options.port),
            )
            await self._load(afe)
            if options.live:
                await stack.start_page(options.live_port, not options.no_browser)
            self._screen.say("Ctrl-C ends what was started here")
            while True:
                await self._poll(bass, afe)
                await asyncio.sleep(PERIOD)

    async def _load(self, afe: ComponentClient | None) -> None:
        from rosafe.client import setup_transaction
        from rosafe.commands._component import format_error
        from rosafe.commands._launcher import ManagedProcess

        if self._setup is None:
            return
        part = self._stack.parts["setup"] = ManagedProcess("setup", "loads", self._options.file)
        if afe is None:
            part.state, part.detail = "refused", "rosAFE does not run"
            return
        try:
            answer = await setup_transaction.apply(afe, self._setup, wait=10.0)
            part.state = "loaded"
            part.detail = f"{self._options.file}: {len(answer['created'])} created, {len(answer['reused'])} reused"
        except ComponentError as problem:
            part.state, part.detail = "refused", format_error(problem)

    async def _poll(self, bass: ComponentClient | None, afe: ComponentClient | None) -> None:
        """Say of the nodes what they do."""
        for name, proxy in (("bass", bass), ("rosAFE", afe)):
            part = self._stack.parts[name]
            if proxy is None or part.state == "ended":
                continue
            try:
                part.detail = await (_acquisition if name == "bass" else _tree)(proxy) + _tree_origin(part)
                part.state = "runs"
            except ComponentError as problem:
                part.state, part.detail = "silent", str(problem)


def _tree_origin(part: ManagedProcess) -> str:
    return "" if part.child is not None else ", was there"


async def _acquisition(bass: ComponentClient) -> str:
    now = await bass.outputs("getAcquisition", {})
    return f"acquires from {now['device']}" if now["running"] else "idle"


async def _tree(afe: ComponentClient) -> str:
    processors = (await afe.outputs("getProcessors", {}))["processors"]
    return f"{len(processors)} processors"


@asynccontextmanager
async def _graph() -> AsyncIterator[Graph]:
    from rosafe.client.graph import Graph

    graph = Graph(os.environ["ROS_MASTER_URI"])
    try:
        yield graph
    finally:
        await graph.close()


class _Screen:
    """The state of all parts: on a terminal written over itself, elsewhere a line for each change."""

    def __init__(self, terminal: bool) -> None:
        self._terminal = terminal
        self._lines: list[str] = []
        self._said: list[str] = []

    def say(self, text: str) -> None:
        """Show a line below all others."""
        self._said.append(text)

    def show(self, lines: Iterable[str]) -> None:
        """Show how it is now."""
        now = [*lines, *self._said]
        if now == self._lines:
            return
        if self._terminal:
            # Lines are left whole for the terminal to wrap: an address is to be copied from there.
            width = shutil.get_terminal_size().columns
            above = sum(max(1, -(-len(line) // width)) for line in self._lines)
            up = f"\x1b[{above}F\x1b[J" if above else ""
            print(up + "".join(f"{line}\n" for line in now), end="", flush=True)
        else:
            print(*(line for line in now if line not in self._lines), sep="\n", flush=True)
        self._lines = now
