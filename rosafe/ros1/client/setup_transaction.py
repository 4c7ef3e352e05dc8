"""Saves the state of rosAFE and bass as a setup, and loads a setup as one transaction of service calls."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol

from rosafe.declarations import ros_names
from rosafe.declarations.plugins import FOLDERS
from rosafe.interface import BASS, KINDS, REQUEST, ROSAFE, ComponentError
from rosafe.ros1.client.errors import middleware_error
from rosafe.setups import AcquireSettings, Setup, SetupError, dry_run, plan, read, setup_processor, write
from rosafe.tree import tree_planner as request
from rosafe.tree.tree_builder import (
    MAX_ATTEMPTS,
    Services,
    execute_step,
    list_processors,
    remove,
    shield_until_done,
    wait_for_input,
)
from rosafe.tree.tree_planner import ExistingProcessor

AUDIO = "Audio"
SOUND_SECONDS = 10.0  # from Acquire to the first audio; a sound card takes a second or two
PAUSE = 0.1

Undo = Callable[[], Awaitable[object]]


class ComponentProtocol(Services, Protocol):
    """The rosAFE component that a setup is saved from or loaded into, with access to the other components."""

    def other(self, node: str) -> AbstractAsyncContextManager[Services]:
        """Return another component of the graph by its full name; ComponentError if there is none."""


async def save(component: ComponentProtocol, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the outputs of `interface.SAVE_SETUP`: the setup of `capture` as text."""
    return {"setup": write(await capture(component), bool(values.get("full", False)))}


async def capture(component: ComponentProtocol) -> Setup:
    """Return a setup of the present tree, connection and acquisition."""
    topic = await component.port_connected(AUDIO)
    for processor in (await component.outputs("getProcessors", {}))["processors"]:
        if processor["kind"] not in KINDS:
            unknown = f"{processor['name']!r} is of kind {processor['kind']}, which is not available here"
            raise ROSAFE.error("e_badNewValue", what=f"{unknown}; set {FOLDERS} as for the node")
    processors = [setup_processor(found) for found in await list_processors(component)]
    sound = None
    if topic:
        async with _bass(component, topic) as bass:
            if bass is not None and (now := await bass.outputs("getAcquisition", {}))["running"]:
                sound = AcquireSettings.of(now)
    return Setup(sound, {AUDIO: ros_names.relative(topic, component.node)} if topic else {}, tuple(processors))


async def load(component: ComponentProtocol, values: Mapping[str, Any]) -> dict[str, Any]:
    """Create everything that the setup in `values` describes; return the outputs of `interface.LOAD_SETUP`.

    An existing processor, connection or acquisition is used if it agrees with the setup. If anything fails, or the task
    is cancelled, all changes are undone, except those that other clients depend on meanwhile.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_badNewValue`` if the text is not a setup, ``e_existsAlready`` if an existing object differs from
        it, and the errors of the component and of bass.
    """
    try:
        setup = await asyncio.to_thread(read, values["setup"])
    except SetupError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
    async with component.turns.setup(processor.name for processor in setup.processors), component.turns.turn():
        return await apply(component, setup)


async def apply(component: ComponentProtocol, setup: Setup, wait: float = 0.0) -> dict[str, Any]:
    """Load a setup object like `load`; wait up to `wait` seconds until the topic of its audio is published."""
    undo_steps: list[Undo] = []
    created: list[str] = []
    try:
        found = await list_processors(component)
        request_plan = plan(setup, found)
        connected, topic = await component.port_connected(AUDIO), await _topic(component, setup)
        await _wait_for_topic(component, topic, wait)
        if found and connected and topic != connected:
            what = f"the tree is connected to {connected}, the setup expects {topic}; call Stop first"
            raise ROSAFE.error("e_existsAlready", what=what)
        sound = await _sound(component, setup, topic, found, undo_steps)
        if topic and topic != connected and (setup.connections or request_plan.steps):
            await shield_until_done(_connect(component, topic, connected, undo_steps))
        names = await _create(component, setup, created, wait_for_sound=sound == "started")
    except BaseException:
        await shield_until_done(_undo(component, created, undo_steps))
        raise
    reused = [name for name in names if name not in created]
    return {"created": [name for name in names if name in created], "reused": reused, "sound": sound}


async def _undo(component: ComponentProtocol, created: list[str], undo_steps: list[Undo]) -> None:
    await remove(component, created)
    for undo in reversed(undo_steps):
        with contextlib.suppress(ComponentError):  # the first error is reported
            await undo()


# --- sound ------------------------------------------------------------------------------------------------------


