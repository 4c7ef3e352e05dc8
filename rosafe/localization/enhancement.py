"""Enhancement of the sound from a direction: a mask from interaural differences, applied to the gammatone channels.

As D. Wang and G. J. Brown (eds., 2006), Computational Auditory Scene Analysis, Wiley, describe for binaural cues; the
likelihood of the cues is that of the direction model (T. May, S. van de Par and A. Kohlrausch, 2011).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.ndimage

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp.framing import FrameGrid
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles, cues
from rosafe.localization.direction_model import WINDOW, DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.localizer import Localizer
from rosafe.processing.process import process
from rosafe.processing.resynthesis import resynthesize
from rosafe.processing.signals import ears_view

WIDTH, GAP = 10.0, 10.0  # degrees: directions up to WIDTH from the target are wanted, those beyond WIDTH + GAP are not
SHARPNESS = 1.5  # factor of log-likelihood ratios
_SMOOTHING = 0.5  # frames, of the mask along time
_BLOCK_SECONDS, _CONTEXT_SECONDS = 10.0, 0.5  # of sound whose channels are in memory; of sound before and after it


def direction_mask(
    sound: Any,
    sample_rate: float,
    azimuth: float,
    head: Head | str | os.PathLike[str] = "sphere",
    parameters: Mapping[str, Any] | None = None,
) -> FloatArray:
    """Estimate the part of each channel and frame that comes from a direction.

    Parameters
    ----------
    sound, sample_rate
        As of `rosafe.localize`.
    azimuth : float
        Direction of the target in degrees relative to the head, left positive.
    head, parameters
        As of `rosafe.localize`.

    Returns
    -------
    ndarray, (C, F)
        Weights from 0 to 1 for the channels in ceil(N / hop) frames of `ild`, as `rosafe.resynthesize` expects them:
        the posterior probability of the target, given ITD, ILD and coherence, if other directions are as likely.

    Raises
    ------
    ValueError
        For mono sound, a direction beyond 1e6 degrees or not finite, and as `rosafe.localize`.

    See Also
    --------
    rosafe.enhance : The sound that this mask selects.

    Notes
    -----
    Directions in front and behind with equal lateral angles are not distinguished.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(16000)
    >>> ears = rosafe.Head.sphere().render(noise, 16000, azimuth=40)
    >>> left, right = (rosafe.direction_mask(ears, 16000, azimuth) for azimuth in (40, -40))
    >>> left.shape, bool(left.mean() > 0.7 > 0.3 > right.mean())
    ((31, 100), True)
    """
    try:
        return _Enhancer(sound, sample_rate, azimuth, head, parameters).mask()
    except ValueError as problem:
        raise problem.with_traceback(None) from None


def enhance(
    sound: Any,
    sample_rate: float,
    azimuth: float,
    head: Head | str | os.PathLike[str] = "sphere",
    parameters: Mapping[str, Any] | None = None,
) -> FloatArray:
    """Enhance the sound from a direction.

    Parameters
    ----------
    sound, sample_rate, azimuth, head, parameters
        As of `rosafe.direction_mask`.

    Returns
    -------
    ndarray, (2, N)
        Both ears with the same weights, so that the interaural differences of the target remain.

    Raises
    ------
    ValueError
        As `rosafe.direction_mask`.

    See Also
    --------
    rosafe.direction_mask : The mask alone.
    rosafe.resynthesize : Sound from a result and a mask.

    Notes
    -----
    docs/resynthesis.md describes the method and its effect.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal((2, 16000))
    >>> head = rosafe.Head.sphere()
    >>> wanted, other = head.render(noise[0], 16000, 0), head.render(noise[1], 16000, 60)
    >>> rosafe.enhance(wanted + other, 16000, azimuth=0).shape
    (2, 16000)
    """
    try:
        return _Enhancer(sound, sample_rate, azimuth, head, parameters).enhance()
    except ValueError as problem:
        raise problem.with_traceback(None) from None


class _Enhancer:
    """A sound, a direction and the model of the head, with checked arguments."""

    def __init__(
        self, sound: Any, sample_rate: float, azimuth: Any, head: Any, parameters: Mapping[str, Any] | None
    ) -> None:
        view = ears_view(sound)
        if view.shape[0] != 2:
            raise ValueError(f"sound: expected two ears, (2, N) or (N, 2), got shape {np.shape(sound)}")
        if not is_number(azimuth) or not angles.in_limits(azimuth):
            raise ValueError(f"azimuth: expected a finite number {angles.LIMITS}, got {short_repr(azimuth)}")
        self._view, self._rate = view, sample_rate
        self._model = Localizer(sample_rate, head, parameters=parameters).model
        self._distance = np.abs(angles.lateral(self._model.azimuths) - angles.lateral(azimuth))

    def _values(self) -> dict[str, Any]:
        return {**self._model.parameters, "in_doNormalize": self._view.dtype.kind == "i"}

    def mask(self) -> FloatArray:
        """Return the mask (C, F)."""
        model = self._model
        if not self._view.shape[1]:
            return np.empty((model.channels, 0))
        features = process(self._view, self._rate, parameters=self._values(), outputs=list(cues.KINDS), pad=True)
        quantized = cues.quantize(features, cues.scaling_db(model.parameters), model.max_itd)
        mask = np.empty((model.channels, len(quantized.level)))
        for begin in range(0, mask.shape[1], WINDOW):
            frames = slice(begin, begin + WINDOW)
            # the floor of a channel is that of a window of its own, as it was when the model was learned
            around = slice(max(0, min(begin, mask.shape[1] - WINDOW)), begin + WINDOW)
            mask[:, frames] = self._probability(model, quantized.select(frames), quantized.level[around]).T
        return np.asarray(scipy.ndimage.gaussian_filter1d(mask, _SMOOTHING, axis=1))

    def _probability(self, model: DirectionModel, found: cues.Cues, around: FloatArray) -> FloatArray:
        """Return the probability (F, C) that a frame of a channel comes from the target."""
        terms = model.unweighted_terms(*model.rows(found, cues.floors(around)))
        likelihood = np.exp(SHARPNESS * (terms - terms.max(axis=-1, keepdims=True)), dtype=np.float64)
        near, far = self._distance <= WIDTH + 1e-9, self._distance > WIDTH + GAP
        wanted = likelihood[..., near if near.any() else self._distance == self._distance.min()].mean(axis=-1)
        return np.asarray(wanted / (wanted + likelihood[..., far].mean(axis=-1)))

    def enhance(self) -> FloatArray:
        """Return the enhanced sound (2, N)."""
        mask, samples = self.mask(), self._view.shape[1]
        values = {**self._values(), "pp_bRemoveDC": False}  # the high-pass is for the cues only
        hop = FrameGrid.design(self._rate, "ild", values).hop
        step, context = (-(-round(seconds * self._rate) // hop) for seconds in (_BLOCK_SECONDS, _CONTEXT_SECONDS))
        output = np.empty((2, samples))
        for first in range(0, mask.shape[1], step):
            begin, end = max(0, first - context), min(first + step, mask.shape[1]) + context
            block = self._view[:, begin * hop : end * hop]
            result = process(block, self._rate, parameters=values, outputs=["gammatone"])
            enhanced = resynthesize(result, mask[:, begin:end])
            part = output[:, first * hop : (first + step) * hop]
            part[:] = enhanced[:, (first - begin) * hop :][:, : part.shape[1]]
        return output
