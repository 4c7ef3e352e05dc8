"""A processor of the tree as others see it: what it computes, of what, in which format, and what it has put out."""

from __future__ import annotations

from typing import Any

from rosafe.declarations.representation import Representation
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.tree.history import History, HistorySlice
from rosafe.tree.parameter_updates import ParameterUpdates
from rosafe.tree.states import StateMachine

EARS = (2,)  # leading shape of what the input takes


class Member(StateMachine):
    """What can be asked of a processor, from any thread.

    Parameters
    ----------
    name : str
        The user's name for it.
    stage : Stage
        The numerics.
    parent : Member or None
        None for the input.
    history_seconds : float
        How much of its output it remembers.

    Attributes
    ----------
    kind : str
        Its representation's.
    error : BaseException or None
        Why it came to its end.
    blocks : int
        That it has worked on.
    """

    parent: Member | None

    def __init__(self, name: str, stage: Stage, parent: Member | None, history_seconds: float) -> None:
        super().__init__(parent)
        self.name = name
        self.kind = stage.REPRESENTATION.kind
        self.error: BaseException | None = None
        self.blocks = 0
        self.changes = ParameterUpdates(stage)
        self.history = History(self.output_shapes, stage.output_format, history_seconds)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r} {self.state.value}>"

    @property
    def stage(self) -> Stage:
        """As it will be after all changes, to be asked and not to be run."""
        return self.changes.final_stage

    @property
    def representation(self) -> Representation:
        """The declaration of what it computes."""
        return self.stage.REPRESENTATION

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Leading shape of what it takes."""
        return EARS if self.parent is None else self.parent.output_shape

    @property
    def output_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Leading shape of each part of its output, such as (2, channels)."""
        return self.stage.part_rows(self.input_shape)

    @property
    def output_shape(self) -> tuple[int, ...]:
        """That of the first part, which its children take."""
        return self.stage.output_rows(self.input_shape)

    @property
    def axes(self) -> tuple[tuple[str, ...], ...]:
        """What lies along the dimensions of each part, time last."""
        return tuple(part.axes for part in self.representation.parts)

    @property
    def signal(self) -> SignalFormat:
        """The format of its output."""
        return self.stage.output_format

    @property
    def rate(self) -> float:
        """Frames of output per second."""
        return self.signal.rate

    @property
    def next_index(self) -> int:
        """Of the audio frame after the newest one that its output knows of."""
        return self.history.next_index

    def parameters(self) -> dict[str, Any]:
        """The values from the next block on, in the order of the parameter structure."""
        return self.stage.parameters

    def derived(self) -> dict[str, Any]:
        """What follows from these."""
        return self.stage.derived

    def values(self) -> dict[str, Any]:
        """Both, of one moment."""
        stage = self.stage
        return {**stage.parameters, **stage.derived}

    def take(self, reader: str) -> HistorySlice:
        """What it released since `reader` asked last, at most the history."""
        return self.history.read_new(reader)
