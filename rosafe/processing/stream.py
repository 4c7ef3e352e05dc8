"""`rosafe.Stream`: the same processors for sound that arrives block by block, without threads."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.dsp.copies import OwnState
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import SAMPLE_RATE, Stage, parts_of
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_change, check_outputs, check_parameters
from rosafe.interface.remarks import rate_advice, unknown_argument, warnings_of
from rosafe.processing.chain import axis_values, computed_ears, in_place_kinds, needed
from rosafe.processing.signals import BlockReader, as_samples, check_finite, frame_times, of_ears, outputs_of
from rosafe.representations import STAGES
from rosafe.tree import sizes
from rosafe.tree.sizes import refuse_over_available

_FINISH_FRAMES = 1024  # zeros that `finish` processes at a time


class Stream(OwnState):
    """Auditory representations of sound that arrives block by block.

    The numbers are those of `rosafe.process`, to the last bit, for any block lengths. Exception: gain control
    (`pp_bNormalizeRMS`) starts with a block. (Without kernels, and with plugins, the last digits depend on the blocks
    too.) A stream must be used by one thread at a time, and starts none. Copies by `copy` and `pickle` are independent
    and continue with the same numbers.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values, such as `fb_nChannels`, as in `rosafe.process`.
    outputs : sequence of str, or str, optional
        The representations to return, as in `rosafe.process`.
    **unknown : object
        TypeError, with a hint at `parameters`.

    Raises
    ------
    ValueError
        One line that names the parameter or the output.

    Warns
    -----
    UserWarning
        As `rosafe.process`, if the window of the pitch is too short.

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
        **unknown: Any,
    ) -> None:
        if unknown:
            raise unknown_argument(next(iter(unknown)), "Stream")
        try:
            self._rate = SAMPLE_RATE.check(sample_rate)
            self._values = check_parameters(parameters)
            self._requested = outputs
            self._sound = SignalFormat.sound(self._rate)
            kinds = check_outputs(outputs)
            try:
                self._begin(kinds, {})
            except ValueError as problem:
                raise rate_advice(problem, self._rate) from None
            for text in warnings_of(self._values, kinds):
                warnings.warn(text, UserWarning, 2)
        except ValueError as problem:
            raise problem.with_traceback(None) from None

    def _begin(self, outputs: Sequence[str], stages: Mapping[str, Stage]) -> None:
        """Begin a new sound with these outputs; create those stages that are not given."""
        complete = create_stages(self._sound, self._values, needed(outputs), stages)
        self._reader = BlockReader()
        self._length = 0  # samples
        self._next = dict.fromkeys(outputs, 0)  # where each output's next frame begins, in samples
        self._install_stages(complete)

    def _install_stages(self, stages: dict[str, Stage]) -> None:
        """Replace the stages; ValueError if these would exceed the memory limits."""
        rows = _connect(stages)
        self._stages = stages
        self._rows = rows
        self._make_plan()
        self._checked_frames = 0  # of a block whose outputs are known to fit into the memory

    def _make_plan(self) -> None:
        """Prepare the loop of `process`: stages with names and axes of the outputs that are returned."""
        axes = {kind: [(name, part.axes) for name, part in KINDS[kind].outputs.items()] for kind in self._next}
        in_place = in_place_kinds(self._stages, self._next)
        self._plan = [
            (kind, KINDS[kind].parent, stage, kind in in_place, axes.get(kind, []))
            for kind, stage in self._stages.items()
        ]

    # --- sound ---

    def process(self, block: Any) -> dict[str, Any]:
        """Compute the outputs of the next block.

        Parameters
        ----------
        block : array_like, shape (2, n) or (n, 2), or (n,) or (1, n) for one ear
            Of any length. Floats, or int32 or int16, whose full scale becomes 1. All blocks have one format.

        Returns
        -------
        dict
            Each output as in `rosafe.process`, with the frames that this block has completed (possibly none), and
            `<kind>_time`, the middle of each since the first sample (s).

        Raises
        ------
        ValueError
            For a block of the wrong shape or type, or with samples that are not finite; the stream is unchanged.
        """
        try:
            samples = self._accept(block)
        except ValueError as problem:
            raise problem.with_traceback(None) from None
        if self._reader.warning:
            warnings.warn(self._reader.warning, UserWarning, stacklevel=2)
        self._length += samples.shape[1]
        return self._compute(samples)

    def _compute(self, samples: np.ndarray) -> dict[str, Any]:
        """Compute the outputs of valid samples."""
        ears = self._reader.ears
        computed: dict[str, Any] = {"": np.broadcast_to(samples, (self._sound.ears, samples.shape[1]))}
        times: dict[Any, np.ndarray] = {}  # most outputs share those of another one
        results: dict[str, Any] = {}
        for kind, above, stage, in_place, axes in self._plan:
            data, required = computed[above], stage.required_extra
            extra = self._stages[above].provided[required] if required else None
            if in_place:
                parts = parts_of(stage.process(data, extra, data))
            else:
                parts = parts_of(stage.process(data, extra) if required else stage.process(data))
            computed[kind] = parts[0]
            if not axes:
                continue
            for (name, along), data in zip(axes, parts, strict=True):
                results[name] = of_ears(ears, along, data)
            first, count, hop = self._next[kind], parts[0].shape[-1], stage.output_format.hop
            key = first, count, hop, stage.output_format.window
            if key not in times:
                times[key] = frame_times(stage.output_format, first, count)
            results[f"{kind}_time"] = times[key]
            self._next[kind] = first + count * hop
        return results

    def finish(self) -> dict[str, Any]:
        """Complete the last frames with zeros; the next block begins a new sound, as after `reset`.

        Returns
        -------
        dict
            As of `process`: the frames that begin within the sound and were not complete. With them, each framed output
            has ceil(N / hop) frames of N samples, with the bits of `rosafe.process` with `pad=True`.
        """
        pieces = [self._compute(np.zeros((self._reader.ears or 2, 0)))]
        while any(start < self._length for start in self._next.values()):
            starts = dict(self._next)
            piece = self._compute(np.zeros((self._reader.ears, _FINISH_FRAMES)))
            for kind, start in starts.items():
                kept = max(0, -((start - self._length) // self._stages[kind].output_format.hop))
                for name in (*KINDS[kind].outputs, f"{kind}_time"):
                    piece[name] = piece[name][..., :kept]
            pieces.append(piece)
        self.reset()
        return {name: np.concatenate([piece[name] for piece in pieces], axis=-1) for name in pieces[0]}

    def _accept(self, block: Any) -> np.ndarray:
        """Return the samples of a block, (ears, n). The first block sets the format of all."""
        reader, first = self._reader, not self._reader.ears
        view = reader.view(block)
        outputs = outputs_of(len(view), self._requested) if first else list(self._next)
        stages = {kind: self._stages[kind] for kind in needed(outputs)} if first else self._stages
        if view.shape[1] > self._checked_frames:
            self._check_size(stages, view.shape[1])
        samples = as_samples(view)
        check_finite(samples)
        # the block is valid: state changes from here on
        self._checked_frames = max(self._checked_frames, view.shape[1])
        reader.accept(block, view)
        if first:
            self._next, self._stages = dict.fromkeys(outputs, 0), stages
            self._sound = SignalFormat.sound(self._rate, computed_ears(len(view), outputs))
            for kind, stage in stages.items():
                stage.set_input_format(_input_format(kind, stages, self._sound))
            self._rows = _connect(stages)
            if "in_doNormalize" not in self._values and reader.whole != stages["input"].parameters["in_doNormalize"]:
                stages["input"].configure(in_doNormalize=reader.whole)
            self._make_plan()
        return samples

    def _check_size(self, stages: Mapping[str, Stage], frames: int) -> None:
        seconds = frames / self._rate
        size = sum(sizes.output_size(s, self._rows[KINDS[kind].parent], seconds) for kind, s in stages.items())
        refuse_over_available(size, "block", "process shorter blocks, or take fewer channels or lags")

    def reset(self) -> None:
        """Return to the state before the first block. Parameters are kept; the next block may have another format."""
        stages = {kind: copy.copy(stage) for kind, stage in self._stages.items()}
        for stage in stages.values():
            stage.reset()
        self._begin(check_outputs(self._requested), stages)

    # --- parameters ---

    def modify(self, name: str, value: Any) -> None:
        """Change a parameter before the next block.

        As in the node, only the affected state is reset. A parameter of a representation that is not computed has no
        effect.

        Parameters
        ----------
        name : str
            Such as ``rm_decaySec``.
        value : object
            Of the parameter's type.

        Raises
        ------
        ValueError
            For an unknown parameter or an invalid value; nothing is changed.
        """
        try:
            name, value = check_change(name, value)
            check_parameters({**self._values, name: value})
            changed = {kind: copy.copy(stage) for kind, stage in self._stages.items()}
            for kind, stage in changed.items():
                stage.set_input_format(_input_format(kind, changed, self._sound))
                if any(name == p.name for p in KINDS[kind].parameters):
                    stage.configure(**{name: value})
            self._install_stages(changed)
        except ValueError as problem:
            raise problem.with_traceback(None) from None
        self._values[name] = value

    def describe(self) -> dict[str, Any]:
        """Return the present parameters, axes, units and rates.

        Returns
        -------
        dict
            `sample_rate` (Hz); `parameters`, the values in effect for all processors; `axes` and `units` of each output
            by name; and the other entries that `rosafe.process` returns: `<kind>_frameRate` (Hz), `fb_cfHz` (Hz),
            `cc_lags` (s) and similar ones.
        """
        parameters: dict[str, Any] = {}
        described: dict[str, Any] = {}
        for kind, stage in self._stages.items():
            known = {**stage.parameters, **stage.derived}
            parameters.update(stage.request_values(stage.parameters))
            described.update({name: axis_values(known[name]) for name in KINDS[kind].coordinates})
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


def create_stages(
    sound: SignalFormat, values: Mapping[str, Any], kinds: Sequence[str], given: Mapping[str, Stage] | None = None
) -> dict[str, Stage]:
    """Return the stages of `kinds`, parents first, with checked `values`; those that are `given` are used."""
    stages: dict[str, Stage] = {}
    for kind in kinds:
        own = {p.name: values[p.name] for p in KINDS[kind].parameters if p.name in values}
        stages[kind] = (given or {}).get(kind) or STAGES[kind](_input_format(kind, stages, sound), **own)
    return stages


def _input_format(kind: str, stages: Mapping[str, Stage], sound: SignalFormat) -> SignalFormat:
    """Return the format of the blocks of a stage; `sound` for the input."""
    parent = stages.get(KINDS[kind].parent)
    return sound if parent is None else parent.output_format


def _connect(stages: Mapping[str, Stage]) -> dict[str, tuple[int, ...]]:
    """Check stages and let each provide the extras of its children. Return the leading shape of each output."""
    rows: dict[str, tuple[int, ...]] = {"": (stages["input"].input_format.ears,)}
    for kind, stage in stages.items():
        above = KINDS[kind].parent
        if stage.required_extra and stage.required_extra not in stages[above].EXTRAS:
            raise ValueError(f"{kind} needs the {stage.required_extra} of {above}, which has none")
        sizes.check_stage(stage, rows[above], 0.0)
        rows[kind] = stage.output_rows(rows[above])
    for kind, stage in stages.items():
        children = (child for name, child in stages.items() if KINDS[name].parent == kind)
        stage.provide = frozenset(child.required_extra for child in children) - {""}
    return rows
