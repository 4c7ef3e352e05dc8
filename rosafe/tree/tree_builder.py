"""Makes whole trees of processors, as `rosafe.tree.tree_planner` plans them, with the services of a component."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, Protocol, TypeVar

from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, REQUEST, ROSAFE, ComponentError
from rosafe.representations import BUILTIN
from rosafe.tree import tree_planner as request
from rosafe.tree.tree_planner import ExistingProcessor, ServiceCall, TreePlan, TreeRequest

MAX_ATTEMPTS = 20  # plans that others' changes of the tree may spoil before the error is told
INPUT_SECONDS = 1.5  # longer than an InputProc waits for sound
POLL_SECONDS = 0.02
LOOK_SECONDS = 0.1  # between two looks at the tree while many processors are removed
BEGIN_BLOCKS, BEGIN_SECONDS = 2.5, 2.0  # how long plugins are watched after they were started: blocks, at most seconds

T = TypeVar("T")


class Turns:
    """Takes turns among the builds of one component, first come, first served.

    A setup is long: it gives way to waiting builds between two of its steps, and then looks at the tree again.

    Attributes
    ----------
    reserved : frozenset of str
        The names that a setup under way makes; other builds choose different ones.
    kept : set of str
        What other builds use of it; it stays also if the setup fails.
    """

    def __init__(self) -> None:
        self.reserved: frozenset[str] = frozenset()
        self.kept: set[str] = set()
        self._setups = asyncio.Lock()
        self._lock = asyncio.Lock()
        self._waiting = 0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Have the turn inside the `async with` block."""
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
        """Reserve the names of a setup inside the block. One setup at a time."""
        async with self._setups:
            self.reserved, self.kept = frozenset(names), set()
            try:
                yield
            finally:
                self.reserved, self.kept = frozenset(), set()

    def keep(self, names: Iterable[str]) -> None:
        """Note that a build uses the processors of these names: a setup under way does not remove them."""
        if self.reserved:
            self.kept.update(names)

    async def give_way(self) -> bool:
        """Let all waiting builds have their turn; return whether there were any. To be called by whose turn it is."""
        if not self._waiting:
            return False
        self._lock.release()
        await shield_until_done(self._lock.acquire())
        return True


class Services(Protocol):
    """A rosAFE, by its services."""

    instance: str
    turns: Turns

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """What a service returns; an activity, nothing, as soon as it runs. Raises ComponentError."""

    async def port_connected(self, port: str) -> str:
        """The topic that an input port is connected to, or nothing."""

    async def published(self, topic: str) -> bool:
        """Whether somebody publishes `topic`."""


async def build(component: Services, values: Mapping[str, Any]) -> dict[str, Any]:
    """Make or find the processors that `values` ask for, those of REQUEST's parameters that are given; its outputs.

    Where anything fails, or the task is cancelled, what was made is removed again, as far as nothing of others hangs on
    it. Others may change the tree meanwhile; a caller keeps his own requests apart, so that what one has found is not
    removed by another that fails.

    Raises
    ------
    ComponentError
        The component's own.
    """
    wish = await _understood(values)
    made: list[str] = []
    try:
        dependencies = await _carry_out(component, wish, made)
        if set(wish.kinds) - BUILTIN and made:
            await _watch_begin(component, made)
    except BaseException:
        await shield_until_done(remove(component, made))
        raise
    component.turns.keep(dependencies)
    return request.build_response(wish, dependencies, made, component.instance)


async def _watch_begin(component: Services, made: list[str]) -> None:
    """Raise ComponentError if a processor that was made fails with one of its first blocks, as plugins may."""
    found = await list_processors(component)
    root = next((p for p in found if not p.parent), None)
    block = root.values["nFramesPerBlock"] / root.rate if root is not None and root.rate else 0.0
    deadline = asyncio.get_running_loop().time() + min(BEGIN_SECONDS, BEGIN_BLOCKS * block)
    while True:
        for name in made:
            await component.outputs("getDependencies", {"nameProc": name})
        if asyncio.get_running_loop().time() > deadline:
            return
        await asyncio.sleep(POLL_SECONDS)


async def find(component: Services, values: Mapping[str, Any]) -> dict[str, Any]:
    """What `build` would answer if all that it needs is there; ``::rosAFE::e_noSuchProcessor`` where it is not."""
    wish = await _understood(values)
    plan = request.plan(wish, await list_processors(component))
    if plan.steps:
        missing = ", ".join(step.service for step in plan.steps if step.makes)
        raise ROSAFE.error("e_noSuchProcessor", what=f"there is none with these parameters; missing: {missing}")
    return request.build_response(wish, plan.dependencies, (), component.instance)


async def _understood(values: Mapping[str, Any]) -> TreeRequest:
    given = dict(values)
    kind = request.kind_of(given.pop("representation"))
    return await asyncio.to_thread(request.parse_request, kind, given)  # numpy's and scipy's work, and their import


async def _carry_out(component: Services, wish: TreeRequest, made: list[str]) -> list[str]:
    problem = ComponentError("::genom::mwerr", what="others change the tree all the time")
    for _ in range(MAX_ATTEMPTS):
        plan = request.plan(wish, await list_processors(component), component.turns.reserved)
        try:
            await _take_steps(component, wish, plan, made)
        except ComponentError as error:
            if not request.is_race(error):
                raise
            problem = error
            if error.ex == request.INTERRUPTED:
                await wait_for_input(component)
        else:
            if not plan.steps or request.chain_exists(plan.dependencies, await list_processors(component)):
                return plan.dependencies
    raise problem


async def wait_for_input(component: Services) -> None:
    """Let another's InputProc, which has taken the place of ours, come to its end: it may be waiting for sound."""
    deadline = asyncio.get_running_loop().time() + INPUT_SECONDS
    while asyncio.get_running_loop().time() < deadline:
        if await list_processors(component):
            return
        await asyncio.sleep(POLL_SECONDS)


async def _take_steps(component: Services, wish: TreeRequest, plan: TreePlan, made: list[str]) -> None:
    if plan.steps and plan.steps[0].makes == plan.dependencies[0]:
        await _connect(component, wish)
    for step in plan.steps:
        await shield_until_done(execute_step(component, step, made))


async def execute_step(component: Services, step: ServiceCall, made: list[str]) -> None:
    """Make one request, and note what it has made."""
    await component.outputs(step.service, step.values)
    if step.makes:
        made.append(step.makes)


async def shield_until_done(work: Awaitable[T]) -> T:
    """Do `work` to its end, also where the task is cancelled meanwhile: what a request made must be known."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)  # how it ends is of no interest any more
        raise


async def _connect(component: Services, wish: TreeRequest) -> None:
    """Connect the Audio port to the topic that the client named, or to bass where it is not connected yet."""
    topic = wish.connect
    if not topic and not await component.port_connected("Audio"):
        default = REQUEST.parameter("connect").default
        topic = default if await component.published(f"/{default}") else ""
    if topic:
        await component.outputs("connect_port", {"local": "Audio", "remote": topic})


async def list_processors(component: Services) -> list[ExistingProcessor]:
    """All processors of the kinds that are known here."""
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


async def remove(component: Services, made: list[str]) -> None:
    """Remove what was made, leaves first, but nothing that others have come to use. Errors are told by what failed."""
    clock, looked = asyncio.get_running_loop().time, -math.inf
    found: dict[str, ExistingProcessor] = {}
    children: Counter[str] = Counter()
    try:
        for name in reversed(made):
            if await component.turns.give_way() or clock() - looked > LOOK_SECONDS:
                found, looked = {p.name: p for p in await list_processors(component)}, clock()
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
