"""Plan how to load a setup into an existing tree: the processors to reuse, and those to create."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rosafe.dsp.signal_format import SignalFormat
from rosafe.interface import ROSAFE, format_value
from rosafe.representations import STAGES
from rosafe.tree.tree_planner import ExistingProcessor, NewProcessor, TreePlan

from .setup import Setup, SetupProcessor


def plan(setup: Setup, existing: Sequence[ExistingProcessor]) -> TreePlan:
    """Return the plan for `setup` in a tree that consists of the `existing` processors.

    A processor is reused if its name and all its values are the same, to the last digit. A tree has only one input,
    which is reused under any name.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_existsAlready`` if the tree has a different processor of the same name.
    """
    by_name = {p.name: p for p in existing}
    tree_input = next((p for p in existing if not p.parent), None)
    sample_rate = tree_input.rate if tree_input else 0.0
    names: dict[str, str] = {}  # from the setup to the tree
    steps: list[NewProcessor] = []
    for processor in setup.processors:
        parent = names.get(processor.parent, "")
        same = by_name.get(processor.name)
        if not processor.parent and tree_input is not None and tree_input.kind == processor.kind:
            same = tree_input
        if same is None:
            names[processor.name] = processor.name
            steps.append(processor.spec.creation(processor.name, parent, processor.input_values))
        else:
            difference = _difference(processor, parent, same, sample_rate)
            if difference:
                advice = "remove it first (the input: Stop), or load another setup"
                raise ROSAFE.error("e_existsAlready", what=f"{same.name!r} exists already and {difference}; {advice}")
            names[processor.name] = same.name
    return TreePlan(list(names.values()), steps)


def _difference(processor: SetupProcessor, parent: str, existing: ExistingProcessor, sample_rate: float) -> str:
    """Return how `existing` differs from the setup's `processor`, whose parent is `parent` in the tree; '' if equal."""
    if existing.kind != processor.kind:
        return f"is of kind {existing.kind}, in the setup of kind {processor.kind}"
    if existing.parent != parent:
        return f"is a child of {existing.parent!r}, in the setup of {processor.parent!r}"
    if not processor.parent:
        for name, value in processor.input_values.items():
            if existing.values.get(name, value) != value:
                return _other_value(existing, name, value)
    if processor.spec.matches(existing, sample_rate):
        return ""
    effective = processor.spec.effective
    names = [*processor.explicit, *effective]  # a value that the setup contains is the most informative
    name = next(name for name in names if name in effective and existing.values[name] != effective[name])
    return _other_value(existing, name, effective[name])


def _other_value(existing: ExistingProcessor, name: str, value: Any) -> str:
    return f"has {name} {format_value(existing.values.get(name))[:80]}, in the setup {format_value(value)[:80]}"


def dry_run(setup: Setup, sample_rate: float) -> None:
    """Raise ComponentError if a processor of `setup` cannot be created for sound of `sample_rate` (Hz)."""
    formats: dict[str, SignalFormat | float] = {"": float(sample_rate)}
    extras: dict[str, Sequence[str]] = {"": ()}
    for processor in setup.processors:
        try:
            stage = STAGES[processor.kind](formats[processor.parent], **processor.values)
            if stage.required_extra and stage.required_extra not in extras[processor.parent]:
                raise ValueError(f"requires the {stage.required_extra}, which {processor.parent!r} does not provide")
        except ValueError as problem:
            what = f"{processor.name!r} at {sample_rate:g} Hz: {problem}"
            raise ROSAFE.error("e_badNewValue", what=what) from None
        formats[processor.name], extras[processor.name] = stage.output_format, stage.EXTRAS
