"""For authors of representations: one call that tries what every stage must hold, on bare stages, without ROS."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from rosafe.dsp.guard import FloatArray
from rosafe.dsp.stage import Stage, parts_of
from rosafe.interface.signals import layout
from rosafe.representations import STAGES
from rosafe.vocabulary.parameter import Parameter

_CUTS = ([1], [7, 0, 160], [441], [3, 1000, 50])


def check_representation(
    kind: type[Stage], sample_rate: float = 16000.0, seconds: float = 0.25, **parameters: Any
) -> None:
    """Raise AssertionError, with what is wrong, unless a representation does what the tree relies on.

    How the signal is cut into blocks makes no difference (1e-9 of the largest number); a part of the signal gives a
    part of the output; the output is finite, contiguous float64, of the shape and number of frames that the stage says;
    silence is no trouble; what is refused changes nothing, nor does a change of a copy; `reset` is a new beginning.

    Parameters
    ----------
    kind : type
        A subclass of Stage with a declaration; what it hangs on is known, as a built-in one or as a plugin.
    sample_rate : float
        Of the sound (Hz).
    seconds : float
        How much sound it is tried on.
    **parameters
        Of the representation, in the place of its defaults.
    """
    trial = _Trial(kind, sample_rate, parameters)
    sound = _sound(int(seconds * sample_rate))
    whole = trial.run(sound, [sound.shape[-1]])
    trial.look_at(whole, sound.shape[-1])
    for cuts in _CUTS:
        _assert_equal(trial.run(sound, cuts), whole, f"the output depends on blocks: cut into {cuts}")
    part = trial.run(sound[:, : sound.shape[-1] // 2], [100])
    _assert_equal(part, [w[..., : p.shape[-1]] for p, w in zip(part, whole, strict=True)], "later sound changes frames")
    trial.look_at(trial.run(np.zeros_like(sound), [500]), sound.shape[-1])
    for parameter in kind.REPRESENTATION.parameters:
        trial.refuse(parameter)
    trial.copy_and_reset(sound)


class _Trial:
    """A stage on its parents."""

    def __init__(self, kind: type[Stage], sample_rate: float, parameters: dict[str, Any]) -> None:
        layout(kind.REPRESENTATION)
        self.kind, self.sample_rate, self.parameters = kind, sample_rate, parameters

    def stages(self) -> list[Stage]:
        """New ones, from the input to the one that is tried."""
        line: list[type[Stage]] = [self.kind]
        while parent := line[0].REPRESENTATION.parent:
            line.insert(0, STAGES[parent])
        made = [line[0](self.sample_rate, **({"in_doNormalize": False} if len(line) > 1 else self.parameters))]
        for stage in line[1:]:
            made.append(stage(made[-1].output_format, **(self.parameters if stage is self.kind else {})))
        return made

    def run(self, sound: FloatArray, sizes: Sequence[int], stages: list[Stage] | None = None) -> list[FloatArray]:
        """The parts of the output, joined."""
        stages = stages or self.stages()
        for parent, child in itertools.pairwise(stages):
            parent.provide = frozenset({child.required_extra} - {""})
        pieces, at, turn = [], 0, 0
        while at < sound.shape[-1] or turn < len(sizes):
            size = sizes[turn % len(sizes)]
            data: Any = stages[0].process(sound[:, at : at + size])
            for parent, stage in itertools.pairwise(stages):
                data = stage.process(parts_of(data)[0], parent.provided.get(stage.required_extra))
            pieces.append(parts_of(data))
            at, turn = at + size, turn + 1
        return [np.concatenate(arrays, axis=-1) for arrays in zip(*pieces, strict=True)]

    def look_at(self, output: list[FloatArray], frames: int) -> None:
        """Shape, type and numbers."""
        stages = self.stages()
        rows: tuple[int, ...] = (2,)
        for stage in stages[:-1]:
            rows, frames = stage.output_rows(rows), stage.output_count(frames)
        last = stages[-1]
        parts = self.kind.REPRESENTATION.parts
        assert len(output) == len(parts), f"{len(output)} arrays where {len(parts)} parts are declared"
        for part, wanted, array in zip(parts, last.part_rows(rows), output, strict=True):
            assert array.dtype == np.float64, f"{part.name}: {array.dtype} where float64 is wanted"
            shape = (*wanted, last.output_count(frames))
            assert array.shape == shape, f"{part.name}: shape {array.shape} where {shape} is said to come"
            assert len(shape) == len(part.axes), f"{part.name}: shape {shape} does not fit the axes {part.axes}"
            assert np.isfinite(array).all(), f"{part.name}: there are numbers that are not finite"

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

    def copy_and_reset(self, sound: FloatArray) -> None:
        """A copy that is changed, as the tree does it to try a change, leaves the stage alone; a reset one is new."""
        half = sound.shape[-1] // 2
        touched, left = self.stages(), self.stages()
        for stages in (touched, left):
            self.run(sound[:, :half], [half], stages)
        twin = copy.copy(touched[-1])
        for name, value in twin.parameters.items():
            try:
                twin.configure(**{name: value})
            except ValueError:
                continue  # what is told of a stage need not be what can be set
        one, other = (self.run(sound[:, half:], [half], stages) for stages in (touched, left))
        _assert_equal(one, other, "a change of a shallow copy alters the stage: build must make new objects")
        for stage in touched:
            stage.reset()
        _assert_equal(
            self.run(sound, [half], touched), self.run(sound, [half]), "after reset() it is not as it was when new"
        )


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
