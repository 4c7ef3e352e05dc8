"""The interaural level difference stage."""

from __future__ import annotations

import numpy as np

from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.numeric_limits import EPSILON, FloatArray


class Ild(FramedStage):
    """Level of the right ear over the left in dB, (2, C, N) to (C, F); positive if the right ear is louder.

    10 log10((E_R + eps) / (E_L + eps)) with E = mean((window x)**2) per frame; silence gives 0 dB.
    """

    REPRESENTATION = Representation(
        kind="ild",
        doc="Interaural level difference",
        parent="ihc",
        axes=("channel", "time"),
        unit="dB",
        parameters=frame_parameters("ild"),
        port_doc="Interaural level differences (dB), in `left`",
        references=(cite("may2011"),),
    )
    prefix = "ild"
    CHANNEL_INDEPENDENT = True

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return rows[1:]

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._as_valid_block(block)
        if kernels.compiled():
            frames = self._frames(samples, self._framing.weights(squared=True))
            return kernels.level_differences(frames, EPSILON)
        energies = self._means(samples, squared=True) + EPSILON
        return 10 * np.log10(energies[1] / energies[0])
