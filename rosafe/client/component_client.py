"""One component instance on the graph, as genomixd's clients use it: its functions, activities and ports."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Mapping
from typing import Any

import rosgraph.names

from rosafe.client import installed_components, setup_transaction
from rosafe.client.actions import ActionClient, Goal
from rosafe.client.asyncio_tools import run_shared
from rosafe.client.graph import Graph, NotRegisteredError, middleware_error
from rosafe.client.installed_components import cannot_load
from rosafe.client.tcpros import (
    ConnectionRejected,
    ServiceClient,
    TcprosConnection,
    TopicReader,
    component_exception,
    connect_service,
)
from rosafe.client.values import complete, partial
from rosafe.component import explicit_defaults
from rosafe.declarations import plugins
from rosafe.declarations.signals import LEVELS
from rosafe.declarations.text import did_you_mean
from rosafe.interface import (
    COMPONENTS,
    FIND,
    KINDS,
    LOAD_SETUP,
    PLUGINS,
    REQUEST,
    REQUIRED,
    ROSAFE,
    SAVE_SETUP,
    ComponentError,
    ComponentSpec,
    Parameter,
    PortSpec,
    Representation,
    Service,
    ros_type,
)
from rosafe.tree import tree_builder

CALL_SECONDS = 60.0  # for the answer to one request
APPEAR_SECONDS = 2.0  # that `load` waits for a component that is just starting
POLL_SECONDS = 0.1
REGISTER_SECONDS = 20.0  # for becoming a client of an action, the first time for becoming a node too
RESULT_GRACE_SECONDS = 0.5  # results that a component sent before it ended arrive within
MAX_PENDING = 1000  # requests to one component that are not answered yet
WHOLE_TREES = (REQUEST, FIND)  # which take parameters of any kind, and only those that are given
_COMPOSITES = {
    REQUEST.name: tree_builder.build,
    FIND.name: tree_builder.find,
    SAVE_SETUP.name: setup_transaction.save,
    LOAD_SETUP.name: setup_transaction.load,
}


class Value:
    """A result: members by name, with their IDL types."""

    def __init__(
        self, component: ComponentSpec, members: tuple[tuple[str, str], ...], values: Mapping[str, Any]
    ) -> None:
        self.component = component
        self.members = members
        self.values = values
        self.warning = ""
        self.data: object = self  # what the values belong to, and perhaps those of others

    def warn(self, warning: str) -> None:
        """Have the component's `warning`, where there is one, among the members."""
        if warning:
            self.warning = warning
            self.members = (*self.members, ("warning", "string"))
            self.values = {**self.values, "warning": warning}

    @property
    def content(self) -> tuple[ComponentSpec, tuple[tuple[str, str], ...], Mapping[str, Any]]:
        """The component, the members with their types, and the values, as encoders take them."""
        return self.component, self.members, self.values

    @property
    def size(self) -> int:
        """About how many bytes the value occupies."""
        return _size(self.values)


NOTHING = Value(COMPONENTS["rosAFE"], (), {})


def _size(value: Any) -> int:
    if isinstance(value, Mapping):
        return sum(map(_size, value.values())) + 64
    if isinstance(value, list):
        return sum(map(_size, value)) + 64
    return int(getattr(value, "nbytes", 32))


