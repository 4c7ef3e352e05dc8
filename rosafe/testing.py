"""For plugin authors: one call that checks a representation on bare stages, without a tree or ROS."""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from rosafe.declarations.idl import element
from rosafe.declarations.parameter import Parameter
from rosafe.declarations.signals import layout
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.plugin_checks import PluginError, checked
from rosafe.dsp.stage import Stage, parts_of
from rosafe.interface import format_value
from rosafe.representations import BUILTIN, STAGES
from rosafe.tree import sizes

_CUTS = ([1], [7, 0, 160], [0, 0, 441], [3, 1000, 50])
_LOUD = 2.0**31  # scale of int32 samples that are not normalised
_LONG_SECONDS = 8.0
_MAX_BYTES = 2**25  # output of a parent for a short sound with a parameter at its limit
_COST_RATE, _COST_SECONDS = 44100.0, 0.5


def check_representation(
    kind: type[Stage], sample_rate: float = 16000.0, seconds: float = 0.25, **parameters: Any
) -> dict[str, float]:
    """Raise AssertionError, with the reason, unless a representation fulfils the requirements of the tree.

    It checks blocks of different lengths, including empty ones; shape, type and contiguity of each output, finite
    numbers and the number of frames; an input that is not modified and shares no memory with the output; a change of
    each parameter and of the number of channels during the sound; parents with parameters at their limits; derived
    values; silence, loud and long sound; values out of range; copies of the stage; and `reset`.

    Parameters
    ----------
    kind : type
        A subclass of Stage with a declaration. Its parent is a built-in representation or a loaded plugin.
    sample_rate : float
        Sample rate of the test sound (Hz).
    seconds : float
        Duration of the test sound.
    **parameters
        Parameters of the representation that replace its defaults.

    Returns
    -------
    dict of str to float
        Computing time by kind, without parents, in ms per second of sound at 44.1 kHz: this representation first, then
        the built-in ones.
    """
    trial = _Trial(kind, sample_rate, parameters)
    sound = _sound(int(seconds * sample_rate))
    with _asserting():
        trial.check_blocks(sound)
        trial.check_levels(sound)
        for parameter in kind.REPRESENTATION.parameters:
            trial.check_refusals(parameter)
            trial.check_change(parameter, sound)
        trial.check_channel_change(sound)
        trial.check_advice()
        trial.check_parents(sound)
        trial.check_copy_and_reset(sound)
        trial.check_long()
        return _costs(trial.kind, parameters)


@contextmanager
def _asserting() -> Iterator[None]:
    """Convert PluginError, which the run-time checks raise, to AssertionError."""
    try:
        yield
    except PluginError as problem:
        raise AssertionError(str(problem)) from problem.__cause__


