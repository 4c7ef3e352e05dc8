"""The names of 0.2 for plugins that were written for it. To be removed in the next release."""

from __future__ import annotations

import ast
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


# Modules from which plugins of 0.2 import what is in rosafe.plugin now
MODULES = ("rosafe.dsp.framing", "rosafe.dsp.stage", "rosafe.vocabulary.parameter", "rosafe.vocabulary.representation")


def used(source: bytes) -> list[str]:
    """The old names that a plugin uses, each with the present one.

    Raises SyntaxError or ValueError for what is not Python.
    """
    renamed = {**OVERRIDES, **ATTRIBUTES}
    found: dict[str, None] = {}
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom):
            if node.module in MODULES:
                found[f"{node.module} (now rosafe.plugin)"] = None
        elif isinstance(node, ast.ClassDef):
            for item in node.body:
                if isinstance(item, ast.FunctionDef):
                    names.append(item.name)
                elif isinstance(item, ast.Assign):
                    names += [target.id for target in item.targets if isinstance(target, ast.Name)]
                elif isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
                    names.append(item.target.id)
        elif isinstance(node, ast.Attribute):
            owner = node.value
            is_self = isinstance(owner, ast.Name) and owner.id == "self"
            is_super = isinstance(owner, ast.Call) and isinstance(owner.func, ast.Name) and owner.func.id == "super"
            if (is_self or is_super) and isinstance(node.ctx, ast.Load):
                names.append(node.attr)
        for name in names:
            if name in renamed:
                found[f"{name} (now {renamed[name]})"] = None
    return sorted(found)
