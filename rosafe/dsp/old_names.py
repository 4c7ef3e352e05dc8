"""The names of version 0.2, for plugins that were written for it. They will be removed in the next release."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cached_property
from types import FunctionType
from typing import Any

# Members that a subclass of Stage may override: the name in 0.2, and the current one
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
    """An alias of an attribute, for reading only: a plugin may use the name for an attribute of its own."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, stage: Any, owner: type) -> Any:
        return self if stage is None else getattr(stage, self._name)


class OldNames:
    """Base class of Stage, which defines each member of a new subclass by its old and its current name."""

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


# Modules from which plugins of 0.2 import the names of rosafe.plugin
MODULES = ("rosafe.dsp.framing", "rosafe.dsp.stage", "rosafe.vocabulary.parameter", "rosafe.vocabulary.representation")


def used(source: bytes) -> list[str]:
    """Return the old names in the source of a plugin, each with the current one.

    Raises SyntaxError or ValueError if the source is not valid Python.
    """
    renamed = {**OVERRIDES, **ATTRIBUTES}
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module in MODULES:
            found.add(f"{node.module} (now rosafe.plugin)")
        found.update(f"{name} (now {renamed[name]})" for name in _members(node) if name in renamed)
    return sorted(found)


def _members(node: ast.AST) -> Iterator[str]:
    """Yield the names that a class defines in its body, or the attribute of `self` or `super()` that is read."""
    if isinstance(node, ast.ClassDef):
        for item in node.body:
            if isinstance(item, ast.FunctionDef):
                yield item.name
            targets = item.targets if isinstance(item, ast.Assign) else [getattr(item, "target", None)]
            yield from (target.id for target in targets if isinstance(target, ast.Name))
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
        owner = node.value.func if isinstance(node.value, ast.Call) else node.value
        if isinstance(owner, ast.Name) and owner.id == ("super" if isinstance(node.value, ast.Call) else "self"):
            yield node.attr
