"""Checks of plugins at run time: read-only input, checked results, and errors with the plugin, its file and line.

`checked` creates a subclass of a plugin's stage with these checks. Built-in stages are not wrapped.
"""

from __future__ import annotations

import inspect
import logging
import math
import sys
import traceback
import types
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, NoReturn

import numpy as np

from rosafe.declarations.checks import MAX_TEXT
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.representation import Derived, Part

from .numeric_limits import FloatArray
from .signal_format import SignalFormat
from .stage import FLOAT64, Output, Stage

log = logging.getLogger("rosafe.plugin")
Rows = tuple[int, ...]


class PluginError(ValueError):
    """A plugin's stage failed or violates its declaration; the text names the plugin, its file and the line."""


def checked(stage: type[Stage], file: str = "") -> type[Stage]:
    """Return a subclass of a plugin's stage whose input is read-only and whose results are checked.

    Parameters
    ----------
    stage : type
        The plugin's class, with a declaration.
    file : str
        The file that defines it, for messages; by default that of its module.

    Returns
    -------
    type
        `stage` itself if it is checked already. Its methods raise `PluginError` for failures and violations.
    """
    if issubclass(stage, CheckedStage):
        return stage
    path = file or getattr(sys.modules.get(stage.__module__), "__file__", None) or _file_of(stage)
    names = {
        "__module__": stage.__module__,
        "__qualname__": stage.__qualname__,
        "__doc__": stage.__doc__,
        "PLUGIN": stage,
        "PLUGIN_FILE": path,
        "PLUGIN_LINE": _line_of(stage, path),
        "CHECKS_NAN": not stage.REPRESENTATION.allow_nan,
        "SUPPORTS_IN_PLACE": False,
        "CHANNEL_INDEPENDENT": False,
    }
    subclass: type[Stage] = types.new_class(
        stage.__name__, (CheckedStage, stage), {}, lambda namespace: namespace.update(names)
    )
    subclass.TAKES_OUT = stage.TAKES_OUT
    return subclass


def _file_of(stage: type[Stage]) -> str:
    """Return the file of the first function that the class itself defines."""
    codes = (getattr(value, "__code__", None) for value in vars(stage).values())
    return next((code.co_filename for code in codes if code is not None), "unknown file")


def _line_of(stage: type[Stage], file: str) -> int:
    """Return the first line of the method that computes, otherwise that of the class."""
    for name in ("frame", "process", "__init__"):
        code = getattr(inspect.unwrap(getattr(stage, name, None) or stage), "__code__", None)
        if code is not None and code.co_filename == file:
            return int(code.co_firstlineno)
    try:
        return inspect.getsourcelines(stage)[1]
    except (OSError, TypeError):
        return 1


def read_only(array: FloatArray) -> FloatArray:
    """Return a view of a contiguous array that cannot be written or made writable again."""
    return np.asarray(memoryview(array).toreadonly())  # type: ignore[arg-type]


class _Count:
    """Compares the number of frames that a stage received and returned with its `output_count`.

    After a change of parameters the phase of its frames is unknown: only their rate is compared.
    """

    def __init__(self, since_start: bool = True) -> None:
        self._since_start = since_start
        self._received = self._returned = 0
        self._max_returned = 0  # for one block
        self._aligned = since_start  # False until the first frame after a change

    def expected(self, stage: Stage, received: int, returned: int) -> int:
        """Return the expected number of frames for the block; `returned` itself if that is plausible."""
        self._received += received
        self._returned += returned
        if self._since_start:
            count = super(CheckedStage, stage).output_count(self._received)  # type: ignore[misc]
            return returned + _whole(count, "output_count") - self._returned
        self._max_returned = max(self._max_returned, returned)
        if not self._aligned:
            if returned:
                self._aligned, self._received, self._returned = True, 0, 0
            return returned
        due = self._received * stage.output_format.rate / stage.input_format.rate
        return (
            returned if abs(self._returned - due) < 2 + self._max_returned else returned + round(due) - self._returned
        )


def text_of_exception(problem: BaseException) -> str:
    """Return the text of an exception, even if its class fails to convert itself to a string."""
    try:
        return str(problem)
    except Exception:
        return "(its text cannot be read)"


def _whole(value: Any, name: str) -> int:
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0:
        return int(value)
    raise TypeError(f"{name}: expected a number of frames, got {value!r:.80}")


def _rows(value: Any, name: str) -> Rows:
    valid = isinstance(value, tuple) and all(
        isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 0 for n in value
    )
    if not valid:
        raise TypeError(f"{name}: expected a tuple of integers, got {value!r:.80}")
    return tuple(map(int, value))


def _values(values: Any, declared: Collection[Parameter | Derived], name: str) -> dict[str, Any]:
    """Return the declared ones of `values`, after a check of their types."""
    if not isinstance(values, Mapping):
        raise TypeError(f"{name}: expected a dict, got {values!r:.80}")
    if missing := [one.name for one in declared if one.name not in values]:
        raise TypeError(f"{name}: {', '.join(missing)} is missing")
    for one in declared:
        try:
            Parameter(one.name, one.idl, REQUIRED, "x", most=sys.maxsize).check(values[one.name])
        except ValueError as problem:
            raise TypeError(f"{name}: {problem}") from None
    return {one.name: values[one.name] for one in declared}


