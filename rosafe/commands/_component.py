"""A running rosAFE for the commands that make requests of one: found on the graph, or a line that says what to do."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rosafe.commands import CommandError
from rosafe.interface import ROSAFE, ComponentError

if TYPE_CHECKING:
    from rosafe.client.component_client import ComponentClient
    from rosafe.client.graph import Graph

PAUSE = 0.2  # seconds between two looks, where a component is waited for


def prepare(wait: float = 0.0) -> None:
    """Have messages and a ROS master, which may take `wait` seconds to come; else Failure."""
    from rosafe.component import generate
    from rosafe.transport import master

    master.set_local_defaults()
    deadline = time.monotonic() + wait
    try:
        generate.ensure_messages()
        while True:
            try:
                return master.check_master(os.environ["ROS_MASTER_URI"])
            except master.MasterError:
                if time.monotonic() > deadline:
                    raise
            time.sleep(PAUSE)
    except (generate.GenerationError, master.MasterError) as problem:
        raise CommandError(str(problem)) from None


@asynccontextmanager
async def component(instance: str, wait: float = 0.0) -> AsyncIterator[ComponentClient]:
    """The rosAFE of that name, which may take `wait` seconds to come; Failure where there is none."""
    from rosafe.client.graph import Graph

    graph = Graph(os.environ["ROS_MASTER_URI"])
    try:
        try:
            proxy = await _found(graph, instance, wait)
        except ComponentError as problem:
            named = "" if instance == ROSAFE.name else f" -i {instance}"
            hint = f"; start it with: rosAFE-ros{named}" if problem.ex == "::genom::mwerr" else ""
            raise CommandError(format_error(problem) + hint) from None
        try:
            yield proxy
        finally:
            await proxy.close()
    finally:
        await graph.close()


async def _found(graph: Graph, instance: str, wait: float) -> ComponentClient:
    from rosafe.client.component_client import ComponentClient, names

    deadline = time.monotonic() + wait
    while True:
        try:
            proxy = await ComponentClient.load(graph, names(ROSAFE.name, instance)[1])
            await proxy.check(ROSAFE.name)
            return proxy
        except ComponentError as problem:
            if problem.ex != "::genom::mwerr" or time.monotonic() > deadline:
                raise
        await asyncio.sleep(PAUSE)


def format_error(problem: ComponentError) -> str:
    """The exception in one line: its name, and what it is about."""
    what = problem.what or ROSAFE.exceptions.get(problem.ex.rpartition("::")[2], "")
    return problem.ex + (f": {what}" if what else "")
