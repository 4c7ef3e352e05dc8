"""The names of 0.2 for plugins that were written for it. To be removed in the next release."""

from __future__ import annotations

from functools import cached_property
from types import FunctionType
from typing import Any

# What a subclass of Stage may override: the name in 0.2, and the present one
OVERRIDES = {
    "PREFIX": "prefix",
    "PROVIDES": "EXTRAS",
    "_build": "build",
    "_output": "output_format",
    "_received": "input_format_changed",
    "complete": "output_count",
    "needs": "required_extra",
}
ATTRIBUTES = {"_values": "values", "given": "input_format", "output": "output_format"}  # of instances


class _Alias:
    """Another name of an attribute. It can be read, not set: a plugin may use the name for something else."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, stage: Any, owner: type) -> Any:
        return self if stage is None else getattr(stage, self._name)


class OldNames:
    """Base class of Stage. Each name that a subclass defines is defined by its other name, too, when it is created."""

    _values, given, output = map(_Alias, ATTRIBUTES.values())

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        for old, new in OVERRIDES.items():
            own = vars(cls)
            if new in own:
                value = own[new]
                setattr(cls, old, value.func if old == "_output" and isinstance(value, cached_property) else value)
            elif old in own:
                setattr(cls, new, own[old])
        if isinstance(method := vars(cls).get("output_format"), FunctionType):
            cls.output_format = cached_property(method)  # type: ignore[attr-defined]
            cls.output_format.__set_name__(cls, "output_format")  # type: ignore[attr-defined]
