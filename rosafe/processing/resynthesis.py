"""Back to sound: `rosafe.resynthesize` for results, `rosafe.Resynthesizer` for channels that arrive block by block."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp.copies import OwnState
from rosafe.dsp.framing import FrameGrid
from rosafe.dsp.gammatone_synthesis import (
    PAST_SECONDS,
    ComplexArray,
    causal_synthesis,
    end_samples,
    outputs_after_end,
    response_length,
    responses,
    synthesis_responses,
)
from rosafe.dsp.numeric_limits import FloatArray, as_numbers
from rosafe.interface import KINDS
from rosafe.processing.stream import Stream
from rosafe.representations.preproc import LEVEL_OF_RMS_1, PreProc
from rosafe.results.result import Result
from rosafe.tree.workers import workers_to_use

_CHUNK = 2**17  # samples of a Fourier transform; more for very narrow filters
_RESPONSES = 2**23  # samples of the Fourier transforms of all channels together: fewer for many channels
_OVERLAP = 2.5  # lengths of the longest impulse response before and after a chunk
_MAX_COMPENSATION = 1e-4  # of the largest power response of the preprocessing: below, it is not compensated
_DELAYS = (0.001, 1.0)  # s, of `Resynthesizer`
_MAX_TAPS = 2**23  # of all its filters together
_MAX_VALUE = 1e100  # of a channel: sums of larger ones overflow
_NUMBERS = f"finite numbers up to {_MAX_VALUE:g}, got larger ones, NaN or infinity"
_TOLERANCE = 1e-9  # of values of a mask


def resynthesize(result: Result, mask: Any = None) -> FloatArray:
    """Compute the sound of a gammatone output, whose channels may be weighted over time by a mask.

    Parameters
    ----------
    result : Result
        Of `rosafe.process` or `rosafe.load`, with the output `gammatone` of linear filters (`fb_type` gammatone).
    mask : array_like, (C, F) or (C, N), optional
        Weights from 0 to 1 for the channels in the frames of `ild`, between whose middles they are interpolated, or for
        each sample. (ears, C, F) or (ears, C, N) has weights for each ear.

    Returns
    -------
    ndarray, (2, N)
        The sound, aligned with the input and at its level; (1, N) for one ear.

    Raises
    ------
    ValueError
        If the result has no gammatone output or one of DRNL filters, and for a mask of another shape or with values
        that are not from 0 to 1.

    See Also
    --------
    rosafe.Resynthesizer : The same with a constant delay, for sound that arrives block by block.
    rosafe.direction_mask : A mask that selects the sound from a direction.

    Notes
    -----
    The channels pass the time-reversed filters, and their sum is equalized: the least-squares solution, without delay.
    Frequencies from about half of the lowest centre frequency on are restored, up to a little above the highest one.
    The response of the filters to the end of the sound, which is not in the result, is estimated from the channels.
    Level scaling, pre-emphasis and the middle ear are compensated; DC removal and gain control are not.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = np.random.default_rng(1).standard_normal((2, 8000))
    >>> result = rosafe.process(noise, 16000, outputs=["gammatone"])
    >>> rosafe.resynthesize(result).shape
    (2, 8000)
    """
    try:
        channels, frequencies, values = _checked_result(result)
        weights = None if mask is None else _Mask(mask, channels.shape, values, result.sample_rate)
        return _Synthesis(channels, frequencies, values, result.sample_rate, weights).run()
    except ValueError as problem:
        raise problem.with_traceback(None) from None  # internal frames do not help the caller


def _checked_result(result: Any) -> tuple[np.ndarray, FloatArray, dict[str, Any]]:
    """Return the channels (ears, C, N), the centre frequencies (C,) and all parameters of a result."""
    if not isinstance(result, Result):
        raise ValueError(
            f"result: expected a result of rosafe.process or rosafe.load, got {type(result).__name__}; "
            "for blocks of rosafe.Stream use rosafe.Resynthesizer"
        )
    if "gammatone" not in result:
        raise ValueError(
            f"result: expected the output gammatone, got {', '.join(result.axes) or 'no outputs'}; "
            "add it to `outputs` of rosafe.process"
        )
    channels = np.asarray(result["gammatone"])
    values = {**_defaults(), **result.parameters}
    _check_linear(values)
    frequencies = np.atleast_1d(np.asarray(result.get("fb_cfHz", values["fb_cfHz"]), np.float64))
    if channels.ndim != 3 or channels.shape[1] != len(frequencies):
        raise ValueError(
            f"gammatone: expected shape (ears, {len(frequencies)}, N) for {len(frequencies)} channels, "
            f"got {short_repr(channels.shape)}"
        )
    if not all((np.abs(row) <= _MAX_VALUE).all() for ear in channels for row in ear):
        raise ValueError(f"gammatone: expected {_NUMBERS}")
    return channels, frequencies, values


def _defaults() -> dict[str, Any]:
    kinds = ("preProc", "gammatone", "ild")
    return {parameter.name: parameter.default for kind in kinds for parameter in KINDS[kind].parameters}


def _check_linear(values: Mapping[str, Any]) -> None:
    if values["fb_type"] != "gammatone":
        raise ValueError(
            f"fb_type: expected 'gammatone', got {short_repr(values['fb_type'])}: DRNL filters are not linear and "
            "cannot be inverted"
        )


class _Mask:
    """Weights (ears or 1, C, F or N) for samples.

    Parameters
    ----------
    mask : array_like
        As of `resynthesize`.
    shape : tuple of int
        Of the channels, (ears, C, N).
    values : mapping
        Parameters of `ild`, in whose frames the mask is.
    sample_rate : float
        In Hz.
    """

    def __init__(self, mask: Any, shape: tuple[int, ...], values: Mapping[str, Any], sample_rate: float) -> None:
        ears, channels, samples = shape
        grid = FrameGrid.design(sample_rate, "ild", values)
        weights = checked_weights(mask, ears, channels)
        counts = {samples, grid.complete_frames(samples), -(-samples // grid.hop)}
        if weights.shape[2] not in counts:
            raise ValueError(
                f"mask: expected {grid.complete_frames(samples)} frames as of ild, or {samples} samples, "
                f"got {weights.shape[2]}"
            )
        self.weights = weights
        self._middles = None
        if weights.shape[2] != samples:
            self._middles = np.arange(weights.shape[2]) * grid.hop + len(grid.window) / 2

    def of(self, channel: int, first: int, end: int) -> FloatArray:
        """Return the weights (ears or 1, n) of a channel from sample `first` to `end`; the last one remains."""
        rows = self.weights[:, channel]
        if self._middles is None:
            return rows[:, np.minimum(np.arange(first, end), rows.shape[1] - 1)]
        if not len(self._middles):
            return np.ones((1, end - first))
        return np.stack([np.interp(np.arange(first, end), self._middles, row) for row in rows])


def checked_weights(mask: Any, ears: int, channels: int) -> FloatArray:
    """Return a mask as (ears or 1, C, n); ValueError for another shape and for values that are not from 0 to 1."""
    try:
        weights = np.asanyarray(mask)
    except ValueError:
        raise ValueError("mask: expected an array, got rows of different lengths") from None
    if isinstance(weights, np.ma.MaskedArray):
        raise ValueError("mask: expected an array of weights, got a masked array; call its method filled(0)")
    if weights.dtype.kind not in "fiub" or weights.ndim not in (2, 3):
        raise ValueError(
            f"mask: expected numbers of shape ({channels}, F) or ({channels}, N), got {weights.dtype} of shape "
            f"{short_repr(weights.shape)}"
        )
    weights = weights if weights.ndim == 3 else weights[np.newaxis]
    if weights.shape[0] not in (1, ears) or weights.shape[1] != channels:
        raise ValueError(
            f"mask: expected {channels} channels, and one or {ears} ears, got shape {short_repr(np.shape(mask))}"
        )
    if weights.size and not (weights.min() >= -_TOLERANCE and weights.max() <= 1 + _TOLERANCE):  # false for NaN too
        raise ValueError(f"mask: expected values from 0 to 1, got {weights.min():g} to {weights.max():g}")
    return np.asarray(weights, np.float64)


class _Synthesis:
    """The synthesis of whole signals: overlapping chunks, on the available cores.

    Parameters
    ----------
    channels : ndarray, (ears, C, N)
        The output of the filterbank.
    frequencies : ndarray, (C,)
        Centre frequencies, Hz.
    values : mapping
        Parameters of `preProc` and `gammatone`.
    sample_rate : float
        In Hz.
    mask : _Mask or None
        Weights of the channels.
    """

    def __init__(
        self,
        channels: np.ndarray,
        frequencies: FloatArray,
        values: Mapping[str, Any],
        sample_rate: float,
        mask: _Mask | None,
    ) -> None:
        self._channels = channels
        self._mask = mask
        bank = (sample_rate, frequencies, int(values["fb_nGamma"]), float(values["fb_bwERBs"]))
        samples = channels.shape[2]
        self._overlap = int(_OVERLAP * response_length(*bank))
        longest = max(min(_CHUNK, _RESPONSES // len(frequencies)), 4 * self._overlap)
        self._size = scipy.fft.next_fast_len(min(longest, samples + 2 * self._overlap), real=True)
        self._step = self._size - 2 * self._overlap
        self._filters = _filters(values, self._size, *bank)[1]
        length = response_length(*bank)
        unknown = min(samples, end_samples(sample_rate))
        width = min(samples, unknown + 2 * length)
        size = scipy.fft.next_fast_len(width + 2 * length, real=True)
        self._after = np.zeros((*channels.shape[:2], 0))  # outputs after the end, (ears, C, length)
        if samples:
            last = channels[..., samples - width :]
            self._after = outputs_after_end(last, *_filters(values, size, *bank), size, length, unknown)

    def run(self) -> FloatArray:
        """Return the sound, (ears, N)."""
        ears, _, samples = self._channels.shape
        sound = np.empty((ears, samples))
        firsts = range(0, samples, self._step)
        if len(firsts) < 2:
            for first in firsts:
                self._chunk(sound, first)
            return sound
        with ThreadPoolExecutor(workers_to_use()) as pool:
            for done in [pool.submit(self._chunk, sound, first) for first in firsts]:
                done.result()
        return sound

    def _chunk(self, sound: FloatArray, first: int) -> None:
        """Compute the samples of `sound` from `first` on, as many as a chunk has."""
        samples = sound.shape[1]
        begin = max(0, first - self._overlap)
        end = min(samples + self._after.shape[2], first + self._step + self._overlap)
        lead, known = begin - (first - self._overlap), min(samples, end) - begin
        padded = np.zeros((len(sound), self._size))
        total = np.zeros((len(sound), self._size // 2 + 1), np.complex128)
        for channel, response in enumerate(self._filters):
            block = padded[:, lead : lead + end - begin]
            block[:, :known] = self._channels[:, channel, begin : begin + known]
            block[:, known:] = self._after[:, channel, : end - begin - known]
            if self._mask is not None:
                block *= self._mask.of(channel, begin, end)
            total += response * scipy.fft.rfft(padded)
        count = min(self._step, samples - first)
        sound[:, first : first + count] = scipy.fft.irfft(total, self._size)[:, self._overlap : self._overlap + count]


def _filters(
    values: Mapping[str, Any], size: int, sample_rate: float, frequencies: FloatArray, order: int, width: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return the frequency responses (C, size // 2 + 1) from the sound to the channels, and those of the synthesis."""
    analysis = responses(size, sample_rate, frequencies, order, width)
    synthesis = synthesis_responses(analysis, frequencies, sample_rate)
    preprocessing = _preprocessing(values, sample_rate, size)
    power = np.abs(preprocessing) ** 2
    synthesis *= preprocessing.conj() / np.maximum(power, _MAX_COMPENSATION * power.max())
    analysis *= preprocessing
    return analysis, synthesis


