"""Saves what a rosAFE and its bass do as a setup, and loads one: as one transaction on the services of a graph."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol

from rosafe.declarations.plugins import FOLDERS
from rosafe.interface import BASS, KINDS, REQUEST, ROSAFE, ComponentError
from rosafe.setups import AcquireSettings, Setup, SetupError, dry_run, plan, read, wanted, write
from rosafe.setups.plan import refused
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
SOUND_SECONDS = 10.0  # from Acquire to the first sound; a sound card takes a second or two
PAUSE = 0.1

Undo = Callable[[], Awaitable[object]]


class ComponentProtocol(Services, Protocol):
    """A rosAFE on a graph with others."""

    def other(self, instance: str) -> AbstractAsyncContextManager[Services]:
        """Another component of the graph; ComponentError where none of that name is there."""


async def save(component: ComponentProtocol, values: Mapping[str, Any]) -> dict[str, Any]:
    """The outputs of `interface.SAVE_SETUP`: the text of what `capture` finds."""
    return {"setup": write(await capture(component), bool(values.get("full", False)))}


async def capture(component: ComponentProtocol) -> Setup:
    """The setup that would make the tree, the connection and the acquisition that are there."""
    topic = await component.port_connected(AUDIO)
    there = (await component.outputs("getProcessors", {}))["processors"]
    for processor in there:
        if processor["kind"] not in KINDS:
            unknown = f"{processor['name']!r} is of kind {processor['kind']}, which is not known here"
            raise refused(f"{unknown}: set {FOLDERS} as for the node")
    processors = [wanted(found) for found in await list_processors(component)]
    sound = None
    if topic:
        async with _bass(component, topic) as bass:
            if bass is not None and (now := await bass.outputs("getAcquisition", {}))["running"]:
                sound = AcquireSettings.of(now)
    return Setup(sound, {AUDIO: topic} if topic else {}, tuple(processors))


async def load(component: ComponentProtocol, values: Mapping[str, Any]) -> dict[str, Any]:
    """Make all that the setup in `values` describes; the outputs of `interface.LOAD_SETUP`.

    Processors, connection and acquisition that are there already are used. Where anything fails, or the task is
    cancelled, what was made is undone, as far as nothing of others hangs on it.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_badNewValue`` for a text that is no setup, ``e_existsAlready`` where something else is there, and
        those of the component and of bass.
    """
    try:
        setup = await asyncio.to_thread(read, values["setup"])
    except SetupError as problem:
        raise refused(str(problem)) from None
    async with component.turns.setup(wanted.name for wanted in setup.processors), component.turns.turn():
        return await apply(component, setup)


async def apply(component: ComponentProtocol, setup: Setup, wait: float = 0.0) -> dict[str, Any]:
    """As `load`, for a setup that was read; `wait` seconds for what it hears, where that is just starting."""
    undoing: list[Undo] = []
    made: list[str] = []
    try:
        found = await list_processors(component)
        request_plan = plan(setup, found)
        now, topic = await component.port_connected(AUDIO), await _topic(component, setup)
        await _wait_for_topic(component, topic, wait)
        if found and now and topic != now:
            what = f"the tree hears {now}, in the setup {topic}: call Stop first"
            raise ROSAFE.error("e_existsAlready", what=what)
        sound = await _sound(component, setup, topic, found, undoing)
        if topic and topic != now and (setup.connections or request_plan.steps):
            await shield_until_done(_connect(component, topic, now, undoing))
        names = await _make(component, setup, made, patient=sound == "started")
    except BaseException:
        await shield_until_done(_undo(component, made, undoing))
        raise
    reused = [name for name in names if name not in made]
    return {"created": [name for name in names if name in made], "reused": reused, "sound": sound}


async def _undo(component: ComponentProtocol, made: list[str], undoing: list[Undo]) -> None:
    await remove(component, made)
    for undo in reversed(undoing):
        with contextlib.suppress(ComponentError):  # what failed first is told
            await undo()


# --- sound ------------------------------------------------------------------------------------------------------


async def _topic(component: ComponentProtocol, setup: Setup) -> str:
    """What the Audio port is to hear; nothing where that is left open and nobody publishes the usual."""
    topic = setup.connections.get(AUDIO, "") or await component.port_connected(AUDIO)
    usual = f"/{REQUEST.parameter('connect').default}"
    return topic or (usual if setup.sound is not None or await component.published(usual) else "")


async def _wait_for_topic(component: ComponentProtocol, topic: str, seconds: float) -> None:
    deadline = asyncio.get_running_loop().time() + seconds
    while topic and asyncio.get_running_loop().time() < deadline and not await component.published(topic):
        await asyncio.sleep(PAUSE)


@contextlib.asynccontextmanager
async def _bass(component: ComponentProtocol, topic: str) -> AsyncIterator[Services | None]:
    """The bass that publishes `topic`; None where that is none of ours."""
    instance, _, port = topic.removeprefix("/").rpartition("/")
    if not instance or "/" in instance or port != AUDIO:
        yield None
        return
    async with contextlib.AsyncExitStack() as stack:
        try:
            bass = await stack.enter_async_context(component.other(instance))
        except ComponentError:
            bass = None
        yield bass if bass is not None and getattr(bass, "component", BASS) is BASS else None


async def _sound(
    component: ComponentProtocol, setup: Setup, topic: str, found: list[ExistingProcessor], undoing: list[Undo]
) -> str:
    """Have the setup's sound acquired: "started" or "reused"; "" where it has none. All that can be checked is."""
    rate = next((p.rate for p in found if not p.parent), 0.0)
    if setup.sound is None:
        if rate:
            await asyncio.to_thread(dry_run, setup, rate)
        return ""
    values = setup.sound.values
    rate = rate or values["sampleRate"]
    if rate:
        await asyncio.to_thread(dry_run, setup, rate)
    async with _bass(component, topic) as bass:
        if bass is None:
            what = f"the setup has a sound, but no bass publishes {topic}: start it with: bass-ros"
            raise ComponentError("::genom::mwerr", what=what)
        now = await bass.outputs("getAcquisition", {})
        if not now["running"]:
            await shield_until_done(_acquire(component, bass, values, topic, undoing))
            return "started"
        for name, value in values.items():
            if now[name] != value:
                what = f"bass acquires with {name} {now[name]}, in the setup {value}: call its Stop first"
                raise ROSAFE.error("e_existsAlready", what=what)
        return "reused"


