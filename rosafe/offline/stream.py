"""`rosafe.Stream`: the same processors on sound that comes block by block, without threads."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import SAMPLE_RATE, Stage, parts_of
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_change, check_outputs, check_parameters
from rosafe.offline.chain import in_place_kinds, needed
from rosafe.offline.memory import refuse_over_available
from rosafe.offline.signals import (
    as_samples,
    check_finite,
    ears_view,
    frame_times,
    is_frames_first,
    of_ears,
    outputs_of,
)
from rosafe.representations import STAGES
from rosafe.tree import sizes

_NUMBER = "in_doNormalize"


class Stream:
    """Auditory representations of sound that comes block by block.

    The numbers are those of `rosafe.process`, to the last bit, whatever the blocks are; only where gain control
    (`pp_bNormalizeRMS`) starts depends on them. (With numpy and scipy in the place of the kernels, and in plugins, the
    last digits do, too.) A stream belongs to one thread at a time and starts none.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values, such as `fb_nChannels`, as of `rosafe.process`.
    outputs : sequence of str, or str, optional
        The representations to return, as of `rosafe.process`.

    Raises
    ------
    ValueError
        One line that names the parameter or the output.

    See Also
    --------
    rosafe.process : A whole signal at once.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> stream = rosafe.Stream(16000, {"fb_nChannels": 16}, outputs=["ild"])
    >>> for block in np.zeros((10, 2, 160)):
    ...     new = stream.process(block)
    >>> new["ild"].shape, new["ild_time"]
    ((16, 1), array([0.09]))
    """

    def __init__(
        self,
        sample_rate: float,
        parameters: Mapping[str, Any] | None = None,
        outputs: Sequence[str] | str | None = None,
    ) -> None:
        try:
            self._rate = SAMPLE_RATE.check(sample_rate)
            self._parameters = check_parameters(parameters)
            self._outputs = check_outputs(outputs)
            self._asked = outputs
            self._begin()
            self._stages: dict[str, Stage] = {}
            for kind in needed(self._outputs):
                self._stages[kind] = STAGES[kind](self._comes_to(kind, self._stages), **self._public_name(kind))
            self._install_stages(self._stages)
        except ValueError as problem:
            raise problem.with_traceback(None) from None

    def _begin(self) -> None:
        self._ears = 0  # not known yet
        self._whole = self._frames_first = False
        self._next = dict.fromkeys(self._outputs, 0)  # where each output's next frame begins, in samples

    def _comes_to(self, kind: str, stages: Mapping[str, Stage]) -> SignalFormat | float:
        parent = stages.get(KINDS[kind].parent)
        return self._rate if parent is None else parent.output_format

    def _install_stages(self, stages: dict[str, Stage]) -> None:
        """Let these stages stand in the place of those that there are; ValueError where they would fill the memory."""
        rows: dict[str, tuple[int, ...]] = {"": (2,)}
        for kind, stage in stages.items():
            above = KINDS[kind].parent
            if stage.required_extra and stage.required_extra not in stages[above].EXTRAS:
                raise ValueError(f"{kind} needs the {stage.required_extra} of {above}, which has none")
            sizes.check_stage(stage, rows[above], 0.0)
            rows[kind] = stage.output_rows(rows[above])
        for kind, stage in stages.items():
            stage.provide = frozenset(
                child.required_extra
                for name, child in stages.items()
                if child.required_extra and KINDS[name].parent == kind
            )
        self._stages = stages
        self._rows = rows
        self._lay_out()
        self._largest = 0  # frames of a block that is known to fit into the memory

    def _lay_out(self) -> None:
        """What `process` goes through for each block: names and axes only of what is returned."""
        axes = {kind: [(name, part.axes) for name, part in KINDS[kind].outputs.items()] for kind in self._stages}
        over = in_place_kinds(self._stages, self._next)
        self._plan = [
            (kind, KINDS[kind].parent, stage, kind in over, axes[kind] if kind in self._next else [])
            for kind, stage in self._stages.items()
        ]

    # --- sound ---

    def process(self, block: Any) -> dict[str, Any]:
        """What is new with the next block of sound.

        Parameters
        ----------
        block : array_like, shape (2, n) or (n, 2), or (n,) or (1, n) for one ear
            Of any length; float, or int32 or int16, whose full scale becomes 1. All blocks are of one kind.

        Returns
        -------
        dict
            Each output as `rosafe.process` returns it, with the frames that this block has completed (there may be
            none), and `<kind>_time`, the middle of each since the first sample (s).

        Raises
        ------
        ValueError
            A block of the wrong shape or type, or with samples that are not finite; nothing has happened.
        """
        try:
            samples = self._checked(block)
        except ValueError as problem:
            raise problem.with_traceback(None) from None
        made: dict[str, Any] = {"": samples if self._ears == 2 else np.broadcast_to(samples, (2, samples.shape[1]))}
        times: dict[Any, np.ndarray] = {}  # most outputs have those of another one
        results: dict[str, Any] = {}
        for kind, above, stage, over, axes in self._plan:
            data, required = made[above], stage.required_extra
            extra = self._stages[above].provided[required] if required else None
            if over:
                parts = parts_of(stage.process(data, extra, data))
            else:
                parts = parts_of(stage.process(data, extra) if required else stage.process(data))
            made[kind] = parts[0]
            if not axes:
                continue
            for (name, along), data in zip(axes, parts, strict=True):
                results[name] = of_ears(self._ears, along, data)
            first, count, hop = self._next[kind], parts[0].shape[-1], stage.output_format.hop
            key = first, count, hop, stage.output_format.window
            if key not in times:
                times[key] = frame_times(stage.output_format, first, count)
            results[f"{kind}_time"] = times[key]
            self._next[kind] = first + count * hop
        return results

    def _checked(self, block: Any) -> np.ndarray:
        """The block as (ears, n); the first one says what all will be."""
        shape = np.shape(block)
        if self._ears == 2 and shape == (1, 2):  # one frame
            block = np.transpose(block)
        view = ears_view(block, self._frames_first)
        (ears, frames), whole = view.shape, view.dtype.kind == "i"
        stages, kept = self._stages, list(self._next)
        if not self._ears:
            kept = outputs_of(ears, self._asked)
            stages = {kind: stage for kind, stage in stages.items() if kind in needed(kept)}
        elif ears != self._ears:
            raise ValueError(
                f"block has shape {shape}; those before it were of {('one ear', 'two ears')[self._ears - 1]}"
            )
        elif whole != self._whole:
            raise ValueError(f"block is of {'whole numbers' if whole else 'floats'}, and those before it were not")
        if frames > self._largest:
            self._check_size(stages, frames)
        samples = as_samples(view)
        check_finite(samples)
        # Nothing is refused from here on.
        self._largest = max(self._largest, frames)
        if len(shape) == 2 and shape != (2, 2):
            self._frames_first = is_frames_first(np.asarray(block)) or shape == (1, 2)
        if not self._ears:
            self._ears, self._whole = ears, whole
            self._next = dict.fromkeys(kept, 0)
            self._stages = stages
            if whole != stages["input"].parameters[_NUMBER] and _NUMBER not in self._parameters:
                stages["input"].configure(**{_NUMBER: whole})
            self._lay_out()
        return samples

    def _check_size(self, stages: Mapping[str, Stage], frames: int) -> None:
        seconds = frames / self._rate
        taken = [sizes.output_size(s, self._rows[KINDS[kind].parent], seconds) for kind, s in stages.items()]
        refuse_over_available(sum(taken), "block: what comes of it")

    def reset(self) -> None:
        """Back to before the first block. Parameters stay as they are, and what comes next may be of another kind."""
        stages = {kind: copy.copy(stage) for kind, stage in self._stages.items()}
        for kind in needed(self._outputs):
            if kind not in stages:  # it was left out for one ear
                stages[kind] = STAGES[kind](self._comes_to(kind, stages), **self._public_name(kind))
        for stage in stages.values():
            stage.reset()
        self._begin()
        self._install_stages({kind: stages[kind] for kind in needed(self._outputs)})

    def _public_name(self, kind: str) -> dict[str, Any]:
        return {p.name: self._parameters[p.name] for p in KINDS[kind].parameters if p.name in self._parameters}

    # --- parameters ---

    def modify(self, name: str, value: Any) -> None:
        """Change a parameter before the next block.

        It resets only what it must, as in the node. A parameter of what is not computed has no effect.

        Parameters
        ----------
        name : str
            Such as ``rm_decaySec``.
        value : object
            Of the parameter's type.

        Raises
        ------
        ValueError
            There is no such parameter, or the value cannot be; nothing has changed.
        """
        try:
            name, value = check_change(name, value)
            tried = {kind: copy.copy(stage) for kind, stage in self._stages.items()}
            for kind, stage in tried.items():
                comes = self._comes_to(kind, tried)
                if isinstance(comes, SignalFormat):
                    stage.set_input_format(comes)
                if any(name == p.name for p in KINDS[kind].parameters):
                    stage.configure(**{name: value})
            self._install_stages(tried)
        except ValueError as problem:
            raise problem.with_traceback(None) from None
        self._parameters[name] = value

    def describe(self) -> dict[str, Any]:
        """What it is at the moment.

        Returns
        -------
        dict
            `sample_rate` (Hz); `parameters`, those in force of all that is computed; `axes` and `units` of each output,
            by name; and what `rosafe.process` returns beside its outputs: `<kind>_frameRate` (Hz), `fb_cfHz` (Hz),
            `cc_lags` (s) and their like.
        """
        parameters: dict[str, Any] = {}
        described: dict[str, Any] = {}
        for kind, stage in self._stages.items():
            known = {**stage.parameters, **stage.derived}
            parameters.update(stage.parameters)
            for name in KINDS[kind].coordinates:
                words = any(isinstance(value, str) for value in known[name])
                described[name] = list(known[name]) if words else np.array(known[name], np.float64)
            if stage.output_format.framed and kind in self._next:
                described[f"{kind}_frameRate"] = stage.output_format.rate
        parts = {name: part for kind in self._next for name, part in KINDS[kind].outputs.items()}
        return {
            "sample_rate": self._rate,
            "parameters": parameters,
            "axes": {name: part.axes for name, part in parts.items()},
            "units": {name: part.unit for name, part in parts.items()},
            **described,
        }
