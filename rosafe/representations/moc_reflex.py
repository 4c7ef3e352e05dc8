"""The medial olivocochlear stage: attenuation of the cochlear amplifier by the efferent reflex."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.stage import Stage

FACTORS = (-0.00012411, -0.051322, -6.3528, -206.11)  # of the cubic P(y), the attenuation in dB for a level in dB
RISE, FALL = (float(level) for level in np.sort(np.roots(np.polyder(FACTORS))))  # P rises between these levels
SILENCE = 1e-200  # any value with a level far below RISE


def _factor(name: str, side: str) -> Parameter:
    doc = f"External factor on the nonlinear path of the {side} side; only 1, as nothing is fed back"
    alias = name.replace("moc_ext", "moc_moc")
    return Parameter.real(name, 1.0, doc, 0.0, 1.0, aliases=(alias,))


class Moc(Stage):
    """Attenuation in dB for the level of each channel, (2, C, F) to (2, C, F); it has no state.

    y = 20 log10(R), raised to at least moc_thresholdRatedB, then limited to -181.858339 to -93.821837 dB, the range in
    which P(y) = -0.00012411 y**3 - 0.051322 y**2 - 6.3528 y - 206.11 rises. The attenuation is P(y), limited to 0 to
    moc_maxAttenuationdB. It is 0 if R is 0 or less.

    Designed for a DRNL filterbank with calibrated level. The attenuation is output but not fed back to the filterbank.
    Factors other than 1 would have an effect only there and are therefore a ValueError.
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
            Parameter.real(
                "moc_thresholdRatedB",
                -180.0,
                "Ratemap level below which the attenuation is constant (dB)",
                -1000.0,
                0.0,
                aliases=("moc_mocThresholdRatedB",),
                unit="dB",
            ),
            Parameter.real(
                "moc_maxAttenuationdB",
                40.0,
                "Greatest attenuation (dB)",
                0.0,
                200.0,
                aliases=("moc_mocMaxAttenuationdB",),
                unit="dB",
            ),
        ),
        port_doc="Attenuations (dB)",
        references=(
            cite("clark2012", "attenuation by the rate"),
            cite("liberman1988", "efferent responses"),
            cite("backus2006", "human reflex"),
        ),
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = self._as_valid_block(block)
        levels = 20 * np.log10(np.maximum(rates, SILENCE))
        np.minimum(np.maximum(levels, self._min_level, out=levels), FALL, out=levels)
        attenuation = np.full(levels.shape, FACTORS[0])
        for factor in FACTORS[1:]:
            attenuation *= levels
            attenuation += factor
        np.minimum(np.maximum(attenuation, 0.0, out=attenuation), self._max_attenuation, out=attenuation)
        attenuation[rates <= 0] = 0.0
        return attenuation

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        for name in ("moc_extIpsi", "moc_extContra"):
            if values[name] != 1:
                raise ValueError(f"{name}: expected 1, as the attenuation is not fed back, got {values[name]:.12g}")
        self._min_level = max(RISE, values["moc_thresholdRatedB"])
        self._max_attenuation = values["moc_maxAttenuationdB"]