class ComponentClient:
    """The component `instance` of the interface `component`. Several sessions may share one."""

    def __init__(self, graph: Graph, component: ComponentSpec, instance: str) -> None:
        self.component = component
        self.instance = instance
        self._graph = graph
        self._services: dict[str, ServiceClient] = {}
        self._actions: dict[str, asyncio.Task[ActionClient]] = {}
        self._readers: dict[str, TopicReader] = {}
        self._link: asyncio.Task[None] | None = None
        self.turns = tree_builder.Turns()
        self.pending = 0  # requests that are not answered yet
        self.used_at = self.answered_at = asyncio.get_running_loop().time()

    @classmethod
    async def load(cls, graph: Graph, instance: str) -> ComponentClient:
        """The proxy of a component that runs, or that appears within a moment, or ComponentError."""
        package = await _package(graph, instance)
        component = await asyncio.to_thread(installed_components.known, package)
        if package not in COMPONENTS:
            component = installed_components.with_ports(component, instance, await graph.published_by(instance))
        with contextlib.suppress(NotRegisteredError, ComponentError):  # later, perhaps
            await graph.node_uri(instance)  # for its ports, should the master be away then
        return cls(graph, component, instance)

    def prepare(self) -> None:
        """Begin to become a client of all activities: then they can be had while the master is away, too."""
        for activity in self.component.activities:
            self._registering(activity.name)

    async def check(self, name: str) -> None:
        """Return if the component runs still and may be called `name`, else raise ComponentError."""
        if name not in (self.component.name, self.instance):
            raise cannot_load(f"/{self.instance} is a {self.component.name}, and no {name}")
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
        """Let go of all connections; activities go on."""
        if self._link is not None:
            self._link.cancel()
        for service in self._services.values():
            service.close()
        for client in self._action_clients():
            await client.close()
        for task in self._actions.values():
            task.cancel()  # those that are still being made

    # --- requests ---

    def service(self, name: str) -> Service:
        """The service or composite called `name` (aliases count), or ``::genom::no_such_service``."""
        for composite in self.component.client_side_services:
            if composite.name == name:
                return composite
        try:
            return self.component.service(name)
        except KeyError:
            known = [s.name for s in (*self.component.services, *self.component.client_side_services)]
            hint = did_you_mean(name, [*known, *(port.name for port in self.component.ports)])  # a URL may mean either
            what = f"{self.component.name} has no service {name[:80]!r}; it has {', '.join(known)}"
            if self.component is ROSAFE:
                what += f"; those of plugins depend on {plugins.FOLDERS}, also of genomixd: {plugins.where()}"
            what += hint
            raise ComponentError("::genom::no_such_service", what=what) from None

    def arguments(self, service: Service, given: Any) -> dict[str, Any]:
        """What `call` and `start` take, of what a client has `given`; ComponentError where that does not fit."""
        return partial(given) if service in WHOLE_TREES else complete(service, given)

    async def call(self, service: Service, values: Mapping[str, Any]) -> Value:
        """What a function returns; an activity returns as soon as it runs, with its outputs if it has ended by then."""
        if service.activity and self.component.name not in COMPONENTS:  # ours have a plain service for each activity
            return await self._call_action(service, values)
        with self._count_pending():
            if service in self.component.client_side_services:
                own = service == LOAD_SETUP  # which gives way
                async with contextlib.nullcontext() if own else self.turns.turn():
                    answer = await _COMPOSITES[service.name](self, values)
                return Value(self.component, service.outputs, answer)
            client = self._client(service.name)
            response = await client.call(values, CALL_SECONDS)
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
        """The outputs of an activity."""
        return Value(self.component, service.outputs, goal.outputs) if goal.outputs else NOTHING

    async def start(self, service: Service, values: Mapping[str, Any]) -> Goal:
        """Send an activity; its goal tells when it runs and when it has ended."""
        with self._count_pending():
            if service.name in {KINDS[kind].request for kind in PLUGINS}:
                await self._client(service.name).check()  # the node may be without the plugin, or have another version
            await self._watch()
            client = await self._action(service.name)
            return await client.send(values)

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """The values that a service returns."""
        return (await self.call(self.service(service), values)).values

    async def port_connected(self, port: str) -> str:
        """The topic that an input port is connected to, as the master knows: it subscribes to something of that type.

        Empty where it is not connected.
        """
        kind = ros_type(self.component.port(port).idl)
        _, subscribed, _ = await self._graph.master("getSystemState")
        types = dict(await self._graph.master("getTopicTypes"))
        topics = [topic for topic, nodes in subscribed if f"/{self.instance}" in nodes]
        return next((topic for topic in topics if types.get(topic, "").split("/")[-1] == kind), "")

    async def published(self, topic: str) -> bool:
        """Whether somebody publishes `topic`."""
        return topic in await self._graph.topics()

    @contextlib.asynccontextmanager
    async def other(self, instance: str) -> AsyncIterator[ComponentClient]:
        """Another component of the graph, for a moment; ComponentError where there is none of that name."""
        proxy = await ComponentClient.load(self._graph, instance)
        try:
            yield proxy
        finally:
            await proxy.close()

    @contextlib.contextmanager
    def _count_pending(self) -> Iterator[None]:
        if self.pending >= MAX_PENDING:
            raise ComponentError("::genomix::e_tooMany", what=f"{self.instance}: {MAX_PENDING} requests are waiting")
        self.pending += 1
        try:
            yield
        finally:
            self.pending -= 1

    def _client(self, service: str) -> ServiceClient:
        if service not in self._services:
            self._services[service] = ServiceClient(self._graph, self.component.name, self.instance, service)
        return self._services[service]

    def _registering(self, action: str) -> asyncio.Task[ActionClient]:
        task = self._actions.get(action)
        if task is None or (task.done() and (task.cancelled() or task.exception() is not None)):
            made = ActionClient.create(self._graph, self.component.name, self.instance, action)
            task = self._actions[action] = run_shared(made)
        return task

    async def _action(self, action: str) -> ActionClient:
        try:
            return await asyncio.wait_for(asyncio.shield(self._registering(action)), REGISTER_SECONDS)
        except TimeoutError:  # rospy tries on until the master answers, and a later request finds it done
            raise middleware_error(f"the ROS master at {self._graph.uri} does not answer") from None

    async def _watch(self) -> None:
        """Have a connection to the component whose end tells that the component has ended."""
        if self._link is None or self._link.done():
            connection = await self._client("connect_port").connect()
            self._link = asyncio.create_task(self._wait_for_end(connection))

    async def _wait_for_end(self, connection: TcprosConnection) -> None:
        try:
            await connection.closed()
        finally:
            connection.close()
        concerned = [goal for client in self._action_clients() for goal in client.goals() if goal.seen.is_set()]
        await asyncio.sleep(RESULT_GRACE_SECONDS)
        for goal in concerned:
            goal.end(middleware_error(f"{self.instance} ended before its activity did"))

    def _action_clients(self) -> list[ActionClient]:
        tasks = self._actions.values()
        return [task.result() for task in tasks if task.done() and not task.cancelled() and task.exception() is None]

    # --- ports ---

    def port(self, name: str) -> PortSpec | None:
        """The port called `name` (aliases count), if there is one."""
        try:
            return self.component.port(name)
        except KeyError:
            return None

    async def read(self, port: PortSpec, element: str) -> Value:
        """The newest sample of a port, keyed by the port's name; zeros where it has none yet.

        Raises ComponentError: ``::genom::no_such_outport`` where there is no such port or element.
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
        """An element that differs in the case of letters only: the user's guide reads 'crossCorrelation'."""
        missing = f"{port.name} has no element {element[:80]!r}"
        try:
            topics = [t for t in await self._graph.topics() if t.startswith(f"{topic}/")]
        except ComponentError:
            raise _no_port(missing) from None
        alike = [t for t in topics if t.lower() == f"{topic}/{element}".lower()]
        if len(alike) == 1:
            return alike[0]
        names = ", ".join(t.removeprefix(f"{topic}/") for t in topics) or "none"
        raise _no_port(f"{missing}; there are: {names}")

    def _reader(self, port: PortSpec) -> TopicReader:
        if port.idl not in self._readers:
            kind = installed_components.message_class(self.component.name, port.idl)
            self._readers[port.idl] = TopicReader(self._graph, self.instance, kind)
        return self._readers[port.idl]

    async def _read(self, port: PortSpec, element: str) -> Any:
        topic, reader = f"/{self.instance}/{port.name}", self._reader(port)
        try:
            if not port.multiple:
                return await reader.read(topic)  # an element is of no use, and scripts give one
            if rosgraph.names.is_legal_name(f"{topic}/{element}"):
                with contextlib.suppress(NotRegisteredError):
                    return await reader.read(f"{topic}/{element}")
            return await reader.read(await self._other_element(topic, port, element))
        except NotRegisteredError as problem:
            raise _no_port(f"{self.instance} does not give out {topic}: {problem}") from None

    # --- description ---

    def describe(self, name: str) -> dict[str, Any]:
        """What a client needs to offer the component under `name`: services and ports with all that the table says."""
        component = self.component
        return {
            "name": name,
            "component": component.name,
            "instance": self.instance,
            "doc": component.doc,
            "services": {
                **{s.name: _describe_service(s, composite=False) for s in component.services},
                **{s.name: _describe_service(s, composite=s in WHOLE_TREES) for s in component.client_side_services},
            },
            "ports": {
                p.name: {
                    "doc": p.doc,
                    "type": p.idl,
                    "multiple": p.multiple,
                    "output": p.output,
                    "aliases": list(p.aliases),
                }
                for p in component.ports
            },
            "exceptions": {f"::{component.name}::{short}": doc for short, doc in component.exceptions.items()},
            "representations": {kind: _describe_representation(r) for kind, r in KINDS.items() if component is ROSAFE},
        }


