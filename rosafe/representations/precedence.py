"""The precedence stage: time and level differences of the first wave front, after removal of a reflection."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Derived, Part, Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import BATCH, FrameBuffer, FramedStage, frame_parameters
from rosafe.dsp.kernels import INTERLEAVED_ROWS, TAPS, Taps, Windowed
from rosafe.dsp.numeric_limits import EPSILON, SQUARE_TINY, TINY, FloatArray, clamp
from rosafe.dsp.rounding import check_length, round_half_away
from rosafe.dsp.signal_format import SignalFormat

MAX_LAG_SECONDS = 0.01  # of autocorrelations
MIN_FREQUENCY = 100.0  # Hz: lower channels are weighted as at this frequency
ACTIVE_PEAK_RATIO = 10 ** (-12 / 20)  # of the highest peak of all channels; channels that reach it are active
MAX_FEW_ACTIVE = 5  # active channels; if there are no more, each channel is normalised
MIN_ENERGY_RATIO = 1e-3  # of the strongest channel; weaker channels are ignored then
NOISE = 1e-13  # of the maximum possible correlation: smaller ones are rounding errors of 0
GAINS = np.arange(101) / 100  # possible gains of an echo
RATIOS = GAINS / (1 + GAINS**2)  # autocorrelation at the delay of the echo, divided by that at lag 0
MAX_GAIN = 0.9
SMALL, LARGE = 0, 1  # the two filters that remove the echo
PAIRS = np.array([(SMALL, SMALL), (LARGE, LARGE), (SMALL, LARGE), (LARGE, SMALL)])  # for left and right


class RunningSums:
    """The sums since the start.

    Attributes
    ----------
    gains, weights : ndarray (C,)
        Weights of the autocorrelations of the channels, and of the output correlations.
    power : ndarray (2 C / 8, K, 8)
        Spectra of the weighted autocorrelations of the channels; rows of the left ear, then of the right one.
    energies : ndarray (2, C)
        These autocorrelations at lag 0, their maximum.
    pairs : ndarray (4, L)
        Correlations of the `PAIRS`.
    """

    def __init__(self) -> None:
        self.begin(np.empty(0), 0, 0)

    def begin(self, frequencies: FloatArray, bins: int, lags: int) -> None:
        """Reset the sums for channels at these frequencies (Hz)."""
        channels = len(frequencies)
        self.gains, self.weights = 1 / np.maximum(frequencies, MIN_FREQUENCY), weights(frequencies)
        self.power = np.zeros((math.ceil(2 * channels / INTERLEAVED_ROWS), bins, INTERLEAVED_ROWS))
        self.energies = np.zeros((2, channels))
        self.pairs = np.zeros((len(PAIRS), lags))


class Precedence(FramedStage):
    """ITD (C, F) in s, ILD (C, F) in dB and correlation (C, L, F) of frames of (2, C, N) after removal of an echo.

    Positive differences mean a source on the right: the left ear lags, the right one is louder. With x a frame times
    the window (hanning), fs the sample rate, f the centre frequencies and XC(a, b)[m] = sum a[n+m] b[n]:

    1. Each ear's autocorrelations up to 10 ms, divided by max(f, 100 Hz), are summed since the start for each channel,
       and these over channels to s. If no more than 5 channels have their peaks within 12 dB of the highest one, each
       channel is first divided by its maximum, and channels with less than 0.001 of the strongest are ignored.
    2. The delay d of the echo is the maximum of s from 0.75 ms on. Its gain b = 0, 0.01... 0.9 is the first one with
       b / (1 + b**2) >= s[d] / max s; it is faded by t = 1 up to 6 ms, (1 - (d - 1 - 6 Q) / (14 Q - 1))**4 up to
       20 ms, Q being 1 ms.
    3. Two filters remove the echo from x: sum over i of (-b t)**i x[n - i d], which is 5 d longer than the frame, and
       sum over i of (-1)**(i+1) b**(6-i) t**(5-i) x[n + (6-i) d], which is d shorter; i = 0...5.
    4. There are four pairs of these filters for both ears. For each pair, correlations of the sum of all channels up to
       1 ms are summed since the start. The pair with the largest maximum is used.
    5. Its correlation in each channel is XC(l, r) / sqrt(sum l**2 sum r**2 + eps) W(f), with `weights` W. The ITD is
       the lag of the first maximum, 0 if all lags are equal. The ILD is 10 log10(sum r**2 / sum l**2), 0 if an ear is
       silent.

    Any change of a parameter or of the channels resets the sums. Unknown centre frequencies are taken as 0.
    """

    REPRESENTATION = Representation(
        kind="precedence",
        doc="Interaural differences of the first wave front",
        parent="gammatone",
        parts=(
            Part("itd", ("channel", "time"), "s"),
            Part("ild", ("channel", "time"), "dB"),
            Part("cc", ("channel", "lag", "time")),
        ),
        parameters=(
            replace(frame_parameters("prec")[1], minimum=MAX_LAG_SECONDS),
            frame_parameters("prec")[2],
            Parameter.positive(
                "prec_maxDelaySec", 0.001, "Maximum delay in cross-correlation computation (s)", 10.0, unit="s"
            ),
        ),
        derived=(Derived("prec_lags", "sequence<double>", "The lags, ascending", unit="s"),),
        coordinates=("prec_lags",),
        centred="lag",
        port_doc="Interaural time differences (s), level differences (dB) and correlations of the first wave front",
        references=(
            cite("braasch2013"),
            cite("stern1988", "weights of the channels"),
            cite("wallach1949", "precedence effect"),
        ),
    )
    prefix = "prec"

    @property
    def derived(self) -> dict[str, Any]:
        return {"prec_lags": (np.arange(-self._max_lag, self._max_lag + 1) / self.sample_rate).tolist()}

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return rows[1:]

    def part_rows(self, rows: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        return (rows[1:], rows[1:], (rows[1], 2 * self._max_lag + 1))

    def state_size(self, rows: tuple[int, ...]) -> int:
        bins = self._points // 2 + 1
        groups = -(-math.prod(rows) // INTERLEAVED_ROWS) * INTERLEAVED_ROWS
        return bins * (groups + 4)  # sums of spectra, and tables of the transform

    def process(
        self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None
    ) -> tuple[FloatArray, ...]:
        samples = self._as_valid_block(block)
        channels = samples.shape[1]
        if self._running.energies.shape[1] != channels:
            frequencies = np.array(self.input_format.center_frequencies)
            known = len(frequencies) == channels
            bins, lags = self._points // 2 + 1, 2 * self._pair_reach + 1
            self._running.begin(frequencies if known else np.zeros(channels), bins, lags)
        compiled = kernels.compiled()
        if compiled:
            frames = self._frames(samples, self._framing.pinned)
            count = frames.number
        else:
            views = self._new_frames(clamp(samples, SQUARE_TINY))
            count = views.shape[-2]
        itd, ild = np.empty((channels, count)), np.empty((channels, count))
        cc = np.empty((channels, 2 * self._max_lag + 1, count))
        at_once = min(count, max(1, BATCH // max(1, channels * self._size)))
        buffers = Windowed.allocate(at_once, channels, self._size)
        for first in range(0, count, max(1, at_once)):
            part = slice(first, min(first + at_once, count))
            batch = buffers.first(part.stop - first)
            if compiled:
                kernels.windowed(frames.part(first, part.stop - first), batch)
            else:
                windowed(views[..., part, :], self._framing.window, batch)
            self._localise(batch, itd[:, part], ild[:, part], cc[..., part])
        if compiled:
            frames.save_tail()
        return itd, ild, cc

    def reset(self) -> None:
        super().reset()
        self._running = RunningSums()

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(super().output_format, lags=self._max_lag)

    def input_format_changed(self, before: SignalFormat) -> None:
        self.build(self.values, frozenset())
        self._buffer = FrameBuffer()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        rate = self.sample_rate
        lag = check_length("prec_maxDelaySec", values["prec_maxDelaySec"] * rate)
        first_delay = math.floor(0.75 * rate / 1000)
        if first_delay < 1:
            raise ValueError(f"sample_rate: expected at least 1334 Hz for precedence, got {rate:.12g} Hz")
        super().build({**values, "prec_wname": "hanning"}, changed)
        self._size = len(self._framing.window)
        self._max_lag, self._pair_reach = math.ceil(lag), math.ceil(rate / 1000)
        self._first_delay, self._last_delay = first_delay, round_half_away(MAX_LAG_SECONDS * rate)
        self._lag_weights = fading(np.arange(self._last_delay + 1), round_half_away(rate / 1000))
        self._points = 1 << (self._size + self._last_delay - 1).bit_length()
        self._running = RunningSums()

    # --- a batch of frames -----------------------------------------------------------------------------------------

    def _localise(self, frames: Windowed, itd: FloatArray, ild: FloatArray, cc: FloatArray) -> None:
        """Compute the results (C, F), (C, F) and (C, L, F)."""
        count, running = itd.shape[1], self._running
        filters = self._filters(self._autocorrelations(frames))

        left, right = (np.broadcast_to(frames.sums[:, [ear]], (count, len(PAIRS), self._size)) for ear in range(2))
        l_taps, r_taps = (filters.of(slice(None), ear, PAIRS[:, ear]) for ear in range(2))  # (F, 4)
        lags, _ = self._correlate(left, l_taps, right, r_taps, self._pair_reach)
        sums = np.cumsum(np.concatenate((running.pairs[np.newaxis], lags)), axis=0)
        running.pairs = sums[-1].copy()
        best = PAIRS[sums[1:].max(axis=-1).argmax(axis=-1)]  # (F, 2)

        left, right = frames.samples[:, 0], frames.samples[:, 1]
        place = np.arange(count)[:, np.newaxis]
        l_taps, r_taps = (filters.of(place, ear, best[:, [ear]]) for ear in range(2))  # (F, 1)
        reach = min(self._max_lag, self._size + (TAPS - 1) * self._last_delay - 1)  # no overlap at longer lags
        lags, energies = self._correlate(left, l_taps, right, r_taps, reach)
        lags *= (running.weights / np.sqrt(energies[0] * energies[1] + EPSILON))[..., np.newaxis]
        if reach < self._max_lag:
            lags = np.pad(lags, ((0, 0), (0, 0), (self._max_lag - reach, self._max_lag - reach)))
        cc[...] = lags.transpose(1, 2, 0)
        differs = lags.max(axis=-1) > lags.min(axis=-1)
        itd[...] = (np.where(differs, lags.argmax(axis=-1) - self._max_lag, 0) / self.sample_rate).T
        levels = np.log10(energies, out=np.zeros_like(energies), where=(energies > 0).all(axis=0))
        ild[...] = 10 * (levels[1] - levels[0]).T

    def _autocorrelations(self, frames: Windowed) -> FloatArray:
        """Return autocorrelations summed over channels and since the start, (F, 2, lags from 0 on)."""
        running = self._running
        energies = np.cumsum(np.concatenate((running.energies[np.newaxis], frames.energies * running.gains)), axis=0)
        running.energies = energies[-1].copy()
        energies = energies[1:]
        active = (frames.peaks > ACTIVE_PEAK_RATIO * frames.peaks.max(axis=-1, keepdims=True)).sum(
            axis=-1, keepdims=True
        )
        strong = energies > np.maximum(MIN_ENERGY_RATIO * energies.max(axis=-1, keepdims=True), TINY)
        factors = np.where(
            active > MAX_FEW_ACTIVE, 1.0, np.divide(1.0, energies, out=np.zeros_like(energies), where=strong)
        )
        add = kernels.add_spectra if kernels.compiled() and self._points <= kernels.MAX_POINTS else add_spectra
        spectra = add(frames.samples, self._points, running.gains, factors, running.power)
        lags: FloatArray = scipy.fft.irfft(spectra, self._points)
        lags = lags[..., : self._last_delay + 1]
        lags[np.abs(lags) < NOISE * lags[..., :1]] = 0.0
        lags[..., self._size :] = 0.0  # no overlap
        return lags

    def _filters(self, lags: FloatArray) -> Taps:
        """Return the filters (F, 2 ears, 2 filters) that remove the echo from frames with these autocorrelations."""
        delays = self._first_delay + lags[..., self._first_delay :].argmax(axis=-1)
        largest = lags.max(axis=-1)
        echo = np.take_along_axis(lags, delays[..., np.newaxis], axis=-1)[..., 0]
        ratios = np.divide(echo, largest, out=np.zeros_like(echo), where=largest > 0).clip(0.0, 0.5)
        gains = np.minimum(GAINS[np.searchsorted(RATIOS, ratios)], MAX_GAIN)[..., np.newaxis]
        faded = self._lag_weights[delays][..., np.newaxis]
        order = np.arange(TAPS)
        back = TAPS - order
        small, large = (-gains * faded) ** order, (-1.0) ** (order + 1) * gains**back * faded ** (back - 1)
        return Taps(delays[..., np.newaxis, np.newaxis] * np.stack((order, -back)), np.stack((small, large), axis=-2))

    def _correlate(
        self, left: FloatArray, left_taps: Taps, right: FloatArray, right_taps: Taps, reach: int
    ) -> tuple[FloatArray, FloatArray]:
        few_lags = 2 * reach + 1 <= kernels.MAX_LAGS
        correlate = kernels.correlate_filtered if kernels.compiled() and few_lags else correlate_filtered
        lags, energies = correlate(left, left_taps, right, right_taps, reach)
        lags[np.abs(lags) < NOISE * np.sqrt(energies[0] * energies[1])[..., np.newaxis]] = 0.0
        return lags, energies


def fading(delays: Any, millisecond: int) -> FloatArray:
    """Return the weight of an echo by its delay: 1 up to 6 ms, 0 from 20 ms on."""
    late = (delays - 1 - 6 * millisecond) / (14 * millisecond - 1)
    return np.where(delays <= 6 * millisecond, 1.0, np.where(delays <= 20 * millisecond, (1 - late) ** 4, 0.0))


def weights(frequencies: FloatArray) -> FloatArray:
    """Return the weights W of channels by Stern et al. (1988), with a maximum at about 600 Hz."""
    low = np.minimum(frequencies, 1200.0)
    level: FloatArray = 0.0938272 * low - 0.000112586 * low**2 + 3.99154e-8 * low**3
    return 10 ** (level / 10) / 276


# --- the same without kernels -----------------------------------------------------------------------------------


def windowed(frames: FloatArray, window: FloatArray, output: Windowed) -> None:
    """Multiply frames (2, C, F, w) by the window (w,)."""
    np.multiply(frames.transpose(2, 0, 1, 3), window, out=output.samples)
    np.sum(output.samples, axis=2, out=output.sums)
    np.max(output.samples, axis=-1, out=output.peaks)
    np.einsum("feci,feci->fec", output.samples, output.samples, out=output.energies)


def add_spectra(
    samples: FloatArray, points: int, gains: FloatArray, factors: FloatArray, power: FloatArray
) -> FloatArray:
    """Add the power spectra of frames (F, 2, C, w), times `gains` (C,), to `power` of `RunningSums`, frame by frame.

    Returns `power` after each frame, times `factors` (F, 2, C) and summed over channels: (F, 2, K). The transform has
    `points` points, and K = points / 2 + 1.
    """
    sums = np.empty((len(samples), 2, power.shape[1]))
    row = np.arange(2 * len(gains)).reshape(2, -1)
    group, lane = row // INTERLEAVED_ROWS, row % INTERLEAVED_ROWS
    for frame, total, factor in zip(samples, sums, factors, strict=True):
        spectra = scipy.fft.rfft(frame, points)
        power[group, :, lane] += (np.square(spectra.real) + np.square(spectra.imag)) * gains[:, np.newaxis]
        np.einsum("ec,eck->ek", factor, power[group, :, lane], out=total)
    return sums


def correlate_filtered(
    left: FloatArray, left_taps: Taps, right: FloatArray, right_taps: Taps, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Correlate frames (F, A, w) of the two ears, each after its filter, over lags up to `reach`: (F, A, L).

    The filters are (F, A), or (F, 1) for all rows. Also returns the energies of the filtered frames, (2, F, A).
    """
    correlations, energies = np.empty((*left.shape[:2], 2 * reach + 1)), np.empty((2, *left.shape[:2]))
    alike = left_taps.shifts.shape[1] == 1
    for frame, which in np.ndindex(left_taps.shifts.shape[:2]):
        rows = slice(None) if alike else slice(which, which + 1)
        l_filtered = _filtered(left[frame, rows], left_taps.of(frame, which))
        r_filtered = _filtered(right[frame, rows], right_taps.of(frame, which))
        for ear, filtered in enumerate((l_filtered, r_filtered)):
            energies[ear, frame, rows] = np.einsum("ai,ai->a", filtered, filtered)
        longest = max(l_filtered.shape[1], r_filtered.shape[1], reach + 1)
        points = scipy.fft.next_fast_len(longest + reach, real=True)
        spectra = scipy.fft.rfft(l_filtered, points) * np.conj(scipy.fft.rfft(r_filtered, points))
        correlations[frame, rows] = np.roll(scipy.fft.irfft(spectra, points), reach, axis=-1)[:, : 2 * reach + 1]
    return correlations, energies


def _filtered(rows: FloatArray, taps: Taps) -> FloatArray:
    """Filter (A, w) by one filter; the result has at least one sample."""
    size = rows.shape[1]
    result = np.zeros((len(rows), max(1, size + taps.shifts[-1])))
    for shift, value in zip(*taps, strict=True):
        place = slice(max(0, shift), max(0, min(size + shift, result.shape[1])))
        result[:, place] += value * rows[:, place.start - shift : place.stop - shift]
    return result
