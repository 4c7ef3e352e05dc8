"""The parameters of processors as parameters of the node, `PROCESSOR.NAME`: declared while the processor exists."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from rosafe.declarations.parameter import Parameter as Declaration
from rosafe.declarations.text import did_you_mean, join_names
from rosafe.interface import ComponentError, format_value
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree

Type = Parameter.Type
TYPES = {"boolean": Type.BOOL, "double": Type.DOUBLE, "string": Type.STRING}  # other types are whole numbers
LISTS = {Type.BOOL: Type.BOOL_ARRAY, Type.DOUBLE: Type.DOUBLE_ARRAY, Type.STRING: Type.STRING_ARRAY}


class ProcessorParameters:
    """Keeps the parameters of the node equal to those of the tree.

    Parameters
    ----------
    node : Node
        Allows parameters that are not declared: those that do not exist are answered with our error.
    tree : Tree
    given : mapping
        Values by the names of parameters, for processors that are created later.
    changed : callable
        Called after a client has changed a parameter.
    """

    def __init__(self, node: Node, tree: Tree, given: Mapping[str, Any], changed: Callable[[], object]) -> None:
        self._node, self._tree, self._changed = node, tree, changed
        self._given = {name: value for name, value in given.items() if "." in name}
        self._declared: dict[str, Processor] = {}
        self._lock = threading.RLock()  # of the declared parameters
        self._own = 0  # the thread that declares or updates parameters to the values of the tree
        node.add_on_set_parameters_callback(self._check)

    def update(self) -> None:
        """Declare, update and remove parameters for the present tree."""
        with self._lock:
            self._own = threading.get_ident()
            try:
                self._update()
            finally:
                self._own = 0

    def _update(self) -> None:
        present = {processor.name: processor for processor in self._tree.processors}
        for name, processor in list(self._declared.items()):
            if present.get(name.partition(".")[0]) is not processor:
                del self._declared[name]
                self._node.undeclare_parameter(name)
        for processor in present.values():
            if processor not in self._declared.values():
                self._give(processor)
            values = processor.values()
            for one in processor.representation.parameters:
                name = f"{processor.name}.{one.name}"
                value = _parameter(name, one, values[one.name])
                if name not in self._declared:
                    self._declared[name] = processor
                    self._node.declare_parameter(name, value.value, _descriptor(one, value), ignore_override=True)
                elif _differs(self._node.get_parameter(name), value):
                    self._node.set_parameters([value])

    def _give(self, processor: Processor) -> None:
        """Set the values that were given for a processor before it was created."""
        for name in [name for name in self._given if name.startswith(f"{processor.name}.")]:
            value = self._given.pop(name)
            try:
                self._tree.modify(processor.name, name.partition(".")[2], _text(value), _literal)
            except ComponentError as problem:
                self._node.get_logger().error(f"parameter {name} is not used: {problem}")

    def _check(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Change the tree by parameters that a client sets: all of them, or none."""
        if self._own == threading.get_ident():
            return SetParametersResult(successful=True)
        done: list[tuple[str, str, str]] = []
        with self._tree.lock:
            try:
                for parameter in parameters:
                    change = self._change(parameter)
                    if change is not None:
                        done.append(change)
            except ComponentError as problem:
                for processor, name, before in reversed(done):
                    self._tree.modify(processor, name, before)
                return SetParametersResult(successful=False, reason=problem.what or str(problem))
        if done:
            self._changed()
        return SetParametersResult(successful=True)

    def _change(self, parameter: Parameter) -> tuple[str, str, str] | None:
        """Change one parameter; return processor, name and value before. None for a parameter that is not of the tree.

        Raises ComponentError.
        """
        name, dot, rest = parameter.name.partition(".")
        if self._node.has_parameter(parameter.name) and parameter.name not in self._declared:
            return None  # of the node itself, or of rclpy
        if not dot:
            known = sorted(own for own in self._node.get_parameters_by_prefix("") if "." not in own)
            hint = did_you_mean(name, known)
            what = f"{name}: expected one of {join_names(known)}, or PROCESSOR.PARAMETER, got an unknown name{hint}"
            raise ComponentError("::rosAFE::e_noSuchParameter", what)
        if name in ("qos_overrides", "use_sim_time"):
            return None
        values = self._tree.find(name).values()
        self._tree.modify(name, rest, _text(parameter.value), _literal)
        found = self._tree.find(name).representation.parameter(rest)
        return name, rest, format_value(values[found.name])


def _literal(parameter: Declaration, value: Any) -> Any:
    """Return a value unchanged: an unknown word is an error."""
    return value


def _text(value: Any) -> str:
    """Return a value of ROS as the text of modifyParameter; a flag for a number is an error."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else format_value([*value] if hasattr(value, "__len__") else value)


def _parameter(name: str, declared: Declaration, value: Any) -> Parameter:
    sequence = declared.idl.startswith("sequence<")
    type_ = TYPES.get(declared.idl.removeprefix("sequence<").removesuffix(">"), Type.INTEGER)
    return Parameter(name, LISTS.get(type_, Type.INTEGER_ARRAY) if sequence else type_, value)


def _differs(present: Parameter, value: Parameter) -> bool:
    """Return whether a parameter has another value than that of the tree, or its number as another type."""
    of_list = isinstance(value.value, list)
    return present.type_ != value.type_ or (list(present.value) if of_list else present.value) != value.value


def _descriptor(declared: Declaration, value: Parameter) -> ParameterDescriptor:
    """Describe a parameter. Its range is a text: ROS would check a range with an error of its own."""
    unit = f" ({declared.unit})" if declared.unit and f"({declared.unit})" not in declared.doc else ""
    return ParameterDescriptor(
        type=value.type_.value,
        description=f"{declared.doc}{unit}",
        additional_constraints=declared.range_text,
        dynamic_typing=True,
    )
