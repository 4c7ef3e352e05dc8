"""Build whole trees of processors, planned by `rosafe.tree.tree_planner`, by the services of a component."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, Protocol, TypeVar

from rosafe.declarations import ros_names
from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, REQUEST, ROSAFE, ComponentError
from rosafe.representations import BUILTIN
from rosafe.tree import tree_planner
from rosafe.tree.tree_planner import ExistingProcessor, ServiceCall, TreePlan, TreeRequest

MAX_ATTEMPTS = 20  # plans that become invalid because other clients change the tree, before this is an error
INPUT_SECONDS = 1.5  # longer than InputProc waits for sound
POLL_SECONDS = 0.02
LIST_SECONDS = 0.1  # between two requests for the list of processors while many are removed
BEGIN_BLOCKS, BEGIN_SECONDS = 2.5, 2.0  # how long new plugins are observed: blocks, and at most seconds

T = TypeVar("T")


class Turns:
    """Queue of the builds of one component: one at a time, first come, first served.

    Loading a setup takes long. It lets waiting builds run between two of its steps, and then lists the tree again.

    Attributes
    ----------
    reserved : frozenset of str
        The names of the processors that a setup in progress creates; other builds choose different names.
    kept : set of str
        The processors of this setup that other builds use. They are kept even if the setup fails.
    """

    def __init__(self) -> None:
        self.reserved: frozenset[str] = frozenset()
        self.kept: set[str] = set()
        self._setups = asyncio.Lock()
        self._lock = asyncio.Lock()
        self._waiting = 0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for the turn, and have it inside the `async with` block."""
        self._waiting += 1
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        try:
            yield
        finally:
            self._lock.release()

    @asynccontextmanager
    async def setup(self, names: Iterable[str]) -> AsyncIterator[None]:
        """Reserve the names of a setup inside the block. One setup is loaded at a time."""
        async with self._setups:
            self.reserved, self.kept = frozenset(names), set()
            try:
                yield
            finally:
                self.reserved, self.kept = frozenset(), set()

    def keep(self, names: Iterable[str]) -> None:
        """Record that a build uses the processors of these names, so that a setup in progress does not remove them."""
        if self.reserved:
            self.kept.update(names)

    async def give_way(self) -> bool:
        """Give up the turn until all waiting builds have run. Return whether there were any."""
        if not self._waiting:
            return False
        self._lock.release()
        await shield_until_done(self._lock.acquire())
        return True


class Services(Protocol):
    """The services of a rosAFE."""

    node: str  # full name of the node
    turns: Turns

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service and return its outputs, for an activity none when it is running. Raises ComponentError."""

    async def port_connected(self, port: str) -> str:
        """Return the topic that an input port is connected to, or an empty string."""

    async def published(self, topic: str) -> bool:
        """Return whether `topic` is published."""


async def build(component: Services, values: Mapping[str, Any]) -> dict[str, Any]:
    """Create or reuse the processors for `values`, which are parameters of REQUEST, and return its outputs.

    If a step fails or the task is cancelled, the created processors are removed again, except those with children of
    other clients. Other clients may change the tree concurrently. The caller runs its own requests one at a time, so
    that a failing request does not remove a processor that another one reuses.

    Raises
    ------
    ComponentError
        An error of the component.
    """
    request = await _parse(values)
    created: list[str] = []
    try:
        dependencies = await _execute(component, request, created)
        if _has_plugins(request) and created:
            await _watch_begin(component, created)
    except BaseException:
        await shield_until_done(remove(component, created))
        raise
    component.turns.keep(dependencies)
    return tree_planner.build_response(request, dependencies, created, component.node)


def _has_plugins(request: TreeRequest) -> bool:
    return bool(set(request.kinds) - BUILTIN)


async def _check_all_exist(component: Services, names: Iterable[str]) -> None:
    """Raise ComponentError, with the reason, if one of the processors has failed; a plugin would fail again."""
    for name in names:
        await component.outputs("getDependencies", {"nameProc": name})


async def _watch_begin(component: Services, created: list[str]) -> None:
    """Raise ComponentError if a created processor fails in one of its first blocks, as plugins may."""
    found = await list_processors(component)
    root = next((p for p in found if not p.parent), None)
    block = root.values["nFramesPerBlock"] / root.rate if root is not None and root.rate else 0.0
    deadline = asyncio.get_running_loop().time() + min(BEGIN_SECONDS, BEGIN_BLOCKS * block)
    while True:
        await _check_all_exist(component, created)
        if asyncio.get_running_loop().time() > deadline:
            return
        await asyncio.sleep(POLL_SECONDS)


async def find(component: Services, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the response of `build` if all processors exist. Raises ``::rosAFE::e_noSuchProcessor`` if not."""
    request = await _parse(values)
    plan = tree_planner.plan(request, await list_processors(component))
    if plan.steps:
        missing = ", ".join(step.service for step in plan.steps if step.creates)
        raise ROSAFE.error("e_noSuchProcessor", what=f"there is none with these parameters; missing: {missing}")
    return tree_planner.build_response(request, plan.dependencies, (), component.node)


