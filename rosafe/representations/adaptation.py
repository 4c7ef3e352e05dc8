"""The adaptation stage: feedback loops that emphasise onsets, as the auditory nerve does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import LIMIT, FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

FULL_SCALE_DB = 100.0  # SPL of sound with an RMS of 1, and the steady output for it in model units
MAX_THRESHOLD_DB = 99.0  # at 100, the threshold would be full scale
DRNL_FACTOR = 1e5  # of the squared samples: (10**(50 / 20))**2
MIN_LIMIT = 1e-30  # replaces a limit of 0
MIN_QUOTIENT, MAX_QUOTIENT = 1e-100, 1e100  # far beyond those of sound; they keep states from 0 and infinity

TAU = (0.005, 0.05, 0.129, 0.253, 0.5)
EVEN_TAU = tuple(np.linspace(0.005, 0.5, 5).tolist())
TERHARDT = "adt_vandorpschuitman"
SETS: dict[str, dict[str, Any]] = {
    "adt_dau": {"adpt_lim": 10.0, "adpt_mindB": 0.0, "adpt_tau": TAU},
    "adt_puschel": {"adpt_lim": 0.0, "adpt_mindB": 0.0, "adpt_tau": EVEN_TAU},
    "adt_breebaart": {"adpt_lim": 10.0, "adpt_mindB": 0.0, "adpt_tau": EVEN_TAU},
    TERHARDT: {"adpt_lim": 0.0, "adpt_tau": TAU},
}


class Adaptation(Stage):
    """Adaptation loops, (2, C, N) to (2, C, N) in model units: 0 at the threshold, 100 for steady 100 dB SPL (RMS 1).

    With v = max(x, x_min), x_min = 10**((adpt_mindB - 100) / 20), for each time constant tau in turn

    * v = v / s
    * v = 1 + m tanh((v - 1) / m) if v > 1 and adpt_lim > 1; m = (1 - s_rest**2) adpt_lim - 1
    * s = a s + (1 - a) v, a = exp(-1 / (tau fs))

    and y = 100 (v - K) / (1 - K). The loops start at rest at x_min, s_rest = x_min**(1/2), x_min**(1/4)...; K, the
    last of these, is the output for x_min. The limit is given in papers as 2 m / (1 + exp(-2 (v - 1) / m)) - m + 1,
    which is equal.

    A name in `adpt_model` replaces the other three parameters by a published set; an empty one has no effect.
    adt_vandorpschuitman uses the threshold of hearing (at most 99 dB) for each channel and ignores adpt_mindB. Any
    change resets the loops to rest.

    After a DRNL filterbank, x is first replaced by (10**(50/20) x)**2.
    """

    REPRESENTATION = Representation(
        kind="adaptation",
        doc="Adaptation loops",
        parent="ihc",
        axes=("ear", "channel", "time"),
        unit="MU",
        parameters=(
            Parameter.real(
                "adpt_lim",
                10.0,
                "Limit of the overshoot, as ratio of the onset's response to the steady one; 1 or less: none",
                0.0,
                1e6,
            ),
            Parameter.real("adpt_mindB", 0.0, "Quietest audible level (dB SPL)", -300.0, 99.0, unit="dB"),
            Parameter(
                "adpt_tau",
                "sequence<double>",
                TAU,
                "Time constant of each loop (s)",
                0.0,
                3600.0,
                open_minimum=True,
                least=1,
                most=kernels.MAX_LOOPS,
                unit="s",
            ),
            Parameter.text(
                "adpt_model",
                "",
                "Published set that overrides the other three; empty: none",
                (*SETS, ""),
                spellings={"adt_breebart": "adt_breebaart"},
            ),
        ),
        port_doc="Output of the adaptation loops (model units)",
        references=(
            cite("puschel1988", "feedback loops", adpt_model=("", "adt_dau", "adt_puschel")),
            cite("dau1996", "feedback loops"),
            cite(
                "dau1997", "limit of the overshoot", adpt_model=("", "adt_dau", "adt_breebaart", "adt_vandorpschuitman")
            ),
            cite("breebaart2001", "time constants", adpt_model="adt_breebaart"),
            cite("vandorp2013", "threshold of each channel", adpt_model="adt_vandorpschuitman"),
            cite("terhardt1979", "threshold of hearing", adpt_model="adt_vandorpschuitman"),
            cite("jepsen2008", "squared input after DRNL filters", fb_type="drnl"),
        ),
    )

    _state: FloatArray | None  # (n, 2, C); None at rest

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._as_valid_block(block)
        loops, channels = self._loops, samples.shape[1]
        if len(loops.thresholds) not in (1, channels):
            raise ValueError(f"block: expected {len(loops.thresholds)} channels, got {channels}")
        if self._state is None or self._state.shape[1:] != samples.shape[:-1]:
            rest = np.broadcast_to(loops.rest[:, np.newaxis], (len(loops.rest), len(samples), channels))
            self._state = np.array(rest, order="C")
        if kernels.compiled():
            return kernels.adaptation(
                samples,
                loops.factor,
                loops.thresholds,
                loops.offsets,
                loops.gains,
                loops.decay_factors,
                loops.limits,
                self._state,
            )
        return adapt(samples, loops, self._state)

    def reset(self) -> None:
        self._state = None

    def input_format_changed(self, before: SignalFormat) -> None:
        self.build(self.values, frozenset())

    def _resolve_values(self, checked: dict[str, Any]) -> dict[str, Any]:
        return self.effective_values(super()._resolve_values(checked))

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        parameter = (cls.DECLARED_WITHIN or cls.REPRESENTATION).parameter
        published = SETS.get(values["adpt_model"], {})
        return {**values, **{name: parameter(name).check(value) for name, value in published.items()}}

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        threshold = np.array([values["adpt_mindB"]])
        if values["adpt_model"] == TERHARDT:
            if not self.input_format.center_frequencies:
                raise ValueError(f"adpt_model: expected channels of known frequencies for {TERHARDT}, got none")
            threshold = np.minimum(hearing_threshold(np.array(self.input_format.center_frequencies)), MAX_THRESHOLD_DB)
        self._loops = Loops.design(
            self.sample_rate,
            threshold,
            values["adpt_tau"],
            values["adpt_lim"],
            DRNL_FACTOR if self.input_format.filterbank == "drnl" else 0.0,
        )
        self._state = None


class Loops(NamedTuple):
    """n adaptation loops, for C channels with different thresholds, or with C = 1 for all channels.

    Attributes
    ----------
    factor : float
        0, or the factor by which the squares of the samples are multiplied first.
    thresholds, offsets, gains : ndarray (C,)
        Samples are raised to the threshold; the output minus the offset is multiplied by the gain.
    decay_factors, limits : ndarray (n,)
        a and m of each loop. Without limits, all m are 0.
    rest : ndarray (n, C)
        The states before the first sample.
    """

    factor: float
    thresholds: FloatArray
    offsets: FloatArray
    gains: FloatArray
    decay_factors: FloatArray
    limits: FloatArray
    rest: FloatArray

    @classmethod
    def design(
        cls, sample_rate: float, threshold_db: FloatArray, tau: list[float], overshoot: float, factor: float
    ) -> Loops:
        """Design loops for thresholds (C,) in dB SPL. Limits require a single threshold."""
        log_threshold = (threshold_db - FULL_SCALE_DB) / 20 * math.log(10)
        logs = log_threshold * 0.5 ** np.arange(1, len(tau) + 1)[:, np.newaxis]
        limits = np.zeros(len(tau))
        if overshoot > 1:  # m tanh(u / m) does not depend on the sign of m
            limits = np.maximum(np.abs(-np.expm1(2 * logs[:, 0]) * overshoot - 1), MIN_LIMIT)
        with np.errstate(divide="ignore", over="ignore"):  # a time constant may be almost 0
            decay_factors = np.exp(-1 / (np.array(tau) * sample_rate))
        return cls(
            factor,
            np.exp(log_threshold),
            np.exp(logs[-1]),
            -100 / np.expm1(logs[-1]),
            decay_factors,
            limits,
            np.exp(logs),
        )


def hearing_threshold(frequencies: FloatArray) -> FloatArray:
    """Return the threshold of hearing in dB SPL at `frequencies` in Hz (Terhardt 1979)."""
    f = frequencies / 1000
    return 3.64 * f**-0.8 - 6.5 * np.exp(-0.6 * (f - 3.3) ** 2) + 0.001 * f**4


def adapt(samples: FloatArray, loops: Loops, state: FloatArray) -> FloatArray:
    """Apply `loops` to (2, C, N) and update their `state` (n, 2, C).

    All loops advance together, each one sample ahead of the next loop: one operation for (n, 2, C) numbers.
    """
    x = np.clip(samples, -LIMIT, LIMIT)
    if loops.factor:
        x = x * x * loops.factor
    x = np.moveaxis(np.maximum(x, loops.thresholds[:, np.newaxis]), -1, 0)
    output = np.empty(x.shape)
    number, count = len(x), len(state)
    a, b, m = (
        values[:, np.newaxis, np.newaxis] for values in (loops.decay_factors, 1 - loops.decay_factors, loops.limits)
    )
    passed = np.empty((count + 1, *x.shape[1:]))  # the input of each loop, and the output of the last
    for step in range(number + count - 1 if number else 0):
        first, end = max(0, step - number + 1), min(count, step + 1)  # the loops with a sample
        busy = slice(first, end)
        if first == 0:
            passed[0] = x[step]
        v = np.maximum(passed[busy] / state[busy], MIN_QUOTIENT)
        if m.any():
            over = np.maximum(v, 1) - 1
            v = np.minimum(v, 1) + m[busy] * np.tanh(over / m[busy])
        else:
            v = np.minimum(v, MAX_QUOTIENT)
        state[busy] = a[busy] * state[busy] + b[busy] * v
        passed[first + 1 : end + 1] = v
        if end == count:
            output[step - count + 1] = passed[-1]
    return np.ascontiguousarray(np.moveaxis((output - loops.offsets) * loops.gains, 0, -1))
