"""The processors of a tree by name, and the failures of those that were removed."""

from __future__ import annotations

from typing import NamedTuple

from rosafe.declarations.errors import ComponentError
from rosafe.declarations.text import join_names, short_repr
from rosafe.dsp.plugin_checks import PluginError
from rosafe.interface import KINDS, ROSAFE
from rosafe.tree.processor import Processor, subtree

MAX_FAILURES = 20  # that are kept


class Failure(NamedTuple):
    """The failure of a processor. `children` are its descendants, which were removed with it."""

    name: str
    kind: str
    reason: str
    children: tuple[str, ...]

    @classmethod
    def of(cls, processor: Processor) -> Failure:
        """Return the failure of a processor whose `error` is set and which is still in the tree."""
        error = processor.error
        reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
        below = tuple(one.name for one in subtree(processor) if one is not processor)
        return cls(processor.name, processor.kind, " ".join(reason.split()), below)

    def __str__(self) -> str:
        below = f"; ended with it: {', '.join(self.children)}" if self.children else ""
        return f"{self.name} ({self.kind}) failed: {self.reason}{below}"


class ProcessorRegistry:
    """The processors of a tree by name. Every method is called with the lock of the tree's requests held.

    Attributes
    ----------
    by_name : dict of str to Processor
        In the order of creation, in which getParameters reports them.
    failures : dict of str to Failure
        By name, oldest first, without processors that were created again.
    """

    def __init__(self) -> None:
        self.by_name: dict[str, Processor] = {}
        self.failures: dict[str, Failure] = {}

    @property
    def root(self) -> Processor | None:
        """The input, if there is one."""
        return next((p for p in self.by_name.values() if p.parent is None), None)

    def find(self, name: str) -> Processor:
        """Return the processor called `name`. Raises e_noSuchProcessor."""
        if name not in self.by_name:
            raise ROSAFE.error("e_noSuchProcessor", self._missing(name))
        return self.by_name[name]

    def find_parent(self, kind: str, name: str, parent_name: str) -> Processor:
        """Return the parent of a processor that can be added. Raises ComponentError in the original's order of checks.

        ``e_noUpperDependencie`` if the parent is missing or of the wrong kind; ``e_existsAlready`` if `name` is in use.
        """
        expected = KINDS[kind].parent
        known = f"; of kind {expected}: {join_names([p.name for p in self.by_name.values() if p.kind == expected])}"
        parent = self.by_name.get(parent_name)
        if parent is None:
            raise ROSAFE.error("e_noUpperDependencie", f"{self._missing(parent_name)}{known}")
        if name in self.by_name:
            raise already_exists(self.by_name[name])
        if parent.kind != expected:
            text = f"{short_repr(parent_name)}: expected a processor of kind {expected}, got kind {parent.kind}{known}"
            raise ROSAFE.error("e_noUpperDependencie", text)
        return parent

    def add(self, processor: Processor) -> None:
        """Add a processor, and forget the failure of a previous one with its name."""
        self.by_name[processor.name] = processor
        self.failures.pop(processor.name, None)

    def record_failure(self, processor: Processor) -> None:
        """Record the failure of a processor that is still in the tree."""
        self.failures[processor.name] = Failure.of(processor)
        for name in list(self.failures)[:-MAX_FAILURES]:
            del self.failures[name]

    def _missing(self, name: str) -> str:
        reason = f": {self.failures[name]}" if name in self.failures else ""
        return f"there is no processor {short_repr(name)}{reason}; there are: {join_names(self.by_name)}"


def already_exists(processor: Processor) -> ComponentError:
    """Return the error of a request to add a processor with the name of an existing one."""
    return ROSAFE.error("e_existsAlready", f"{short_repr(processor.name)} exists already, of kind {processor.kind}")
