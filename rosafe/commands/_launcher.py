"""Processes of the front-end: use those that run, start the others, monitor them and end them."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import aiohttp
from rosgraph.names import get_ros_namespace

from rosafe.commands import CommandError
from rosafe.interface import COMPONENTS, ComponentError
from rosafe.ros1.transport import master, paths
from rosafe.system.processes import Child, ProcessGroup
from rosafe.system.terminal import printable

if TYPE_CHECKING:
    from rosafe.ros1.client.component_client import ComponentClient
    from rosafe.ros1.client.graph import Graph

START_SECONDS = 30.0
END_SECONDS = 6.0  # one second more than the servers need
POLL_SECONDS = 0.1
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_URL = re.compile(r"http://\S+")


@dataclass
class ManagedProcess:
    """One process and its state on the screen."""

    name: str
    state: str = "starts"
    detail: str = ""
    child: Child | None = None  # if it was started here

    def poll(self) -> None:
        """Update the state if the process has ended."""
        if self.child is not None and self.child.has_ended() and self.state != "ended":
            code = self.child.process.returncode
            lines = [line for line in _COLOUR.sub("", self.child.err).splitlines() if line.strip()]
            self.state = "ended"
            if code < 0:  # without a last message
                self.detail = f"killed by signal {-code}"
            else:
                self.detail = f"exit code {code}" + (f": {lines[-1].strip()}" if lines else "")


@dataclass
class Launcher:
    """All processes from the master to the live page, in the environment `env`. Use it as a context manager."""

    env: Mapping[str, str]
    processes: dict[str, ManagedProcess] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._children = ProcessGroup(self.env)  # nodes and servers
        # The other processes need the master until they have ended. roscore ends rosmaster and rosout after SIGTERM,
        # but not after SIGKILL.
        self._masters = ProcessGroup(self.env, orphaned="TERM")

    def __enter__(self) -> Launcher:
        return self

    def __exit__(self, *exception: object) -> None:
        self._children.close(END_SECONDS)
        self._masters.close(END_SECONDS)

    @property
    def ended(self) -> list[ManagedProcess]:
        """Processes that were started here and have ended by themselves."""
        for process in self.processes.values():
            process.poll()
        return [process for process in self.processes.values() if process.state == "ended"]

    def start(self, name: str, *command: str, master: bool = False) -> ManagedProcess:
        """Start one of the commands."""
        children = self._masters if master else self._children
        process = self.processes[name] = ManagedProcess(name, child=children.start(*command))
        return process

    async def start_master(self) -> None:
        """Use the running ROS master or start one. Raises CommandError if neither is possible."""
        uri = self.env["ROS_MASTER_URI"]
        if await _answers(uri):
            self.processes["roscore"] = ManagedProcess("roscore", "runs", f"{uri}, was there")
            return
        if not master.is_local(uri):
            raise CommandError(f"no ROS master at {uri}; start roscore on that machine")
        process = self.start("roscore", "roscore", "-p", str(urlsplit(uri).port or 11311), master=True)
        await self._until(process, lambda: _answers(uri))
        process.detail = uri

    async def start_node(self, graph: Graph, name: str, *options: str) -> ComponentClient | None:
        """Use the running component `name` or start it. Return a client of it, or None if it does not start."""
        running = await _client(graph, name) if self.processes["roscore"].child is None else None
        if running is not None:
            self.processes[name] = ManagedProcess(name, "runs", "was there")
            return running
        process = self.start(name, paths.program(f"{name}-ros"), *options)
        found: list[ComponentClient] = []

        async def is_up() -> bool:
            client = await _client(graph, name)
            found.extend([client] if client is not None else [])
            return client is not None

        await self._until(process, is_up)
        return found[0] if found else None

    async def start_genomixd(self, port: int) -> None:
        """Use the running genomixd on `port` or start one."""
        url = f"http://127.0.0.1:{port}"
        if other := await _genomixd(url):
            process = self.processes["genomixd"] = ManagedProcess("genomixd", "runs", f"{url}, was there")
            if (namespace := _namespace(other)) != _namespace(f"Namespace: {get_ros_namespace(self.env)}"):
                process.state = "refused"
                process.detail = f"{url} is a genomixd of the namespace {namespace}; choose another one with --port"
            return
        process = self.start("genomixd", paths.program("genomixd"), "-p", str(port))
        await self._until(process, lambda: _genomixd(url))
        if process.state == "runs":
            process.detail = url

    async def start_localizer(self, graph: Graph, settings: Mapping[str, Any]) -> None:
        """Use the running localizer or start one with these settings."""
        from rosafe.ros1.client import localizer

        node = graph.resolve(localizer.NODE)
        if self.processes["roscore"].child is None and await localizer.is_registered(graph, node):
            self.processes["localizer"] = ManagedProcess("localizer", "runs", "was there")
            return
        await localizer.set_parameters(graph, node, settings)
        process = self.start("localizer", paths.program("rosafe"), "localize")
        await self._until(process, lambda: localizer.is_registered(graph, node))
        if process.state == "runs":
            process.detail = f"head: {settings.get('head', 'sphere')}"

    async def start_page(self, port: int, browser: bool) -> None:
        """Start the server of the live page."""
        options = ["--port", str(port), *(() if browser else ("--no-browser",))]
        process = self.start("page", paths.program("rosafe"), "live", *options)

        async def prints_url() -> bool:
            return process.child is not None and bool(_URL.search(process.child.out))

        await self._until(process, prints_url)
        if process.child is not None and (url := _URL.search(process.child.out)):
            process.detail = url[0]

    async def _until(self, process: ManagedProcess, condition: Callable[[], Awaitable[object]]) -> None:
        deadline = asyncio.get_running_loop().time() + START_SECONDS
        while True:
            process.poll()
            if process.state == "ended":
                return
            if await condition():
                process.state = "runs"
                return
            if asyncio.get_running_loop().time() > deadline:
                process.state, process.detail = "late", f"not up after {START_SECONDS:g} s"
                return
            await asyncio.sleep(POLL_SECONDS)

    def lines(self) -> Iterator[str]:
        """Yield the lines of the screen."""
        for process in self.processes.values():
            yield printable(f"{process.name:9} {process.state:7} {process.detail}".rstrip())


async def _answers(uri: str) -> bool:
    try:
        await asyncio.to_thread(master.check_master, uri)
    except master.MasterError:
        return False
    return True


async def _client(graph: Graph, name: str) -> ComponentClient | None:
    from rosafe.ros1.client.component_client import ComponentClient

    try:
        client = await ComponentClient.load(graph, name)
        await client.check(COMPONENTS[name].name)
    except ComponentError:
        return None
    return client


async def _genomixd(url: str) -> str:
    """Return the beginning of the help of the genomixd at `url`; empty if there is none."""
    timeout = aiohttp.ClientTimeout(total=2)
    try:
        async with aiohttp.ClientSession(timeout=timeout) as http, http.get(f"{url}/") as answer:
            text = (await answer.content.read(300)).decode("utf-8", "replace")
            return text if text.startswith("genomixd") else ""
    except (aiohttp.ClientError, OSError):
        return ""


def _namespace(text: str) -> str:
    found = re.search(r"^Namespace: (/\S*)", text, re.MULTILINE)
    return (found[1] if found else "").rstrip("/") or "/"


def environment() -> dict[str, str]:
    """Return the environment of this process with the additions that the children need."""
    from rosafe.ros1.component import generate

    master.set_local_defaults()
    master.check_family()
    return {**os.environ, **generate.environment()}
