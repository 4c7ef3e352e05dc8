"""The input stage: conversion of sound card samples to floating point numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.stage import Stage


class Input(Stage):
    """Scaling of the samples: y = x / in_normalizeValue if in_doNormalize, otherwise y = x. It has no state.

    Full scale of int32 becomes 1 with the default of 2**31 - 1. Samples beyond ±1e70 are clamped, those
    below 1e-200 become 0.
    """

    REPRESENTATION = Representation(
        kind="input",
        doc="Read the audio that comes in on the Audio port, block by block",
        axes=("ear", "time"),
        parameters=(
            Parameter.flag("in_doNormalize", True, "Flag to divide the samples by in_normalizeValue"),
            Parameter(
                "in_normalizeValue", "unsigned long long", 2**31 - 1, "Sample value that becomes 1.0", 1, 2**64 - 1
            ),
        ),
        name_doc="Name of the activity",
        port="inputProcPort",
        port_doc="Output of the input processor",
        references=(cite("twoears2018"),),
    )
    INPUT = ("ear", "time")

    def process(self, block: Any, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        """Convert (2, N) of int32 or float to (2, N). NaN and infinities are a ValueError."""
        if type(block) is np.ndarray and block.dtype == np.int32 and block.shape[:-1] == (self.input_format.ears,):
            scaled: FloatArray = np.divide(block, self._divisor, order="C")
            return scaled
        samples = self._as_valid_block(block)
        if np.asarray(block).dtype.kind == "f":  # whole numbers are always finite and within the limit
            if not np.isfinite(samples).all():
                raise ValueError("block: expected finite samples, got NaN or infinity")
            samples = clamp(samples)
        return samples / self._divisor

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._divisor = float(values["in_normalizeValue"]) if values["in_doNormalize"] else 1.0
