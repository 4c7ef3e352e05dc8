"""The inner hair cell stage: rectification and loss of phase locking, by the models in use."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from scipy import signal

from .cascade import Cascade
from .checks import word
from .guard import LIMIT, FloatArray, limited
from .stage import Parameter, ParameterTable, Stage

# Butterworth low-pass after the rectification: order, cutoff (Hz), how many in cascade
LOWPASS = {
    "joergensen": (1, 150.0, 1),
    "dau": (2, 1000.0, 1),
    "breebart": (1, 2000.0, 5),
    "bernstein": (2, 425.0, 1),
}
ENVELOPE_METHODS = ("hilbert", "joergensen", "bernstein")
METHODS = ("none", "halfwave", "fullwave", "square", "hilbert", "joergensen", "dau", "breebart", "bernstein")


class InnerHairCell(Stage):
    """Firing probability from basilar membrane motion, (2, C, N) to (2, C, N). A change starts the filter anew.

    ========== ===================================================================================================
    none       x
    halfwave   max(x, 0)
    fullwave   abs(x)
    square     x**2
    hilbert    the envelope
    joergensen envelope, low-pass of order 1 at 150 Hz
    dau        max(x, 0), low-pass of order 2 at 1 kHz (Dau et al. 1996)
    breebart   max(x, 0), five low-passes of order 1 at 2 kHz (Breebaart et al. 2001)
    bernstein  max(envelope**-0.77 x, 0)**2, low-pass of order 2 at 425 Hz (Bernstein et al. 1999); 0 without envelope
    ========== ===================================================================================================
    """

    PARAMETERS: ClassVar[ParameterTable] = {"ihc_method": Parameter("dau", word(*METHODS))}

    @property
    def needs_envelope(self) -> bool:
        """Whether `process` must be given the filterbank's envelope."""
        return self._values["ihc_method"] in ENVELOPE_METHODS

    def process(self, block: FloatArray, envelope: FloatArray | None = None) -> FloatArray:
        """As `Stage.process`; `envelope` is that of `block`, of the same shape, for the methods that need it."""
        samples = limited(self._checked(block))
        if self.needs_envelope:
            if envelope is None or np.shape(envelope) != samples.shape:
                raise ValueError(f"envelope: {self._values['ihc_method']} needs one of the shape of the block")
            rectified = self._from_envelope(samples, limited(self._checked(envelope)))
        else:
            rectified = self._from_samples(samples)
        return rectified if self._lowpass is None else self._lowpass.process(rectified)

    def reset(self) -> None:
        if self._lowpass is not None:
            self._lowpass.reset()

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        lowpass = None
        if values["ihc_method"] in LOWPASS:
            order, cutoff, times = LOWPASS[values["ihc_method"]]
            if cutoff >= self.sample_rate / 2:
                raise ValueError(f"ihc_method: {values['ihc_method']} needs a sample rate above {2 * cutoff:.12g} Hz")
            lowpass = Cascade(np.tile(signal.butter(order, cutoff, fs=self.sample_rate, output="sos"), (times, 1)))
        self._lowpass = lowpass

    def _from_samples(self, samples: FloatArray) -> FloatArray:
        method = self._values["ihc_method"]
        if method == "none":
            return samples.copy()
        if method == "fullwave":
            return np.abs(samples)
        if method == "square":
            return np.square(samples)
        return np.maximum(samples, 0.0)

    def _from_envelope(self, samples: FloatArray, envelope: FloatArray) -> FloatArray:
        if self._values["ihc_method"] != "bernstein":
            return envelope.copy()
        compressed = np.power(envelope, -0.77, out=np.zeros_like(envelope), where=envelope > 0)
        compressed *= samples
        # the bound tells only where an envelope is smaller by far than the signal it is said to belong to
        return np.square(np.clip(compressed, 0.0, LIMIT, out=compressed))
