"""Find a running rosAFE on the ROS graph for the commands that send requests, or report how to start one."""

from __future__ import annotations

import argparse
import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rosafe.commands import CommandError
from rosafe.interface import ROSAFE, ComponentError

if TYPE_CHECKING:
    from rosafe.ros1.client.component_client import ComponentClient
    from rosafe.ros1.client.graph import Graph

POLL_SECONDS = 0.2  # between two attempts to reach a component or the master


def prepare(wait: float = 0.0) -> None:
    """Generate the messages and wait at most `wait` seconds for a ROS master; GenerationError or MasterError."""
    from rosafe.ros1.component import generate
    from rosafe.ros1.transport import master

    master.set_local_defaults()
    deadline = time.monotonic() + wait
    generate.ensure_messages()
    while True:
        try:
            return master.check_master(os.environ["ROS_MASTER_URI"])
        except master.MasterError:
            if time.monotonic() > deadline:
                raise
        time.sleep(POLL_SECONDS)


def add_instance(parser: argparse.ArgumentParser) -> None:
    """Add -i."""
    text = f"name of the rosAFE node (default: {ROSAFE.name})"
    parser.add_argument("-i", "--instance", default=ROSAFE.name, metavar="INSTANCE", help=text)


@asynccontextmanager
async def open_graph() -> AsyncIterator[Graph]:
    """Provide the graph of the master of this environment."""
    from rosafe.ros1.client.graph import Graph

    graph = Graph(os.environ["ROS_MASTER_URI"])
    try:
        yield graph
    finally:
        await graph.close()


@asynccontextmanager
async def component(instance: str, wait: float = 0.0) -> AsyncIterator[ComponentClient]:
    """Provide a client of the rosAFE node `instance`. Raises CommandError if there is none within `wait` seconds."""
    async with open_graph() as graph:
        try:
            client = await _find(graph, instance, wait)
        except ComponentError as problem:
            named = "" if instance == ROSAFE.name else f" -i {instance}"
            hint = f"; start it with: rosAFE-ros{named}" if problem.ex == "::genom::mwerr" else ""
            raise CommandError(format_error(problem) + hint) from None
        try:
            yield client
        finally:
            await client.close()


async def _find(graph: Graph, instance: str, wait: float) -> ComponentClient:
    from rosafe.ros1.client.component_client import ComponentClient, names

    deadline = time.monotonic() + wait
    while True:
        try:
            client = await ComponentClient.load(graph, (await names(graph, ROSAFE.name, instance))[1])
            await client.check(ROSAFE.name)
            return client
        except ComponentError as problem:
            if problem.ex != "::genom::mwerr" or time.monotonic() > deadline:
                raise
        await asyncio.sleep(POLL_SECONDS)


def format_error(problem: ComponentError) -> str:
    """Return the exception as one line: name and reason."""
    reason = problem.what or ROSAFE.exceptions.get(problem.ex.rpartition("::")[2], "")
    return problem.ex + (f": {reason}" if reason else "")
