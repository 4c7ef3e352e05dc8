"""Parameters and outputs as users of offline processing name them: checks that need neither numpy nor a tree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosafe.interface import FIXED, KINDS

_PARAMETERS = {name: p for kind in KINDS.values() for p in kind.parameters for name in (p.name, *p.aliases)}
_MISSPELT = {wrong: p.name for kind in KINDS.values() for p in kind.parameters for wrong in p.former}


def check_parameters(parameters: Any) -> dict[str, Any]:
    """Real names and checked values of a dict of parameters (None: an empty one), or ValueError."""
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters: {type(parameters).__name__} is not a dict of names and values")
    return dict(check_parameter(name, value) for name, value in parameters.items())


def check_parameter(name: Any, value: Any, text: bool = False) -> tuple[str, Any]:
    """The real name and the checked value of one parameter, or ValueError; `value` may be given as `text`."""
    if not isinstance(name, str) or name not in _PARAMETERS:
        known = ", ".join(p.name for kind in KINDS.values() for p in kind.parameters)
        raise ValueError(f"unknown parameter {name!r}; there are: {known}")
    parameter = _PARAMETERS[name]
    checked = parameter.read(value) if text else parameter.check(value)
    return parameter.name, checked


def check_change(name: Any, value: Any) -> tuple[str, Any]:
    """As `check_parameter`, for a change on the way: also under the original's misspelt name of modifyParameter.

    With that (`set_rm_scailing`) go its misspelt values (`_power`).
    """
    if isinstance(name, str) and name in _MISSPELT:
        name = _MISSPELT[name]
        value = value.removeprefix("_") if isinstance(value, str) else value
    return check_parameter(name, value)


def check_outputs(outputs: Any) -> list[str]:
    """The outputs to keep, each once, in the order of the chain (None: the original's seven), or ValueError."""
    try:
        wanted = [outputs] if isinstance(outputs, str) else list(FIXED if outputs is None else outputs)
    except TypeError:
        raise ValueError(f"outputs: {outputs!r} is not a sequence of names") from None
    for name in wanted:
        if not isinstance(name, str) or name not in KINDS:
            raise ValueError(f"unknown output {name!r}; there are: {', '.join(KINDS)}")
    return [kind for kind in KINDS if kind in wanted]