def names(component: str, instance: str) -> tuple[str, str]:
    """Name and instance that `load` means.

    Parameters
    ----------
    component : str
        The name of the component, or of an instance; a path to a plugin (``/opt/lib/rosAFE.so``) counts by its last
        part.
    instance : str
        Name of the node; empty: as the component.

    Raises
    ------
    ComponentError
        ``::genomix::e_load`` where one of them is no name.
    """
    name = component.rstrip("/").rsplit("/", 1)[-1].removesuffix(".so")
    instance = instance.strip("/") or name
    for word in (name, instance):
        if not rosgraph.names.is_legal_base_name(word):
            raise cannot_load(f"{word[:80]!r} is no name of a component or instance")
    return name, instance


async def _package(graph: Graph, instance: str) -> str:
    """The ROS package of the component that runs as `instance`, asked of the component itself."""
    name = f"/{instance}/connect_port"
    probe = {"service": name, "md5sum": "*", "probe": "1", "callerid": graph.name}
    deadline = asyncio.get_running_loop().time() + APPEAR_SECONDS
    pause = POLL_SECONDS
    while True:
        try:
            # Where it was the last time, or where somebody says that it is.
            if graph.known_address(instance) is not None or await graph.serves(name):
                connection = await connect_service(graph, instance, probe)
                connection.close()
                return connection.header.get("type", "").split("/")[0]
            problem = _not_running(instance, name)
        except NotRegisteredError:
            problem = _not_running(instance, name)
        except ComponentError as no_master:
            problem = no_master
        except (ConnectionRejected, OSError) as failure:
            why = str(failure) or "no answer"
            problem = middleware_error(f"{instance} is not running, though the master lists it ({why})")
            pause *= 2  # a look is for all, a connection for one only
        if asyncio.get_running_loop().time() > deadline:
            raise problem
        await asyncio.sleep(pause)


