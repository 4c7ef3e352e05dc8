"""The processes of a robot's hearing: those that are there are used, the others started, watched and ended."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import aiohttp

from rosafe.commands import CommandError
from rosafe.demo.processes import Child, ProcessGroup
from rosafe.interface import COMPONENTS, ComponentError
from rosafe.terminal import printable
from rosafe.transport import master, paths

if TYPE_CHECKING:
    from rosafe.client.component_client import ComponentClient
    from rosafe.client.graph import Graph

START_SECONDS = 30.0
END_SECONDS = 6.0  # a second more than our servers take
PAUSE = 0.1
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_URL = re.compile(r"http://\S+")


@dataclass
class ManagedProcess:
    """One process, as the screen shows it."""

    name: str
    state: str = "starts"
    detail: str = ""
    child: Child | None = None  # where it was started here

    def look(self) -> None:
        """Notice that it has ended, if it has."""
        if self.child is not None and self.child.has_ended() and self.state != "ended":
            code = self.child.process.returncode
            lines = [line for line in _COLOUR.sub("", self.child.err).splitlines() if line.strip()]
            self.state = "ended"
            if code < 0:  # it had no last words
                self.detail = f"killed by signal {-code}"
            else:
                self.detail = f"exit code {code}" + (f": {lines[-1].strip()}" if lines else "")


@dataclass
class Launcher:
    """Everything from the master to the page, in an environment `env`. Use it as a context manager."""

    env: Mapping[str, str]
    parts: dict[str, ManagedProcess] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._children = ProcessGroup(self.env)  # nodes and servers
        # Which the others need until they have ended; roscore ends its rosmaster and rosout where it is told to, not
        # where it is killed.
        self._masters = ProcessGroup(self.env, orphaned="TERM")

    def __enter__(self) -> Launcher:
        return self

    def __exit__(self, *exception: object) -> None:
        self._children.close(END_SECONDS)
        self._masters.close(END_SECONDS)

    @property
    def ended(self) -> list[ManagedProcess]:
        """Those that were started here and have ended by themselves."""
        for part in self.parts.values():
            part.look()
        return [part for part in self.parts.values() if part.state == "ended"]

    def start(self, name: str, *command: str, master: bool = False) -> ManagedProcess:
        """Start one of the commands."""
        children = self._masters if master else self._children
        part = self.parts[name] = ManagedProcess(name, child=children.start(*command))
        return part

    async def start_master(self) -> None:
        """Have a ROS master; Failure where there is none, and none can be started."""
        uri = self.env["ROS_MASTER_URI"]
        if await _answers(uri):
            self.parts["roscore"] = ManagedProcess("roscore", "runs", f"{uri}, was there")
            return
        if not master.is_local(uri):
            raise CommandError(f"there is no ROS master at {uri}, and it is for that machine to start it: roscore")
        part = self.start("roscore", "roscore", "-p", str(urlsplit(uri).port or 11311), master=True)
        await self._until(part, lambda: _answers(uri))
        part.detail = uri

    async def start_node(self, graph: Graph, name: str, *options: str) -> ComponentClient | None:
        """Have the component `name`, and a proxy of it; None where it does not come up."""
        there = await _proxy(graph, name) if self.parts["roscore"].child is None else None
        if there is not None:
            self.parts[name] = ManagedProcess(name, "runs", "was there")
            return there
        part = self.start(name, paths.program(f"{name}-ros"), *options)
        found: list[ComponentClient] = []

        async def is_up() -> bool:
            proxy = await _proxy(graph, name)
            found.extend([proxy] if proxy is not None else [])
            return proxy is not None

        await self._until(part, is_up)
        return found[0] if found else None

    async def start_genomixd(self, port: int) -> None:
        """Have a genomixd on `port`."""
        url = f"http://127.0.0.1:{port}"
        if await _is_genomixd(url):
            self.parts["genomixd"] = ManagedProcess("genomixd", "runs", f"{url}, was there")
            return
        part = self.start("genomixd", paths.program("genomixd"), "-p", str(port))
        await self._until(part, lambda: _is_genomixd(url))
        if part.state == "runs":
            part.detail = url

    async def start_page(self, port: int, browser: bool) -> None:
        """Serve the live page."""
        options = ["--port", str(port), *(() if browser else ("--no-browser",))]
        part = self.start("page", paths.program("rosafe"), "live", *options)

        async def tells_url() -> bool:
            return part.child is not None and bool(_URL.search(part.child.out))

        await self._until(part, tells_url)
        if part.child is not None and (url := _URL.search(part.child.out)):
            part.detail = url[0]

    async def _until(self, part: ManagedProcess, condition: Callable[[], Awaitable[bool]]) -> None:
        deadline = asyncio.get_running_loop().time() + START_SECONDS
        while True:
            part.look()
            if part.state == "ended":
                return
            if await condition():
                part.state = "runs"
                return
            if asyncio.get_running_loop().time() > deadline:
                part.state, part.detail = "late", f"not up after {START_SECONDS:g} s"
                return
            await asyncio.sleep(PAUSE)

    def lines(self) -> Iterator[str]:
        """What the screen shows."""
        for part in self.parts.values():
            yield printable(f"{part.name:9} {part.state:7} {part.detail}".rstrip())


async def _answers(uri: str) -> bool:
    try:
        await asyncio.to_thread(master.check_master, uri)
    except master.MasterError:
        return False
    return True


async def _proxy(graph: Graph, name: str) -> ComponentClient | None:
    from rosafe.client.component_client import ComponentClient

    try:
        proxy = await ComponentClient.load(graph, name)
        await proxy.check(COMPONENTS[name].name)
    except ComponentError:
        return None
    return proxy


async def _is_genomixd(url: str) -> bool:
    timeout = aiohttp.ClientTimeout(total=2)
    try:
        async with aiohttp.ClientSession(timeout=timeout) as http, http.get(f"{url}/") as answer:
            return (await answer.content.read(100)).startswith(b"genomixd")
    except (aiohttp.ClientError, OSError):
        return False


def environment() -> dict[str, str]:
    """That of this process, with what the children need besides."""
    from rosafe.component import generate

    master.set_local_defaults()
    return {**os.environ, **generate.environment()}
