"""The input stage: sound card samples become floating point numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.stage import Stage


class Input(Stage):
    """Scaling of the samples: y = x / in_normalizeValue if in_doNormalize, else y = x. It has no state.

    Full scale of int32 becomes 1 with the default of 2**31 - 1. Samples beyond ±1e70 are taken as that, those
    below 1e-200 as 0.
    """

    REPRESENTATION = Representation(
        kind="input",
        doc="Read the audio that comes in on the Audio port, block by block",
        axes=("ear", "time"),
        parameters=(
            Parameter("in_doNormalize", "boolean", True, "Flag to divide the samples by in_normalizeValue"),
            Parameter(
                "in_normalizeValue", "unsigned long long", 2**31 - 1, "Sample value that becomes 1.0", 1, 2**64 - 1
            ),
        ),
        name_doc="Name of the activity",
        port="inputProcPort",
        port_doc="What the input processor put out",
    )
    INPUT = ("ear", "time")

    def process(self, block: Any, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        """(2, N) of int32 or float to (2, N); ValueError for NaN and infinities."""
        samples = self._as_valid_block(block)
        if np.asarray(block).dtype.kind == "f":  # of whole numbers, all are finite and within the limit
            if not np.isfinite(samples).all():
                raise ValueError("block: there are samples that are not finite")
            samples = clamp(samples)
        return samples / self._divisor

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._divisor = float(values["in_normalizeValue"]) if values["in_doNormalize"] else 1.0