async def _acquire(
    component: ComponentProtocol, bass: Services, values: Mapping[str, Any], topic: str, undoing: list[Undo]
) -> None:
    async def stop() -> None:
        async with _bass(component, topic) as again:
            if again is not None:
                await again.outputs("Stop", {})

    await bass.outputs("Acquire", values)
    undoing.append(stop)


async def _connect(component: ComponentProtocol, topic: str, before: str, undoing: list[Undo]) -> None:
    await component.outputs("connect_port", {"local": AUDIO, "remote": topic})
    if before:
        undoing.append(lambda: component.outputs("connect_port", {"local": AUDIO, "remote": before}))


# --- processors -------------------------------------------------------------------------------------------------


async def _make(component: ComponentProtocol, setup: Setup, made: list[str], patient: bool) -> list[str]:
    """The names in the tree of the setup's processors, once they are all there.

    `patient`: the sound has just been started, and may need a while.
    """
    problem = ComponentError("::genom::mwerr", what="others change the tree all the time")
    deadline = asyncio.get_running_loop().time() + (SOUND_SECONDS if patient else 0.0)
    tries = 0
    while tries < MAX_ATTEMPTS:
        now = plan(setup, await list_processors(component))
        try:
            for step in now.steps:
                await shield_until_done(execute_step(component, step, made))
                if await component.turns.give_way():
                    break  # the others may have changed the tree
        except ComponentError as error:
            if error.ex == "::rosAFE::e_noData" and asyncio.get_running_loop().time() < deadline:
                await asyncio.sleep(PAUSE)
                await component.turns.give_way()
                continue
            if not request.is_race(error):
                raise
            problem, tries = error, tries + 1
            if error.ex == request.INTERRUPTED:
                await wait_for_input(component)
        else:
            if not now.steps:
                return now.names
    raise problem
