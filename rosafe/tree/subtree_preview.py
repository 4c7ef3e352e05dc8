"""Preview of a request: the stages that a processor and its descendants would get, and the memory that they need."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from rosafe.dsp.stage import Stage
from rosafe.tree import sizes
from rosafe.tree.processor import Processor
from rosafe.tree.sizes import Rows


class ProcessorPreview(NamedTuple):
    """A processor with the stage, and the leading shape of its input, that it would have after a request."""

    processor: Processor
    stage: Stage
    rows: Rows


def preview_subtree(processor: Processor, stage: Stage) -> list[ProcessorPreview]:
    """Return the preview of `processor` with `stage`, and those of its descendants.

    Raises ValueError if one of them rejects the request.
    """
    parent_stage = None if processor.parent is None else processor.parent.stage
    return list(_previews(processor, stage, processor.input_shape, parent_stage))


def _previews(processor: Processor, stage: Stage, rows: Rows, parent_stage: Stage | None) -> Iterator[ProcessorPreview]:
    extra = stage.required_extra
    if parent_stage is not None and extra and extra not in parent_stage.EXTRAS:
        raise ValueError(f"{processor.kind} needs the {extra} of {parent_stage.REPRESENTATION}, which has none")
    yield ProcessorPreview(processor, stage, rows)

    def preview_child(child: Processor) -> list[ProcessorPreview]:
        changed = child.changes.preview_input(stage.output_format)
        return list(_previews(child, changed, stage.output_rows(rows), stage))

    for child in list(processor.children):
        yield from child.ask(preview_child) or ()


def check_memory(previews: Sequence[ProcessorPreview], others: Iterable[Processor], seconds: float) -> None:
    """Raise ValueError if `seconds` of output of a previewed processor, or of these and all `others`, is too large."""
    planned = [(stage, rows) for _, stage, rows in previews]
    for stage, rows in planned:
        sizes.check_stage(stage, rows, seconds)
    sizes.check_all([*planned, *filter(None, [other.ask(_measured) for other in others])], seconds)


def _measured(processor: Processor) -> tuple[Stage, Rows]:
    """Return the stage and the leading shape of its input, after the stage has been asked for its sizes once."""
    stage, rows = processor.stage, processor.input_shape
    sizes.output_size(stage, rows, 0.0)
    sizes.state_size(stage, rows)
    return stage, rows
