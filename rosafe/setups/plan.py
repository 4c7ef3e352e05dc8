"""What to do for a setup in a tree that is there already: which processors serve, and the requests for the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rosafe.dsp.signal_format import SignalFormat
from rosafe.interface import BLOCK_AND_BUFFERS, ROSAFE, ComponentError, format_value
from rosafe.representations import STAGES
from rosafe.tree.tree_planner import ExistingProcessor, ServiceCall, creation_call

from .setup import Setup, SetupProcessor


class SetupPlan(NamedTuple):
    """The names of the setup's processors in the tree (parents first), of those that are there, and what to do."""

    names: list[str]
    reused: list[str]
    steps: list[ServiceCall]


def plan(setup: Setup, found: Sequence[ExistingProcessor]) -> SetupPlan:
    """What to do for `setup` in a tree that consists of `found`.

    A processor of the same name that is the same, to the last digit, is used. There is but one input, and it is used
    under whatever name.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_existsAlready`` where one of that name is another one.
    """
    there = {p.name: p for p in found}
    sample_rate = next((p.rate for p in found if not p.parent), 0.0)
    names: dict[str, str] = {}  # in the tree, of those in the setup
    reused, steps = [], []
    for wanted in setup.processors:
        parent = names.get(wanted.parent, "")
        same = there.get(wanted.name)
        if not wanted.parent:
            same = next((p for p in found if not p.parent and p.kind == wanted.kind), same)
        if same is None:
            names[wanted.name] = wanted.name
            steps += creation_call(wanted.level, wanted.name, parent, wanted.input_values)
        else:
            _compare(wanted, parent, same, sample_rate)
            names[wanted.name] = same.name
            reused.append(same.name)
    return SetupPlan(list(names.values()), reused, steps)


def _compare(wanted: SetupProcessor, parent: str, there: ExistingProcessor, sample_rate: float) -> None:
    """Return where `there` is what is wanted, else raise e_existsAlready with the difference."""
    if there.kind != wanted.kind:
        _refuse(there, f"is of kind {there.kind}, in the setup of kind {wanted.kind}")
    if there.parent != parent:
        _refuse(there, f"hangs on {there.parent!r}, in the setup on {wanted.parent!r}")
    if not wanted.parent:
        for p in BLOCK_AND_BUFFERS:
            value = wanted.input_values[p.name]
            if there.values.get(p.name, value) != value:
                _differs(there, p.name, value)
    if not wanted.level.matches(there, sample_rate):
        told: Mapping[str, Any] = wanted.level.in_force
        first = [*wanted.given, *told]  # what the setup says itself tells most
        name = next(name for name in first if name in told and there.values[name] != told[name])
        _differs(there, name, told[name])


def _differs(there: ExistingProcessor, name: str, value: Any) -> None:
    _refuse(there, f"has {name} {format_value(there.values.get(name))[:80]}, in the setup {format_value(value)[:80]}")


def _refuse(there: ExistingProcessor, how: str) -> None:
    what = f"{there.name!r} is there already and {how}: remove it first (the input: Stop), or load another setup"
    raise ROSAFE.error("e_existsAlready", what=what)


def dry_run(setup: Setup, sample_rate: float) -> None:
    """Whether all processors of `setup` can be made for sound of `sample_rate` (Hz): ComponentError where not."""
    formats: dict[str, SignalFormat | float] = {"": float(sample_rate)}
    providers: dict[str, Sequence[str]] = {"": ()}
    for wanted in setup.processors:
        try:
            stage = STAGES[wanted.kind](formats[wanted.parent], **wanted.values)
            if stage.required_extra and stage.required_extra not in providers[wanted.parent]:
                raise ValueError(f"it needs the {stage.required_extra} of {wanted.parent!r}, which has none")
        except ValueError as problem:
            raise refused(f"{wanted.name!r} at {sample_rate:g} Hz: {problem}") from None
        formats[wanted.name], providers[wanted.name] = stage.output_format, stage.EXTRAS


def refused(why: str) -> ComponentError:
    """The component's exception for a setup that cannot be."""
    return ROSAFE.error("e_badNewValue", what=why)
