"""Start the complete front-end: a ROS master, bass, rosAFE, genomixd, a setup, the localizer, and the live page.

Processes that already run are used and continue afterwards. Processes that were started here end with Ctrl-C. FILE.yaml
is a setup with sound and processors; `rosafe setup save` writes one, and docs/setups.md describes it.

exit status: 0 ended by Ctrl-C, 1 a process did not start or ended by itself, 2 wrong command line

examples:
  rosafe up
  rosafe up setups/scene.yaml --live     # the built-in scene and its representations
  rosafe up tree.yaml
  rosafe up --device plughw:1,0 --localize --head robot.head --live     # sources around a robot"""

from __future__ import annotations

import argparse
import asyncio
import os
import shutil
import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rosafe.commands._component import format_error, open_graph
from rosafe.commands._parameters import add_mirror
from rosafe.interface import ComponentError
from rosafe.system import option_types
from rosafe.tree.setups import AcquireSettings, Setup, write

if TYPE_CHECKING:
    from rosafe.commands._launcher import Launcher
    from rosafe.ros1.client.component_client import ComponentClient

POLL_SECONDS = 1.0  # between two queries of the state of all nodes


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", metavar="FILE.yaml", nargs="?", help="the setup to load (default: none)")
    parser.add_argument("--device", metavar="DEVICE", help="capture from DEVICE, instead of the sound of FILE.yaml")
    parser.add_argument(
        "--localize", action="store_true", help="also track the directions of sources, as `rosafe localize` does"
    )
    parser.add_argument(
        "--head",
        metavar="FILE",
        help="head for --localize: SOFA file or model (default: that of FILE.yaml, otherwise a sphere)",
    )
    add_mirror(parser)
    parser.add_argument("--live", action="store_true", help="also serve the live page, as `rosafe live` does")
    parser.add_argument(
        "--keep",
        metavar="FILE",
        default="",
        help="option for a rosAFE-ros that is started here; FILE.yaml then defines the sound and the first tree",
    )
    parser.add_argument(
        "--port", type=option_types.port(minimum=1), default=8080, help="port of genomixd (default: 8080)"
    )
    parser.add_argument(
        "--live-port",
        type=option_types.port(minimum=1),
        default=8090,
        metavar="PORT",
        help="port of the live page (default: 8090)",
    )
    parser.add_argument("--no-browser", action="store_true", help="do not open a browser")


def run(options: argparse.Namespace) -> int:
    """Start the processes, show their states, and end them."""
    from rosafe.commands._launcher import Launcher, environment
    from rosafe.commands.setup import read_file, without_saved_tree
    from rosafe.ros1.component import generate
    from rosafe.ros1.transport import master

    # Errors in the setup are reported before any process starts.
    setup = without_saved_tree(read_file(options.file), options.keep) if options.file else None
    if options.device:
        setup = replace(setup or Setup(), sound=AcquireSettings.of({"device": options.device}))
    env = environment()
    master.check_address(env["ROS_MASTER_URI"])
    generate.ensure_messages()
    with Launcher(env) as launcher:
        asyncio.run(_Session(options, setup, launcher).run())
        if sys.stdout.isatty():
            print("ending the processes that were started here", flush=True)
        refused = any(process.state == "refused" for process in launcher.processes.values())
        return int(refused or bool(launcher.ended))


def _localizer_settings(options: argparse.Namespace, setup: Setup | None) -> dict[str, Any] | None:
    """Return the settings of the localizer, or None if none is to be started."""
    of_setup = setup.localizer if setup is not None else None
    if of_setup is None and not options.localize and not options.head and options.mirror is None:
        return None
    settings = dict(of_setup or {})
    if options.head:
        settings["head"] = os.path.abspath(os.path.expanduser(options.head))
        settings.pop("mirror", None)  # of another head
    if options.mirror is not None:
        settings["mirror"] = options.mirror
    return settings


