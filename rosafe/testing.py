"""For authors of plugins: one call that tries what the tree relies on, on bare stages, without ROS."""

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
_LOUD = 2.0**31  # the samples of int32 sound that is not normalised
_LONG_SECONDS = 8.0
_MAX_BYTES = 2**25  # of the output of a parent at a limit of its parameters, for a short sound
_COST_RATE, _COST_SECONDS = 44100.0, 0.5


def check_representation(
    kind: type[Stage], sample_rate: float = 16000.0, seconds: float = 0.25, **parameters: Any
) -> dict[str, float]:
    """Raise AssertionError, with the reason, unless a representation does what the tree relies on.

    It tries blocks of different lengths, empty ones included; shape, type and contiguity of each output, finite
    numbers, the number of frames; that the input is not written, and that output and input share no memory; a change
    of each parameter and of the number of channels during the sound; parents with their parameters at their limits;
    derived values; silence, loud and long sound; values out of range; copies of the stage; `reset`.

    Parameters
    ----------
    kind : type
        A subclass of Stage with a declaration; its parent is a built-in representation or a plugin that is loaded.
    sample_rate : float
        Of the sound (Hz).
    seconds : float
        How much sound it is tried on.
    **parameters
        Of the representation, instead of its defaults.

    Returns
    -------
    dict of str to float
        Milliseconds of computing per second of sound at 44.1 kHz, by kind: this representation first, then the
        built-in ones, each without its parents.
    """
    trial = _Trial(kind, sample_rate, parameters)
    sound = _sound(int(seconds * sample_rate))
    with _asserting():
        trial.try_blocks(sound)
        trial.try_levels(sound)
        for parameter in kind.REPRESENTATION.parameters:
            trial.refuse(parameter)
            trial.change(parameter, sound)
        trial.change_channels(sound)
        trial.try_parents(sound)
        trial.copy_and_reset(sound)
        trial.try_long()
        return _costs(trial.kind, parameters)


@contextmanager
def _asserting() -> Iterator[None]:
    """Violations that are found at run time, too, are assertions here."""
    try:
        yield
    except PluginError as problem:
        raise AssertionError(str(problem)) from problem.__cause__


