"""The public, thread-safe side of a processor: its stage, its formats, its parameters and its output."""

from __future__ import annotations

from typing import Any

from rosafe.declarations.representation import Representation
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.tree.history import History, HistorySlice
from rosafe.tree.parameter_updates import ParameterUpdates
from rosafe.tree.states import StateMachine

EARS = (2,)  # leading shape of the input's blocks


class Member(StateMachine):
    """The properties of a processor that any thread may read.

    Parameters
    ----------
    name : str
        The name given by the user.
    stage : Stage
        The computation.
    parent : Member or None
        None for the input.
    history_seconds : float
        Length of the history of its output.

    Attributes
    ----------
    kind : str
        The kind of its representation.
    error : BaseException or None
        The reason for its failure.
    blocks : int
        Number of blocks processed.
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
        """The stage after all pending parameter updates, for queries only."""
        return self.changes.final_stage

    @property
    def representation(self) -> Representation:
        """The declaration of its representation."""
        return self.stage.REPRESENTATION

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Leading shape of its input."""
        return EARS if self.parent is None else self.parent.output_shape

    @property
    def output_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Leading shape of each part of its output, such as (2, channels)."""
        return self.stage.part_rows(self.input_shape)

    @property
    def output_shape(self) -> tuple[int, ...]:
        """Leading shape of the first part, which is the input of its children."""
        return self.stage.output_rows(self.input_shape)

    @property
    def axes(self) -> tuple[tuple[str, ...], ...]:
        """The names of the dimensions of each part, time last."""
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
        """Index of the audio frame after the newest one that its output depends on."""
        return self.history.next_index

    def parameters(self) -> dict[str, Any]:
        """Return the values from the next block on, in the order of the parameter structure."""
        return self.stage.parameters

    def derived(self) -> dict[str, Any]:
        """Return the values derived from the parameters."""
        return self.stage.derived

    def values(self) -> dict[str, Any]:
        """Return parameters and derived values of the same moment."""
        stage = self.stage
        return {**stage.parameters, **stage.derived}

    def take(self, reader: str) -> HistorySlice:
        """Return the output since the last call by `reader`, at most the history."""
        return self.history.read_new(reader)
