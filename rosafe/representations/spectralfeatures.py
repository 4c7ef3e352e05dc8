"""The spectral features stage: fourteen numbers that describe the shape of the spectrum of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import LIMIT, FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

E = 1e-15  # added to denominators and arguments of logarithms
MAX_RATE = LIMIT**2  # the square of the largest sample


@dataclass
class Spectra:
    """Spectra x_c of F frames with intermediate results of several features. Arrays are (C, 2, F) or (2, F).

    `extended` is (C, 2, F + 1): the spectra with the spectrum before the first one.
    """

    extended: FloatArray
    frequencies: FloatArray  # f_c (C,) in Hz
    bright: float  # sf_brCF
    part: float  # sf_roPerc

    @cached_property
    def x(self) -> FloatArray:
        return self.extended[..., 1:]

    @cached_property
    def highest(self) -> float:
        return float(self.frequencies.max())

    @cached_property
    def total(self) -> FloatArray:
        """X + E, with X the sum over channels."""
        return self.x.sum(axis=0) + E

    @cached_property
    def mean(self) -> FloatArray:
        return self.x.mean(axis=0)

    @cached_property
    def center(self) -> FloatArray:
        """The centre of gravity in Hz."""
        return self.moment(self.frequencies)

    @cached_property
    def levels(self) -> FloatArray:
        """10 log10(x + E) in dB, of the extended spectra."""
        return 10 * np.log10(self.extended + E)

    @cached_property
    def deviations(self) -> FloatArray:
        """The deviations from the mean over the channels, in standard deviations."""
        deviations = self.x - self.mean
        channels = len(deviations)
        squares = np.einsum("cef,cef->ef", deviations, deviations)
        return deviations / (np.sqrt(squares / max(1, channels - 1)) + E)

    @cached_property
    def norms(self) -> FloatArray:
        """||x|| + E, of the extended spectra."""
        return np.sqrt(np.einsum("cef,cef->ef", self.extended, self.extended)) + E

    def moment(self, weights: FloatArray) -> FloatArray:
        """Return sum w_c x_c / (X + E)."""
        return np.einsum("c,cef->ef", weights, self.x) / self.total


def _spread(of: Spectra) -> FloatArray:
    distances = of.frequencies[:, np.newaxis, np.newaxis] - of.center
    return np.sqrt(np.einsum("cef,cef,cef->ef", distances, distances, of.x) / of.total) / of.highest


def _entropy(of: Spectra) -> FloatArray:
    shares = of.x / of.total
    channels = len(shares)
    if channels == 1:
        return np.zeros(shares.shape[1:])
    return np.einsum("cef,cef->ef", shares, -np.log(shares + E)) / math.log(channels)


def _decrease(of: Spectra) -> FloatArray:
    first, others = of.x[0], of.x[1:]
    steps = 1.0 / np.arange(1, len(others) + 1)
    return np.einsum("c,cef->ef", steps, others - first) / (others.sum(axis=0) + E)


def _flatness(of: Spectra) -> FloatArray:
    sounding = of.x > 0
    logarithms = np.log(of.x, out=np.zeros(of.x.shape), where=sounding)
    return sounding.all(axis=0) * np.exp(logarithms.mean(axis=0)) / (of.mean + E)


def _rolloff(of: Spectra) -> FloatArray:
    sums = of.x.cumsum(axis=0)
    threshold = of.part * sums[-1]
    index = (sums >= threshold).argmax(axis=0)
    before = np.maximum(index - 1, 0)
    below, above = (np.take_along_axis(sums, i[np.newaxis], axis=0)[0] for i in (before, index))
    way = np.divide(threshold - below, above - below, out=np.zeros(index.shape), where=index > 0)
    low, high = of.frequencies[before], of.frequencies[index]
    return np.where(sums[-1] > 0, (low + way * (high - low)) / of.highest, 0.0)


def _flux(of: Spectra) -> FloatArray:
    return np.sqrt(np.square(np.diff(of.levels, axis=-1)).mean(axis=0))


def _irregularity(of: Spectra) -> FloatArray:
    steps = np.diff(of.levels[..., 1:], axis=0)
    return np.sqrt(np.einsum("cef,cef->ef", steps, steps) / max(1, len(steps)))


def _variation(of: Spectra) -> FloatArray:
    products = np.einsum("cef,cef->ef", of.x, of.extended[..., :-1])
    return 1 - products / (of.norms[..., 1:] * of.norms[..., :-1])


FEATURES: dict[str, Callable[[Spectra], FloatArray]] = {
    "centroid": lambda of: of.center / of.highest,
    "crest": lambda of: of.x.max(axis=0) / (of.mean + E),
    "spread": _spread,
    "entropy": _entropy,
    "brightness": lambda of: of.moment((of.frequencies > of.bright) * 1.0),
    "hfc": lambda of: of.moment(np.square(of.frequencies)),
    "decrease": _decrease,
    "flatness": _flatness,
    "flux": _flux,
    "kurtosis": lambda of: np.square(np.square(of.deviations)).mean(axis=0) - 3,
    "skewness": lambda of: (np.square(of.deviations) * of.deviations).mean(axis=0),
    "irregularity": _irregularity,
    "rolloff": _rolloff,
    "variation": _variation,
}
ORDER = {word: index for index, word in enumerate(FEATURES)}


class SpectralFeatures(Stage):
    """One number for each frame, ear and feature, (2, C, F) to (2, S, F), in the order of sf_requests.

    With the rates x_c = max(R_c, 0) of a frame's C channels, their center frequencies f_c and the highest of these
    f_max, E = 1e-15, X = sum x_c, m = X / C, p_c = x_c / (X + E), D_c = 10 log10(x_c + E), s the standard deviation of
    x over the channels (C - 1 in the denominator) and g = sum f_c x_c / (X + E):

    ============ ====================================================================================================
    centroid     g / f_max
    crest        max x_c / (m + E)
    spread       sqrt(sum (f_c - g)**2 x_c / (X + E)) / f_max
    entropy      -sum p_c ln(p_c + E) / ln C
    brightness   sum of x_c with f_c > sf_brCF, over X + E
    hfc          sum f_c**2 x_c / (X + E), in Hz**2
    decrease     sum over c >= 1 of (x_c - x_0) / c, over E + sum over c >= 1 of x_c
    flatness     exp(mean ln x_c) / (m + E); 0 if a channel is silent
    flux         sqrt(mean (D_c[k] - D_c[k-1])**2) in dB; 0 in the first frame
    kurtosis     mean ((x_c - m) / (s + E))**4, less 3
    skewness     mean ((x_c - m) / (s + E))**3
    irregularity sqrt(mean over c >= 1 of (D_c - D_(c-1))**2) in dB
    rolloff      f_r / f_max, with f_r where x_0 + ... + x_c, linearly interpolated, reaches sf_roPerc X; f_0 if
                 x_0 alone reaches it; 0 for silence
    variation    1 - sum x_c[k] x_c[k-1] / ((||x[k]|| + E) (||x[k-1]|| + E)); the first frame is its own predecessor
    ============ ====================================================================================================

    Silence gives 0, except for kurtosis (-3) and variation (1). With one channel, entropy, irregularity and s are 0.
    A change of a parameter keeps the state; a change of the channels resets it.
    """

    REPRESENTATION = Representation(
        kind="spectralFeatures",
        doc="Spectral features",
        parent="ratemap",
        axes=("ear", "feature", "time"),
        parameters=(
            Parameter(
                "sf_requests",
                "sequence<string>",
                ("all",),
                "Features, in this order; all of them if one is all",
                choices=("all", *FEATURES),
                least=1,
            ),
            Parameter.positive(
                "sf_brCF",
                1500.0,
                "Brightness counts the channels above this (Hz)",
                1e6,
                aliases=("sf_br_cf",),
                unit="Hz",
            ),
            Parameter.positive("sf_roPerc", 0.8, "Part of the energy below the roll-off", 1.0, aliases=("sf_ro_perc",)),
        ),
        coordinates=("sf_requests",),
        port_doc="Spectral features, [feature][frame]",
        references=(
            cite("peeters2011", "descriptors of the spectrum"),
            cite("misra2004", "entropy"),
            cite("jensen2004", "high-frequency content"),
            cite("lerch2012", "crest, flatness, skewness and kurtosis"),
            cite("tzanetakis2002", "centroid, roll-off and flux"),
            cite("scheirer1997", "roll-off and flux of speech and music"),
        ),
    )

    _last: FloatArray | None = None  # the last spectra, (2, C, 1)

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        words = values["sf_requests"]
        return {**values, "sf_requests": list(FEATURES) if "all" in words else words}

    @property
    def parameters(self) -> dict[str, Any]:
        return self.effective_values(self.values)

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (rows[0], len(self._words))

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(self.input_format, center_frequencies=())

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = self._as_valid_block(block)
        channels, known = rates.shape[1], len(self._frequencies)
        if not channels == known > 0:
            raise ValueError(f"block: expected {known} channels, those with known centre frequencies, got {channels}")
        if rates.shape[-1] == 0:
            return np.empty((len(rates), len(self._words), 0))
        spectra = np.minimum(np.maximum(rates, 0.0), MAX_RATE)
        before = spectra[..., :1].copy() if self._last is None else self._last
        self._last = spectra[..., -1:].copy()
        bright, part = self.values["sf_brCF"], self.values["sf_roPerc"]
        if not kernels.compiled():
            extended = np.concatenate((before, spectra), axis=-1).swapaxes(0, 1)
            of = Spectra(np.ascontiguousarray(extended), self._frequencies, bright, part)
            by_name = {word: FEATURES[word](of) for word in dict.fromkeys(self._words)}
            return np.stack([by_name[word] for word in self._words], axis=1)
        features = np.empty((len(rates), len(FEATURES), rates.shape[-1]))
        kernels.spectral_features(spectra, before, self._frequencies, bright, part, features)
        return features if self._words == tuple(ORDER) else features.take([ORDER[word] for word in self._words], axis=1)

    def reset(self) -> None:
        self._last = None

    def input_format_changed(self, before: SignalFormat) -> None:
        if self.input_format.center_frequencies != before.center_frequencies:
            self._last = None
            self._frequencies = np.array(self.input_format.center_frequencies)

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        words: Sequence[str] = values["sf_requests"]
        self._words = tuple(FEATURES) if "all" in words else tuple(words)
        self._frequencies = np.array(self.input_format.center_frequencies)
