"""Parameters and outputs as users of offline processing name them: checks that need no tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rosafe.declarations.parameter import short_repr
from rosafe.declarations.text import did_you_mean
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, Parameter

_BY_NAME = {name: p for kind in KINDS.values() for p in kind.parameters for name in (p.name, *p.aliases)}
_BY_FORMER_NAME = {name: p for kind in KINDS.values() for p in kind.parameters for name in p.former}


def check_parameters(parameters: Any) -> dict[str, Any]:
    """Real names and checked values of a dict of parameters (None: an empty one), or ValueError."""
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters: {type(parameters).__name__} is not a dict of names and values")
    return dict(check_parameter(name, value) for name, value in parameters.items())


def check_parameter(name: Any, value: Any, text: bool = False) -> tuple[str, Any]:
    """The real name and the checked value of one parameter, or ValueError; `value` may be given as `text`."""
    parameter = _parameter(name)
    return parameter.name, parameter.read(value) if text else parameter.check(value)


def check_change(name: Any, value: Any) -> tuple[str, Any]:
    """As `check_parameter`, for a change on the way: also under the original's misspelt name of modifyParameter.

    With that (`set_rm_scailing`) go its misspelt values (`_power`).
    """
    if isinstance(name, str) and name in _BY_FORMER_NAME:
        parameter = _BY_FORMER_NAME[name]
        return parameter.name, parameter.check(value.removeprefix("_") if isinstance(value, str) else value)
    return check_parameter(name, value)


def _parameter(name: Any) -> Parameter:
    if not isinstance(name, str) or name not in _BY_NAME:
        known = list(dict.fromkeys(p.name for kind in KINDS.values() for p in kind.parameters))
        raise ValueError(f"unknown parameter {short_repr(name)}; {_suggestion(name, known)}")
    return _BY_NAME[name]


def _suggestion(name: Any, known: Sequence[str]) -> str:
    """What may have been meant, or all that there is."""
    hint = did_you_mean(name, known) if isinstance(name, str) else ""
    return hint.removeprefix("; ") or f"there are: {', '.join(known)}"


def check_outputs(outputs: Any) -> list[str]:
    """The outputs to keep, each once, parents first (None: those of the original), or ValueError."""
    try:
        wanted = [outputs] if isinstance(outputs, str) else list(CORE_REPRESENTATIONS if outputs is None else outputs)
    except TypeError:
        raise ValueError(f"outputs: {outputs!r} is not a sequence of names") from None
    for name in wanted:
        if not isinstance(name, str) or name not in KINDS:
            raise ValueError(f"unknown output {short_repr(name)}; {_suggestion(name, list(KINDS))}")
    return [kind for kind in KINDS if kind in wanted]
