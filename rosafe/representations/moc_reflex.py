"""Medial olivocochlear attenuation: how much the efferent reflex turns the cochlear amplifier down.

* N. R. Clark, G. J. Brown, T. Jürgens and R. Meddis (2012), "A frequency-selective feedback model of auditory efferent
  suppression and its implications for the recognition of speech in noise", J. Acoust. Soc. Am. 132, 1535-1541
* M. C. Liberman (1988), "Response properties of cochlear efferent neurons: monaural vs. binaural stimulation and the
  effects of noise", J. Neurophysiol. 60, 1779-1798
* B. C. Backus and J. J. Guinan (2006), "Time-course of the human medial olivocochlear reflex", J. Acoust. Soc. Am. 119,
  2889-2904
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.stage import Stage

FACTORS = (-0.00012411, -0.051322, -6.3528, -206.11)  # of the cubic P(y), the attenuation in dB of a level in dB
RISE, FALL = (float(level) for level in np.sort(np.roots(np.polyder(FACTORS))))  # between these it rises
SILENCE = 1e-200  # anything that is as far below RISE


def _factor(name: str, side: str) -> Parameter:
    doc = f"External factor on the nonlinear path of the {side} side; only 1, as nothing is fed back"
    alias = name.replace("moc_ext", "moc_moc")
    return Parameter(name, "double", 1.0, doc, 0.0, 1.0, aliases=(alias,))


class Moc(Stage):
    """Attenuation in dB that the level of each channel asks for, (2, C, F) to (2, C, F); it has no state.

    y = 20 log10(R), at least moc_thresholdRatedB, and then no less than -181.858339 and no more than -93.821837 dB,
    between which P(y) = -0.00012411 y**3 - 0.051322 y**2 - 6.3528 y - 206.11 rises; the attenuation is P(y), no less
    than 0 and no more than moc_maxAttenuationdB. Where R is 0 or less, it is 0.

    Made for a DRNL filterbank with calibrated level. The attenuation is put out and not fed back to the filterbank;
    factors other than 1 would act there only, and are refused.
    """

    REPRESENTATION = Representation(
        kind="moc",
        doc="Medial olivocochlear attenuation",
        parent="ratemap",
        axes=("ear", "channel", "time"),
        unit="dB",
        parameters=(
            _factor("moc_extIpsi", "same"),
            _factor("moc_extContra", "other"),
            Parameter(
                "moc_thresholdRatedB",
                "double",
                -180.0,
                "Ratemap level below which there is no more change (dB)",
                -1000.0,
                0.0,
                aliases=("moc_mocThresholdRatedB",),
                unit="dB",
            ),
            Parameter(
                "moc_maxAttenuationdB",
                "double",
                40.0,
                "Greatest attenuation (dB)",
                0.0,
                200.0,
                aliases=("moc_mocMaxAttenuationdB",),
                unit="dB",
            ),
        ),
        port_doc="Attenuations (dB)",
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = self._as_valid_block(block)
        levels = 20 * np.log10(np.maximum(rates, SILENCE))
        np.minimum(np.maximum(levels, self._least, out=levels), FALL, out=levels)
        attenuation = np.full(levels.shape, FACTORS[0])
        for factor in FACTORS[1:]:
            attenuation *= levels
            attenuation += factor
        np.minimum(np.maximum(attenuation, 0.0, out=attenuation), self._most, out=attenuation)
        attenuation[rates <= 0] = 0.0
        return attenuation

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        for name in ("moc_extIpsi", "moc_extContra"):
            if values[name] != 1:
                raise ValueError(f"{name}: {values[name]:.12g} is not 1, and the attenuation is not fed back")
        self._least = max(RISE, values["moc_thresholdRatedB"])
        self._most = values["moc_maxAttenuationdB"]
