"""The input stage: sound card samples become floating point numbers."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .checks import flag, whole
from .guard import FloatArray, limited
from .stage import Parameter, ParameterTable, Stage


class Input(Stage):
    """Scaling of the samples: y = x / in_normalizeValue if in_doNormalize, else y = x. It has no state.

    Full scale of int32 becomes 1 with the default of 2**31 - 1. Samples beyond ±1e70 are taken as that, those
    below 1e-200 as 0.
    """

    PARAMETERS: ClassVar[ParameterTable] = {
        "in_doNormalize": Parameter(True, flag),
        "in_normalizeValue": Parameter(2**31 - 1, whole(1, 2**64 - 1)),
    }
    BLOCK = ("2 ears", "samples")

    def process(self, block: Any) -> FloatArray:
        """(2, N) of int32 or float to (2, N); ValueError for NaN and infinities."""
        samples = self._checked(block)
        if np.asarray(block).dtype.kind == "f":  # of whole numbers, all are finite and within the limit
            if not np.isfinite(samples).all():
                raise ValueError("block: there are samples that are not finite")
            samples = limited(samples)
        return samples / self._divisor

    def reset(self) -> None:
        """Nothing: there is no state."""

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._divisor = float(values["in_normalizeValue"]) if values["in_doNormalize"] else 1.0
