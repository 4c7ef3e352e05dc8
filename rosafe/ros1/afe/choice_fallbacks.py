"""Choices in requests that are not known: replaced as in the original, with a warning, or rejected."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import rospy

from rosafe.declarations.parameter import Parameter
from rosafe.interface.remarks import advice
from rosafe.ros1.transport import master
from rosafe.tree.processor import Processor

STRICT_CHOICES_PARAM = "~strict_words"  # ROS parameter, read for each unknown choice


class ChoiceFallbacks:
    """Unknown choices in requests: replaced as in the original, with a warning, or rejected in strict mode.

    Parameters
    ----------
    strict : bool
        Reject unknown choices, whatever the value of the ROS parameter.
    """

    def __init__(self, strict: bool) -> None:
        self._strict = strict
        self._warnings: dict[Processor, dict[str, str]] = {}  # by the name of the parameter
        self._advised: set[Processor] = set()
        self._lock = threading.Lock()

    def resolving(self, warnings: dict[str, str]) -> Callable[[Parameter, Any], Any]:
        """Return a function that replaces unknown choices, except in strict mode, and adds a warning to `warnings`."""

        def resolve(parameter: Parameter, value: Any) -> Any:
            warnings[parameter.name] = warning = parameter.substitution_warning(value)
            return value if warning and self._is_strict() else parameter.resolve_choice(value)

        return resolve

    def _is_strict(self) -> bool:
        try:
            return self._strict or bool(rospy.get_param_cached(STRICT_CHOICES_PARAM, False) == 1)  # true, or 1
        except master.FAILURES:
            return False

    def note(self, processor: Processor, warnings: dict[str, str]) -> str:
        """Log and store the `warnings` about parameters of a processor, and return them as one line."""
        with self._lock:
            stored = {**self._warnings.pop(processor, {}), **warnings}
            if any(stored.values()):
                self._warnings[processor] = {name: warning for name, warning in stored.items() if warning}
        lines = [f"{processor.name}: {warning}" for warning in warnings.values() if warning]
        for line in [*lines, *self._advice(processor)]:
            rospy.logwarn(line)
        return "; ".join(lines)

    def _advice(self, processor: Processor) -> list[str]:
        """Return the declared warning about valid but unsuitable values, once for each processor."""
        if processor in self._advised:
            return []
        with self._lock:
            self._advised.add(processor)
        values: dict[str, Any] = {}
        ancestor: Processor | None = processor
        while ancestor is not None:
            values |= ancestor.stage.parameters
            ancestor = ancestor.parent
        text = advice(processor.kind, values)
        return [f"{processor.name}: {text}"] if text else []

    def forget(self, processor: Processor) -> None:
        """Remove the warnings of a processor that has ended."""
        with self._lock:
            self._warnings.pop(processor, None)
            self._advised.discard(processor)

    @property
    def lines(self) -> list[str]:
        """The warnings about the current parameters of all processors."""
        with self._lock:
            return [f"{p.name}: {warning}" for p, warnings in self._warnings.items() for warning in warnings.values()]
