"""Words in requests that nobody knows: taken as the original takes them, which is told everywhere, or refused."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import rospy

from rosafe.declarations.parameter import Parameter
from rosafe.transport import master
from rosafe.tree.processor import Processor

STRICT_CHOICES_PARAM = "~strict_words"  # the ROS parameter; read whenever there is such a word


class ChoiceFallbacks:
    """What was taken for unknown words, for each processor that has got some.

    Parameters
    ----------
    strict : bool
        Refuse them, whatever the ROS parameter says.
    """

    def __init__(self, strict: bool) -> None:
        self._strict = strict
        self._told: dict[Processor, dict[str, str]] = {}  # by the name of the parameter
        self._lock = threading.Lock()

    def resolving(self, doubts: dict[str, str]) -> Callable[[Parameter, Any], Any]:
        """What takes known words for unknown ones, unless those are to be refused, and enters that into `doubts`."""

        def take(parameter: Parameter, value: Any) -> Any:
            doubts[parameter.name] = doubt = parameter.substitution_warning(value)
            return value if doubt and self._refused() else parameter.resolve_choice(value)

        return take

    def _refused(self) -> bool:
        if self._strict:
            return True
        try:
            return bool(rospy.get_param_cached(STRICT_CHOICES_PARAM, False) == 1)  # true, or 1
        except master.FAILURES:  # nobody says so
            return False

    def note(self, processor: Processor, doubts: dict[str, str]) -> str:
        """Log and keep the `doubts` about parameters of a processor, and return them as one line."""
        with self._lock:
            told = {**self._told.pop(processor, {}), **doubts}
            told = {name: doubt for name, doubt in told.items() if doubt}
            if told:
                self._told[processor] = told
        lines = [f"{processor.name}: {doubt}" for doubt in doubts.values() if doubt]
        for line in lines:
            rospy.logwarn(line)
        return "; ".join(lines)

    def forget(self, processor: Processor) -> None:
        """The processor has ended."""
        with self._lock:
            self._told.pop(processor, None)

    @property
    def lines(self) -> list[str]:
        """A line for each unknown word that a processor goes by."""
        with self._lock:
            return [f"{processor.name}: {doubt}" for processor, told in self._told.items() for doubt in told.values()]
