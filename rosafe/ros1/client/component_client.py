"""A client of one component instance: calls its functions, starts its activities, and reads its ports."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import rosgraph.names

from rosafe.declarations import plugins
from rosafe.declarations.signals import LEVELS
from rosafe.declarations.text import did_you_mean
from rosafe.interface import (
    BLOCK_AND_BUFFERS,
    COMPONENTS,
    KINDS,
    PLUGINS,
    ROSAFE,
    ComponentError,
    ComponentSpec,
    PortSpec,
    Service,
    ros_type,
)
from rosafe.interface.rosafe import WHOLE_TREES
from rosafe.ros1.client import installed_components, whole_trees
from rosafe.ros1.client.actions import ActionClient, Goal
from rosafe.ros1.client.asyncio_tools import run_shared
from rosafe.ros1.client.description import describe_component
from rosafe.ros1.client.errors import cannot_load, middleware_error, too_many
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.ros1.client.tcpros import (
    ConnectionRejected,
    ServiceClient,
    TcprosConnection,
    TopicReader,
    component_exception,
    connect_service,
    not_running,
)
from rosafe.ros1.client.values import complete, partial
from rosafe.ros1.component import explicit_defaults
from rosafe.tree.tree_planner import ExistingProcessor

CALL_SECONDS = 60.0  # for the answer to one request
APPEAR_SECONDS = 2.0  # that `load` waits for a component that is starting
POLL_SECONDS = 0.1
REGISTER_SECONDS = 20.0  # to become a client of an action, including becoming a node the first time
RESULT_GRACE_SECONDS = 0.5  # for results that a component sent before it ended
MAX_PENDING = 1000  # unanswered requests to one component


class Value:
    """A result: members by name, with their IDL types."""

    def __init__(
        self, component: ComponentSpec, members: tuple[tuple[str, str], ...], values: Mapping[str, Any]
    ) -> None:
        self.component = component
        self.members = members
        self.values = values
        self.warning = ""
        self.data: object = self  # the owner of the memory, which several results may share

    def warn(self, warning: str) -> None:
        """Add the component's `warning` to the members, unless it is empty."""
        if warning:
            self.warning = warning
            self.members = (*self.members, ("warning", "string"))
            self.values = {**self.values, "warning": warning}

    @property
    def content(self) -> tuple[ComponentSpec, tuple[tuple[str, str], ...], Mapping[str, Any]]:
        """The arguments of an encoder: component, members with their types, and values."""
        return self.component, self.members, self.values

    @property
    def size(self) -> int:
        """The approximate size in bytes."""
        return _size(self.values)


NOTHING = Value(ROSAFE, (), {})


def _size(value: Any) -> int:
    if isinstance(value, Mapping):
        return sum(map(_size, value.values())) + 64
    if isinstance(value, list):
        return sum(map(_size, value)) + 64
    return int(getattr(value, "nbytes", 32))


@dataclass(frozen=True)
class Call:
    """A checked request of a client: a service with its values, or a port to read."""

    client: ComponentClient
    service: Service | None = None  # None: read `port`
    values: Mapping[str, Any] = field(default_factory=dict)
    port: PortSpec | None = None
    element: str = ""

    @property
    def is_activity(self) -> bool:
        """Whether the request starts an activity, which can be aborted."""
        return self.service is not None and self.service.activity

    async def run(self) -> Value:
        """Return the result: for an activity when it has started, with its outputs if it has ended by then."""
        if self.service is not None:
            return await self.client.call(self.service, self.values)
        assert self.port is not None
        return await self.client.read(self.port, self.element)

    async def start(self) -> Goal:
        """Start the activity."""
        assert self.service is not None
        return await self.client.start(self.service, self.values)

    def result(self, goal: Goal) -> Value:
        """Return the outputs of the activity."""
        assert self.service is not None
        return self.client.result(self.service, goal)


