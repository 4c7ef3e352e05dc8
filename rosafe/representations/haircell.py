"""The inner hair cell stage: rectification and loss of phase locking, by one of several models."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import SQUARE_TINY, TINY, FloatArray, clamp
from rosafe.dsp.sos_filter import SosFilter
from rosafe.dsp.stage import Stage

# Butterworth low-pass after the rectification: order, cutoff (Hz), number in cascade
LOWPASS = {
    "joergensen": (1, 150.0, 1),
    "dau": (2, 1000.0, 1),
    "dau1996": (1, 1000.0, 1),
    "breebart": (1, 2000.0, 5),
    "bernstein": (2, 425.0, 1),
}
# before the low-pass; "none" for other methods
RECTIFICATION = {
    "halfwave": "halfwave",
    "fullwave": "fullwave",
    "square": "square",
    "dau": "halfwave",
    "dau1996": "halfwave",
    "breebart": "halfwave",
    "bernstein": "compressed",
}
COMPRESSION = -0.77  # of bernstein
RECTIFIERS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "none": np.copy,
    "halfwave": lambda samples: np.maximum(samples, 0.0),
    "fullwave": np.abs,
    "square": lambda samples: np.square(clamp(samples, SQUARE_TINY)),
}
ENVELOPE_METHODS = ("hilbert", "joergensen", "bernstein")
METHODS = ("none", "halfwave", "fullwave", "square", "hilbert", "joergensen", "dau", "breebart", "bernstein", "dau1996")


class InnerHairCell(Stage):
    """Firing probability from basilar membrane motion, (2, C, N) to (2, C, N). A change resets the filter.

    ========== ===================================================================================================
    none       x
    halfwave   max(x, 0)
    fullwave   abs(x)
    square     x**2
    hilbert    the envelope
    joergensen envelope, low-pass of order 1 at 150 Hz
    dau        max(x, 0), low-pass of order 2 at 1 kHz, as in Two!Ears
    dau1996    max(x, 0), low-pass of order 1 at 1 kHz, as `ihc_dau1996` of the Auditory Modeling Toolbox
    breebart   max(x, 0), five low-passes of order 1 at 2 kHz, together 3 dB down at 770 Hz
    bernstein  max(envelope**-0.77 x, 0)**2, low-pass of order 2 at 425 Hz; 0 if the envelope is 0
    ========== ===================================================================================================

    All low-passes are Butterworth filters by the bilinear transform with prewarping. The envelope is an extra of the
    filterbank (`GammatoneBank`, `DrnlBank`), computed sample by sample: unlike with an FFT, the result does not depend
    on block boundaries. A low-pass at or above half the sample rate is a ValueError.
    """

    REPRESENTATION = Representation(
        kind="ihc",
        doc="Inner hair cell representation",
        parent="gammatone",
        axes=("ear", "channel", "time"),
        level=20.0,
        parameters=(Parameter.text("ihc_method", "dau", "The IHC method name", METHODS, fallback="dau"),),
        name_doc="The name of this activity",
        port_doc="Output of each inner hair cell processor",
        word="innerhaircell",
        references=(
            cite("dau1996", "half-wave rectification and low-pass at 1 kHz", ihc_method=("dau", "dau1996")),
            cite("majdak2022", "order of the low-pass", ihc_method="dau1996"),
            cite("breebaart2001", "half-wave rectification and low-pass of order 5", ihc_method="breebart"),
            cite("bernstein1999", "compression of the envelope and low-pass at 425 Hz", ihc_method="bernstein"),
            cite("jorgensen2011", "envelope and low-pass at 150 Hz", ihc_method="joergensen"),
        ),
    )

    SUPPORTS_IN_PLACE = True
    CHANNEL_INDEPENDENT = True

    @property
    def required_extra(self) -> str:
        return "envelope" if self.values["ihc_method"] in ENVELOPE_METHODS else ""

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples, envelope = self._as_valid_block(block), extra
        method = self.values["ihc_method"]
        rectification = RECTIFICATION.get(method, "none")
        if not self.required_extra:
            envelope = None
        elif envelope is None or np.shape(envelope) != samples.shape:
            raise ValueError(f"envelope: {method} requires one of the shape of the block")
        elif rectification == "compressed":
            envelope = self._as_valid_block(envelope)
        else:
            samples, envelope = self._as_valid_block(envelope), None
        if kernels.compiled():
            state = self._lowpass.ensure_state(samples.shape[:-1])
            output = self._output_array(samples.shape, out)
            kernels.rectify_and_filter(rectification, samples, envelope, self._lowpass.sections, state, output)
            return output
        if envelope is not None:
            return self._lowpass.process(compressed(clamp(samples), clamp(envelope)))
        return self._lowpass.process(RECTIFIERS[rectification](clamp(samples)))

    def reset(self) -> None:
        self._lowpass.reset()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        method = values["ihc_method"]
        sections = np.empty((0, 6))
        if method in LOWPASS:
            order, cutoff, times = LOWPASS[method]
            if cutoff >= self.sample_rate / 2:
                raise ValueError(
                    f"ihc_method: expected a sample rate above {2 * cutoff:.12g} Hz for {method}, got "
                    f"{self.sample_rate:.12g} Hz"
                )
            sections = np.tile(scipy.signal.butter(order, cutoff, fs=self.sample_rate, output="sos"), (times, 1))
        self._lowpass = SosFilter(sections)


def compressed(samples: FloatArray, envelope: FloatArray) -> FloatArray:
    """Return max(envelope**-0.77 samples, 0)**2, and 0 if the envelope is 0."""
    result = np.power(envelope, COMPRESSION, out=np.zeros_like(envelope), where=envelope >= TINY)
    result *= samples
    # the limit has an effect only if an envelope is far below its signal
    return np.square(clamp(np.maximum(result, 0.0, out=result), SQUARE_TINY))