class CheckedStage(Stage):
    """The first base class of the classes that `checked` creates; the plugin's own class is the second."""

    PLUGIN: ClassVar[type[Stage]]
    PLUGIN_FILE: ClassVar[str]
    PLUGIN_LINE: ClassVar[int]
    CHECKS_NAN: ClassVar[bool]
    CONVERTS: ClassVar[bool] = True  # arrays of other real types, and arrays that are not contiguous
    _warned: ClassVar[set[str]] = set()  # kinds whose arrays were converted

    def __init__(self, *arguments: Any, **parameters: Any) -> None:
        self.__count = _Count()
        self.__rows: dict[Rows, tuple[Rows, ...]] = {}
        with self._locating("__init__", refuses=True):
            super().__init__(*arguments, **parameters)
        self._inspect()

    # --- errors ---

    @classmethod
    def describe_plugin(cls) -> str:
        """Return the kind and the file, for messages."""
        return f"plugin {cls.REPRESENTATION.kind} ({cls.PLUGIN_FILE})"

    @classmethod
    def _violation(cls, text: str, line: int = 0) -> PluginError:
        return PluginError(f"plugin {cls.REPRESENTATION.kind} ({cls.PLUGIN_FILE}:{line or cls.PLUGIN_LINE}): {text}")

    @classmethod
    @contextmanager
    def _locating(cls, name: str, refuses: bool = False) -> Iterator[None]:
        """Convert any exception of the method `name` to a `PluginError`.

        A method that `refuses` values may raise a ValueError that begins with the name of a parameter.
        """
        try:
            yield
        except (PluginError, KeyboardInterrupt):
            raise
        except BaseException as problem:
            if refuses and isinstance(problem, ValueError) and not cls._is_fault(problem):
                raise
            cls._raise(name, problem)

    @classmethod
    def _is_fault(cls, problem: ValueError) -> bool:
        """Return whether the plugin's own code raised it for another reason than the value of a parameter."""
        names = tuple(cls.REPRESENTATION.value_names)
        return cls._line(problem) > 0 and not text_of_exception(problem).startswith(names)

    @classmethod
    def _line(cls, problem: BaseException) -> int:
        """Return the line of the plugin's file in which the exception was raised; 0 if it was raised elsewhere."""
        trace = traceback.walk_tb(problem.__traceback__)
        lines = [line for frame, line in trace if frame.f_code.co_filename == cls.PLUGIN_FILE]
        return lines[-1] if lines else 0

    @classmethod
    def _raise(cls, name: str, problem: BaseException) -> NoReturn:
        text = " ".join(f"{type(problem).__name__}: {text_of_exception(problem)}".split())
        raise cls._violation(f"{name}: {text[:MAX_TEXT]}", cls._line(problem)) from problem

    # --- blocks ---

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        output = self._call_process(block, extra, out)
        parts = output if isinstance(output, tuple) else (output,)
        rows = self.__rows.get(block.shape[:-1]) or self._expected_rows(block.shape[:-1])
        if len(parts) != len(rows):
            raise self._violation(f"process: expected {len(rows)} arrays, one for each part, got {len(parts)}")
        shared = [block] if extra is None else [block, extra]
        declared = self.REPRESENTATION.parts
        parts = tuple(self._part(*each, shared, out) for each in zip(parts, rows, declared, strict=True))
        frames = parts[0].shape[-1]
        try:
            expected = self.__count.expected(self, block.shape[-1], frames)
        except Exception as problem:
            self._raise("output_count", problem)
        if expected != frames:
            raise self._violation(f"process: expected {expected} frames as output_count declares, got {frames}")
        for part, array in zip(declared, parts, strict=True):
            if array.shape[-1] != frames:
                raise self._violation(f"{part.name}: expected {frames} frames as in the first part, got {array.shape}")
        for name in self.provide:
            self._check_extra(name)
        return parts if isinstance(output, tuple) else parts[0]

    def _call_process(self, block: FloatArray, extra: FloatArray | None, out: FloatArray | None) -> Output:
        """Call `process` of the plugin with read-only arrays, and without trailing arguments that are None."""
        arguments: list[Any] = [read_only(block)]
        if extra is not None or out is not None:
            arguments.append(None if extra is None else read_only(extra))
        if out is not None:
            arguments.append(out)
        try:
            return super().process(*arguments)
        except KeyboardInterrupt:
            raise
        except BaseException as problem:
            self._raise("process", problem)

    def _part(
        self, array: Any, rows: Rows, part: Part, shared: Collection[FloatArray], out: FloatArray | None
    ) -> FloatArray:
        """Return one array of the output after a comparison with its declaration."""
        if not isinstance(array, np.ndarray):
            raise self._violation(f"{part.name}: expected a float64 array, got {type(array).__name__}")
        if array.dtype.kind not in "fiub":
            raise self._violation(f"{part.name}: expected a float64 array, got {array.dtype} array")
        if array.ndim == 0 or array.shape[:-1] != rows:
            shape = ", ".join(map(str, (*rows, "frames")))
            raise self._violation(f"{part.name}: expected shape ({shape}), got {array.shape}")
        if any(np.may_share_memory(array, one) for one in shared):
            raise self._violation(f"{part.name}: expected a new array, got one that shares memory with the input")
        if array is not out and not (array.dtype is FLOAT64 and array.flags.c_contiguous and type(array) is np.ndarray):
            array = self._converted(array, part.name)
        if self.CHECKS_NAN and not math.isfinite(array.sum()) and not np.isfinite(array).all():
            raise self._violation(f"{part.name}: expected finite numbers, got NaN or infinity (see allow_nan)")
        return array

    def _converted(self, array: Any, name: str) -> FloatArray:
        kind = self.REPRESENTATION.kind
        got = f"one of {array.dtype}" if array.dtype != FLOAT64 else "one that is not contiguous"
        text = f"{name}: expected a contiguous float64 array, got {got}"
        if not self.CONVERTS:
            raise self._violation(text)
        if kind not in self._warned:
            self._warned.add(kind)
            log.warning("%s: %s; it is converted", self.describe_plugin(), text)
        return np.ascontiguousarray(array, np.float64)

    def _check_extra(self, name: str) -> None:
        extra = self.provided.get(name) if isinstance(self.provided, dict) else None
        if not isinstance(extra, np.ndarray) or extra.dtype != FLOAT64:
            raise self._violation(f"provided[{name!r}]: expected a float64 array, got {type(extra).__name__}")

    def reset(self) -> None:
        with self._locating("reset"):
            super().reset()
        self.__count = _Count()

    # --- declared properties ---

    def reconfigure(self, given: SignalFormat, changes: Collection[Mapping[str, Any]]) -> None:
        changed = given != self.input_format or any(changes)
        with self._locating("build", refuses=True):
            super().reconfigure(given, changes)
        if changed:
            self.__count = _Count(since_start=False)
            self.__rows = {}
            self._inspect()

    def _inspect(self) -> None:
        """Check all members that can be read without a block."""
        if not {"input_format", "values", "provide", "provided"} <= vars(self).keys():
            raise self._violation("__init__: expected a call of super().__init__(input_format, **parameters)")
        for name in ("output_format", "parameters", "derived", "required_extra", "look_ahead"):
            getattr(self, name)

    @property
    def parameters(self) -> dict[str, Any]:
        with self._locating("parameters"):
            return _values(super().parameters, self.REPRESENTATION.parameters, "parameters")

    @property
    def derived(self) -> dict[str, Any]:
        with self._locating("derived"):
            return _values(super().derived, self.REPRESENTATION.derived, "derived")

    @property
    def output_format(self) -> SignalFormat:
        with self._locating("output_format"):
            found = super().output_format
            if not isinstance(found, SignalFormat):
                raise TypeError(f"output_format: expected a SignalFormat, got {type(found).__name__}")
            return found

    @property
    def required_extra(self) -> str:
        with self._locating("required_extra"):
            name = super().required_extra
            if not isinstance(name, str):
                raise TypeError(f"required_extra: expected a name, got {name!r:.80}")
            return name

    @property
    def look_ahead(self) -> int:
        with self._locating("look_ahead"):
            return _whole(super().look_ahead, "look_ahead")

    def output_rows(self, rows: Rows) -> Rows:
        with self._locating("output_rows"):
            return _rows(super().output_rows(rows), "output_rows")

    def part_rows(self, rows: Rows) -> tuple[Rows, ...]:
        with self._locating("part_rows"):
            parts = super().part_rows(rows)
            if not isinstance(parts, tuple) or len(parts) != len(self.REPRESENTATION.parts):
                raise TypeError(f"part_rows: expected one tuple for each part, got {parts!r:.80}")
            checked_rows = tuple(_rows(part, "part_rows") for part in parts)
            for part, shape in zip(self.REPRESENTATION.parts, checked_rows, strict=True):
                if len(shape) != len(part.axes) - 1:
                    raise TypeError(f"output_rows: expected a length for each of {part.axes[:-1]}, got {shape}")
            return checked_rows

    def _expected_rows(self, rows: Rows) -> tuple[Rows, ...]:
        self.__rows[rows] = expected = self.part_rows(rows)
        return expected

    def state_size(self, rows: Rows) -> int:
        with self._locating("state_size"):
            return _whole(super().state_size(rows), "state_size")

    def required_input(self, frames: int) -> int:
        return frames  # `process` of a plugin may buffer in another way than its base class

    def output_count(self, count: int) -> int:
        with self._locating("output_count"):
            return _whole(super().output_count(count), "output_count")


def plugin_of(stage: Stage | type[Stage]) -> str:
    """Return the kind and the file of the plugin of a stage; empty for a built-in stage."""
    kind = stage if isinstance(stage, type) else type(stage)
    return kind.describe_plugin() if issubclass(kind, CheckedStage) else ""