class _Trial:
    """Creates and checks a stage with its parents."""

    def __init__(self, kind: type[Stage], sample_rate: float, parameters: dict[str, Any]) -> None:
        layout(kind.REPRESENTATION)
        self.kind = _strict(kind)
        self.sample_rate, self.parameters = sample_rate, parameters

    def stages(self, parent_values: Mapping[str, Mapping[str, Any]] | None = None) -> list[Stage]:
        """Create stages from the input to the checked one; `parent_values` are parameters of parents, by kind."""
        created: list[Stage] = []
        for stage in _line(self.kind):
            values = dict((parent_values or {}).get(stage.REPRESENTATION.kind, {}))
            if stage is self.kind:
                values |= self.parameters
            elif not created:
                values.setdefault("in_doNormalize", False)
            created.append(stage(created[-1].output_format if created else self.sample_rate, **values))
        return created

    def run(self, sound: FloatArray, lengths: Sequence[int], stages: list[Stage] | None = None) -> list[FloatArray]:
        """Return the parts of the output for blocks of these lengths (used cyclically), joined."""
        stages = stages or self.stages()
        for parent, child in itertools.pairwise(stages):
            parent.provide = frozenset({child.required_extra} - {""})
        pieces, first, number = [], 0, 0
        while first < sound.shape[-1] or number < len(lengths):
            length = lengths[number % len(lengths)]
            data: Any = stages[0].process(sound[:, first : first + length])
            for parent, stage in itertools.pairwise(stages):
                block = parts_of(data)[0]
                before = block.copy()
                data = stage.process(block, parent.provided.get(stage.required_extra))
                changed = stage is stages[-1] and not np.array_equal(before, block, equal_nan=True)
                assert not changed, "process writes to its input"
            pieces.append(parts_of(data))
            first, number = first + length, number + 1
        return [np.concatenate(arrays, axis=-1) for arrays in zip(*pieces, strict=True)]

    # --- sound ---

    def check_blocks(self, sound: FloatArray) -> None:
        """Check that the output depends neither on blocks (to 1e-9 of the largest number) nor on later sound."""
        whole = self.run(sound, [sound.shape[-1]])
        self.check_shapes(whole, sound.shape[-1])
        for cuts in _CUTS:
            _assert_equal(self.run(sound, cuts), whole, f"the output depends on blocks: lengths {cuts}")
        part = self.run(sound[:, : sound.shape[-1] // 2], [100])
        expected = [w[..., : p.shape[-1]] for p, w in zip(part, whole, strict=True)]
        _assert_equal(part, expected, "later sound changes earlier frames")

    def check_levels(self, sound: FloatArray) -> None:
        """Check silence and loud sound."""
        for name, samples in (("silence", np.zeros_like(sound)), ("loud sound", _LOUD * sound)):
            with _trying(name):
                self.check_shapes(self.run(samples, [500]), sound.shape[-1])

    def check_long(self) -> None:
        """Check that the state of the stage does not grow with the length of the sound."""
        half = _sound(int(_LONG_SECONDS / 2 * self.sample_rate))
        stages = self.stages()
        kept = []
        for _ in range(2):
            with _trying("long sound"):
                self.run(half, [4000], stages)
            kept.append(_memory_of(vars(stages[-1])))
        assert kept[1] < 1.5 * kept[0] + 10_000, (
            f"its state grows with the sound: {kept[0]} bytes after {_LONG_SECONDS / 2:g} s, "
            f"{kept[1]} after {_LONG_SECONDS:g} s"
        )

    def check_shapes(self, output: list[FloatArray], frames: int) -> None:
        """Check shape and number of frames of the whole output; the run-time checks have checked each block."""
        stages = self.stages()
        rows: tuple[int, ...] = (2,)
        for stage in stages[:-1]:
            rows, frames = stage.output_rows(rows), stage.output_count(frames)
        last = stages[-1]
        for part, part_rows, array in zip(self.kind.REPRESENTATION.parts, last.part_rows(rows), output, strict=True):
            shape = (*part_rows, last.output_count(frames))
            assert array.shape == shape, f"{part.name}: expected shape {shape} for the whole sound, got {array.shape}"
        first = last.part_rows(rows)[0]
        assert last.output_rows(rows) == first, f"output_rows: expected {first}, the first of part_rows"
        for name, value in {**last.parameters, **last.derived}.items():
            assert isinstance(format_value(value), str), f"{name}: {value!r} cannot be formatted as text"

    # --- parameters ---

    def check_refusals(self, parameter: Parameter) -> None:
        """Check that invalid values are refused and change nothing."""
        bad: list[Any] = [object(), float("nan")]
        if parameter.maximum is not None:
            bad.append(2 * abs(parameter.maximum) + 1)
        if parameter.choices:
            bad.append("unknown choice")
        for value in bad:
            stage = self.stages()[-1]
            before = stage.parameters
            try:
                stage.configure(**{parameter.name: value})
            except ValueError as problem:
                assert str(problem).startswith(parameter.name), f"{problem}: does not begin with {parameter.name}"
                assert stage.parameters == before, f"{parameter.name}: changed although {value!r} was refused"
            else:
                raise AssertionError(f"{parameter.name}: {value!r} was not refused")

    def check_change(self, parameter: Parameter, sound: FloatArray) -> None:
        """Check changes to other values in the middle of the sound."""
        half = sound.shape[-1] // 2
        for value in _values_of(parameter):
            stages = self.stages()
            self.run(sound[:, :half], [160], stages)
            with _trying(f"{parameter.name} = {value!r} during the sound"):
                try:
                    stages[-1].configure(**{parameter.name: value})
                    if not _fits(stages):
                        continue
                except PluginError:
                    raise
                except ValueError as problem:
                    names = tuple(p.name for p in self.kind.REPRESENTATION.parameters)
                    assert str(problem).startswith(names), f"{problem}: does not begin with the name of a parameter"
                    continue
                self.run(sound[:, half:], [160, 0, 7], stages)

    def check_channel_change(self, sound: FloatArray) -> None:
        """Check changes of the number of channels in the middle of the sound."""
        half = sound.shape[-1] // 2
        parents = [stage.REPRESENTATION for stage in self.stages()[:-1]]
        for bank, name in enumerate(declared.channel_parameter for declared in parents):
            for channels in (5, 1, 40) if name else ():
                stages = self.stages()
                self.run(sound[:, :half], [160], stages)
                stages[bank].configure(**{name: np.geomspace(100.0, 0.4 * self.sample_rate, channels)})
                with _trying(f"{channels} channels during the sound"):
                    if _follow(stages[bank:]):
                        self.run(sound[:, half:], [160, 0, 7], stages)

    def check_parents(self, sound: FloatArray) -> None:
        """Check the stage with each parameter of its parents at its limits, one at a time."""
        short = sound[:, : int(0.1 * self.sample_rate)]
        for parent in _line(self.kind)[:-1]:
            for parameter in parent.REPRESENTATION.parameters:
                for value in _limits(parameter):
                    with _trying(f"{parameter.name} = {value!r}"):
                        try:
                            stages = self.stages({parent.REPRESENTATION.kind: {parameter.name: value}})
                        except PluginError:
                            raise
                        except ValueError:
                            continue
                        if _fits(stages):
                            self.run(short, [500], stages)

    def check_advice(self) -> None:
        """Check that the declared advice accepts the parameters of the representation and of its parents."""
        if advice := self.kind.REPRESENTATION.advice:
            with _trying("advice"):
                text = advice({name: value for stage in self.stages() for name, value in stage.parameters.items()})
                assert isinstance(text, str), f"expected a text, got {text!r:.80}"

    # --- copies ---

    def check_copy_and_reset(self, sound: FloatArray) -> None:
        """Check that changes of a shallow copy do not affect the stage, and that `reset` works."""
        half = sound.shape[-1] // 2
        copied, untouched = self.stages(), self.stages()
        for stages in (copied, untouched):
            self.run(sound[:, :half], [half], stages)
        with _trying("copy.copy of the stage"):
            copied_stage = copy.copy(copied[-1])
            assert type(copied_stage) is type(copied[-1]) and vars(copied_stage).keys() == vars(copied[-1]).keys(), (
                "it is not a copy"
            )
        for name, value in copied_stage.parameters.items():
            try:
                copied_stage.configure(**{name: value})
            except PluginError:
                raise
            except ValueError:
                continue  # reported parameters need not be settable
        independent = self._deep_copy(copied)
        rest, lengths = sound[:, half:], [half // 2, 0, half]
        one, other = (self.run(rest, lengths, stages) for stages in (copied, untouched))
        _assert_equal(one, other, "a change of a shallow copy alters the stage: build must create new objects")
        if independent:
            again = self.run(rest, lengths, independent)
            _assert_equal(again, other, "a deep copy of the stage does not continue as the stage, or shares its state")
        for stage in copied:
            stage.reset()
        again, new = self.run(sound, [half], copied), self.run(sound, [half])
        _assert_equal(again, new, "after reset() the output differs from that of a new stage")

    def _deep_copy(self, stages: list[Stage]) -> list[Stage]:
        """Return deep copies of the stages; none if their state cannot be copied, such as an open file."""
        with _trying("copy.deepcopy of the stage"):
            try:
                return copy.deepcopy(stages)
            except TypeError:
                return []


@contextmanager
def _trying(subject: str) -> Iterator[None]:
    """Convert any exception to AssertionError, prefixed with the subject of the check."""
    try:
        yield
    except AssertionError as problem:
        raise AssertionError(f"{subject}: {problem}") from problem.__cause__
    except Exception as problem:
        text = str(problem) if isinstance(problem, PluginError) else f"{type(problem).__name__}: {problem}"
        raise AssertionError(f"{subject}: {text}") from problem


def _strict(kind: type[Stage]) -> type[Stage]:
    """Return `kind` with the run-time checks of plugins, but without their conversions."""
    if kind.REPRESENTATION.kind in BUILTIN and STAGES[kind.REPRESENTATION.kind] is kind:
        return kind
    return type(kind.__name__, (checked(kind),), {"CONVERTS": False, "__module__": kind.__module__})


def _line(kind: type[Stage]) -> list[type[Stage]]:
    """Return the stages from the input to `kind`."""
    line = [kind]
    while parent := line[0].REPRESENTATION.parent:
        line.insert(0, STAGES[parent])
    return line


def _fits(stages: Sequence[Stage]) -> bool:
    """Return whether the memory that each stage needs for a short sound is acceptable."""
    rows: tuple[int, ...] = (2,)
    for stage in stages:
        if sizes.output_size(stage, rows, 0.25) > _MAX_BYTES or sizes.state_size(stage, rows) > _MAX_BYTES:
            return False
        if stage.output_format.window > stage.sample_rate:  # longer than the sound: 1 s
            return False
        rows = stage.output_rows(rows)
    return True


def _follow(stages: Sequence[Stage]) -> bool:
    """Pass the format of the first stage down; False if a stage refuses it, which is allowed."""
    for parent, child in itertools.pairwise(stages):
        try:
            child.set_input_format(parent.output_format)
        except PluginError:
            raise
        except ValueError:
            return False
    return True


def _limits(parameter: Parameter) -> list[Any]:
    """Return the minimum and the maximum, or all choices."""
    if parameter.choices:
        return [[word] if element(parameter.idl) else word for word in parameter.choices]
    if parameter.idl == "boolean":
        return [False, True]
    if element(parameter.idl) or parameter.idl == "string":
        return []
    low, high = parameter.minimum, parameter.maximum
    whole = parameter.idl != "double"
    least = None if low is None else low + (1 if whole else 1e-3 * abs(parameter.default or 1)) * parameter.open_minimum
    return [int(value) if whole else value for value in (least, high) if value is not None]


def _values_of(parameter: Parameter) -> list[Any]:
    """Return values other than the default, which a stage should accept or refuse by name."""
    default = parameter.default
    if parameter.choices or parameter.idl == "boolean":
        return _limits(parameter)
    if element(parameter.idl):
        return [list(default)[:-1], [*default, *list(default)[-1:]]]
    if parameter.idl == "string":
        return [f"{default}x"]
    changed = [default + 1 if parameter.idl != "double" else 1.5 * default, default / 2]
    values = [*_limits(parameter), *(v if parameter.idl == "double" else int(v) for v in changed)]
    return [value for value in values if _is_possible(parameter, value)]


def _is_possible(parameter: Parameter, value: Any) -> bool:
    try:
        parameter.check(value)
    except ValueError:
        return False
    return True


def _memory_of(value: Any, depth: int = 4) -> int:
    """Return the bytes of the arrays and numbers in an object."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if depth == 0 or isinstance(value, (str, bytes, type)) or callable(value):
        return 0
    if isinstance(value, Mapping):
        return sum(_memory_of(one, depth - 1) for one in value.values())
    if isinstance(value, (int, float, complex)):
        return 8
    if hasattr(value, "__len__") and hasattr(value, "__iter__"):
        return sum(_memory_of(one, depth - 1) for one in value)
    return _memory_of(getattr(value, "__dict__", {}), depth - 1)


def _costs(kind: type[Stage], parameters: Mapping[str, Any]) -> dict[str, float]:
    """Return the computing time of `kind` and of the built-in representations, in ms per second of sound."""
    stages: dict[str, type[Stage]] = {kind.REPRESENTATION.kind: kind}
    for name in (name for name in STAGES if name in BUILTIN):
        stages.setdefault(name, STAGES[name])
    costs: dict[str, float] = {}
    for stage in stages.values():
        _measure(_line(stage), kind, parameters, costs)
    return {name: costs[name] for name in stages}


def _measure(
    line: list[type[Stage]], kind: type[Stage], parameters: Mapping[str, Any], costs: dict[str, float]
) -> None:
    """Add the computing time of the last stage of `line`: the median over blocks of 50 ms."""
    created: list[Stage] = []
    for stage in line:
        values: dict[str, Any] = dict(parameters) if stage is kind else {}
        created.append(stage(created[-1].output_format if created else _COST_RATE, **values))
    for parent, child in itertools.pairwise(created):
        parent.provide = frozenset({child.required_extra} - {""})
    frames = int(_COST_RATE / 20)
    sound = (_sound(int(_COST_SECONDS * _COST_RATE)) * _LOUD).astype(np.int32)
    durations = []
    for at in range(0, sound.shape[-1], frames):
        data: Any = sound[:, at : at + frames]
        extras: Mapping[str, FloatArray] = {}
        for one in created:
            arguments = (data, extras[one.required_extra]) if one.required_extra else (data,)
            started = time.thread_time()
            output = one.process(*arguments)
            seconds = time.thread_time() - started
            data, extras = parts_of(output)[0], one.provided
        durations.append(seconds)
    costs[line[-1].REPRESENTATION.kind] = 1e3 * float(np.median(durations)) * _COST_RATE / frames


def _sound(frames: int) -> FloatArray:
    """Return noise with a pause, at a lower level in the right ear."""
    sound = np.random.default_rng(0).standard_normal((2, frames)) * [[0.1], [0.03]]
    sound[:, frames // 3 : frames // 2] = 0
    return sound


def _assert_equal(got: list[FloatArray], expected: list[FloatArray], text: str) -> None:
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape, f"{text}: expected shape {b.shape}, got {a.shape}"
        scale = max(1e-300, np.abs(b).max(initial=0.0))
        assert np.allclose(a, b, rtol=0, atol=1e-9 * scale, equal_nan=True), text
