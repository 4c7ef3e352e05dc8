"""The onset and offset strength stages: rise and fall of the level of each channel from frame to frame."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

SILENCE = 1e-200  # lower rates are raised to this: -2000 dB


def _limit(name: str, what: str) -> Parameter:
    return Parameter.positive(name, 30.0, f"Upper limit of {what} strength (dB)", 1000.0, unit="dB")


class _Strength(Stage):
    """The change of the level from frame to frame in one direction, limited, in dB; (2, C, F) to (2, C, F).

    The level 10 log10(max(R, 1e-200)) dB is provided as an extra. A change of the channels resets the last level; all
    other changes keep it.
    """

    EXTRAS = ("level",)
    RISING: ClassVar[bool]

    _last: FloatArray | None = None  # level of the last frame, (2, C, 1); None before the first frame

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = self._as_valid_block(block)
        levels: FloatArray = np.log10(np.maximum(rates, SILENCE))
        levels *= 10.0
        self.provided = {"level": levels} if "level" in self.provide else {}
        strength = np.empty(levels.shape)
        if levels.shape[-1] == 0:
            return strength
        if self._last is None or self._last.shape[:-1] != levels.shape[:-1]:
            self._last = levels[..., :1]  # the change of the first frame is 0
        before = np.concatenate((self._last, levels[..., :-1]), axis=-1)
        more, less = (levels, before) if self.RISING else (before, levels)
        np.clip(np.subtract(more, less, out=strength), 0.0, self._limit, out=strength)
        self._last = levels[..., -1:].copy()
        return strength

    def reset(self) -> None:
        self._last = None
        self.provided = {}

    def input_format_changed(self, before: SignalFormat) -> None:
        if self.input_format.center_frequencies != before.center_frequencies:
            self._last = None

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        (self._limit,) = values.values()


class OnsetStrength(_Strength):
    """The rise of the level, (2, C, F) to (2, C, F) in dB.

    min(max(L[k] - L[k-1], 0), ons_maxOnsetdB), with L the level of each channel in dB; 0 in the first frame.
    """

    REPRESENTATION = Representation(
        kind="onsetStrength",
        doc="Onset strength",
        parent="ratemap",
        axes=("ear", "channel", "time"),
        unit="dB",
        parameters=(_limit("ons_maxOnsetdB", "onset"),),
        request="OnsetProc",
        port_doc="Onset strengths (dB)",
        references=(
            cite("klapuri1999", "rise of the level in each channel"),
            cite("bregman1990", "grouping by common onset"),
        ),
    )
    RISING = True


class OffsetStrength(_Strength):
    """The fall of the level, (2, C, F) to (2, C, F) in dB.

    min(max(L[k-1] - L[k], 0), ofs_maxOffsetdB), with L the level of each channel in dB; 0 in the first frame.

    In exact silence after sound the ratemap's integrator decays: the offset is constant, 10.86 dB per frame by
    default, until the level is -2000 dB.
    """

    REPRESENTATION = Representation(
        kind="offsetStrength",
        doc="Offset strength",
        parent="ratemap",
        axes=("ear", "channel", "time"),
        unit="dB",
        parameters=(_limit("ofs_maxOffsetdB", "offset"),),
        request="OffsetProc",
        port_doc="Offset strengths (dB)",
        references=(
            cite("klapuri1999", "change of the level in each channel"),
            cite("bregman1990", "grouping by common offset"),
        ),
    )
    RISING = False
