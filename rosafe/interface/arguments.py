"""Checks of the parameters and outputs of offline processing that need no tree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rosafe.declarations.text import did_you_mean, short_repr
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, Parameter
from rosafe.representations import STAGES

_BY_NAME = {name: p for kind in KINDS.values() for p in kind.parameters for name in (p.name, *p.aliases)}
_BY_FORMER_NAME = {name: p for kind in KINDS.values() for p in kind.parameters for name in p.former}


def check_parameters(parameters: Any) -> dict[str, Any]:
    """Return declared names and checked values of a dict of parameters (None: an empty one), or raise ValueError.

    Combinations are checked too, except with the sample rate: fb_lowFreqHz is below fb_highFreqHz.
    """
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters: expected a dict of names and values, got {type(parameters).__name__}")
    checked = dict(check_parameter(name, value) for name, value in parameters.items())
    for kind, declared in KINDS.items():
        defaults = {p.name: p.default for p in declared.parameters}
        if not checked.keys().isdisjoint(defaults):
            STAGES[kind].effective_values({name: checked.get(name, default) for name, default in defaults.items()})
    return checked


def check_parameter(name: Any, value: Any, text: bool = False) -> tuple[str, Any]:
    """Return the declared name and checked value of one parameter, or raise ValueError; `value` may be a `text`."""
    parameter = _parameter(name)
    return parameter.name, parameter.read(value) if text else parameter.check(value)


def check_change(name: Any, value: Any) -> tuple[str, Any]:
    """Check a parameter update like `check_parameter`; the original's misspelt names are accepted as well.

    A misspelt name (`set_rm_scailing`) also has misspelt values (`_power`).
    """
    if isinstance(name, str) and name in _BY_FORMER_NAME:
        parameter = _BY_FORMER_NAME[name]
        return parameter.name, parameter.check(value.removeprefix("_") if isinstance(value, str) else value)
    return check_parameter(name, value)


def is_parameter(name: Any) -> bool:
    """Return whether a parameter has this name or alias."""
    return isinstance(name, str) and name in _BY_NAME


def _parameter(name: Any) -> Parameter:
    if not is_parameter(name):
        known = list(dict.fromkeys(p.name for kind in KINDS.values() for p in kind.parameters))
        raise ValueError(f"parameters: expected a known parameter, got {short_repr(name)}; {_suggestion(name, known)}")
    return _BY_NAME[name]


def _suggestion(name: Any, known: Sequence[str]) -> str:
    """Return the closest names, or all names if none is close."""
    hint = did_you_mean(name, known) if isinstance(name, str) else ""
    return hint.removeprefix("; ") or f"there are: {', '.join(known)}"


def check_outputs(outputs: Any) -> list[str]:
    """Return the outputs to keep, each once, parents first (None: those of the original), or raise ValueError."""
    try:
        requested = (
            [outputs] if isinstance(outputs, str) else list(CORE_REPRESENTATIONS if outputs is None else outputs)
        )
    except TypeError:
        raise ValueError(f"outputs: expected a sequence of names, got {outputs!r}") from None
    for name in requested:
        if not isinstance(name, str) or name not in KINDS:
            raise ValueError(
                f"outputs: expected a known output, got {short_repr(name)}; {_suggestion(name, list(KINDS))}"
            )
    if not requested:
        raise ValueError("outputs: expected at least one name, got none")
    return [kind for kind in KINDS if kind in requested]


def needed(outputs: Iterable[str]) -> list[str]:
    """Return the kinds of processors that `outputs` need, parents first."""
    found = {kind.kind for kind in KINDS.values() if not kind.parent}
    for kind in outputs:
        while kind:
            found.add(kind)
            kind = KINDS[kind].parent
    return [kind for kind in KINDS if kind in found]