class _Session:
    """One run of the command."""

    def __init__(self, options: argparse.Namespace, setup: Setup | None, launcher: Launcher) -> None:
        self._options = options
        self._setup = setup
        self._launcher = launcher
        self._screen = _Screen(sys.stdout.isatty())

    async def run(self) -> None:
        """Run until a signal is received."""
        from rosafe.ros1.client.asyncio_tools import until_signal

        show = asyncio.create_task(self._show())
        try:
            await until_signal(self._work())
        finally:
            show.cancel()
            await asyncio.gather(show, return_exceptions=True)
            self._screen.show(self._launcher.lines())

    async def _show(self) -> None:
        while True:
            for process in self._launcher.processes.values():
                process.poll()
            self._screen.show(self._launcher.lines())
            await asyncio.sleep(POLL_SECONDS / 4)

    async def _work(self) -> None:
        options, launcher = self._options, self._launcher
        await launcher.start_master()
        async with open_graph() as graph:
            keep = ("--keep", options.keep) if options.keep else ()
            bass, afe, _ = await asyncio.gather(
                launcher.start_node(graph, "bass"),
                launcher.start_node(graph, "rosAFE", *keep),
                launcher.start_genomixd(options.port),
            )
            await self._load(afe)
            if (settings := _localizer_settings(options, self._setup)) is not None:
                await launcher.start_localizer(graph, settings)
            if options.live:
                await launcher.start_page(options.live_port, not options.no_browser)
            self._screen.say("Press Ctrl-C to end the processes that were started here")
            while True:
                await self._poll(bass, afe)
                await asyncio.sleep(POLL_SECONDS)

    async def _load(self, afe: ComponentClient | None) -> None:
        from rosafe.commands._launcher import ManagedProcess
        from rosafe.ros1.client import whole_trees

        if self._setup is None:
            return
        name = self._options.file or self._options.device
        process = self._launcher.processes["setup"] = ManagedProcess("setup", "loads", name)
        if afe is None:
            process.state, process.detail = "refused", "rosAFE is not running"
            return
        try:
            answer = await whole_trees.load(afe, write(self._setup), wait=10.0)
            process.state = "loaded"
            process.detail = f"{name}: {len(answer['created'])} created, {len(answer['reused'])} reused"
        except ComponentError as problem:
            process.state, process.detail = "refused", format_error(problem)

    async def _poll(self, bass: ComponentClient | None, afe: ComponentClient | None) -> None:
        """Update the states of the nodes."""
        for name, client in (("bass", bass), ("rosAFE", afe)):
            process = self._launcher.processes[name]
            if client is None or process.state == "ended":
                continue
            try:
                process.detail = await (_acquisition if name == "bass" else _tree)(client) + (
                    "" if process.child else ", was there"
                )
                process.state = "runs"
            except ComponentError as problem:
                process.state, process.detail = "silent", str(problem)


async def _acquisition(bass: ComponentClient) -> str:
    now = await bass.outputs("getAcquisition", {})
    return f"acquires from {now['device']}" if now["running"] else "idle"


async def _tree(afe: ComponentClient) -> str:
    processors = (await afe.outputs("getProcessors", {}))["processors"]
    return f"{len(processors)} processors"


class _Screen:
    """Display of the state of all processes: redrawn on a terminal, otherwise a line for each change."""

    def __init__(self, terminal: bool) -> None:
        self._terminal = terminal
        self._lines: list[str] = []
        self._notes: list[str] = []

    def say(self, text: str) -> None:
        """Add a line below all others."""
        self._notes.append(text)

    def show(self, lines: Iterable[str]) -> None:
        """Show the current state."""
        now = [*lines, *self._notes]
        if now == self._lines:
            return
        if self._terminal:
            # The terminal wraps long lines; they are not cut, so that URLs can be copied.
            width = shutil.get_terminal_size().columns
            above = sum(max(1, -(-len(line) // width)) for line in self._lines)
            up = f"\x1b[{above}F\x1b[J" if above else ""
            print(up + "".join(f"{line}\n" for line in now), end="", flush=True)
        else:
            print(*(line for line in now if line not in self._lines), sep="\n", flush=True)
        self._lines = now
