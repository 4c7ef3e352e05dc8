"""The classes that describe the interface of a component: requests, ports, exceptions, structs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from rosafe.declarations.errors import ComponentError
from rosafe.declarations.idl import TIME, TIME_MEMBERS
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.signals import Struct

_N = TypeVar("_N", Parameter, "PortSpec", "Service")

_DECLARATION = re.compile(r"^(struct|exception|message) (\S+) \{(.*?)\};$", re.MULTILINE | re.DOTALL)
_FIELD = re.compile(r"\s*([^;]+) (\w+);")


def read_idl(module: str) -> dict[str, dict[str, Struct]]:
    """Return the contents of the IDL file beside a module: structs, exceptions and messages, each by name."""
    found: dict[str, dict[str, Struct]] = {"struct": {}, "exception": {}, "message": {}}
    for kind, name, body in _DECLARATION.findall(Path(module).with_suffix(".idl").read_text("utf-8")):
        found[kind][name] = tuple((field, idl) for idl, field in _FIELD.findall(body))
    return found


def _find(items: Iterable[_N], name: str) -> _N:
    """Return the item with the given name or alias, or raise KeyError."""
    for item in items:
        if name == item.name or name in item.aliases:
            return item
    raise KeyError(name)


def _is_unset(parameter: Parameter, value: Any) -> bool:
    """Return whether `value` stands for the default in a ROS request, which has no defaults of its own."""
    if isinstance(value, bool) or not parameter.zero_is_default or parameter.default is REQUIRED:
        return False
    return bool(len(value) == 0 if hasattr(value, "__len__") else value == 0)  # "" and [] have a length


@dataclass(frozen=True)
class Service:
    """One request of a component.

    An `activity` request lives until it ends or is stopped, and has an action in addition to the service; the others
    are functions that return immediately. `interrupts` names activities: when this request begins, their running
    instances end.
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
        """Return the parameter with the given name or alias, or raise KeyError."""
        return _find(self.parameters, name)

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return `values` with the defaults of the other parameters, in the order of declaration.

        Parameters that depend on the sample rate have no default here, and are left out.
        """
        known = (p for p in self.parameters if p.name in values or not p.follows_rate)
        return {p.name: values.get(p.name, p.default) for p in known}

    def from_ros(self, request: Any, literal: bool = False) -> dict[str, Any]:
        """Return the unchecked values of a ROS request or goal, in which 0, "" and [] stand for the default.

        The values of a client that fills in the defaults itself are `literal`. Such a client marks parameters that
        depend on the sample rate, and that it leaves unset, by NaN.
        """
        values = {p.name: getattr(request, p.name) for p in self.parameters}
        if literal:
            unset = {p.name for p in self.parameters if p.follows_rate and math.isnan(values[p.name])}
            return {name: value for name, value in values.items() if name not in unset}
        return self.completed({p.name: values[p.name] for p in self.parameters if not _is_unset(p, values[p.name])})

    def check(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return all values as the Python types of their parameters; ValueError names the first that is rejected."""
        return {p.name: p.check(p.resolve_choice(values[p.name])) for p in self.parameters if p.name in values}


@dataclass(frozen=True)
class PortSpec:
    """A data port: one topic, or one topic per element if `multiple`."""

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
    # Messages of topics that are not ports, by their ROS names.
    messages: Mapping[str, Struct] = field(default_factory=dict)
    # Requests for whole trees in the form that clients such as genomixd offer.
    client_side_services: tuple[Service, ...] = ()
    # The ROS services that carry them out. ROS tools fill in every field of a request, hence one string holds all
    # parameters. Clients of genomixd do not see these.
    ros_services: tuple[Service, ...] = ()

    @property
    def on_graph(self) -> tuple[Service, ...]:
        """All requests that are ROS services."""
        return (*self.services, *self.ros_services)

    @property
    def activities(self) -> tuple[Service, ...]:
        """The requests that live until they end or are stopped."""
        return tuple(s for s in self.services if s.activity)

    def members(self, idl: str) -> Struct:
        """Return the members of a struct, or of the ROS type time, for which no file is written."""
        return TIME_MEMBERS if idl == TIME else self.structs[idl]

    def service(self, name: str) -> Service:
        """Return the service with the given name or alias, or raise KeyError."""
        return _find(self.on_graph, name)

    def port(self, name: str) -> PortSpec:
        """Return the port with the given name or alias, or raise KeyError."""
        return _find(self.ports, name)

    def error(self, short: str, why: str = "", **detail: Any) -> ComponentError:
        """Return the component's exception `short`, such as ``e_noData``; KeyError if it is not declared."""
        if short not in self.exceptions:
            raise KeyError(short)
        return ComponentError(f"::{self.name}::{short}", why, **detail)
