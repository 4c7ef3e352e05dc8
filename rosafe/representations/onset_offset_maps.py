"""The onset and offset map stages: binary maps of the transients that several neighbouring channels share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.rounding import check_length, round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

# Frames that remain in the buffer after their output (at least the look-ahead): an update may extend the windows of
# later frames.
MIN_HISTORY_FRAMES = 512
TOUCHING = np.ones((3, 3))  # neighbours of a unit in time and channel, including diagonal ones

PARAMETERS = (
    Parameter.real("trm_minStrengthdB", 3.0, "Weaker transients are ignored (dB)", 0.0, 1000.0, unit="dB"),
    Parameter.count("trm_minSpread", 5, "Minimum number of connected units", 1, 1024),
    Parameter.real(
        "trm_fuseWithinSec",
        0.03,
        "Among transients of a channel closer than this, only the strongest is kept (s)",
        0.0,
        10.0,
        unit="s",
    ),
    Parameter.real(
        "trm_minValuedB",
        -2000.0,
        "Transients are ignored if the ratemap's level is below this (dB); -2000: never",
        -2000.0,
        1000.0,
        unit="dB",
    ),
)


class _Map(Stage):
    """1 at transients and 0 elsewhere, (2, C, F) to (2, C, F - H).

    For a segment of frames, with q = round(trm_fuseWithinSec rate):

    1. Strengths below trm_minStrengthdB count as 0, and so do those at which the level of the ratemap, 10 log10 R, is
       below trm_minValuedB.
    2. Transients are the peaks of each channel: units with a rise before and a fall after, within the segment. The peak
       of a plateau is at its middle, rounded down.
    3. If q is more than 2, peaks are kept in order of strength, of equals the earlier first, if they are q or more
       frames from all peaks kept before.
    4. Adjacent peaks, including diagonal ones, form fragments; fragments of fewer than trm_minSpread units are removed.

    Frame k is computed from the segment from max(0, k - H) to k + H with H = 2 q + trm_minSpread - 1. (With q = 0 and
    trm_minSpread = 1 the map is empty: one frame has no peaks.) A change of a parameter keeps the state, and the next
    output frame follows the previous one. A change of the channels resets the state and drops pending frames.
    """

    _fuse: int  # q
    _rows: tuple[int, ...] = ()  # of the blocks
    _past = 0  # frames in the buffer that have been output

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._buffer = FrameBuffer()  # of strengths and levels, (2, 2, C)
        super().__init__(input_format, **parameters)

    @property
    def required_extra(self) -> str:
        # always required: after an update, the levels of frames that are in the buffer already may be needed
        return "level"

    @property
    def look_ahead(self) -> int:
        return 2 * self._fuse + int(self.values["trm_minSpread"]) - 1

    def state_size(self, rows: tuple[int, ...]) -> int:
        frames = self.look_ahead + max(self.look_ahead, MIN_HISTORY_FRAMES)
        return 4 * math.prod(rows) * frames  # strengths and levels, in an array of up to twice that size

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        strengths = self._as_valid_block(block)
        if extra is None or np.shape(extra) != strengths.shape:
            raise ValueError("level: expected one of the shape of the block")
        both = np.stack((strengths, self._as_valid_block(extra)))
        if both.shape[:-1] != self._rows:
            self._rows, self._past = both.shape[:-1], 0
        held = self._buffer.append(both)
        reach = self.look_ahead
        count = max(0, held.shape[-1] - self._past - reach)
        output = np.empty((*strengths.shape[:-1], count))
        if count > 0:
            values = self.values
            thresholds = values["trm_minStrengthdB"], values["trm_minValuedB"]
            fuse = self._fuse if self._fuse > 2 else 0
            make = kernels.transient_map if kernels.compiled() else columns
            make(held[0], held[1], self._past, reach, thresholds, fuse, values["trm_minSpread"], output)
        self._past += count
        surplus = max(0, self._past - max(reach, MIN_HISTORY_FRAMES))
        self._buffer.drop(surplus)
        self._past -= surplus
        return output

    def reset(self) -> None:
        self._buffer = FrameBuffer()
        self._past = 0

    def input_format_changed(self, before: SignalFormat) -> None:
        if self.input_format.center_frequencies != before.center_frequencies:
            self.reset()
        self.build(self.values, frozenset())

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        frames = check_length("trm_fuseWithinSec", values["trm_fuseWithinSec"] * self.input_format.rate)
        self._fuse = round_half_away(frames)


class OnsetMap(_Map):
    __doc__ = _Map.__doc__

    REPRESENTATION = Representation(
        kind="onsetMap",
        doc="Onset map",
        parent="onsetStrength",
        background="onsetStrength",
        axes=("ear", "channel", "time"),
        parameters=PARAMETERS,
        port_doc="Onset maps, 0 or 1",
        references=(cite("turgeon2002"),),
    )


class OffsetMap(_Map):
    __doc__ = _Map.__doc__

    REPRESENTATION = Representation(
        kind="offsetMap",
        doc="Offset map",
        parent="offsetStrength",
        background="offsetStrength",
        axes=("ear", "channel", "time"),
        parameters=PARAMETERS,
        port_doc="Offset maps, 0 or 1",
        references=(cite("turgeon2002"),),
    )


def columns(
    strengths: FloatArray,
    levels: FloatArray,
    first: int,
    reach: int,
    thresholds: tuple[float, float],
    fuse: int,
    spread: int,
    output: FloatArray,
) -> None:
    """Compute the frames of a map from `first` on, `output` (2, C, F), of strengths and levels (2, C, n): see `_Map`.

    Each depends on the frames up to `reach` frames from it; n is at least first + F + reach. `thresholds` are the
    minimum strength and the minimum level; a `fuse` of 0 keeps all peaks.
    """
    audible = np.where((strengths < thresholds[0]) | (levels < thresholds[1]), 0.0, strengths)
    for frame in range(output.shape[-1]):
        middle = min(first + frame, reach)
        segment = audible[..., first + frame - middle : first + frame + reach + 1]
        for ear, of_ear in enumerate(segment):
            output[ear, :, frame] = whole(of_ear, fuse, spread)[:, middle] if of_ear[:, middle].any() else 0.0


def whole(strengths: FloatArray, fuse: int, spread: int) -> NDArray[np.bool_]:
    """Return the units (C, n) that remain after steps 2 to 4 of `_Map` on strengths (C, n)."""
    transients = np.zeros(strengths.shape, bool)
    for of_channel, chosen in zip(strengths, transients, strict=True):
        peaks, _ = scipy.signal.find_peaks(of_channel)
        for peak in peaks[np.lexsort((peaks, -of_channel[peaks]))]:  # the strongest first, of equals the earlier
            if not chosen[max(0, peak - max(0, fuse - 1)) : peak + max(1, fuse)].any():
                chosen[peak] = True
    fragments, _ = scipy.ndimage.label(transients, TOUCHING)
    large = np.bincount(fragments.ravel()) >= spread
    large[0] = False
    kept: NDArray[np.bool_] = large[fragments]
    return kept