class ComponentClient:
    """A client of the node `instance`, whose interface is `component`. Several sessions may share one.

    `instance` is relative to the namespace of this process, unless it begins with a slash; `node` is the full name.
    """

    def __init__(self, graph: Graph, component: ComponentSpec, instance: str) -> None:
        self.component = component
        self.instance = instance
        self.node = graph.resolve(instance)
        self.graph = graph
        self._services: dict[str, ServiceClient] = {}
        self._actions: dict[str, asyncio.Task[ActionClient]] = {}
        self._readers: dict[str, TopicReader] = {}
        self._link: asyncio.Task[None] | None = None
        self.pending = 0  # unanswered requests
        self.used_at = self.answered_at = asyncio.get_running_loop().time()

    @classmethod
    async def load(cls, graph: Graph, instance: str) -> ComponentClient:
        """Return a client of a component that runs or is starting, or raise ComponentError."""
        package = await _package(graph, instance)
        component = await asyncio.to_thread(installed_components.known, package)
        if package not in COMPONENTS:
            topics = await graph.published_by(instance)
            component = installed_components.with_ports(component, graph.resolve(instance), topics)
        with contextlib.suppress(NotRegisteredError, ComponentError):
            await graph.node_uri(instance)  # caches the address for its ports, in case the master stops answering
        return cls(graph, component, instance)

    def prepare(self) -> None:
        """Begin to become a client of all activities, which then also work if the master stops answering."""
        for activity in self.component.activities:
            self._registering(activity.name)

    def describe(self, name: str) -> dict[str, Any]:
        """Return the description of the component for a client that has loaded it under `name`."""
        return describe_component(self.component, self.instance, self.node, name)

    async def check(self, name: str) -> None:
        """Raise ComponentError if the component no longer runs, or if `name` is neither its name nor its instance's."""
        if name not in (self.component.name, self.node.rpartition("/")[2]):
            raise cannot_load(f"{self.node}: expected the component {name}, got {self.component.name}")
        with self._count_pending():
            await self._client("connect_port").check()

    async def is_reachable(self) -> bool:
        """Return whether the component can be reached."""
        try:
            await self._client("connect_port").check()
        except ComponentError:
            return False
        return True

    async def close(self) -> None:
        """Close all connections; activities continue."""
        if self._link is not None:
            self._link.cancel()
        for service in self._services.values():
            service.close()
        for client in self._action_clients():
            await client.close()
        for task in self._actions.values():
            task.cancel()  # unfinished ones

    # --- requests ---

    def service(self, name: str) -> Service:
        """Return the service with the given name or alias, or raise ``::genom::no_such_service``."""
        for service in self.component.client_side_services:
            if service.name == name:
                return service
        try:
            return self.component.service(name)
        except KeyError:
            known = [s.name for s in (*self.component.services, *self.component.client_side_services)]
            hint = did_you_mean(name, [*known, *(port.name for port in self.component.ports)])  # a URL may name a port
            what = f"{self.component.name} has no service {name[:80]!r}; it has {', '.join(known)}"
            if self.component is ROSAFE:
                what += f"; those of plugins depend on {plugins.FOLDERS}, also of genomixd: {plugins.where()}"
            raise ComponentError("::genom::no_such_service", what=what + hint) from None

    def arguments(self, service: Service, text_args: Any) -> dict[str, Any]:
        """Return the values for `call` and `start`; ComponentError if the arguments of a client do not fit."""
        return partial(text_args) if service in WHOLE_TREES else complete(service, text_args)

    def prepare_call(self, name: str, text_args: Any, element: str) -> Call:
        """Return a request to the service `name`, or to read (an `element` of) the port `name`."""
        with contextlib.suppress(KeyError):
            return Call(self, port=self.component.port(name), element=element)
        service = self.service(name)
        return Call(self, service, self.arguments(service, text_args))

    async def call(self, service: Service, values: Mapping[str, Any]) -> Value:
        """Return the result of a service; see `Call.run`."""
        if service.activity and self.component.name not in COMPONENTS:  # those have a service for each activity
            return await self._call_action(service, values)
        with self._count_pending():
            if service in self.component.client_side_services:
                return Value(self.component, service.outputs, await whole_trees.call(self, service.name, values))
            return await self._call_node(service, values)

    async def _call_node(self, service: Service, values: Mapping[str, Any]) -> Value:
        response = await self._client(service.name).call(values, CALL_SECONDS)
        if not response.genom_success:
            raise component_exception(response.genom_exdetail)
        value = Value(self.component, service.outputs, {name: getattr(response, name) for name, _ in service.outputs})
        value.warn(explicit_defaults.warning_in(response.genom_exdetail))
        return value

    async def _call_action(self, service: Service, values: Mapping[str, Any]) -> Value:
        goal = await self.start(service, values)
        try:
            await goal.acknowledged.wait()
        finally:
            goal.forget()
        if goal.error is not None:
            raise goal.error
        return self.result(service, goal)

    def result(self, service: Service, goal: Goal) -> Value:
        """Return the outputs of an activity."""
        return Value(self.component, service.outputs, goal.outputs) if goal.outputs else NOTHING

    async def start(self, service: Service, values: Mapping[str, Any]) -> Goal:
        """Start an activity; the state of its goal reports when it runs and when it has ended."""
        with self._count_pending():
            await self.check_plugins([service.name])
            await self._watch()
            return await (await self._action(service.name)).send(values)

    async def check_plugins(self, requests: Iterable[str]) -> None:
        """Raise ComponentError if the node has not the same version of a plugin that has one of these `requests`."""
        for request in {KINDS[kind].request for kind in PLUGINS}.intersection(requests):
            await self._client(request).check()

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service and return its outputs."""
        return (await self.call(self.service(service), values)).values

    async def node_outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service in its form as a ROS service, and return its outputs."""
        return (await self._call_node(self.component.service(service), values)).values

    async def processors(self) -> list[ExistingProcessor]:
        """Return all processors of a rosAFE whose kind is known here."""
        found = []
        for processor in (await self.outputs("getProcessors", {}))["processors"]:
            kind = KINDS.get(processor["kind"])
            if kind is not None:
                texts = {entry["name"]: entry["value"] for entry in processor["parameters"]}
                declared = kind.parameters if kind.parent else (*kind.parameters, *BLOCK_AND_BUFFERS)
                values = {p.name: p.parse(texts[p.name]) for p in declared if p.name in texts}
                parent, rate = processor["upperDepName"], float(processor["rate"])
                found.append(ExistingProcessor(processor["name"], kind.kind, parent, values, rate))
        return found

    async def port_connected(self, port: str) -> str:
        """Return the topic that an input port is connected to; empty if it is not connected.

        It is the topic of the port's type that the component subscribes to, according to the master.
        """
        kind = ros_type(self.component.port(port).idl)
        _, subscribed, _ = await self.graph.master("getSystemState")
        types = dict(await self.graph.master("getTopicTypes"))
        topics = [topic for topic, nodes in subscribed if self.node in nodes]
        return next((topic for topic in topics if types.get(topic, "").split("/")[-1] == kind), "")

    async def published(self, topic: str) -> bool:
        """Return whether `topic` is published."""
        return topic in await self.graph.topics()

    @contextlib.asynccontextmanager
    async def other(self, node: str) -> AsyncIterator[ComponentClient]:
        """Yield a client of another component by its full name; ComponentError if there is none."""
        client = await ComponentClient.load(self.graph, self.graph.shorten(node))
        try:
            yield client
        finally:
            await client.close()

    @contextlib.contextmanager
    def _count_pending(self) -> Iterator[None]:
        if self.pending >= MAX_PENDING:
            raise too_many(f"{self.instance}: {MAX_PENDING} requests are waiting")
        self.pending += 1
        try:
            yield
        finally:
            self.pending -= 1

    def _client(self, service: str) -> ServiceClient:
        if service not in self._services:
            self._services[service] = ServiceClient(self.graph, self.component.name, self.instance, service)
        return self._services[service]

    def _registering(self, action: str) -> asyncio.Task[ActionClient]:
        task = self._actions.get(action)
        if task is None or (task.done() and (task.cancelled() or task.exception() is not None)):
            client = ActionClient.create(self.graph, self.component.name, self.instance, action)
            task = self._actions[action] = run_shared(client)
        return task

    async def _action(self, action: str) -> ActionClient:
        try:
            return await asyncio.wait_for(asyncio.shield(self._registering(action)), REGISTER_SECONDS)
        except TimeoutError:  # rospy retries until the master answers, and a later request uses the result
            raise middleware_error(f"the ROS master at {self.graph.uri} does not answer") from None

    async def _watch(self) -> None:
        """Keep a connection to the component open; when it closes, the component has ended."""
        if self._link is None or self._link.done():
            connection = await self._client("connect_port").connect()
            self._link = asyncio.create_task(self._wait_for_end(connection))

    async def _wait_for_end(self, connection: TcprosConnection) -> None:
        try:
            await connection.closed()
        finally:
            connection.close()
        goals = [goal for client in self._action_clients() for goal in client.goals.values() if goal.seen.is_set()]
        await asyncio.sleep(RESULT_GRACE_SECONDS)
        for goal in goals:
            goal.end(middleware_error(f"{self.instance} ended before its activity did"))

    def _action_clients(self) -> list[ActionClient]:
        tasks = self._actions.values()
        return [task.result() for task in tasks if task.done() and not task.cancelled() and task.exception() is None]

    # --- ports ---

    async def read(self, port: PortSpec, element: str) -> Value:
        """Return the latest message of a port, by the port's name; zeros if it has none yet.

        Raises ComponentError ``::genom::no_such_outport`` if there is no such output port or element.
        """
        with self._count_pending():
            if not port.output:
                raise _no_port(f"{port.name} is an input port; connect_port connects it")
            message = await self._read(port, element)
        value = _zero(self.component, port.idl)
        if message is not None:
            value = {name: getattr(message, name) for name, _ in self.component.members(port.idl)}
        sample = Value(self.component, ((port.name, port.idl),), {port.name: value})
        sample.data = message
        return sample

    async def _other_element(self, topic: str, port: PortSpec, element: str) -> str:
        """Return the topic of an element whose name differs only in case: the user's guide has 'crossCorrelation'."""
        missing = f"{port.name} has no element {element[:80]!r}"
        try:
            topics = [t for t in await self.graph.topics() if t.startswith(f"{topic}/")]
        except ComponentError:
            raise _no_port(missing) from None
        candidates = [t for t in topics if t.lower() == f"{topic}/{element}".lower()]
        if len(candidates) == 1:
            return candidates[0]
        elements = ", ".join(t.removeprefix(f"{topic}/") for t in topics) or "none"
        raise _no_port(f"{missing}; there are: {elements}")

    async def _read(self, port: PortSpec, element: str) -> Any:
        topic = f"{self.node}/{port.name}"
        if port.idl not in self._readers:
            kind = installed_components.message_class(self.component.name, port.idl)
            self._readers[port.idl] = TopicReader(self.graph, self.instance, kind)
        reader = self._readers[port.idl]
        try:
            if not port.multiple:
                return await reader.read(topic)  # scripts may pass an element, which is ignored
            if rosgraph.names.is_legal_name(f"{topic}/{element}"):
                with contextlib.suppress(NotRegisteredError):
                    return await reader.read(f"{topic}/{element}")
            return await reader.read(await self._other_element(topic, port, element))
        except NotRegisteredError as problem:
            raise _no_port(f"{self.instance} does not publish {topic}: {problem}") from None


