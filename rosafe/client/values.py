"""What clients send as arguments, checked and converted by the interface table before anything goes to a component."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from rosafe.declarations.idl import element
from rosafe.declarations.parameter import StructParameter
from rosafe.declarations.text import did_you_mean
from rosafe.interface import KINDS, REQUEST, REQUIRED, ComponentError, Parameter, Service
from rosafe.tree.tree_planner import kind_of

_WORDS = {
    **dict.fromkeys(("1", "true", "yes", "on", "t"), True),
    **dict.fromkeys(("0", "false", "no", "off", "f"), False),
}
_WHOLE = re.compile(r"[+-]?[0-9]{1,30}")
MANY = 20  # parameters in one line
_STRUCTURES = {name for kind in KINDS.values() for name in (kind.kind, kind.word)}
# members of those structures all the same
_NO_PARAMETERS = {"name", *(derived.name for kind in KINDS.values() for derived in kind.derived)}


def tcl_list(text: str) -> list[str] | None:
    """The words of a Tcl list, or None if `text` is not one. Braces are understood, quotes and backslashes are not."""
    words: list[str] = []
    at = 0
    while at < len(text):
        if text[at].isspace():
            at += 1
            continue
        begin, depth = at, 0
        while at < len(text) and (depth or not text[at].isspace()):
            if text[at] in '"\\':
                return None
            depth += (text[at] == "{") - (text[at] == "}")
            at += 1
            if depth <= 0 and text[at - 1] == "}":
                break
        word = text[begin:at]
        braced = word.startswith("{")
        if depth or braced != word.endswith("}") or (at < len(text) and not text[at].isspace()):
            return None
        words.append(word[1:-1] if braced else word)
    return words


def bad_value(what: str) -> ComponentError:
    """The error of an argument that is not sent at all."""
    return ComponentError("::genom::serialization", what=what)


def parse_input(text: str) -> Any:
    """The JSON value `text`, or the error that says why it is none; nothing stands for no arguments."""
    if not text.strip():
        return {}
    try:
        value = json.loads(text)
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise bad_value("input: half a surrogate pair is no character") from None
    except (ValueError, RecursionError) as problem:
        raise bad_value(f"input is not JSON: {problem}") from None
    return value


def complete(service: Service, given: Any) -> dict[str, Any]:
    """All arguments of `service`: those `given`, checked, and the defaults of the others.

    Parameters
    ----------
    service : Service
    given : mapping or sequence
        By name (aliases count, any order), or by position in the order of declaration. The numbers and booleans of
        clients without types may be texts.

    Returns
    -------
    dict
        Values by the parameters' own names, of the right Python types. Ranges are the component's business.

    Raises
    ------
    ComponentError
        ``::genom::serialization`` whose `what` names the argument and says what is allowed.
    """
    values = _converted(service, _named(service, given))
    _require(service, values)
    # What follows the sample rate is the component's to choose: no number asks it to.
    known = service.completed(values)
    return {p.name: known.get(p.name, math.nan) for p in service.parameters}


def partial(given: Any) -> dict[str, Any]:
    """The arguments of `interface.REQUEST` that are `given`, and no others.

    An object, or an array of the representation and, where there are any, an object of the others: by position nobody
    knows them. A structure of getParameters, or an array of one, stands for its members. null stands for what is not
    given.

    Raises
    ------
    ComponentError
        As `complete`.
    """
    pairs = _positional_after_kind(given) if isinstance(given, (list, tuple)) else _named(REQUEST, given)
    unfolded = [pair for name, value in pairs for pair in _expand_structures(name, value)]
    values = _converted(REQUEST, [(name, value) for name, value in unfolded if value is not None])
    _require(REQUEST, values)
    try:
        kind_of(values["representation"])
    except ValueError as problem:
        raise bad_value(f"{REQUEST.name}: {problem}") from None
    return values


def _positional_after_kind(given: Sequence[Any]) -> list[tuple[str, Any]]:
    words = list(given)
    parameters = words.pop() if words and isinstance(words[-1], Mapping) else {}
    if len(words) == 2 and words[1] in (None, "", []):  # an empty matrix of MATLAB
        words.pop()
    if len(words) > 1:
        given_instead = str(words[1])[:80]
        raise bad_value(
            f"{REQUEST.name}: after representation come the parameters in one object, not {given_instead!r}"
        )
    return [*(("representation", word) for word in words), *parameters.items()]


def _expand_structures(name: str, value: Any) -> list[tuple[str, Any]]:
    if name not in _STRUCTURES:
        return [(name, value)]
    structures = value if isinstance(value, list) else [value]
    if len(structures) > 1 or not all(isinstance(structure, Mapping) for structure in structures):
        raise bad_value(f"{name}: wanted is an object with parameters, as an element of getParameters")
    return [pair for structure in structures for pair in structure.items() if pair[0] not in _NO_PARAMETERS]


def _converted(service: Service, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in pairs:
        parameter = _parameter(service, name)
        if parameter.name in values:
            raise bad_value(f"{service.name}: {parameter.name} is given twice")
        values[parameter.name] = _convert(service, parameter, value)
    return values


def _require(service: Service, values: Mapping[str, Any]) -> None:
    missing = next((p for p in service.parameters if p.default is REQUIRED and p.name not in values), None)
    if missing is not None:
        raise bad_value(f"{service.name}: {missing.name} is missing; {missing.range_text or expected(service)}")


def expected(service: Service) -> str:
    """One line with the names of the parameters, and with their types unless they are many."""
    if not service.parameters:
        return f"{service.name} takes no parameters"
    if len(service.parameters) > MANY:
        return f"{service.name} takes " + ", ".join(p.name for p in service.parameters)
    return f"{service.name} takes " + ", ".join(f"{p.name} ({p.idl})" for p in service.parameters)


def _named(service: Service, given: Any) -> list[tuple[str, Any]]:
    if isinstance(given, Mapping):
        return list(given.items())
    if isinstance(given, (list, tuple)):
        if len(given) > len(service.parameters):
            raise bad_value(f"{len(given)} arguments are too many; {expected(service)}")
        return [(p.name, value) for p, value in zip(service.parameters, given, strict=False)]
    raise bad_value(f"input is neither an object nor an array; {expected(service)}")


def _parameter(service: Service, name: str) -> Parameter:
    try:
        return service.parameter(name)
    except KeyError:
        known = [p.name for p in service.parameters]
        raise bad_value(f"unknown parameter {name[:80]!r}; {expected(service)}{did_you_mean(name, known)}") from None


def _convert(service: Service, parameter: Parameter, value: Any) -> Any:
    checks = parameter
    if not parameter.checked_by_client:  # the component names what it allows
        checks = dataclasses.replace(parameter, minimum=None, maximum=None, least=0, choices=(), spellings={})
    try:
        return checks.check(_typed_value(parameter, value))
    except ValueError as problem:
        allowed = f"; {parameter.range_text}" if parameter.range_text else ""
        raise bad_value(f"{service.name}: {problem} ({parameter.name} is a {parameter.idl}{allowed})") from None


def _typed_value(parameter: Parameter, value: Any) -> Any:
    """`value` with texts turned into what the type of the parameter asks for."""
    if not isinstance(parameter, StructParameter):
        return _typed(parameter.idl, value)
    of = element(parameter.idl)
    if isinstance(value, str):
        value = _parse(value, sequence=bool(of))
    if of:
        items = _by_index(value) if isinstance(value, Mapping) else value
        one = dataclasses.replace(parameter, idl=of)
        return [_typed_value(one, item) for item in items] if isinstance(items, list) else items
    return _typed_members(parameter, value) if isinstance(value, Mapping) else value


def _typed_members(parameter: StructParameter, values: Mapping[str, Any]) -> dict[str, Any]:
    typed = dict(values)
    for member in parameter.members:
        value = values.get(member.name)
        if isinstance(value, str) and element(member.idl):
            value = _parse(value, sequence=True)
        if member.name in typed:
            typed[member.name] = _typed_value(member, value)
    return typed


def _parse(text: str, sequence: bool) -> Any:
    """The sequence or structure that a text is, in JSON or as a Tcl list or dict; the text itself if it is neither."""
    with contextlib.suppress(ValueError, RecursionError):
        parsed = json.loads(text)
        if isinstance(parsed, list if sequence else dict):
            return parsed
    words = tcl_list(text)
    if words is None or (len(words) % 2 and not sequence):
        return text
    return words if sequence else dict(zip(words[::2], words[1::2], strict=True))


def _typed(idl: str, value: Any) -> Any:
    """`value` with texts turned into numbers and booleans, where the type asks for those and the text is one."""
    if idl.startswith("sequence<"):
        of = element(idl)
        if isinstance(value, Mapping):
            value = _by_index(value)
        if isinstance(value, list):
            return [_typed(of, item) for item in value]
        if value == "":
            return []
        return [_typed(of, value)] if isinstance(value, str) else value
    if idl == "string" or not isinstance(value, str):
        return value
    text = value.strip()
    if idl == "boolean":
        return _WORDS.get(text.lower(), value)
    if _WHOLE.fullmatch(text):
        return int(text)
    try:
        return float(text) if "_" not in text else value
    except ValueError:
        return value


def _by_index(items: Mapping[str, Any]) -> list[Any]:
    """``{"0": a, "1": b}`` as a list; ValueError where the keys are not the indexes from 0 on."""
    wanted = [str(i) for i in range(len(items))]
    if sorted(items) != sorted(wanted):
        raise ValueError("the keys of a sequence given as an object are its indexes, from 0 on")
    return [items[i] for i in wanted]
