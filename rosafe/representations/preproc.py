"""The pre-processing stage: DC removal, pre-emphasis, gain control, level scaling and middle ear, in this order."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.middle_ear import MODELS, middle_ear_fir
from rosafe.dsp.numeric_limits import SQUARE_TINY, FloatArray, clamp
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.sos_filter import HighPass, SosFilter, leaky_integrator
from rosafe.dsp.stage import Stage

DC_ORDER = 4
LEVEL_OF_RMS_1 = 100.0  # dB SPL


class PreProc(Stage):
    """Conditioning of the ear signals, (2, N) to (2, N). Any change of a parameter resets all filters.

    DC removal is a Butterworth high-pass of order 4, in normal form (`HighPass`). Level scaling multiplies by
    10**((100 - pp_refSPLdB) / 20): in the tree, an RMS of 1 corresponds to 100 dB SPL.
    """

    REPRESENTATION = Representation(
        kind="preProc",
        doc="Condition the input: DC removal, pre-emphasis, gain control, level scaling, middle ear",
        parent="input",
        axes=("ear", "time"),
        parameters=(
            Parameter.flag("pp_bRemoveDC", False, "Flag to activate the DC-removal high-pass filter"),
            Parameter.positive(
                "pp_cutoffHzDC", 20.0, "Cutoff frequency (Hz) of DC-removal high-pass filter", 1e6, unit="Hz"
            ),
            Parameter.flag("pp_bPreEmphasis", False, "Flag to activate pre-emphasis"),
            Parameter.real(
                "pp_coefPreEmphasis",
                0.97,
                "Coefficient for pre-emphasis compensation (usually between 0.9 and 1)",
                -1.0,
                1.0,
            ),
            Parameter.flag("pp_bNormalizeRMS", False, "Flag to activate binaural RMS normalization"),
            Parameter.positive(
                "pp_intTimeSecRMS", 0.5, "Time constant (s) for automatic gain control", 3600.0, unit="s"
            ),
            Parameter.flag("pp_bLevelScaling", False, "Flag to activate the level scaling"),
            Parameter.real(
                "pp_refSPLdB",
                100.0,
                "Reference dB SPL value to correspond to input signal RMS value of 1",
                -200.0,
                400.0,
                aliases=("pp_refSPLdBS",),
                unit="dB",
            ),
            Parameter.flag("pp_bMiddleEarFiltering", False, "Flag to activate middle ear filtering"),
            Parameter.text(
                "pp_middleEarModel",
                "jepsen",
                "Middle ear filter model (jepsen or lopezpoveda)",
                MODELS,
                fallback="jepsen",
                spellings={"jespen": "jepsen"},  # as in the user guide
            ),
            Parameter.flag("pp_bUnityComp", False, "Compensation to have maximum of unity gain for middle ear filter"),
        ),
        name_doc="The name of this activity",
        request="PreProc",
        port_doc="Output of each pre-processor",
        word="time",
        references=(
            cite("twoears2018", "order of the steps"),
            cite("young2006", "pre-emphasis", pp_bPreEmphasis=True),
            cite("tchorz2003", "gain control", pp_bNormalizeRMS=True),
            cite("jepsen2008", "level convention", pp_bLevelScaling=True),
            cite(
                "goode1994",
                "measurements of the middle ear",
                pp_bMiddleEarFiltering=True,
                pp_middleEarModel="lopezpoveda",
            ),
            cite("lopezpoveda2001", "middle-ear filter", pp_bMiddleEarFiltering=True, pp_middleEarModel="lopezpoveda"),
            cite("jepsen2008", "middle-ear filter", pp_bMiddleEarFiltering=True, pp_middleEarModel="jepsen"),
        ),
    )
    INPUT = ("ear", "time")

    @property
    def block_size_dependent(self) -> bool:
        return bool(self.values["pp_bNormalizeRMS"])  # see `GainControl`

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        if not self._steps and self._gain == 1.0:
            return self._as_valid_block(block).copy()
        samples = clamp(self._as_valid_block(block))
        for step in self._steps:
            samples = step.process(samples)
        return samples * self._gain

    def reset(self) -> None:
        for step in self._steps:
            step.reset()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        steps: list[HighPass | PreEmphasis | GainControl | Fir] = []
        if values["pp_bRemoveDC"]:
            cutoff = values["pp_cutoffHzDC"]
            if cutoff >= self.sample_rate / 2:
                raise ValueError(f"pp_cutoffHzDC: expected less than half the sample rate, got {cutoff:.12g} Hz")
            steps.append(HighPass(DC_ORDER, cutoff, self.sample_rate))
        if values["pp_bPreEmphasis"]:
            steps.append(PreEmphasis(abs(values["pp_coefPreEmphasis"])))
        if values["pp_bNormalizeRMS"]:
            steps.append(GainControl(values["pp_intTimeSecRMS"] * self.sample_rate))
        if values["pp_bMiddleEarFiltering"]:
            fir = middle_ear_fir(values["pp_middleEarModel"], self.sample_rate, values["pp_bUnityComp"])
            steps.append(Fir(fir))
        self._steps = steps
        # A constant factor can be applied after the middle ear as well as before it.
        self._gain = 10 ** ((LEVEL_OF_RMS_1 - values["pp_refSPLdB"]) / 20) if values["pp_bLevelScaling"] else 1.0


class PreEmphasis:
    """y[n] = x[n] - c x[n-1]."""

    def __init__(self, coefficient: float) -> None:
        self.coefficient = coefficient
        self.reset()

    def reset(self) -> None:
        self.last = np.zeros((0, 1))  # x[n-1] of each ear

    def process(self, block: FloatArray) -> FloatArray:
        """Filter (ears, N)."""
        if len(self.last) != len(block):
            self.last = np.zeros((len(block), 1))
        delayed = np.concatenate((self.last, block), axis=-1)
        self.last = delayed[:, -1:].copy()
        return block - self.coefficient * delayed[:, :-1]


class GainControl:
    """Division by the running RMS of the louder ear: y = x / max over ears of (sqrt(p) + 1e-8).

    p[n] = r p[n-1] + (1 - r) x[n]**2 with r = exp(-1 / time_constant). Each ear starts with its first block that is not
    all zero. p[-1] is the mean square of the first samples of that block, at most one time constant. This start is the
    only result in the chain that depends on block boundaries.

    Parameters
    ----------
    time_constant : float
        In samples.
    """

    FLOOR = 1e-8

    def __init__(self, time_constant: float) -> None:
        self.decay_factor = float(np.exp(-1 / time_constant))
        self.start_samples = max(1.0, time_constant)
        self.reset()

    def reset(self) -> None:
        self.started = [False, False]  # one ear uses the first
        self.power = [SosFilter(leaky_integrator(self.decay_factor)) for _ in range(2)]

    def process(self, block: FloatArray) -> FloatArray:
        """Normalise (ears, N)."""
        gain = np.zeros(block.shape[-1])
        for ear, samples in enumerate(block):
            squares = np.square(clamp(samples, SQUARE_TINY))
            if not self.started[ear]:
                self._start(ear, squares)
            if self.started[ear]:
                np.maximum(gain, np.sqrt(self.power[ear].process(squares)), out=gain)
        return block / (gain + self.FLOOR)

    def _start(self, ear: int, squares: FloatArray) -> None:
        if squares.any():
            count = round_half_away(min(len(squares), self.start_samples))
            self.power[ear].state = np.array([[self.decay_factor * squares[:count].mean(), 0.0]])
            self.started[ear] = True


class Fir:
    """An FIR filter by direct convolution: exact, and as fast as an FFT at about 500 taps."""

    def __init__(self, taps: FloatArray) -> None:
        self.taps = taps
        self.reset()

    def reset(self) -> None:
        self.history = np.zeros((0, len(self.taps) - 1))  # of each ear

    def process(self, block: FloatArray) -> FloatArray:
        """Filter (ears, N)."""
        if block.shape[-1] == 0:
            return block
        if len(self.history) != len(block):
            self.history = np.zeros((len(block), len(self.taps) - 1))
        samples = np.concatenate((self.history, block), axis=-1)
        self.history = samples[:, block.shape[-1] :].copy()
        return np.array([np.convolve(ear, self.taps, mode="valid") for ear in samples])