async def _topic(component: ComponentProtocol, setup: Setup) -> str:
    """Return the topic for the Audio port; empty if the setup has none and the default topic is not published."""
    if AUDIO in setup.connections:
        return ros_names.resolve(setup.connections[AUDIO], component.node)
    topic = await component.port_connected(AUDIO)
    default = ros_names.resolve(REQUEST.parameter("connect").default, component.node)
    return topic or (default if setup.sound is not None or await component.published(default) else "")


async def _wait_for_topic(component: ComponentProtocol, topic: str, seconds: float) -> None:
    deadline = asyncio.get_running_loop().time() + seconds
    while topic and asyncio.get_running_loop().time() < deadline and not await component.published(topic):
        await asyncio.sleep(PAUSE)


@contextlib.asynccontextmanager
async def _bass(component: ComponentProtocol, topic: str) -> AsyncIterator[Services | None]:
    """Yield the bass component that publishes `topic`; None if another node publishes it."""
    node, _, port = topic.rpartition("/")
    if not node or port != AUDIO:
        yield None
        return
    async with contextlib.AsyncExitStack() as stack:
        try:
            bass = await stack.enter_async_context(component.other(node))
        except ComponentError:
            bass = None
        yield bass if bass is not None and getattr(bass, "component", BASS) is BASS else None


async def _sound(
    component: ComponentProtocol, setup: Setup, topic: str, found: list[ExistingProcessor], undo_steps: list[Undo]
) -> str:
    """Check the setup, and start its sound; return "started", "reused", or "" if it has none."""
    values = setup.sound.values if setup.sound is not None else {"sampleRate": 0.0}
    if rate := next((p.rate for p in found if not p.parent), 0.0) or values["sampleRate"]:
        await asyncio.to_thread(dry_run, setup, rate)
    if setup.sound is None:
        return ""
    async with _bass(component, topic) as bass:
        if bass is None:
            what = f"the setup has a sound, but no bass publishes {topic}; start it with: bass-ros"
            if ros_names.relative(topic, component.node).startswith("/"):  # in another namespace
                what += f", or write {REQUEST.parameter('connect').default} for the bass beside {component.node}"
            raise middleware_error(what)
        running = await bass.outputs("getAcquisition", {})
        if not running["running"]:
            await shield_until_done(_acquire(component, bass, values, topic, undo_steps))
            return "started"
        for name, value in values.items():
            if running[name] != value:
                what = f"bass acquires with {name} {running[name]}, the setup expects {value}; call its Stop first"
                raise ROSAFE.error("e_existsAlready", what=what)
        return "reused"


async def _acquire(
    component: ComponentProtocol, bass: Services, values: Mapping[str, Any], topic: str, undo_steps: list[Undo]
) -> None:
    async def stop() -> None:
        async with _bass(component, topic) as started:
            if started is not None:
                await started.outputs("Stop", {})

    await bass.outputs("Acquire", values)
    undo_steps.append(stop)


async def _connect(component: ComponentProtocol, topic: str, previous: str, undo_steps: list[Undo]) -> None:
    await component.outputs("connect_port", {"local": AUDIO, "remote": topic})
    if previous:
        undo_steps.append(lambda: component.outputs("connect_port", {"local": AUDIO, "remote": previous}))


# --- processors -------------------------------------------------------------------------------------------------


async def _create(component: ComponentProtocol, setup: Setup, created: list[str], wait_for_sound: bool) -> list[str]:
    """Create the missing processors of the setup; return the names of all of them in the tree.

    `wait_for_sound`: the sound was just started, and its first block may arrive only after some seconds.
    """
    problem = middleware_error(f"gave up after {MAX_ATTEMPTS} attempts: other clients keep changing the tree")
    deadline = asyncio.get_running_loop().time() + (SOUND_SECONDS if wait_for_sound else 0.0)
    attempts = 0
    while attempts < MAX_ATTEMPTS:
        current = plan(setup, await list_processors(component))
        try:
            for step in current.steps:
                await shield_until_done(execute_step(component, step, created))
                if await component.turns.give_way():
                    break  # other clients may have changed the tree
        except ComponentError as error:
            if error.ex == "::rosAFE::e_noData" and asyncio.get_running_loop().time() < deadline:
                await asyncio.sleep(PAUSE)
                await component.turns.give_way()
                continue
            if not request.is_race(error):
                raise
            problem, attempts = error, attempts + 1
            if error.ex == request.INTERRUPTED:
                await wait_for_input(component)
        else:
            if not current.steps:
                return current.names
    raise problem