async def names(graph: Graph, component: str, instance: str) -> tuple[str, str]:
    """Return the names of a component and its instance from the arguments of `load`.

    Parameters
    ----------
    graph : Graph
        Relative names are in its namespace.
    component : str
        Name of the component or instance, or the path of a GenoM plugin (``/opt/lib/rosAFE.so``, also without the
        suffix), whose file name counts.
    instance : str
        Name of the node, such as ``robot1/rosAFE``; empty: that of the component.

    Raises
    ------
    ComponentError
        ``::genomix::e_load`` if one of them is not a valid name.
    """
    name = component.rstrip("/").rsplit("/", 1)[-1].removesuffix(".so")
    instance = instance.rstrip("/")
    if not instance and _is_node_name(component):  # otherwise a relative path, or an absolute one as scripts have it
        is_node = not component.startswith("/") or await graph.is_service(f"{component.rstrip('/')}/connect_port")
        instance = component.rstrip("/") if is_node else ""
    instance = instance or name
    if not (rosgraph.names.is_legal_base_name(name) and _is_node_name(instance)):
        wrong = name if _is_node_name(instance) else instance
        raise cannot_load(f"expected the name of a component or instance, such as robot1/rosAFE, got {wrong[:80]!r}")
    return name, graph.shorten(instance)


