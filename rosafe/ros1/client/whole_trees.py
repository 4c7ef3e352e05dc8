"""Requests for whole trees of rosAFE: the node builds them; the sound of a setup is started here, at bass."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Mapping
from typing import TYPE_CHECKING, Any

from rosafe.declarations import ros_names
from rosafe.interface import BASS, FIND, LOAD_SETUP, MAX_SEQUENCE, REQUEST, ROSAFE, SAVE_SETUP, ComponentError
from rosafe.ros1.client.errors import middleware_error
from rosafe.tree.setups import AcquireSettings, Setup, read, write
from rosafe.tree.tree_planner import ancestor_kinds, kind_of

if TYPE_CHECKING:
    from rosafe.ros1.client.component_client import ComponentClient

AUDIO = "Audio"
SOUND_SECONDS = 10.0  # from Acquire to the first audio; a sound card takes a second or two
PAUSE = 0.1


async def call(component: ComponentClient, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the outputs of a request for a whole tree: one of `ROSAFE.client_side_services`.

    If the task is cancelled meanwhile, everything that it has created is removed again, except processors with children
    of other clients.
    """
    if service == SAVE_SETUP.name:
        return {"setup": await save(component, bool(values["full"]))}
    if service == LOAD_SETUP.name:
        return await load(component, values["setup"])
    await component.check_plugins(kind.request for kind in ancestor_kinds(kind_of(values["representation"])))
    parameters = {name: value for name, value in values.items() if name not in ("representation", "connect")}
    request = {
        "representation": values["representation"],
        "parameters": json.dumps(parameters),
        "connect": values.get("connect", ""),
    }
    if service == FIND.name:
        return await component.node_outputs(service, request)
    return await _create(component, service, request)


async def save(component: ComponentClient, full: bool) -> str:
    """Return the present tree, connection and acquisition as the text of a setup."""
    text = str((await component.node_outputs(SAVE_SETUP.name, {"full": full}))["setup"])
    if topic := await component.port_connected(AUDIO):
        async with _bass(component, topic) as bass:
            if bass is not None and (now := await bass.outputs("getAcquisition", {}))["running"]:
                _, _, sections = text.partition("\n")
                return write(Setup(AcquireSettings.of(now)), full) + sections
    return text


async def load(component: ComponentClient, text: str, wait: float = 0.0) -> dict[str, Any]:
    """Create everything that the setup `text` describes; return the outputs of `interface.LOAD_SETUP`.

    An existing processor, connection or acquisition is used if it agrees with the setup. If anything fails, or the task
    is cancelled, all changes are undone, except those that other clients depend on meanwhile. Wait up to `wait` seconds
    until the topic of the sound is published.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_badNewValue`` if the text is not a setup, ``e_existsAlready`` if an existing object differs from
        it, and the errors of the component and of bass.
    """
    clock = asyncio.get_running_loop().time
    await component.node_outputs(LOAD_SETUP.name, {"setup": text, "check": True})
    setup = await asyncio.to_thread(read, text, [])
    connected = await component.port_connected(AUDIO)
    topic = await _topic(component, setup, connected)
    deadline = clock() + wait
    while topic and clock() < deadline and not await component.published(topic):
        await asyncio.sleep(PAUSE)
    async with _sound(component, setup, topic) as sound:
        try:
            return {**await _load_tree(component, text, SOUND_SECONDS if sound == "started" else 0.0), "sound": sound}
        except asyncio.CancelledError:
            if connected and connected != topic:
                await _finish(_try(component.outputs("connect_port", {"local": AUDIO, "remote": connected})))
            raise


async def _load_tree(component: ComponentClient, text: str, seconds: float) -> Mapping[str, Any]:
    """Let the node load the setup; without sound, try again for `seconds`."""
    deadline = asyncio.get_running_loop().time() + seconds
    while True:
        try:
            return await _create(component, LOAD_SETUP.name, {"setup": text, "check": False})
        except ComponentError as problem:
            if problem.ex != "::rosAFE::e_noData" or asyncio.get_running_loop().time() > deadline:
                raise
        await asyncio.sleep(PAUSE)


async def _create(component: ComponentClient, service: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Call a service that creates processors; remove them again if the task is cancelled meanwhile."""
    answer = asyncio.ensure_future(component.node_outputs(service, request))
    try:
        return await asyncio.shield(answer)
    except asyncio.CancelledError:
        await _finish(_remove_created(component, answer))
        raise


async def _remove_created(component: ComponentClient, answer: Awaitable[Mapping[str, Any]]) -> None:
    with contextlib.suppress(ComponentError):
        names = list((await answer)["created"])
        for end in range(len(names), 0, -MAX_SEQUENCE):
            await component.node_outputs("removeUnused", {"names": names[max(0, end - MAX_SEQUENCE) : end]})


async def _try(work: Awaitable[object]) -> None:
    with contextlib.suppress(ComponentError):  # the first error is reported
        await work


async def _finish(work: Awaitable[object]) -> None:
    """Complete `work`, also if the task is cancelled meanwhile."""
    task = asyncio.ensure_future(work)
    while not task.done():
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.wait([task])


# --- sound ------------------------------------------------------------------------------------------------------


async def _topic(component: ComponentClient, setup: Setup, connected: str) -> str:
    """Return the topic for the Audio port; empty if the setup has none and the default topic is not published."""
    if AUDIO in setup.connections:
        return ros_names.resolve(setup.connections[AUDIO], component.node)
    default = ros_names.resolve(REQUEST.parameter("connect").default, component.node)
    return connected or (default if setup.sound is not None or await component.published(default) else "")


@contextlib.asynccontextmanager
async def _bass(component: ComponentClient, topic: str) -> AsyncIterator[ComponentClient | None]:
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
        yield bass if bass is not None and bass.component is BASS else None


@contextlib.asynccontextmanager
async def _sound(component: ComponentClient, setup: Setup, topic: str) -> AsyncIterator[str]:
    """Start the sound of the setup, and stop it if the block ends with an exception.

    Yields "started", "reused" if bass acquires already, or "" if the setup has no sound.
    """
    if setup.sound is None:
        yield ""
        return
    async with _bass(component, topic) as bass:
        if bass is None:
            what = f"the setup has a sound, but no bass publishes {topic}; start it with: bass-ros"
            if ros_names.relative(topic, component.node).startswith("/"):  # in another namespace
                what += f", or write {REQUEST.parameter('connect').default} for the bass beside {component.node}"
            raise middleware_error(what)
        running = await bass.outputs("getAcquisition", {})
        if running["running"]:
            for name, value in setup.sound.values.items():
                if running[name] != value:
                    what = f"bass acquires with {name} {running[name]}, the setup expects {value}; call its Stop first"
                    raise ROSAFE.error("e_existsAlready", what=what)
            yield "reused"
            return
        acquired = asyncio.ensure_future(bass.outputs("Acquire", setup.sound.values))
        try:
            await asyncio.shield(acquired)
            yield "started"
        except BaseException:
            await _finish(_stop(bass, acquired))
            raise


async def _stop(bass: ComponentClient, acquired: Awaitable[object]) -> None:
    with contextlib.suppress(ComponentError):
        await acquired
        await bass.outputs("Stop", {})
