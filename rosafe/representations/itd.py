"""The interaural time difference stage: the lag at which the cross-correlation has its peak."""

from __future__ import annotations

from rosafe.declarations.literature import MAY_2011
from rosafe.declarations.reference import Citation
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.parabolic_peak import ParabolicPeaks, PeakStage


class Itd(PeakStage):
    """Interaural time difference in s, (C, L, F) to (C, F); positive if the left ear lags, for sources on the right.

    (i - M + d) / fs, with i the index of the first maximum of the correlations c[0] to c[2M], and d = (c[i-1] -
    c[i+1]) / (c[i-1] - 2 c[i] + c[i+1]) / 2 the top of the parabola through it and its neighbours, 0 at both ends. The
    result is 0 if all correlations are equal, as in silence.
    """

    REPRESENTATION = Representation(
        kind="itd",
        doc="Interaural time difference",
        parent="crossCorrelation",
        axes=("channel", "time"),
        unit="s",
        port_doc="Interaural time differences (s), in `left`",
        references=(Citation(MAY_2011),),
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        correlations = self._as_valid_block(block)
        peaks = ParabolicPeaks.find(correlations)
        lags = peaks.place - correlations.shape[1] // 2 + peaks.offset
        lags[peaks.flat] = 0.0
        lags /= self.sample_rate
        return lags
