"""The interaural coherence stage: the height of the peak of the cross-correlation."""

from __future__ import annotations

from rosafe.declarations.literature import FALLER_2004
from rosafe.declarations.reference import Citation
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.parabolic_peak import ParabolicPeaks, PeakStage


class Ic(PeakStage):
    """Interaural coherence, (C, L, F) to (C, F): the height of the peak of the correlation.

    c[i] - (c[i-1] - c[i+1]) d / 4, with i and d as in `rosafe.representations.itd.Itd`; c[i] at the ends of the lags.
    The top of a parabola may be slightly above 1. Silence gives 0.
    """

    REPRESENTATION = Representation(
        kind="ic",
        doc="Interaural coherence",
        parent="crossCorrelation",
        axes=("channel", "time"),
        port_doc="Interaural coherences, in `left`",
        references=(Citation(FALLER_2004),),
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        return ParabolicPeaks.find(self._as_valid_block(block)).height
