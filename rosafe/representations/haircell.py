"""The inner hair cell stage: rectification and loss of phase locking, by the models in use.

* dau: T. Dau, D. Püschel and A. Kohlrausch (1996), "A quantitative model of the 'effective' signal processing in the
  auditory system. I. Model structure", J. Acoust. Soc. Am. 99, 3615-3622
* breebart: J. Breebaart, S. van de Par and A. Kohlrausch (2001), "Binaural processing model based on contralateral
  inhibition. I. Model structure", J. Acoust. Soc. Am. 110, 1074-1088
* bernstein: L. R. Bernstein, S. van de Par and C. Trahiotis (1999), "The normalized interaural correlation: accounting
  for NoSπ thresholds obtained with Gaussian and 'low-noise' masking noise", J. Acoust. Soc. Am. 106, 870-876
* joergensen: S. Jørgensen and T. Dau (2011), "Predicting speech intelligibility based on the signal-to-noise envelope
  power ratio after modulation-frequency selective processing", J. Acoust. Soc. Am. 130, 1475-1487
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import SQUARE_TINY, TINY, FloatArray, clamp
from rosafe.dsp.sos_filter import SosFilter
from rosafe.dsp.stage import Stage

# Butterworth low-pass after the rectification: order, cutoff (Hz), how many in cascade
LOWPASS = {
    "joergensen": (1, 150.0, 1),
    "dau": (2, 1000.0, 1),
    "breebart": (1, 2000.0, 5),
    "bernstein": (2, 425.0, 1),
}
# before the low-pass; "none" where it is not named
RECTIFICATION = {
    "halfwave": "halfwave",
    "fullwave": "fullwave",
    "square": "square",
    "dau": "halfwave",
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
    dau        max(x, 0), low-pass of order 2 at 1 kHz
    breebart   max(x, 0), five low-passes of order 1 at 2 kHz, together 3 dB down at 770 Hz
    bernstein  max(envelope**-0.77 x, 0)**2, low-pass of order 2 at 425 Hz; 0 where there is no envelope
    ========== ===================================================================================================

    All low-passes are Butterworth filters by the bilinear transform with prewarping. The envelope is the filterbank's
    (`GammatoneBank`, `DrnlBank`), sample by sample: the result does not depend on blocks, as that of an FFT would.
    ValueError where a low-pass would lie at or above half the sample rate.
    """

    REPRESENTATION = Representation(
        kind="ihc",
        doc="Inner hair cell representation",
        parent="gammatone",
        axes=("ear", "channel", "time"),
        parameters=(Parameter("ihc_method", "string", "dau", "The IHC method name", choices=METHODS, fallback="dau"),),
        name_doc="The name of this activity",
        port_doc="What each inner hair cell processor put out",
        word="innerhaircell",
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
            raise ValueError(f"envelope: {method} needs one of the shape of the block")
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
                raise ValueError(f"ihc_method: {method} needs a sample rate above {2 * cutoff:.12g} Hz")
            sections = np.tile(scipy.signal.butter(order, cutoff, fs=self.sample_rate, output="sos"), (times, 1))
        self._lowpass = SosFilter(sections)


def compressed(samples: FloatArray, envelope: FloatArray) -> FloatArray:
    """max(envelope**-0.77 samples, 0)**2, 0 where there is no envelope."""
    result = np.power(envelope, COMPRESSION, out=np.zeros_like(envelope), where=envelope >= TINY)
    result *= samples
    # the bound tells only where an envelope is smaller by far than the signal it is said to belong to
    return np.square(clamp(np.maximum(result, 0.0, out=result), SQUARE_TINY))
