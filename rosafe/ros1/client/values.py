"""Arguments of clients: check and convert them with the interface table before they are sent to a component."""

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
from rosafe.interface import KINDS, REQUEST, REQUIRED, Parameter, Service
from rosafe.ros1.client.errors import bad_value
from rosafe.tree.tree_planner import kind_of

_BOOLEANS = {
    **dict.fromkeys(("1", "true", "yes", "on", "t"), True),
    **dict.fromkeys(("0", "false", "no", "off", "f"), False),
}
_WHOLE = re.compile(r"[+-]?[0-9]{1,30}")
MAX_TYPED = 20  # parameters that an error message lists with their types
_STRUCTURES = {name for kind in KINDS.values() for name in (kind.kind, kind.word)}
# Members of these structures that are not parameters.
_NO_PARAMETERS = {"name", *(derived.name for kind in KINDS.values() for derived in kind.derived)}


def tcl_list(text: str) -> list[str] | None:
    """Return the elements of a Tcl list with braces; None if `text` is not one, or has quotes or backslashes."""
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


def parse_input(text: str) -> Any:
    """Return the value of the JSON `text`; an empty text stands for no arguments.

    Raises ``::genom::serialization`` if the text is not valid JSON.
    """
    if not text.strip():
        return {}
    try:
        value = json.loads(text)
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise bad_value("input: contains an unpaired UTF-16 surrogate") from None
    except (ValueError, RecursionError) as problem:
        raise bad_value(f"input: expected JSON: {problem}") from None
    return value


def complete(service: Service, text_args: Any) -> dict[str, Any]:
    """Return the values of all parameters of `service`: converted `text_args`, and defaults for the others.

    Parameters
    ----------
    service : Service
    text_args : mapping or sequence
        Arguments by name or alias in any order, or by position in the order of declaration. Clients without types may
        pass numbers and booleans as texts.

    Returns
    -------
    dict
        Values by the parameters' names, as the declared Python types. The component checks the ranges.

    Raises
    ------
    ComponentError
        ``::genom::serialization`` whose `what` names the parameter and its allowed values.
    """
    values = _converted(service, _named(service, text_args))
    _require(service, values)
    # NaN makes the component choose the default of a parameter that depends on the sample rate.
    known = service.completed(values)
    return {p.name: known.get(p.name, math.nan) for p in service.parameters}


def partial(text_args: Any) -> dict[str, Any]:
    """Return the values of `interface.REQUEST` for the arguments that are present, without defaults for the others.

    `text_args` is an object, or an array of the representation and an optional object with the other arguments, which
    have no positions. A structure of getParameters, or an array of one, stands for its members. null stands for an
    argument that is not present.

    Raises
    ------
    ComponentError
        See `complete`.
    """
    pairs = _positional_after_kind(text_args) if isinstance(text_args, (list, tuple)) else _named(REQUEST, text_args)
    expanded = [pair for name, value in pairs for pair in _expand_structures(name, value)]
    values = _converted(REQUEST, [(name, value) for name, value in expanded if value is not None])
    _require(REQUEST, values)
    try:
        kind_of(values["representation"])
    except ValueError as problem:
        raise bad_value(f"{REQUEST.name}: {problem}") from None
    return values


def _positional_after_kind(text_args: Sequence[Any]) -> list[tuple[str, Any]]:
    words = list(text_args)
    others = words.pop() if words and isinstance(words[-1], Mapping) else {}
    if len(words) == 2 and words[1] in (None, "", []):  # an empty matrix of MATLAB
        words.pop()
    if len(words) > 1:
        what = "expected the parameters in one object after representation"
        raise bad_value(f"{REQUEST.name}: {what}, got {str(words[1])[:80]!r}")
    return [*(("representation", word) for word in words), *others.items()]


def _expand_structures(name: str, value: Any) -> list[tuple[str, Any]]:
    if name not in _STRUCTURES:
        return [(name, value)]
    structures = value if isinstance(value, list) else [value]
    if len(structures) > 1 or not all(isinstance(structure, Mapping) for structure in structures):
        raise bad_value(f"{name}: expected an object with parameters, such as an element of getParameters")
    return [pair for structure in structures for pair in structure.items() if pair[0] not in _NO_PARAMETERS]