def _is_node_name(name: str) -> bool:
    return bool(name) and name.isascii() and not name.startswith("~") and rosgraph.names.is_legal_name(name)


async def _package(graph: Graph, instance: str) -> str:
    """Return the ROS package of the component that runs as `instance`, as the component reports it."""
    name = f"{graph.resolve(instance)}/connect_port"
    probe = {"service": name, "md5sum": "*", "probe": "1", "callerid": graph.name}
    deadline = asyncio.get_running_loop().time() + APPEAR_SECONDS
    pause = POLL_SECONDS
    while True:
        try:
            if graph.known_address(instance) is None and not await graph.is_service(name):
                raise NotRegisteredError(name)
            connection = await connect_service(graph, instance, probe)
            connection.close()
            return connection.header.get("type", "").split("/")[0]
        except NotRegisteredError:
            problem = not_running(instance, name)
        except ComponentError as no_master:
            problem = no_master
        except (ConnectionRejected, OSError) as failure:
            why = str(failure) or "no answer"
            problem = middleware_error(f"{instance} is not running, though it is registered at the master ({why})")
            pause *= 2  # all callers share a poll of the master, but not a connection
        if asyncio.get_running_loop().time() > deadline:
            raise problem
        await asyncio.sleep(pause)


def _no_port(what: str) -> ComponentError:
    return ComponentError("::genom::no_such_outport", what=what)


def _zero(component: ComponentSpec, idl: str) -> Any:
    if idl.startswith("sequence<"):
        return []
    if idl.startswith("::"):
        if idl in LEVELS:
            return []
        return {name: _zero(component, kind) for name, kind in component.members(idl)}
    return "" if idl == "string" else 0