def _not_running(instance: str, name: str) -> ComponentError:
    return middleware_error(f"{instance} is not running: nobody serves {name}")


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


def _describe_service(service: Service, composite: bool) -> dict[str, Any]:
    return {
        "doc": service.doc,
        "activity": service.activity,
        "composite": composite,
        "aliases": list(service.aliases),
        "parameters": {p.name: describe_parameter(p) for p in service.parameters},
        "outputs": dict(service.outputs),
        "throws": list(service.throws),
    }


def _describe_representation(representation: Representation) -> dict[str, Any]:
    return {
        "word": representation.word,
        "aliases": list(representation.word_aliases),
        "request": representation.request,
        "port": representation.port,
        "parent": representation.parent,
        "name": representation.name,
        "binaural": representation.binaural,
        "parts": {part.name: {"axes": list(part.axes), "unit": part.unit} for part in representation.parts},
        "parameters": [p.name for p in representation.parameters],
        "derived": [d.name for d in representation.derived],
        "coordinates": list(representation.coordinates),
        "features": list(representation.features),
    }


def describe_parameter(parameter: Parameter) -> dict[str, Any]:
    """All that the table says of a parameter."""
    required = parameter.default is REQUIRED
    return {
        "type": parameter.idl,
        "doc": parameter.doc,
        "required": required,
        "default": "" if required else parameter.default,
        "range": parameter.range_text,
        "choices": list(parameter.choices),
        "unit": parameter.unit,
        "aliases": list(parameter.aliases),
    }