def _converted(service: Service, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in pairs:
        parameter = _parameter(service, name)
        if parameter.name in values:
            raise bad_value(f"{service.name}: {parameter.name}: expected one value, got two")
        values[parameter.name] = _convert(service, parameter, value)
    return values


def _require(service: Service, values: Mapping[str, Any]) -> None:
    missing = next((p for p in service.parameters if p.default is REQUIRED and p.name not in values), None)
    if missing is not None:
        raise bad_value(f"{service.name}: {missing.name} is missing; {missing.range_text or expected(service)}")


def expected(service: Service) -> str:
    """Return one line with the names of the parameters, and with their types unless there are many."""
    if not service.parameters:
        return f"{service.name} takes no parameters"
    typed = len(service.parameters) <= MAX_TYPED
    return f"{service.name} takes " + ", ".join(f"{p.name} ({p.idl})" if typed else p.name for p in service.parameters)


def _named(service: Service, text_args: Any) -> list[tuple[str, Any]]:
    """Return pairs of names and values."""
    if isinstance(text_args, Mapping):
        return list(text_args.items())
    if not isinstance(text_args, (list, tuple)):
        raise bad_value(f"input: expected an object or an array; {expected(service)}")
    if len(text_args) > len(service.parameters):
        what = f"expected at most {len(service.parameters)} arguments, got {len(text_args)}"
        raise bad_value(f"{service.name}: {what}; {expected(service)}")
    return [(p.name, value) for p, value in zip(service.parameters, text_args, strict=False)]


def _parameter(service: Service, name: str) -> Parameter:
    try:
        return service.parameter(name)
    except KeyError:
        known = [p.name for p in service.parameters]
        what = f"expected a known parameter, got {name[:80]!r}"
        raise bad_value(f"{service.name}: {what}; {expected(service)}{did_you_mean(name, known)}") from None


def _convert(service: Service, parameter: Parameter, value: Any) -> Any:
    checks = parameter
    if not parameter.checked_by_client:  # the component checks the value and names the allowed ones
        checks = dataclasses.replace(parameter, minimum=None, maximum=None, least=0, choices=(), spellings={})
    try:
        return checks.check(_typed_value(parameter, value))
    except ValueError as problem:
        allowed = f"; {parameter.range_text}" if parameter.range_text else ""
        raise bad_value(f"{service.name}: {problem} ({parameter.name} is a {parameter.idl}{allowed})") from None


def _typed_value(parameter: Parameter, value: Any) -> Any:
    """Return `value` with texts converted to the type of the parameter."""
    if not isinstance(parameter, StructParameter):
        return _typed(parameter.idl, value)
    of = element(parameter.idl)
    if isinstance(value, str):
        value = _parse(value, sequence=bool(of))
    if of:
        items = _by_index(value) if isinstance(value, Mapping) else value
        one = dataclasses.replace(parameter, idl=of)
        return [_typed_value(one, item) for item in items] if isinstance(items, list) else items
    if not isinstance(value, Mapping):
        return value
    typed = dict(value)
    for member in parameter.members:
        if member.name in typed:
            item = typed[member.name]
            is_text = isinstance(item, str) and element(member.idl)
            typed[member.name] = _typed_value(member, _parse(item, sequence=True) if is_text else item)
    return typed


def _parse(text: str, sequence: bool) -> Any:
    """Return the sequence or structure in a text: JSON, a Tcl list or dict; the text itself if it is neither."""
    with contextlib.suppress(ValueError, RecursionError):
        parsed = json.loads(text)
        if isinstance(parsed, list if sequence else dict):
            return parsed
    words = tcl_list(text)
    if words is None or (len(words) % 2 and not sequence):
        return text
    return words if sequence else dict(zip(words[::2], words[1::2], strict=True))


def _typed(idl: str, value: Any) -> Any:
    """Return `value` with texts converted to numbers and booleans if the type requires it and the text is valid."""
    if of := element(idl):
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
        return _BOOLEANS.get(text.lower(), value)
    if _WHOLE.fullmatch(text):
        return int(text)
    try:
        return float(text) if "_" not in text else value
    except ValueError:
        return value


def _by_index(items: Mapping[str, Any]) -> list[Any]:
    """Return ``{"0": a, "1": b}`` as a list; ValueError if the keys are not the indexes from 0 on."""
    indexes = [str(i) for i in range(len(items))]
    if sorted(items) != sorted(indexes):
        raise ValueError("expected the indexes from 0 on as the keys of a sequence")
    return [items[i] for i in indexes]