class _Trial:
    """A stage on its parents."""

    def __init__(self, kind: type[Stage], sample_rate: float, parameters: dict[str, Any]) -> None:
        layout(kind.REPRESENTATION)
        self.kind = _strict(kind)
        self.sample_rate, self.parameters = sample_rate, parameters

    def stages(self, above: Mapping[str, Mapping[str, Any]] | None = None) -> list[Stage]:
        """New ones, from the input to the one that is tried; `above` are parameters of parents, by kind."""
        made: list[Stage] = []
        for stage in _line(self.kind):
            values = dict((above or {}).get(stage.REPRESENTATION.kind, {}))
            if stage is self.kind:
                values |= self.parameters
            elif not made:
                values.setdefault("in_doNormalize", False)
            made.append(stage(made[-1].output_format if made else self.sample_rate, **values))
        return made

    def run(self, sound: FloatArray, lengths: Sequence[int], stages: list[Stage] | None = None) -> list[FloatArray]:
        """The parts of the output, joined."""
        stages = stages or self.stages()
        for parent, child in itertools.pairwise(stages):
            parent.provide = frozenset({child.required_extra} - {""})
        pieces, at, turn = [], 0, 0
        while at < sound.shape[-1] or turn < len(lengths):
            length = lengths[turn % len(lengths)]
            data: Any = stages[0].process(sound[:, at : at + length])
            for parent, stage in itertools.pairwise(stages):
                block = parts_of(data)[0]
                if stage is not stages[-1]:
                    data = stage.process(block, parent.provided.get(stage.required_extra))
                    continue
                before = block.copy()
                data = stage.process(block, parent.provided.get(stage.required_extra))
                assert np.array_equal(before, block, equal_nan=True), "process writes to its input"
            pieces.append(parts_of(data))
            at, turn = at + length, turn + 1
        return [np.concatenate(arrays, axis=-1) for arrays in zip(*pieces, strict=True)]

    # --- sound ---

    def try_blocks(self, sound: FloatArray) -> None:
        """How the sound is cut into blocks makes no difference (1e-9 of the largest number), nor does later sound."""
        whole = self.run(sound, [sound.shape[-1]])
        self.look_at(whole, sound.shape[-1])
        for cuts in _CUTS:
            _assert_equal(self.run(sound, cuts), whole, f"the output depends on blocks: cut into {cuts}")
        part = self.run(sound[:, : sound.shape[-1] // 2], [100])
        wanted = [w[..., : p.shape[-1]] for p, w in zip(part, whole, strict=True)]
        _assert_equal(part, wanted, "later sound changes frames")

    def try_levels(self, sound: FloatArray) -> None:
        """Silence, and loud sound."""
        for name, samples in (("silence", np.zeros_like(sound)), ("loud sound", _LOUD * sound)):
            with _trying(name):
                self.look_at(self.run(samples, [500]), sound.shape[-1])

    def try_long(self) -> None:
        """Long sound: what the stage keeps must not grow with it."""
        half = _sound(int(_LONG_SECONDS / 2 * self.sample_rate))
        stages = self.stages()
        kept = []
        for _ in range(2):
            with _trying("long sound"):
                self.run(half, [4000], stages)
            kept.append(_held(vars(stages[-1])))
        assert kept[1] < 1.5 * kept[0] + 10_000, (
            f"its state grows with the sound: {kept[0]} bytes after {_LONG_SECONDS / 2:g} s, "
            f"{kept[1]} after {_LONG_SECONDS:g} s"
        )

    def look_at(self, output: list[FloatArray], frames: int) -> None:
        """Shape and number of frames of the whole output; `checked` has looked at each block."""
        stages = self.stages()
        rows: tuple[int, ...] = (2,)
        for stage in stages[:-1]:
            rows, frames = stage.output_rows(rows), stage.output_count(frames)
        last = stages[-1]
        for part, wanted, array in zip(self.kind.REPRESENTATION.parts, last.part_rows(rows), output, strict=True):
            shape = (*wanted, last.output_count(frames))
            assert array.shape == shape, f"{part.name}: expected shape {shape} in all, got {array.shape}"
        first = last.part_rows(rows)[0]
        assert last.output_rows(rows) == first, f"output_rows: expected {first} as the first of part_rows"
        for name, value in {**last.parameters, **last.derived}.items():
            assert isinstance(format_value(value), str), f"{name}: {value!r} has no text"

    # --- parameters ---

    def refuse(self, parameter: Parameter) -> None:
        """What is out of its range is refused and changes nothing."""
        bad: list[Any] = [object(), float("nan")]
        if parameter.maximum is not None:
            bad.append(2 * abs(parameter.maximum) + 1)
        if parameter.choices:
            bad.append("no such word")
        for value in bad:
            stage = self.stages()[-1]
            before = stage.parameters
            try:
                stage.configure(**{parameter.name: value})
            except ValueError as problem:
                assert str(problem).startswith(parameter.name), f"{problem}: does not begin with {parameter.name}"
                assert stage.parameters == before, f"{parameter.name}: was changed though {value!r} was refused"
            else:
                raise AssertionError(f"{parameter.name}: {value!r} was not refused")

    def change(self, parameter: Parameter, sound: FloatArray) -> None:
        """Each other value, from the middle of the sound on."""
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

    def change_channels(self, sound: FloatArray) -> None:
        """Another number of channels, from the middle of the sound on."""
        stages = self.stages()
        bank = next((i for i, stage in enumerate(stages[:-1]) if stage.REPRESENTATION.kind == "gammatone"), None)
        if bank is None:
            return
        for channels in (5, 1, 40):
            stages = self.stages()
            half = sound.shape[-1] // 2
            self.run(sound[:, :half], [160], stages)
            stages[bank].configure(fb_nChannels=channels)
            with _trying(f"fb_nChannels = {channels} during the sound"):
                if _follow(stages[bank:]):
                    self.run(sound[:, half:], [160, 0, 7], stages)

    def try_parents(self, sound: FloatArray) -> None:
        """All parameters of the parents at their limits, one at a time."""
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

    # --- copies ---

    def copy_and_reset(self, sound: FloatArray) -> None:
        """A copy that is changed, as the tree does it to try a change, leaves the stage alone; a reset one is new."""
        half = sound.shape[-1] // 2
        touched, left = self.stages(), self.stages()
        for stages in (touched, left):
            self.run(sound[:, :half], [half], stages)
        with _trying("copy.copy of the stage"):
            twin = copy.copy(touched[-1])
            assert type(twin) is type(touched[-1]) and vars(twin).keys() == vars(touched[-1]).keys(), "it is no copy"
        for name, value in twin.parameters.items():
            try:
                twin.configure(**{name: value})
            except PluginError:
                raise
            except ValueError:
                continue  # what is reported of a stage need not be what can be set
        one, other = (self.run(sound[:, half:], [half], stages) for stages in (touched, left))
        _assert_equal(one, other, "a change of a shallow copy alters the stage: build must make new objects")
        for stage in touched:
            stage.reset()
        again, new = self.run(sound, [half], touched), self.run(sound, [half])
        _assert_equal(again, new, "after reset() it is not as it was when new")


@contextmanager
def _trying(what: str) -> Iterator[None]:
    """Name what is tried in what fails; the stage must not fail with anything."""
    try:
        yield
    except AssertionError as problem:
        raise AssertionError(f"{what}: {problem}") from problem.__cause__
    except Exception as problem:
        text = str(problem) if isinstance(problem, PluginError) else f"{type(problem).__name__}: {problem}"
        raise AssertionError(f"{what}: {text}") from problem


def _strict(kind: type[Stage]) -> type[Stage]:
    """`kind` with the checks of plugins, and without conversions."""
    if kind.REPRESENTATION.kind in BUILTIN and STAGES[kind.REPRESENTATION.kind] is kind:
        return kind
    made = checked(kind)
    return type(kind.__name__, (made,), {"CONVERTS": False, "__module__": kind.__module__})


def _line(kind: type[Stage]) -> list[type[Stage]]:
    """The stages from the input to `kind`."""
    line = [kind]
    while parent := line[0].REPRESENTATION.parent:
        line.insert(0, STAGES[parent])
    return line


def _fits(stages: Sequence[Stage]) -> bool:
    """Whether a short sound does not take too much memory at any stage."""
    rows: tuple[int, ...] = (2,)
    for stage in stages:
        if sizes.output_size(stage, rows, 0.25) > _MAX_BYTES or sizes.state_size(stage, rows) > _MAX_BYTES:
            return False
        if stage.output_format.window > stage.sample_rate:  # a second, of which there is less
            return False
        rows = stage.output_rows(rows)
    return True


def _follow(stages: Sequence[Stage]) -> bool:
    """Hand the format of the first one down; False if one refuses it, as it may."""
    for parent, child in itertools.pairwise(stages):
        try:
            child.set_input_format(parent.output_format)
        except PluginError:
            raise
        except ValueError:
            return False
    return True


def _limits(parameter: Parameter) -> list[Any]:
    """The least and the greatest value, or all words."""
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
    """Values other than the default that should be possible, or be refused by name."""
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


def _held(value: Any, depth: int = 4) -> int:
    """Bytes of the arrays and numbers that an object keeps."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if depth == 0 or isinstance(value, (str, bytes, type)) or callable(value):
        return 0
    if isinstance(value, Mapping):
        return sum(_held(one, depth - 1) for one in value.values())
    if isinstance(value, (int, float, complex)):
        return 8
    if hasattr(value, "__len__") and hasattr(value, "__iter__"):
        return sum(_held(one, depth - 1) for one in value)
    return _held(getattr(value, "__dict__", {}), depth - 1)


def _costs(kind: type[Stage], parameters: Mapping[str, Any]) -> dict[str, float]:
    """ms of computing per second of sound, of `kind` and of the built-in representations."""
    stages: dict[str, type[Stage]] = {kind.REPRESENTATION.kind: kind}
    for own in (stage for name, stage in STAGES.items() if name in BUILTIN):
        stages.setdefault(own.REPRESENTATION.kind, own)
    costs: dict[str, float] = {}
    for stage in stages.values():
        _measure(_line(stage), kind, parameters, costs)
    return {name: costs[name] for name in stages}


def _measure(
    line: list[type[Stage]], kind: type[Stage], parameters: Mapping[str, Any], costs: dict[str, float]
) -> None:
    """Add the cost of the last one of `line`; the median of blocks of 50 ms."""
    made: list[Stage] = []
    for stage in line:
        values: dict[str, Any] = dict(parameters) if stage is kind else {}
        made.append(stage(made[-1].output_format if made else _COST_RATE, **values))
    for parent, child in itertools.pairwise(made):
        parent.provide = frozenset({child.required_extra} - {""})
    frames = int(_COST_RATE / 20)
    sound = (_sound(int(_COST_SECONDS * _COST_RATE)) * _LOUD).astype(np.int32)
    taken = []
    for at in range(0, sound.shape[-1], frames):
        data: Any = sound[:, at : at + frames]
        extras: Mapping[str, FloatArray] = {}
        for one in made:
            arguments = (data, extras[one.required_extra]) if one.required_extra else (data,)
            begun = time.thread_time()
            output = one.process(*arguments)
            spent = time.thread_time() - begun
            data, extras = parts_of(output)[0], one.provided
        taken.append(spent)
    costs[line[-1].REPRESENTATION.kind] = 1e3 * float(np.median(taken)) * _COST_RATE / frames


def _sound(frames: int) -> FloatArray:
    """Noise with a stretch of silence, the right ear quieter."""
    sound = np.random.default_rng(0).standard_normal((2, frames)) * [[0.1], [0.03]]
    sound[:, frames // 3 : frames // 2] = 0
    return sound


def _assert_equal(got: list[FloatArray], wanted: list[FloatArray], what: str) -> None:
    for a, b in zip(got, wanted, strict=True):
        assert a.shape == b.shape, f"{what}: shape {a.shape} instead of {b.shape}"
        scale = max(1e-300, np.abs(b).max(initial=0.0))
        assert np.allclose(a, b, rtol=0, atol=1e-9 * scale, equal_nan=True), what