def _preprocessing(values: Mapping[str, Any], sample_rate: float, size: int) -> ComplexArray:
    """Return the response of level scaling, pre-emphasis and middle ear at the frequencies of an FFT."""
    own = {parameter.name for parameter in KINDS["preProc"].parameters}
    chosen = {name: value for name, value in values.items() if name in own}
    impulse = np.zeros((2, size))
    impulse[:, 0] = 1.0
    stage = PreProc(sample_rate, **{**chosen, "pp_bRemoveDC": False, "pp_bNormalizeRMS": False})
    return np.asarray(scipy.fft.rfft(stage.process(impulse)[0]))


class Resynthesizer(OwnState):
    """The sound of gammatone channels that arrive block by block, with a constant delay.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Those with which the channels are computed, as of `rosafe.Stream`.
    delay : float, optional
        Of the sound relative to the input of the filterbank, in s, from 0.001 to 1. A longer delay has a smaller error.

    Attributes
    ----------
    delay : float
        The delay in s: a whole number of samples.
    delay_samples : int
        The delay in samples.
    error_db : float
        Level of the error relative to the sound, for speech-shaped noise between 1.2 times the lowest and 0.8 times the
        highest centre frequency.

    Raises
    ------
    ValueError
        One line that names the parameter.

    See Also
    --------
    rosafe.resynthesize : Without delay, for whole results.

    Notes
    -----
    Level scaling is compensated; other preprocessing is not. The output of a block depends on no later block, and only
    by rounding on the length of blocks. Copies by `copy` and `pickle` are independent and continue with the same
    numbers.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> stream = rosafe.Stream(16000, outputs=["gammatone"])
    >>> resynthesizer = rosafe.Resynthesizer(16000, delay=0.016)
    >>> for block in np.zeros((10, 2, 160)):
    ...     sound = resynthesizer.process(stream.process(block)["gammatone"])
    >>> sound.shape, resynthesizer.delay_samples, resynthesizer.error_db < -40
    ((2, 160), 256, True)
    """

    def __init__(self, sample_rate: float, parameters: Mapping[str, Any] | None = None, delay: float = 0.016) -> None:
        described = Stream(sample_rate, parameters, ["gammatone"]).describe()
        values = described["parameters"]
        _check_linear(values)
        if not (is_number(delay) and _DELAYS[0] <= delay <= _DELAYS[1]):
            raise ValueError(f"delay: expected {_DELAYS[0]:g} to {_DELAYS[1]:g} s, got {short_repr(delay)}")
        highest = _MAX_TAPS / len(described["fb_cfHz"]) / (delay + PAST_SECONDS)
        if sample_rate > highest:
            raise ValueError(
                f"sample_rate: expected at most {highest:.0f} Hz for a delay of {delay:g} s, got {sample_rate:g}"
            )
        self.delay_samples = round(delay * sample_rate)
        self.delay = self.delay_samples / sample_rate
        filters, self.error_db = causal_synthesis(
            sample_rate, described["fb_cfHz"], values["fb_nGamma"], values["fb_bwERBs"], self.delay_samples
        )
        scaling = (values["pp_refSPLdB"] - LEVEL_OF_RMS_1) / 20 if values["pp_bLevelScaling"] else 0.0
        self._filters = filters * 10**scaling
        self._spectra: tuple[int, ComplexArray | None] = (0, None)  # size and transform of the filters
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first block."""
        self._past: FloatArray | None = None  # (ears, C, L - 1)

    def process(self, channels: Any, mask: Any = None) -> FloatArray:
        """Compute the sound for the next block of channels.

        Parameters
        ----------
        channels : array_like, (ears, C, n)
            The output `gammatone` of `rosafe.Stream.process`; all blocks have one number of ears.
        mask : array_like, (C, n), optional
            Weights from 0 to 1; (ears, C, n) for each ear.

        Returns
        -------
        ndarray, (ears, n)
            Sound that ends `delay` before the end of the block.

        Raises
        ------
        ValueError
            For channels or a mask of the wrong shape or with other values; nothing has changed.
        """
        block = as_numbers("channels", channels)
        count, taps = self._filters.shape
        ears = (1, 2) if self._past is None else (len(self._past),)
        if block.ndim != 3 or block.shape[0] not in ears or block.shape[1] != count:
            raise ValueError(
                f"channels: expected shape ({' or '.join(map(str, ears))}, {count}, n), got {short_repr(block.shape)}"
            )
        if not (np.abs(block) <= _MAX_VALUE).all():
            raise ValueError(f"channels: expected {_NUMBERS}")
        length = block.shape[2]
        if mask is not None:
            weights = checked_weights(mask, len(block), count)
            if weights.shape[2] != length:
                raise ValueError(f"mask: expected {length} samples, got {weights.shape[2]}")
            block = block * weights
        past = np.zeros((len(block), count, taps - 1)) if self._past is None else self._past
        joined = np.concatenate((past, block), axis=-1)
        self._past = joined[..., length:].copy()
        size = scipy.fft.next_fast_len(taps - 1 + length, real=True)
        if self._spectra[0] != size:
            self._spectra = size, scipy.fft.rfft(self._filters, size)
        total = np.sum(self._spectra[1] * scipy.fft.rfft(joined, size), axis=1)
        return np.asarray(scipy.fft.irfft(total, size)[:, taps - 1 : taps - 1 + length])
