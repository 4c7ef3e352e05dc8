"""The amplitude modulation spectrogram stage: how fast the level of each channel goes up and down.

* S. D. Ewert and T. Dau (2000), "Characterizing frequency selectivity for envelope fluctuations", J. Acoust. Soc. Am.
  108, 1181-1196
* T. May and T. Dau (2014), "Computational speech segregation based on an auditory-inspired modulation analysis", J.
  Acoust. Soc. Am. 136, 3350-3359
* G. Kim, Y. Lu, Y. Hu and P. C. Loizou (2009), "An algorithm that improves speech intelligibility in noise for
  normal-hearing listeners", J. Acoust. Soc. Am. 126, 1486-1494
* B. Kollmeier and R. Koch (1994), "Speech enhancement based on physiological and psychoacoustical models of modulation
  perception and binaural interaction", J. Acoust. Soc. Am. 95, 1593-1602
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import MAX_FRAME_SECONDS, FrameBuffer, FramedStage, FrameGrid
from rosafe.dsp.numeric_limits import FLUSH_INTERVAL, FloatArray, clamp
from rosafe.dsp.rounding import sample_count
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.sos_filter import SosFilterBank
from rosafe.dsp.windows import ALL_NAMES, window

MAX_FILTERS = 256
BATCH = 2**18  # samples that are transformed at a time, to bound memory and stay in the cache
UPPER = math.sqrt(1.25) + 0.5  # the edges of a band-pass of Q = 1 are at so many times its centre, and at 1 / UPPER
FRAMES = frozenset({"ams_wname", "ams_wSizeSec", "ams_hSizeSec"})  # a change of these keeps what is buffered


class Decimation:
    """Every `ratio`-th sample of a stream, from the first one on."""

    def __init__(self, ratio: int) -> None:
        self.ratio = ratio
        self._rows: tuple[int, ...] = ()
        self._skip = 0  # samples of the next block before the next one that is taken

    def process(self, block: FloatArray) -> FloatArray:
        """(*rows, N) to (*rows, n). Other rows than in the last block mean a new beginning."""
        if block.shape[:-1] != self._rows:
            self._rows, self._skip = block.shape[:-1], 0
        taken = np.ascontiguousarray(block[..., self._skip :: self.ratio])
        self._skip = (self._skip - block.shape[-1]) % self.ratio
        return taken


class AmsFeatures(FramedStage):
    """Strength of modulation in each channel by frequency of modulation, (2, C, N) to (2, C, M, F).

    Every ams_dsRatio-th sample is taken, without a filter before: fd = fs / ams_dsRatio. Frames of these have
    w = 2 round(ams_wSizeSec fd / 2) samples and begin every h = round(w / (ams_wSizeSec / ams_hSizeSec)).

    * log: filters at the frequencies ams_cfHz; where these are not given, ams_nFilters from ams_lowFreqHz to
      ams_highFreqHz with equal ratios, or one an octave for 0. The first is a Butterworth low-pass of order 1 at its
      frequency f, the others Butterworth band-passes with one pair of poles from f (sqrt(1.25) - 0.5) to
      f (sqrt(1.25) + 0.5), which is Q = 1; from rest, they run on from frame to frame. Their output y gives
      mean(abs(window y)) of each frame.
    * lin: with D = (ams_highFreqHz - ams_lowFreqHz) / (ams_nFilters + 1), M = ams_nFilters triangles centred at
      ams_lowFreqHz + i D, i = 1...M, over the spectrum: sum over b of max(0, 1 - abs(b fd / N - centre) / D)
      abs(FFT(window x)[b]) / N, with N = 2**ceil(log2(2 w)) points, b = 0...N / 2.

    `parameters` tells the centres in force as ams_cfHz. ValueError where a filter would not lie below fd / 2.
    A change of window or step keeps what is buffered; any other one begins filters, frames and decimation anew.
    """

    REPRESENTATION = Representation(
        kind="amsFeatures",
        doc="Amplitude modulation spectrogram",
        parent="ihc",
        axes=("ear", "channel", "filter", "time"),
        parameters=(
            Parameter(
                "ams_fbType",
                "string",
                "log",
                "Modulation filters of constant Q (log), or bins of an FFT summed up by triangles (lin)",
                choices=("log", "lin"),
            ),
            Parameter(
                "ams_nFilters",
                "unsigned long",
                15,
                "Number of modulation filters; 0 (log only): one an octave",
                0,
                MAX_FILTERS,
                aliases=("ams_nFilter",),
            ),
            Parameter(
                "ams_lowFreqHz",
                "double",
                4.0,
                "Lowest centre frequency (Hz); lin: lower edge of the lowest triangle, which may be 0",
                0.0,
                1e6,
                unit="Hz",
            ),
            Parameter(
                "ams_highFreqHz",
                "double",
                1024.0,
                "Highest centre frequency (Hz), more than the lowest; lin: upper edge of the highest triangle",
                0.0,
                1e6,
                open_minimum=True,
                unit="Hz",
            ),
            Parameter(
                "ams_cfHz",
                "sequence<double>",
                (),
                "Centre frequencies (Hz, log only); empty: chosen from the three above",
                0.0,
                1e6,
                open_minimum=True,
                unit="Hz",
            ),
            Parameter("ams_dsRatio", "unsigned long", 4, "One of so many samples is taken", 1, 1000),
            Parameter("ams_wSizeSec", "double", 0.032, "Window duration (s)", 0.0, MAX_FRAME_SECONDS, True, unit="s"),
            Parameter("ams_hSizeSec", "double", 0.016, "Window step size (s)", 0.0, MAX_FRAME_SECONDS, True, unit="s"),
            Parameter("ams_wname", "string", "rectwin", "Window name", choices=ALL_NAMES),
        ),
        coordinates=("ams_cfHz",),
        request="ModulationProc",
        port_doc="Amplitude modulation spectrograms, [filter][channel][frame]",
    )
    prefix = "ams"

    _decimation: Decimation
    _filters: SosFilterBank

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        return {**values, "ams_cfHz": center_frequencies(values).tolist()}

    @property
    def parameters(self) -> dict[str, Any]:
        return self.effective_values(self.values)

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (*rows, len(self._frequencies))

    def state_size(self, rows: tuple[int, ...]) -> int:
        filters = len(self._frequencies) if self._triangles is None else 1
        return 2 * math.prod(rows) * filters * len(self.window)  # in a store of up to twice as many

    def output_count(self, count: int) -> int:
        return self._framing.complete_frames(-(-count // self._decimation.ratio))

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._decimation.process(self._as_valid_block(block))
        if self._triangles is not None:
            return self._by_spectra(clamp(samples), self._triangles)
        rows = (*samples.shape[:-1], len(self._frequencies))
        if kernels.compiled():
            frames = self._frames(samples, self._framing.weights(squared=False), rows)
            state = self._filters.started(samples.shape[:-1])
            return kernels.modulation(frames, self._filters.sections, state)
        parts = [np.empty((*rows, 0))]
        for first in range(
            0, samples.shape[-1], FLUSH_INTERVAL
        ):  # what comes out takes much more memory than what goes in
            filtered = self._filters.process(clamp(samples[..., first : first + FLUSH_INTERVAL]))
            parts.append(self._means(np.abs(filtered), squared=False))
        return np.concatenate(parts, axis=-1)

    def _by_spectra(self, samples: FloatArray, triangles: FloatArray) -> FloatArray:
        frames = self._framing.frames(self._buffer.append(samples))  # (2, C, F, w)
        channels, count = frames.shape[1:3]
        result = np.empty((2, channels, triangles.shape[1], count))
        points = transform_points(len(self.window))
        at_once = max(1, BATCH // points)  # frames of one channel, or of as many channels as go with them
        channels_at_once = max(1, at_once // max(1, count))
        for first in range(0, channels, channels_at_once):
            some = slice(first, first + channels_at_once)
            for begin in range(0, count, at_once):
                part = slice(begin, begin + at_once)
                spectra = np.abs(scipy.fft.rfft(frames[:, some, part] * self.window, points)[..., : len(triangles)])
                # not a matrix product: see `FrameGrid.means`
                result[:, some, :, part] = np.einsum("ecfb,bm->ecmf", spectra, triangles)
        self._buffer.drop(count * self._framing.hop)
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
        rate = self.input_format.rate / values["ams_dsRatio"]
        framing = design_framing(values, rate)
        frequencies = center_frequencies(values)
        triangles = sections = None
        if values["ams_fbType"] == "lin":
            if values["ams_highFreqHz"] > rate / 2:
                raise ValueError(f"ams_highFreqHz: more than half of the sample rate after ams_dsRatio, {rate:.12g} Hz")
            triangles = design_triangles(frequencies, values, rate, transform_points(len(framing.window)))
        elif UPPER * frequencies.max() >= rate / 2:
            name = "ams_cfHz" if values["ams_cfHz"] else "ams_highFreqHz"
            raise ValueError(
                f"{name}: a filter at {frequencies.max():.12g} Hz needs a sample rate above"
                f" {2 * UPPER * frequencies.max():.6g} Hz after ams_dsRatio, and there it is {rate:.12g} Hz"
            )
        else:
            sections = design_sections(frequencies, rate)
        self._framing, self._frequencies, self._triangles = framing, frequencies, triangles
        if not changed <= FRAMES:
            self._decimation = Decimation(values["ams_dsRatio"])
            self._filters = SosFilterBank(np.empty((0, 6)) if sections is None else sections)
            self._buffer = FrameBuffer()


def design_framing(values: Mapping[str, Any], rate: float) -> FrameGrid:
    """The frames at the sample rate (Hz) after the decimation; ValueError if a window is too short."""
    seconds = values["ams_wSizeSec"]
    size = 2 * sample_count("ams_wSizeSec", seconds * rate / 2)
    hop = sample_count("ams_hSizeSec", max(1.0, size / (seconds / values["ams_hSizeSec"])))
    return FrameGrid(np.abs(window(values["ams_wname"], size)), hop)  # rounding makes some ends less than 0


def center_frequencies(values: Mapping[str, Any]) -> FloatArray:
    """Centre frequencies (M,) in Hz that the checked parameters ask for; ValueError where these do not go together."""
    low, high, count, given = (values[f"ams_{name}"] for name in ("lowFreqHz", "highFreqHz", "nFilters", "cfHz"))
    if high <= low:
        raise ValueError(f"ams_highFreqHz: {high:.12g} Hz is not more than ams_lowFreqHz ({low:.12g} Hz)")
    if values["ams_fbType"] == "lin":
        if given:
            raise ValueError("ams_cfHz: centre frequencies cannot be given where ams_fbType is lin")
        if count == 0:
            raise ValueError("ams_nFilters: at least 1 where ams_fbType is lin")
        return low + (high - low) / (count + 1) * np.arange(1, count + 1)
    if low == 0:
        raise ValueError("ams_lowFreqHz: more than 0 where ams_fbType is log")
    if given:
        return np.array(given)
    if count == 0:
        return np.ldexp(low, np.arange(math.floor(math.log2(high) - math.log2(low) + 1e-9) + 1))
    return 2 ** np.linspace(math.log2(low), math.log2(high), count)


def design_sections(frequencies: FloatArray, rate: float) -> FloatArray:
    """Sections (M, 6): a low-pass at the first of the frequencies (M,) in Hz, band-passes at the others.

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
    """Points of the FFT of frames of `size` samples: 2**ceil(log2(2 size))."""
    return 1 << (2 * size - 1).bit_length()


def design_triangles(frequencies: FloatArray, values: Mapping[str, Any], rate: float, points: int) -> FloatArray:
    """By what to multiply the magnitudes of a spectrum, (B, M), up to the highest bin that counts."""
    width = (values["ams_highFreqHz"] - values["ams_lowFreqHz"]) / (len(frequencies) + 1)
    bins = min(points // 2, math.ceil(values["ams_highFreqHz"] / rate * points)) + 1
    distances = np.abs(np.arange(bins)[:, np.newaxis] * (rate / points) - frequencies) / width
    return np.maximum(0.0, 1.0 - distances) / points
