"""The amplitude modulation spectrogram stage: the rate at which the level of each channel fluctuates."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import MAX_FRAME_SECONDS, FrameBuffer, FramedStage, FrameGrid, batches
from rosafe.dsp.numeric_limits import FLUSH_INTERVAL, FloatArray, clamp, modulus
from rosafe.dsp.rounding import sample_count
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.sos_filter import SosFilterBank
from rosafe.dsp.windows import ALL_NAMES, window

MAX_FILTERS = 256
MAX_RELATIVE_FREQUENCY = 0.475  # of the sample rate: upper edge of the highest filter by default
UPPER = math.sqrt(1.25) + 0.5  # edges of a band-pass of Q = 1: its centre times UPPER, and divided by it
FRAMES = frozenset({"ams_wname", "ams_wSizeSec", "ams_hSizeSec"})  # parameters whose change keeps the buffer


class Decimation:
    """Every `ratio`-th sample of a stream, from the first one on."""

    def __init__(self, ratio: int) -> None:
        self.ratio = ratio
        self._rows: tuple[int, ...] = ()
        self._skip = 0  # samples of the next block before the next selected one

    def process(self, block: FloatArray) -> FloatArray:
        """Decimate (*rows, N) to (*rows, n). A change of the leading shape resets the phase."""
        if block.shape[:-1] != self._rows:
            self._rows, self._skip = block.shape[:-1], 0
        selected = np.ascontiguousarray(block[..., self._skip :: self.ratio])
        self._skip = (self._skip - block.shape[-1]) % self.ratio
        return selected


class AmsFeatures(FramedStage):
    """Strength of modulation in each channel by modulation frequency, (2, C, N) to (2, C, M, F).

    Every ams_dsRatio-th sample is selected, without an anti-aliasing filter: fd = fs / ams_dsRatio. Frames of these
    samples have length w = 2 round(ams_wSizeSec fd / 2) and hop h = round(w / (ams_wSizeSec / ams_hSizeSec)).

    * log: filters at the frequencies ams_cfHz; if these are not given, ams_nFilters from ams_lowFreqHz to
      ams_highFreqHz with equal ratios, or one per octave for 0. The first is a Butterworth low-pass of order 1 at its
      frequency f, the others Butterworth band-passes with one pair of poles from f (sqrt(1.25) - 0.5) to
      f (sqrt(1.25) + 0.5), that is, Q = 1. They start at rest and keep their state between frames. The result is
      mean(abs(window y)) of each frame of their output y.
    * lin: with D = (ams_highFreqHz - ams_lowFreqHz) / (ams_nFilters + 1), M = ams_nFilters triangles centred at
      ams_lowFreqHz + i D, i = 1...M, over the spectrum: sum over b of max(0, 1 - abs(b fd / N - centre) / D)
      abs(FFT(window x)[b]) / N, with N = 2**ceil(log2(2 w)) points, b = 0...N / 2.

    The low-pass includes the mean level (0 Hz): as a feature it is the level of the channel rather than its modulation,
    and ams_cfHz reports its cut-off frequency.

    `parameters` reports the current centre frequencies as ams_cfHz. A filter that is not below fd / 2 is a ValueError.
    A change of window or step keeps the buffer; any other change resets filters, frames and decimation.
    """

    REPRESENTATION = Representation(
        kind="amsFeatures",
        doc="Amplitude modulation spectrogram",
        parent="ihc",
        axes=("ear", "channel", "filter", "time"),
        level=20.0,
        parameters=(
            Parameter.text(
                "ams_fbType",
                "log",
                "Modulation filters of constant Q (log), or bins of an FFT summed up by triangles (lin)",
                ("log", "lin"),
            ),
            Parameter.count(
                "ams_nFilters",
                15,
                "Number of modulation filters; 0 (log only): one an octave",
                0,
                MAX_FILTERS,
                aliases=("ams_nFilter",),
            ),
            Parameter.real(
                "ams_lowFreqHz",
                4.0,
                "Lowest centre frequency (Hz); lin: lower edge of the lowest triangle, which may be 0",
                0.0,
                1e6,
                unit="Hz",
            ),
            Parameter.positive(
                "ams_highFreqHz",
                1024.0,
                "Highest centre frequency (Hz); lin: upper edge of the highest triangle; not given: lower if the "
                "sample rate after ams_dsRatio requires it",
                1e6,
                unit="Hz",
                follows_rate=True,
            ),
            Parameter(
                "ams_cfHz",
                "sequence<double>",
                (),
                "Centre frequencies (Hz, log only), the first that of a low-pass; empty: chosen from the three above",
                0.0,
                1e6,
                open_minimum=True,
                unit="Hz",
            ),
            Parameter.count("ams_dsRatio", 4, "Decimation: one of this number of samples is used", 1, 1000),
            Parameter.positive("ams_wSizeSec", 0.032, "Window duration (s)", MAX_FRAME_SECONDS, unit="s"),
            Parameter.positive("ams_hSizeSec", 0.016, "Window step size (s)", MAX_FRAME_SECONDS, unit="s"),
            Parameter.text("ams_wname", "rectwin", "Window name", ALL_NAMES),
        ),
        coordinates=("ams_cfHz",),
        request="ModulationProc",
        port_doc="Amplitude modulation spectrograms, [filter][channel][frame]",
        references=(
            cite("may2014", "amplitude modulation spectrogram"),
            cite("ewert2000", "modulation filters of constant Q", ams_fbType="log"),
            cite("kim2009", "sums of FFT bins", ams_fbType="lin"),
            cite("kollmeier1994", "sums of FFT bins", ams_fbType="lin"),
        ),
    )
    prefix = "ams"

    _decimation: Decimation
    _filters: SosFilterBank
    _given: frozenset[str] = frozenset()  # parameters with a default that follows the sample rate

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        return {**values, "ams_cfHz": center_frequencies(values).tolist()}

    @classmethod
    def resolve_rate_defaults(
        cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float
    ) -> dict[str, Any]:
        rate = sample_rate / values["ams_dsRatio"]
        edge = 1.0 if values["ams_fbType"] == "lin" else UPPER  # relative to the highest frequency
        limit = MAX_RELATIVE_FREQUENCY * rate / edge
        free = "ams_highFreqHz" not in given and not values["ams_cfHz"]
        if free and edge * values["ams_highFreqHz"] >= rate / 2 and values["ams_lowFreqHz"] < limit:
            return {**values, "ams_highFreqHz": limit}
        return dict(values)

    @property
    def parameters(self) -> dict[str, Any]:
        return self.effective_values(self._rate_values(self.values))

    def _rate_values(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return self.resolve_rate_defaults(values, self._given, self.input_format.rate)

    def _resolve_values(self, checked: dict[str, Any]) -> dict[str, Any]:
        self._given = self._given | ({"ams_highFreqHz"} & checked.keys())
        return super()._resolve_values(checked)

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (*rows, len(self._frequencies))

    def state_size(self, rows: tuple[int, ...]) -> int:
        filters = len(self._frequencies) if self._triangles is None else 1
        return 2 * math.prod(rows) * filters * len(self.window)  # in an array of up to twice that size

    def output_count(self, count: int) -> int:
        return self._framing.complete_frames(-(-count // self._decimation.ratio))

    def required_input(self, frames: int) -> int:
        return (super().required_input(frames) - 1) * self._decimation.ratio + 1

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._decimation.process(self._as_valid_block(block))
        if self._triangles is not None:
            return self._by_spectra(clamp(samples), self._triangles)
        rows = (*samples.shape[:-1], len(self._frequencies))
        if kernels.compiled():
            frames = self._frames(samples, self._framing.weights(squared=False), rows)
            state = self._filters.ensure_state(samples.shape[:-1])
            return kernels.modulation(frames, self._filters.sections, state)
        parts = [np.empty((*rows, 0))]
        for first in range(0, samples.shape[-1], FLUSH_INTERVAL):  # the output is much larger than the input
            filtered = self._filters.process(clamp(samples[..., first : first + FLUSH_INTERVAL]))
            parts.append(self._means(np.abs(filtered), squared=False))
        return np.concatenate(parts, axis=-1)

    def _by_spectra(self, samples: FloatArray, triangles: FloatArray) -> FloatArray:
        frames = self._new_frames(samples)  # (2, C, F, w)
        channels, count = frames.shape[1:3]
        result = np.empty((len(frames), channels, triangles.shape[1], count))
        points = transform_points(len(self.window))
        for some, part in batches(channels, count, points):
            spectra = modulus(scipy.fft.rfft(frames[:, some, part] * self.window, points)[..., : len(triangles)])
            # not a matrix product: see `FrameGrid.means`
            result[:, some, :, part] = np.einsum("ecfb,bm->ecmf", spectra, triangles)
        return result

    def reset(self) -> None:
        super().reset()
        self._decimation = Decimation(self._decimation.ratio)
        self._filters = SosFilterBank(self._filters.sections)

    @cached_property
    def output_format(self) -> SignalFormat:
        ratio = self._decimation.ratio
        return replace(
            self.input_format,
            rate=self.input_format.rate / ratio / self._framing.hop,
            framed=True,
            hop=self._framing.hop * ratio * self.input_format.hop,
            window=len(self._framing.window) * ratio * self.input_format.hop,
        )

    def input_format_changed(self, before: SignalFormat) -> None:
        self.build(self.values, frozenset(self.values))

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        values = self._rate_values(values)
        rate = self.input_format.rate / values["ams_dsRatio"]
        framing = design_framing(values, rate)
        frequencies = center_frequencies(values)
        triangles = sections = None
        if values["ams_fbType"] == "lin":
            if values["ams_highFreqHz"] > rate / 2:
                raise ValueError(
                    f"ams_highFreqHz: expected at most half of {rate:.12g} Hz, the sample rate after ams_dsRatio, got "
                    f"{values['ams_highFreqHz']:.12g} Hz"
                )
            triangles = design_triangles(frequencies, values, rate, transform_points(len(framing.window)))
        elif UPPER * frequencies.max() >= rate / 2:
            name = "ams_cfHz" if values["ams_cfHz"] else "ams_highFreqHz"
            raise ValueError(
                f"{name}: expected a sample rate above {2 * UPPER * frequencies.max():.6g} Hz after ams_dsRatio for a "
                f"filter at {frequencies.max():.12g} Hz, got {rate:.12g} Hz"
            )
        else:
            sections = design_sections(frequencies, rate)
        self._framing, self._frequencies, self._triangles = framing, frequencies, triangles
        if not changed <= FRAMES:
            self._decimation = Decimation(values["ams_dsRatio"])
            self._filters = SosFilterBank(np.empty((0, 6)) if sections is None else sections)
            self._buffer = FrameBuffer()


def design_framing(values: Mapping[str, Any], rate: float) -> FrameGrid:
    """Return the frames at the sample rate (Hz) after decimation. Raise ValueError if a window is too short."""
    seconds = values["ams_wSizeSec"]
    size = 2 * sample_count("ams_wSizeSec", seconds * rate / 2)
    hop = sample_count("ams_hSizeSec", max(1.0, size / (seconds / values["ams_hSizeSec"])))
    return FrameGrid(np.abs(window(values["ams_wname"], size)), hop)  # rounding makes some ends negative


def center_frequencies(values: Mapping[str, Any]) -> FloatArray:
    """Return the centre frequencies (M,) in Hz for checked parameters. Raise ValueError if these are inconsistent."""
    low, high, count, given = (values[f"ams_{name}"] for name in ("lowFreqHz", "highFreqHz", "nFilters", "cfHz"))
    if high <= low:
        raise ValueError(f"ams_highFreqHz: expected more than ams_lowFreqHz ({low:.12g} Hz), got {high:.12g} Hz")
    if values["ams_fbType"] == "lin":
        if given:
            raise ValueError("ams_cfHz: expected no centre frequencies if ams_fbType is lin")
        if count == 0:
            raise ValueError("ams_nFilters: expected at least 1 if ams_fbType is lin, got 0")
        return low + (high - low) / (count + 1) * np.arange(1, count + 1)
    if low == 0:
        raise ValueError("ams_lowFreqHz: expected more than 0 if ams_fbType is log, got 0")
    if given:
        return np.array(given)
    if count == 0:
        return np.ldexp(low, np.arange(math.floor(math.log2(high) - math.log2(low) + 1e-9) + 1))
    return 2 ** np.linspace(math.log2(low), math.log2(high), count)


def design_sections(frequencies: FloatArray, rate: float) -> FloatArray:
    """Return sections (M, 6): a low-pass at the first of the frequencies (M,) in Hz, band-passes at the others.

    Butterworth filters by the bilinear transform with prewarping, as those of `scipy.signal.butter`.
    """
    sections = np.zeros((len(frequencies), 6))
    cutoff = math.tan(math.pi * frequencies[0] / rate)
    sections[0] = cutoff / (1 + cutoff), cutoff / (1 + cutoff), 0, 1, (cutoff - 1) / (cutoff + 1), 0
    lower, upper = (np.tan(np.pi * frequencies[1:] * edge / rate) for edge in (1 / UPPER, UPPER))
    width, square = upper - lower, lower * upper
    norm = 1 + width + square
    sections[1:, 0], sections[1:, 2] = width / norm, -width / norm
    sections[1:, 3], sections[1:, 4], sections[1:, 5] = 1, 2 * (square - 1) / norm, (1 - width + square) / norm
    return sections


def transform_points(size: int) -> int:
    """Return the number of points of the FFT of `size` samples, 2**ceil(log2(2 size))."""
    return 1 << (2 * size - 1).bit_length()


def design_triangles(frequencies: FloatArray, values: Mapping[str, Any], rate: float, points: int) -> FloatArray:
    """Return weights of the magnitudes of a spectrum, (B, M), up to the highest bin with a weight."""
    width = (values["ams_highFreqHz"] - values["ams_lowFreqHz"]) / (len(frequencies) + 1)
    bins = min(points // 2, math.ceil(values["ams_highFreqHz"] / rate * points)) + 1
    distances = np.abs(np.arange(bins)[:, np.newaxis] * (rate / points) - frequencies) / width
    return np.maximum(0.0, 1.0 - distances) / points
