"""Onset and offset maps: binary maps of where transients are that several neighbouring channels share.

M. Turgeon, A. S. Bregman and P. A. Ahad (2002), "Rhythmic masking release: contribution of cues for perceptual
organization to the cross-spectral fusion of concurrent narrow-band noises", J. Acoust. Soc. Am. 111, 1819-1831.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.rounding import MAX_SAMPLES, round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

# Frames that stay known after they were put out, or as many as the look-ahead if that is more: a change may make the
# windows of the frames to come longer.
KEPT = 512
TOUCHING = np.ones((3, 3))  # neighbours of a unit in time and channel, at the corners too

PARAMETERS = (
    Parameter("trm_minStrengthdB", "double", 3.0, "Weaker transients are ignored (dB)", 0.0, 1000.0, unit="dB"),
    Parameter("trm_minSpread", "unsigned long", 5, "Least number of units that hang together", 1, 1024),
    Parameter(
        "trm_fuseWithinSec",
        "double",
        0.03,
        "Of transients closer than this in a channel only the strongest stays (s)",
        0.0,
        10.0,
        unit="s",
    ),
    Parameter(
        "trm_minValuedB",
        "double",
        -2000.0,
        "Transients are ignored where the ratemap's level is below this (dB); -2000: nowhere",
        -2000.0,
        1000.0,
        unit="dB",
    ),
)


class _Map(Stage):
    """1 where a transient is and 0 elsewhere, (2, C, F) to (2, C, F - H).

    For a stretch of frames, with q = round(trm_fuseWithinSec rate):

    1. Strengths below trm_minStrengthdB count as 0, and so do those where the ratemap's level, 10 log10 R, is below
       trm_minValuedB.
    2. Transients are the peaks of each channel: units with a rise before and a fall after, inside the stretch. Of a
       plateau, it is the one in the middle, or before that.
    3. Where q is more than 2, each stays, from the strongest to the weakest and of equals the earlier first, if it is q
       or more frames from all that stay.
    4. Those that touch, at corners too, form fragments; fragments of fewer than trm_minSpread units are removed.

    Frame k is that of the stretch from max(0, k - H) to k + H with H = 2 q + trm_minSpread - 1. (So with q = 0 and
    trm_minSpread = 1 nothing stays: one frame has no peaks.) Nothing begins anew when a parameter changes: the next
    frame put out is the first that was not yet. Other channels do mean a new beginning, without the frames held back.
    """

    _fuse: int  # q
    _rows: tuple[int, ...] = ()  # of the blocks
    _past = 0  # frames in the buffer that have been put out

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._buffer = FrameBuffer()  # of strengths and levels, (2, 2, C)
        super().__init__(input_format, **parameters)

    @property
    def required_extra(self) -> str:
        # also while the levels do not matter: they may, after a change, for the frames that are here already
        return "level"

    @property
    def look_ahead(self) -> int:
        return 2 * self._fuse + int(self.values["trm_minSpread"]) - 1

    def state_size(self, rows: tuple[int, ...]) -> int:
        frames = self.look_ahead + max(self.look_ahead, KEPT)
        return 4 * math.prod(rows) * frames  # strengths and levels, in a store of up to twice as many

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        strengths = self._as_valid_block(block)
        if extra is None or np.shape(extra) != strengths.shape:
            raise ValueError("level: wanted is one of the shape of the block")
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
        surplus = max(0, self._past - max(reach, KEPT))
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
        frames = values["trm_fuseWithinSec"] * self.input_format.rate
        if frames > MAX_SAMPLES:
            raise ValueError(f"trm_fuseWithinSec: too long, {frames:.6g} frames")
        self._fuse = round_half_away(frames)


class OnsetMap(_Map):
    __doc__ = _Map.__doc__

    REPRESENTATION = Representation(
        kind="onsetMap",
        doc="Onset map",
        parent="onsetStrength",
        axes=("ear", "channel", "time"),
        parameters=PARAMETERS,
        port_doc="Onset maps, 0 or 1",
    )


class OffsetMap(_Map):
    __doc__ = _Map.__doc__

    REPRESENTATION = Representation(
        kind="offsetMap",
        doc="Offset map",
        parent="offsetStrength",
        axes=("ear", "channel", "time"),
        parameters=PARAMETERS,
        port_doc="Offset maps, 0 or 1",
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
    """The frames of a map from `first` on, `output` (2, C, F), of strengths and levels (2, C, n), as `_Map` says.

    Each is made from those that lie up to `reach` frames from it; n is at least first + F + reach. `thresholds` are the
    least strength and the least level; a `fuse` of 0 leaves all peaks.
    """
    heard = np.where((strengths < thresholds[0]) | (levels < thresholds[1]), 0.0, strengths)
    for frame in range(output.shape[-1]):
        middle = min(first + frame, reach)
        stretch = heard[..., first + frame - middle : first + frame + reach + 1]
        for ear, of_ear in enumerate(stretch):
            output[ear, :, frame] = whole(of_ear, fuse, spread)[:, middle] if of_ear[:, middle].any() else 0.0


def whole(strengths: FloatArray, fuse: int, spread: int) -> NDArray[np.bool_]:
    """Steps 2 to 4 of `_Map` on strengths (C, n): which units stay, (C, n)."""
    transients = np.zeros(strengths.shape, bool)
    for of_channel, stays in zip(strengths, transients, strict=True):
        peaks, _ = scipy.signal.find_peaks(of_channel)
        for peak in peaks[np.lexsort((peaks, -of_channel[peaks]))]:  # the strongest first, of equals the earlier
            if not stays[max(0, peak - max(0, fuse - 1)) : peak + max(1, fuse)].any():
                stays[peak] = True
    fragments, _ = scipy.ndimage.label(transients, TOUCHING)
    large = np.bincount(fragments.ravel()) >= spread
    large[0] = False
    kept: NDArray[np.bool_] = large[fragments]
    return kept
