"""Checks of plugins against the tree and the other representations. Their fields have been checked already."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from rosafe.declarations.checks import bad_name
from rosafe.declarations.representation import Representation
from rosafe.declarations.signals import layout
from rosafe.declarations.text import short_repr
from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import Stage

# Names of the component's own requests and topics, and of the structures of its messages; see rosafe/interface
REQUESTS = [
    "Stop",
    "abort_activity",
    "connect_port",
    "connect_service",
    "find",
    "getDependencies",
    "getParameters",
    "getProcessors",
    "getRepresentation",
    "getSignal",
    "getSignals",
    "kill",
    "loadSetup",
    "modifyParameter",
    "removeProcessor",
    "removeUnused",
    "request",
    "saveSetup",
]
PORTS = ["Audio", "dataObj", "frameTime", "genom_state", "trace"]
STRUCTS = ["TimeDomain", "TimeFrequency", "AutoCorrelation", "CrossCorrelation", "Modulation"]

# Types that every client can send: Python, ROS, HTTP, Tcl, MATLAB and the live page
TYPES = (
    "boolean",
    "unsigned long",
    "unsigned long long",
    "long",
    "double",
    "string",
    "sequence<double>",
    "sequence<string>",
)
# Methods that the tree calls, with their arguments
METHODS: dict[str, tuple[Any, ...]] = {
    "process": ("block",),
    "reset": (),
    "build": ("values", "changed"),
    "input_format_changed": ("before",),
    "output_rows": ("rows",),
    "part_rows": ("rows",),
    "output_count": ("count",),
    "state_size": ("rows",),
}


def problem_of(stage: Any, others: Mapping[str, type[Stage]]) -> str:
    """Return the reason why `stage` cannot be used together with `others`; empty if it can."""
    try:
        return next(_problems(stage, others), "")
    except Exception as problem:  # raised by the plugin's class, for example by one of its properties
        return f"{type(problem).__name__}: {' '.join(str(problem).split())}"


def _problems(stage: Any, others: Mapping[str, type[Stage]]) -> Iterator[str]:
    declared = stage.REPRESENTATION
    try:
        layout(declared)
    except ValueError as problem:
        yield str(problem)
    yield from _class_problems(stage)
    if not declared.parent:
        yield "parent: expected a kind of processor, got none"
    if declared.parent not in others:
        yield f"parent: expected one of {', '.join(others)}, got {declared.parent!r}"
    drawn = others[declared.background].REPRESENTATION.parts if declared.background in others else ()
    if declared.background and [part.axes for part in drawn] != [("ear", "channel", "time")]:
        yield f"background: expected a kind with the axes ear, channel, time, got {declared.background!r}"
    for parameter in declared.parameters:
        if parameter.idl not in TYPES:
            yield f"parameters: {parameter.name} is of type {parameter.idl}; expected one of {', '.join(TYPES)}"
    yield from _reserved_names(declared)
    for other in others.values():
        yield from _conflicts(declared, other.REPRESENTATION)
    yield from _extra_problems(stage, others[declared.parent])


def _class_problems(stage: Any) -> Iterator[str]:
    """Yield the defects of the class itself."""
    declared = stage.REPRESENTATION
    if not (isinstance(stage, type) and issubclass(stage, Stage)):
        yield f"{stage.__name__}: expected a subclass of Stage or FramedStage"
    yield from _method_problems(stage)
    if issubclass(stage, FramedStage):
        yield from _prefix_problems(stage)
    if declared.derived and stage.derived is Stage.derived:
        yield f"derived: {declared.derived[0].name} is declared, but the property derived is missing"
    if not isinstance(stage.EXTRAS, (tuple, list)) or any(bad_name(name) for name in stage.EXTRAS):
        yield f"EXTRAS: expected a tuple of names, got {short_repr(stage.EXTRAS)}"
    for name, kind in (("look_ahead", int), ("required_extra", str)):
        value = getattr(stage, name)
        if not (hasattr(value, "__get__") and not inspect.isfunction(value)) and not isinstance(value, kind):
            yield f"{name}: expected a property, got {short_repr(value)}"


def _method_problems(stage: Any) -> Iterator[str]:
    framed = issubclass(stage, FramedStage)
    for name, arguments in {**METHODS, **({"frame": ("frames",)} if hasattr(stage, "frame") else {})}.items():
        try:
            inspect.signature(getattr(stage, name)).bind(None, *arguments)
        except (AttributeError, TypeError, ValueError):
            method = short_repr(getattr(stage, name, None))
            yield f"{name}: expected a method {name}({', '.join(('self', *arguments))}), got {method}"
    if stage.process is Stage.process or (
        framed and stage.process is FramedStage.process and stage.frame is FramedStage.frame
    ):
        yield "expected a method process, or frame in a FramedStage; there is none"
    if len(parts := stage.REPRESENTATION.parts) > 1 and stage.part_rows is Stage.part_rows:
        yield f"parts: {len(parts)} are declared, but the method part_rows is missing"


def _prefix_problems(stage: type[FramedStage]) -> Iterator[str]:
    prefix = getattr(stage, "prefix", None)
    if problem := bad_name(prefix):
        yield f"prefix: {problem}"
    names = {parameter.name for parameter in (stage.DECLARED_WITHIN or stage.REPRESENTATION).parameters}
    for end in ("wname", "wSizeSec", "hSizeSec"):
        if f"{prefix}_{end}" not in names:
            yield f"prefix: expected frame_parameters({prefix!r}), which declare {prefix}_{end}"


def _extra_problems(stage: type[Stage], parent: type[Stage]) -> Iterator[str]:
    if stage.required_extra is not Stage.required_extra and len(inspect.signature(stage.process).parameters) < 3:
        yield "required_extra: expected a method process(self, block, extra=None) that takes it"
    needed = vars(stage).get("required_extra", "")
    if isinstance(needed, str) and needed and needed not in parent.EXTRAS:
        yield f"required_extra: {parent.REPRESENTATION.kind} has no {needed!r}"


def _commands(one: Representation) -> tuple[str, ...]:
    """Return its requests and ports, which are commands of one namespace in Tcl and MATLAB."""
    return (one.request, *one.request_aliases, one.port, *one.port_aliases)


def _words(one: Representation) -> tuple[str, ...]:
    return (one.kind, one.word, *one.word_aliases)


def _results(one: Representation) -> list[str]:
    """Return the keys of results of `rosafe.process`."""
    return [*one.outputs, f"{one.kind}_time", f"{one.kind}_frameRate", *one.coordinates]


def _reserved_names(declared: Representation) -> Iterator[str]:
    reserved = {name.lower() for name in (*REQUESTS, *PORTS)}
    commands = [name.lower() for name in _commands(declared)]
    for name in _commands(declared):
        if name.lower() in reserved or name.startswith("genom_"):
            yield f"request or port: {name!r} is one of the component's own"
        if commands.count(name.lower()) > 1:
            yield f"request or port: there are two called {name!r}, apart from upper and lower case"
    if len(declared.parts) > 1 and declared.kind.lower() in {name.lower() for name in STRUCTS}:
        yield f"kind: {declared.kind!r} is the name of another message"
    keys = _results(declared)
    if len(set(keys)) < len(keys):
        yield f"coordinates: two results of rosafe.process would have one name, of {', '.join(keys)}"


def _conflicts(declared: Representation, other: Representation) -> Iterator[str]:
    """Yield the names in use already. Names of files and commands are compared without regard to case."""
    for what, names in (("kind or word", _words), ("request or port", _commands), ("task", lambda one: (one.task,))):
        taken = {name.lower() for name in names(other)}
        for name in names(declared):
            if name.lower() in taken:
                yield f"{what}: {other.kind} has {name!r} already"
    if declared.name == other.name:
        yield f"name: {other.kind} has {declared.name!r} already"
    for what, keys in (("parameters", lambda one: one.value_names), ("results", _results)):
        if both := set(keys(declared)) & set(keys(other)):
            yield f"{what}: {other.kind} has {min(both)!r} already"
