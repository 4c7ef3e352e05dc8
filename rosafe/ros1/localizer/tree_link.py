"""The link to rosAFE: finds the node, requests the representations, and watches that their processors stay as they are.

It runs on a thread of its own, with an event loop: its calls have time limits, and no call of the master can block the
thread that publishes.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import rospy

from rosafe.audio.files.windows import MAX_WINDOW
from rosafe.declarations import ros_names
from rosafe.dsp.framing import FrameGrid
from rosafe.interface import BLOCK_AND_BUFFERS, REQUEST, RESTORED_PARAM, ROSAFE, ComponentError, format_value
from rosafe.localization import cues
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import OK, WARN, FrameFormat
from rosafe.localization.status import NodeStatus
from rosafe.ros1.client.component_client import ComponentClient
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.ros1.client.tcpros import ServiceClient, component_exception
from rosafe.ros1.component import serialization
from rosafe.ros1.transport import registration
from rosafe.system.log_throttle import ThrottledLog
from rosafe.system.terminal import printable
from rosafe.tree.tree_planner import ExistingProcessor

BLOCK_SECONDS = 0.05  # block of a new input, rounded to a multiple of the hop: 2205 frames at 44.1 kHz
POLL_SECONDS = 1.0  # between two checks of the processors, and between two attempts
PROBE_SECONDS = 0.05  # between two looks for a message of sound
SOUND_SECONDS = 1.0  # for two messages of the sound
CALL_SECONDS = 30.0
MAX_PAUSE = 16.0  # s between two requests that fail
REMOVE_SECONDS = 2.0  # for the processors to be removed at the end
STOPPED = "rosAFE was stopped: waiting for an input (InputProc, rosafe request, or a setup), or a restart of rosAFE"

_report = ThrottledLog(rospy.logwarn, 60.0)


class CreatedProcessors:
    """The processors that the localizer has created in rosAFE, and which it removes at its end.

    They are without the input, which cannot be removed. The private ROS parameter ~created contains them too, for a
    node of the same name that replaces this one; a restarted master gets it again.

    Attributes
    ----------
    names : list of str
        In the order of their creation.
    node : str
        The address of the rosAFE that has them.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.node = ""
        self._parameter = rospy.resolve_name("~created")

    async def recall(self, graph: Graph, instance: str, node: str) -> None:
        """Read the parameter if rosAFE at the address `node` is another one than before.

        The processors of the rosAFE before it exist again if it has restored its tree (`rosAFE-ros --keep`).
        """
        if node == self.node:
            return
        stored = await _list_parameter(graph, self._parameter)
        names = stored[1:] or self.names
        if stored[:1] != [node]:
            restored = await _list_parameter(graph, f"{instance}/{RESTORED_PARAM}")
            names = [name for name in names if restored[:1] == [node] and name in restored[1:]]
        self.node, self.names = node, []
        await self._set(graph, names)

    async def add(self, graph: Graph, names: Iterable[str]) -> None:
        """Add processors."""
        names = list(names)
        await self._set(graph, [*(name for name in self.names if name not in names), *names])

    async def keep(self, graph: Graph, existing: Iterable[str]) -> None:
        """Forget processors that no longer exist: others may be created with their names."""
        existing = set(existing)
        await self._set(graph, [name for name in self.names if name in existing])

    async def _set(self, graph: Graph, names: list[str]) -> None:
        if names != self.names:
            self.names = names
            stored = registration.registrar().parameters[self._parameter] = [self.node, *names]
            await graph.master("setParam", self._parameter, stored)

    async def remove(self, graph: Graph, client: ComponentClient) -> None:
        """Remove them from rosAFE, except those with children of other clients."""
        with contextlib.suppress(ComponentError):
            await client.node_outputs("removeUnused", {"names": self.names})
        await self.keep(graph, (processor.name for processor in await client.processors()))
        if not self.names:
            registration.registrar().parameters.pop(self._parameter, None)
            with contextlib.suppress(NotRegisteredError):
                await graph.master("deleteParam", self._parameter)


async def _list_parameter(graph: Graph, name: str) -> list[str]:
    """Return a ROS parameter that is a list of texts; empty if there is none."""
    try:
        value = await graph.master("getParam", name)
    except NotRegisteredError:
        return []
    return [str(item) for item in value] if isinstance(value, list) else []