async def _parse(values: Mapping[str, Any]) -> TreeRequest:
    parameters = dict(values)
    kind = tree_planner.kind_of(parameters.pop("representation"))
    return await asyncio.to_thread(tree_planner.parse_request, kind, parameters)  # imports and uses numpy and scipy


async def _execute(component: Services, request: TreeRequest, created: list[str]) -> list[str]:
    problem = ComponentError(
        "::genom::mwerr", what=f"gave up after {MAX_ATTEMPTS} attempts: other clients kept changing the tree"
    )
    for _ in range(MAX_ATTEMPTS):
        plan = tree_planner.plan(request, await list_processors(component), component.turns.reserved)
        try:
            await _execute_plan(component, request, plan, created)
        except ComponentError as error:
            if not tree_planner.is_race(error):
                raise
            problem = error
            if error.ex == tree_planner.INTERRUPTED:
                await wait_for_input(component)
        else:
            if not plan.steps or tree_planner.chain_exists(plan.dependencies, await list_processors(component)):
                return plan.dependencies
            if _has_plugins(request):
                await _check_all_exist(component, [step.creates for step in plan.steps if step.creates])
    raise problem


async def wait_for_input(component: Services) -> None:
    """Wait until the InputProc of another client, which has interrupted ours, ends; it may wait for sound."""
    deadline = asyncio.get_running_loop().time() + INPUT_SECONDS
    while asyncio.get_running_loop().time() < deadline:
        if await list_processors(component):
            return
        await asyncio.sleep(POLL_SECONDS)


async def _execute_plan(component: Services, request: TreeRequest, plan: TreePlan, created: list[str]) -> None:
    if plan.steps and plan.steps[0].creates == plan.dependencies[0]:
        await _connect(component, request)
    for step in plan.steps:
        await shield_until_done(execute_step(component, step, created))


async def execute_step(component: Services, step: ServiceCall, created: list[str]) -> None:
    """Call a service, and append the name of the processor that it has created to `created`."""
    await component.outputs(step.service, step.values)
    if step.creates:
        created.append(step.creates)


async def shield_until_done(work: Awaitable[T]) -> T:
    """Complete `work` even if the task is cancelled meanwhile: the processors that a call creates must be known."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)  # its result is no longer needed
        raise


async def _connect(component: Services, request: TreeRequest) -> None:
    """Connect the Audio port to the topic that the client named, or to bass if it is not connected yet."""
    topic = str(request.explicit.get("connect", ""))
    if not topic and not await component.port_connected("Audio"):
        default = REQUEST.parameter("connect").default
        topic = default if await component.published(ros_names.resolve(default, component.node)) else ""
    if topic:
        await component.outputs("connect_port", {"local": "Audio", "remote": topic})


async def list_processors(component: Services) -> list[ExistingProcessor]:
    """Return all processors whose kind is known here."""
    found = []
    for processor in (await component.outputs("getProcessors", {}))["processors"]:
        kind = KINDS.get(processor["kind"])
        if kind is not None:
            texts = {entry["name"]: entry["value"] for entry in processor["parameters"]}
            declared = kind.parameters if kind.parent else (*kind.parameters, *BLOCK_AND_BUFFERS)
            values = {p.name: p.parse(texts[p.name]) for p in declared if p.name in texts}
            rate = float(processor.get("rate", 0.0))
            found.append(ExistingProcessor(processor["name"], kind.kind, processor["upperDepName"], values, rate))
    return found


async def remove(component: Services, created: list[str]) -> None:
    """Remove the created processors, leaves first, except those that other clients use. Stops at the first error."""
    clock, listed = asyncio.get_running_loop().time, -math.inf
    found: dict[str, ExistingProcessor] = {}
    children: Counter[str] = Counter()
    try:
        for name in reversed(created):
            if await component.turns.give_way() or clock() - listed > LIST_SECONDS:
                found, listed = {p.name: p for p in await list_processors(component)}, clock()
                children = Counter(p.parent for p in found.values())
            if name not in found or children[name] or name in component.turns.kept:
                continue
            parent = found[name].parent
            if parent:
                await component.outputs("removeProcessor", {"name": name})
            elif len(found) == 1:
                await component.outputs("Stop", {})
            del found[name]
            children[parent] -= 1
    except ComponentError:
        return
