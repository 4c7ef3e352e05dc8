"""What a component's interface is made of: requests, ports, exceptions, structs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rosafe.declarations.errors import ComponentError
from rosafe.declarations.idl import TIME, TIME_MEMBERS
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.signals import Struct


def _unset(parameter: Parameter, value: Any) -> bool:
    """Whether `value` means the default in a ROS request, which carries none."""
    if isinstance(value, bool) or not parameter.zero_is_default or parameter.default is REQUIRED:
        return False
    return bool(len(value) == 0 if hasattr(value, "__len__") else value == 0)  # "" and [] have a length


@dataclass(frozen=True)
class Service:
    """One request of a component.

    `activity` requests live until they end or are stopped and have an action beside the service; the others are
    functions that answer at once. `interrupts` names the activity of which running instances end when this begins.
    """

    name: str
    doc: str
    parameters: tuple[Parameter, ...] = ()
    outputs: Struct = ()
    throws: tuple[str, ...] = ()
    activity: bool = False
    task: str = ""
    interrupts: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()

    def parameter(self, name: str) -> Parameter:
        """The parameter called `name` (aliases count), or KeyError."""
        for parameter in self.parameters:
            if name == parameter.name or name in parameter.aliases:
                return parameter
        raise KeyError(name)

    def completed(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """All values, in the order of declaration: those `given`, and the defaults of the others.

        Without those that follow the sample rate and are not given.
        """
        known = (p for p in self.parameters if p.name in given or not p.follows_rate)
        return {p.name: given.get(p.name, p.default) for p in known}

    def from_ros(self, request: Any, literal: bool = False) -> dict[str, Any]:
        """The values of a ROS request or goal, not yet checked; 0, "" and [] there stand for the default.

        A client that knows the defaults, and has filled them in, means all `literal`; for what follows the sample rate
        it has none, and says so with NaN.
        """
        values = {p.name: getattr(request, p.name) for p in self.parameters}
        if literal:
            unknown = [p.name for p in self.parameters if p.follows_rate and math.isnan(values[p.name])]
            return {name: value for name, value in values.items() if name not in unknown}
        return self.completed({p.name: values[p.name] for p in self.parameters if not _unset(p, values[p.name])})

    def check(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """All values as their parameters' Python types, or ValueError naming the first that is refused."""
        return {p.name: p.check(p.resolve_choice(values[p.name])) for p in self.parameters if p.name in values}


@dataclass(frozen=True)
class PortSpec:
    """A data port: one topic, or one topic per element where `multiple`."""

    name: str
    idl: str
    doc: str
    output: bool = True
    multiple: bool = False
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class ComponentSpec:
    """The interface of one component (ROS package)."""

    name: str
    doc: str
    services: tuple[Service, ...]
    ports: tuple[PortSpec, ...]
    tasks: tuple[str, ...]
    exceptions: Mapping[str, str]  # short name -> meaning
    structs: Mapping[str, Struct]  # by IDL name
    # What genomixd makes of several services, for its clients to call like one.
    client_side_services: tuple[Service, ...] = ()
    # Composites that the component carries out itself, under the same names, for ROS' own tools: these fill in every
    # field of a request, hence one text stands for all parameters. genomixd's clients do not see these.
    ros_services: tuple[Service, ...] = ()

    @property
    def on_graph(self) -> tuple[Service, ...]:
        """All that are services of ROS."""
        return (*self.services, *self.ros_services)

    def members(self, idl: str) -> Struct:
        """The members of a struct, or of ROS' own time, of which no file is made."""
        return TIME_MEMBERS if idl == TIME else self.structs[idl]

    def service(self, name: str) -> Service:
        """The service called `name` (aliases count), or KeyError."""
        for service in self.on_graph:
            if name == service.name or name in service.aliases:
                return service
        raise KeyError(name)

    def port(self, name: str) -> PortSpec:
        """The port called `name` (aliases count), or KeyError."""
        for port in self.ports:
            if name == port.name or name in port.aliases:
                return port
        raise KeyError(name)

    @property
    def activities(self) -> tuple[Service, ...]:
        """The requests that live until they end or are stopped."""
        return tuple(s for s in self.services if s.activity)

    @property
    def functions(self) -> tuple[Service, ...]:
        """The requests that answer at once."""
        return tuple(s for s in self.services if not s.activity)

    def error(self, short: str, why: str = "", **detail: Any) -> ComponentError:
        """The component's exception `short`, such as ``e_noData``."""
        if short not in self.exceptions:
            raise KeyError(short)
        return ComponentError(f"::{self.name}::{short}", why, **detail)