@dataclass(frozen=True)
class LocalizerPorts:
    """Representations that rosAFE computes.

    Attributes
    ----------
    model : DirectionModel
        Of the head, for their parameters.
    format : FrameFormat
        Of their frames.
    topics : mapping
        By representation.
    audio : str
        The topic of the sound.
    """

    model: DirectionModel
    format: FrameFormat
    topics: Mapping[str, str]
    audio: str


class _Waiting(Exception):
    """Something is missing; the text names it."""


class TreeLink:
    """Provides the representations as long as rosAFE runs.

    Parameters
    ----------
    instance : str
        Full name of the rosAFE node.
    connect : str
        Topic of the sound, if an input has to be created.
    model_for : callable
        Called with the sample rate, on another thread; it may take long. Raises ValueError if the head has none.
    established : callable
        Called with a `LocalizerPorts` when all representations are computed, and with None when they no longer are.
    status : NodeStatus
        Reports missing parts.
    is_stalled : callable
        Returns whether no more frames arrive.
    """

    def __init__(
        self,
        instance: str,
        connect: str,
        model_for: Callable[[float], DirectionModel],
        established: Callable[[LocalizerPorts | None], None],
        status: NodeStatus,
        is_stalled: Callable[[], bool] = lambda: False,
    ) -> None:
        self._instance = instance
        self._connect = connect
        self._model_for = model_for
        self._established, self._is_stalled = established, is_stalled
        self._status = status
        self._created = CreatedProcessors()
        self._input_of = ""  # the address of the rosAFE whose input was there
        self._watched: dict[str, ExistingProcessor] = {}
        self._rate = 0.0  # sample rate, Hz
        self._wakener: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None
        self._closing = False
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="tree link", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def check_now(self) -> None:
        """Check the processors soon, because something about them has changed."""
        if self._wakener is not None:
            loop, wake = self._wakener
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(wake.set)

    def close(self) -> None:
        """Remove the created processors from rosAFE, and end."""
        self._closing = True
        self.check_now()
        self._thread.join(REMOVE_SECONDS)

    # --- the thread ---

    async def _run(self) -> None:
        self._wakener = asyncio.get_running_loop(), asyncio.Event()
        graph = Graph(os.environ["ROS_MASTER_URI"], "localizer")
        pause = POLL_SECONDS
        try:
            while not self._closing:
                try:
                    await self._serve(graph)
                except _Waiting as problem:
                    pause = POLL_SECONDS
                    self._status.set("rosAFE", WARN, printable(str(problem)))
                except ComponentError as problem:
                    pause = min(2 * pause, MAX_PAUSE)
                    self._status.set("rosAFE", WARN, _reason(problem))
                except Exception as problem:  # the node continues, and waits until rosAFE can be used again
                    pause = min(2 * pause, MAX_PAUSE)
                    self._status.set_error("rosAFE", problem)
                await self._pause(pause)
            with contextlib.suppress(ComponentError, NotRegisteredError, TimeoutError):
                await asyncio.wait_for(self._remove_created(graph), REMOVE_SECONDS)
        finally:
            await graph.close()

    async def _remove_created(self, graph: Graph) -> None:
        if self._created.names and not registration.registrar().is_replaced:  # otherwise its successor uses them
            client = await ComponentClient.load(graph, self._instance)
            try:
                await self._created.remove(graph, client)
            finally:
                await client.close()

    async def _pause(self, seconds: float = POLL_SECONDS) -> None:
        assert self._wakener is not None
        _, wake = self._wakener
        if not self._closing:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(wake.wait(), seconds)
        wake.clear()

    async def _serve(self, graph: Graph) -> None:
        """Request the representations of the running node, and watch them until they change."""
        try:
            client = await ComponentClient.load(graph, self._instance)
        except ComponentError as problem:
            raise _Waiting(f"waiting for rosAFE: {problem.what}") from None
        try:
            await self._recall_created(graph, client)
            link = await self._establish(graph, client)
            self._status.set("rosAFE", OK, f"localizing with {', '.join(link.topics.values())}")
            self._established(link)
            while not self._closing:
                await self._pause()
                await self._check(client)
        except TimeoutError:
            raise _Waiting(f"waiting for rosAFE: {self._instance} does not answer") from None
        except ComponentError as problem:
            if self._watched:  # rosAFE has ended
                raise _Waiting(_reason(problem)) from None
            raise
        finally:
            if self._watched:
                self._watched = {}
                self._established(None)
            await client.close()

    async def _recall_created(self, graph: Graph, client: ComponentClient) -> None:
        """Find out which processors of this rosAFE were created by this node, or by one of its name before it."""
        try:
            node = await graph.node_uri(self._instance)
        except NotRegisteredError:  # it ends, or the master has restarted
            raise _Waiting(f"waiting for rosAFE: {self._instance} is not registered at the master") from None
        await self._created.recall(graph, self._instance, node)
        if processors := await client.processors():  # otherwise a tree may still be restored
            await self._created.keep(graph, (processor.name for processor in processors))

    async def _establish(self, graph: Graph, client: ComponentClient) -> LocalizerPorts:
        service = ServiceClient(graph, ROSAFE.name, self._instance, "request")
        try:
            model = await self._model_of_input(graph, service, client)
            rate = model.sample_rate
            topics: dict[str, str] = {}
            names: set[str] = set()
            for kind in cues.KINDS:
                answer = await self._request(graph, service, kind, model.parameters)
                topics[kind] = answer.topic
                names |= set(answer.dependencies)
        finally:
            service.close()
        processors = {p.name: p for p in await client.processors()}
        missing = names - processors.keys()
        root = _input_of(processors.values())
        if missing or root is None or root.name not in names or root.rate != rate:
            raise _Waiting("the processors of rosAFE have changed meanwhile")
        self._watched, self._rate = {name: processors[name] for name in names}, rate
        self._input_of = self._created.node
        block = int(root.values["nFramesPerBlock"])
        grid = FrameGrid.design(rate, "cc", model.parameters)
        _report_block(self._status, block, grid.hop, rate)
        format_ = FrameFormat(rate, model.channels, len(grid.window), grid.hop, block)
        return LocalizerPorts(model, format_, topics, await self._audio_topic(client))

    async def _model_of_input(self, graph: Graph, service: ServiceClient, client: ComponentClient) -> DirectionModel:
        """Return the model for the input, which is created if there is none, or if the rate of the sound differs."""
        for _ in range(2):
            root = _input_of(await client.processors())
            if root is None:
                model = await self._model(await self._wait_for_sound(client))
                if await client.processors():  # meanwhile: a tree was restored
                    continue
                hop = FrameGrid.design(model.sample_rate, "cc", model.parameters).hop
                frames = hop * max(1, round(BLOCK_SECONDS * model.sample_rate / hop))
                await self._request(graph, service, "input", {"nFramesPerBlock": frames})
            elif (await self._sound_rate(client) or root.rate) != root.rate:
                await self._replace_input(graph, client, root)
            else:
                return await self._model(root.rate)
        raise _Waiting("waiting for rosAFE: its input has changed")

    async def _wait_for_sound(self, client: ComponentClient) -> int:
        """Return the sample rate of the sound, for an input that is to be created."""
        if self._input_of == self._created.node:
            raise _Waiting(STOPPED)
        while not (rate := await self._sound_rate(client)):
            if self._closing or not await client.is_reachable():
                raise _Waiting("waiting for rosAFE")
        return rate

    async def _replace_input(self, graph: Graph, client: ComponentClient, root: ExistingProcessor) -> None:
        """Create the input again, for sound of another sample rate. Only processors of this node are removed."""
        await self._created.remove(graph, client)
        buffers = {parameter.name: root.values[parameter.name] for parameter in BLOCK_AND_BUFFERS}
        try:
            await client.outputs("InputProc", {"name": root.name, **buffers})
        except ComponentError as problem:
            self._input_of = ""  # after Stop an input is created
            raise _Waiting(
                f"waiting for rosAFE: {problem.what}: rosservice call {self._instance}/Stop removes its processors"
            ) from None

    async def _sound_rate(self, client: ComponentClient) -> int:
        """Return the sample rate of the sound, 0 if there is none: rosAFE logs requests that fail for want of it."""
        topic = await self._audio_topic(client)
        rate = await sound_rate(topic, SOUND_SECONDS)
        if not rate:
            self._status.set("rosAFE", WARN, f"waiting for sound on {topic}")
        return rate

    async def _audio_topic(self, client: ComponentClient) -> str:
        """Return the topic of the sound."""
        topic = self._connect or await client.port_connected("Audio") or REQUEST.parameter("connect").default
        return str(rospy.resolve_name(ros_names.resolve(topic, self._instance)))

    async def _model(self, rate: float) -> DirectionModel:
        try:
            return await asyncio.to_thread(self._model_for, rate)
        except (ValueError, InterruptedError) as problem:
            raise _Waiting(str(problem)) from None

    async def _request(
        self, graph: Graph, service: ServiceClient, representation: str, parameters: Mapping[str, Any]
    ) -> Any:
        text = "\n".join(f"{name}: {format_value(value)}" for name, value in parameters.items())
        values = {"representation": representation, "parameters": text, "connect": self._connect}
        answer = await service.call(values, CALL_SECONDS)
        if not answer.genom_success:
            problem = component_exception(answer.genom_exdetail)
            if problem.ex == "::rosAFE::e_noData":
                raise _Waiting(f"waiting for sound: {problem.what or 'no audio on the Audio port'}")
            raise problem
        created = [name for name in answer.created if name != answer.dependencies[0]]
        if created:
            await self._created.add(graph, created)
        return answer

    async def _check(self, client: ComponentClient) -> None:
        """Raise _Waiting if a processor was removed or changed."""
        if self._closing:
            return
        if self._is_stalled():
            rate = await self._sound_rate(client)
            if rate and rate != self._rate:
                raise _Waiting(f"the sample rate of the sound has changed from {self._rate:g} to {rate} Hz")
        found = {p.name: p for p in await client.processors()}
        if _input_of(found.values()) is None:
            raise _Waiting(STOPPED)
        for name, expected in self._watched.items():
            if name not in found:
                raise _Waiting(f"the processor {name} of rosAFE was removed; it is requested again")
            if found[name].values != expected.values or found[name].rate != expected.rate:
                changed = [key for key, value in expected.values.items() if found[name].values.get(key) != value]
                what = f"{', '.join(changed) or 'sample rate'} of the processor {name} of rosAFE"
                raise _Waiting(f"{what} was changed; another one is requested")


def _input_of(processors: Iterable[ExistingProcessor]) -> ExistingProcessor | None:
    return next((processor for processor in processors if not processor.parent), None)


def _report_block(status: NodeStatus, block: int, hop: int, rate: float) -> None:
    status.value("block of rosAFE (frames)", block)
    more = 1000 * (block / rate - BLOCK_SECONDS)
    if more > 1:
        _report(f"the input of rosAFE has blocks of {block} frames: they add {more:.0f} ms to the latency")
    if block % hop:
        _report(
            f"the blocks of rosAFE ({block} frames) are not a multiple of the hop ({hop}): the frames of "
            "processors that were created one after another do not coincide, and sources are found less often"
        )


def _reason(problem: ComponentError) -> str:
    what = problem.what or ROSAFE.exceptions.get(problem.ex.rpartition("::")[2], "")
    return printable(f"waiting for rosAFE: {problem.ex}: {what}")


async def sound_rate(topic: str, seconds: float) -> int:
    """Return the sample rate (Hz) of the sound on a topic (`binaudio_portStruct`); 0 if there is none within a time."""
    rates: list[int] = []  # of messages: the first one may be an old one of a latched topic

    def received(message: Any) -> None:
        rates.append(0 if message.problem else int(message.sampleRate))

    # rospy has one message class for each topic of a process, which `InputSound` may use at the same time
    message_class = serialization.tolerant_message_class("rosAFE", "::binaudio::portStruct", MAX_WINDOW)
    subscriber = rospy.Subscriber(topic, message_class, received, queue_size=1)
    try:
        until = time.monotonic() + seconds
        while len(rates) < 2 and time.monotonic() < until:
            await asyncio.sleep(PROBE_SECONDS)
    finally:
        subscriber.unregister()
    return rates[-1] if len(rates) > 1 else 0
