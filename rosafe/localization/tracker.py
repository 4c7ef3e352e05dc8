"""Tracks of sources from candidates: birth, motion, crossing and death.

Each track is a Kalman filter over azimuth and angular velocity, with a probability of existence as in D. Musicki,
R. Evans and S. Stankovic (1994), "Integrated probabilistic data association", IEEE Trans. Autom. Control 39,
1237-1241. Candidates are assigned to tracks by the smallest sum of distances.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from rosafe.localization import angles
from rosafe.localization.mixture import MIN_SHARE, SEPARATION, Candidate

PRESENT = 0.5  # a source with a higher probability is present
FORGOTTEN = 0.05  # a source with a lower probability is dropped
GATE = 15.0  # degrees between a track and its candidate, at most
_MEASUREMENT_STD = 3.0  # degrees, of a candidate
_VELOCITY_STD = 15.0  # degrees/s, of a new track
_ACCELERATION_STD = 8.0  # degrees/s per square root of a second
_NEW_SHARE = 0.12  # of a candidate of a source that is not known yet; noise without a direction gives smaller peaks
_IMAGE_WIDTH = 7.5  # degrees of lateral angle between a source and its image, at most
_CLEAR_ODDS = 4.0  # log-odds of a candidate against its front-back image that decide,
_CLEAR_OWN_ODDS = 10.0  # and of its own units
_CLEAR_SECONDS = 2.0  # for which a decision holds
_ODDS_RATE = 0.1  # of the mean log-odds of a track
_BIRTH = -2.0  # log-odds of a new track
_MAX_LOG_ODDS = 2.2
_GAIN, _MAX_GAIN = 8.0, 1.5  # log-odds per share above the needed one, and at most
_LOSS = 0.7  # log-odds for each update with a smaller share
MIN_LEVEL_DB = -200.0  # level of silence
_CROSSING = 3.0  # s, at most, in which two sources have one candidate
_COURSE = 20  # updates in which a source moves or does not
_MOVED = 8.0  # degrees in these updates: a source that moves
_SHARE_RATE = 0.2  # of the mean share of a track


class Track:
    """One source.

    Attributes
    ----------
    id : int
        Number of the source; 0 until it was present for the first time.
    first_time, last_time : float
        When a candidate supported it first and last, s.
    state : ndarray, (2,)
        Azimuth (degrees) and angular velocity (degrees/s).
    share : float
        Mean over the last half second.
    power : float
        Of the last candidate.
    """

    def __init__(self, candidate: Candidate, time: float) -> None:
        self.id = 0
        self.first_time = self.last_time = time
        self.state = np.array([candidate.azimuth, 0.0])
        self.share, self.power = candidate.share, candidate.power
        self.odds = candidate.odds  # mean against the front-back image
        self._clear_time = -math.inf
        self.own_time = time  # when it had a candidate that is not also near another track without one
        self.log_odds = _BIRTH
        self._covariance = np.diag([_MEASUREMENT_STD**2, _VELOCITY_STD**2])
        self.history: list[tuple[float, float, float, float]] = []
        self._course: deque[tuple[float, float]] = deque(maxlen=_COURSE)  # azimuth in the world, and from the head

    @property
    def azimuth(self) -> float:
        """Degrees in (-180, 180]."""
        return float(angles.wrap(self.state[0]))

    @property
    def azimuth_std(self) -> float:
        """Standard deviation of the azimuth in degrees."""
        return float(np.sqrt(self._covariance[0, 0]))

    @property
    def probability(self) -> float:
        """Probability that the source exists and sounds."""
        return float(1 / (1 + np.exp(-self.log_odds)))

    def level_db(self, gain_db: float) -> float:
        """Return the level of its last candidate; `gain_db` leads from a power of the ratemap to dB full scale."""
        return max(MIN_LEVEL_DB, 10 * math.log10(max(self.power, 1e-300)) + gain_db)

    def predict(self, seconds: float) -> None:
        """Move it on in time."""
        transition = np.array([[1.0, seconds], [0.0, 1.0]])
        self.state = transition @ self.state
        noise = _ACCELERATION_STD**2 * np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        self._covariance = transition @ self._covariance @ transition.T + noise

    def correct(self, candidate: Candidate, time: float, is_own: bool = True) -> None:
        """Update it with its candidate; it moves on as before if that is also the candidate of another source."""
        if is_own:
            innovation = float(angles.difference(candidate.azimuth, self.state[0]))
            gain = self._covariance[:, 0] / (self._covariance[0, 0] + _MEASUREMENT_STD**2)
            self.state = self.state + gain * innovation
            self._covariance = self._covariance - np.outer(gain, self._covariance[0])
            self.own_time = time
        self.power = candidate.power
        self.last_time = time
        self.odds += _ODDS_RATE * (candidate.odds - self.odds)
        if candidate.odds > _CLEAR_ODDS or candidate.own_odds > _CLEAR_OWN_ODDS:
            self._clear_time = time

    def is_clear(self, time: float) -> bool:
        """Return whether cues decided lately that this source is none of a front-back image."""
        return time - self._clear_time <= _CLEAR_SECONDS

    def support(self, excess: float) -> None:
        """Raise the probability by the `excess` of the share over the needed one; lower it if that is not positive."""
        gain = min(_MAX_GAIN, _GAIN * excess) if excess > 0 else -_LOSS
        self.log_odds = min(_MAX_LOG_ODDS, self.log_odds + gain)

    def follow(self, yaw: float) -> None:
        """Add the present azimuth to those that show whether the source moves."""
        self._course.append((self.azimuth, self.azimuth - yaw))

    @property
    def moves(self) -> bool:
        """Whether the source has moved, both in the world and relative to the head."""
        course = np.array(self._course).reshape(-1, 2)
        return bool(len(course)) and bool(np.all(np.abs(angles.difference(course, course[-1])).max(axis=0) > _MOVED))

    @property
    def rank(self) -> tuple[bool, float, float]:
        """The order in which tracks remain if cues do not decide clearly: known ones, odds, shares."""
        return bool(self.id), self.odds, self.share

    def remember(self, time: float) -> None:
        """Add the present values to the history."""
        self.history.append((time, self.azimuth, self.azimuth_std, self.probability))

    def as_dict(self) -> dict[str, Any]:
        """Return the track as `rosafe.localize` does."""
        time, azimuth, std, probability = np.array(self.history, np.float64).reshape(-1, 4).T
        return {
            "id": self.id,
            "first_time": self.first_time,
            "last_time": self.last_time,
            "time": time,
            "azimuth": azimuth,
            "azimuth_std": std,
            "probability": probability,
        }


class Tracker:
    """Sources over time.

    Attributes
    ----------
    tracks : list of Track
        Those that are not forgotten; a source is present if its probability is above `PRESENT`.
    finished : list of Track
        Those that were present once and are forgotten now, if `keep` was set.
    time : float
        Of the last update, s; -inf before the first one.
    """

    def __init__(self, keep: bool = True) -> None:
        self.tracks: list[Track] = []
        self.finished: list[Track] = []
        self._keep = keep
        self.time = -math.inf
        self._next_id = 1

    def update(self, candidates: Sequence[Candidate], time: float, yaw: float = 0.0) -> None:
        """Take the candidates of the time `time` (s), which must ascend; `yaw` (degrees) is that of the head."""
        for track in self.tracks:
            track.predict(time - self.time)
            track.follow(yaw)
        self.time = time
        matched = self._assign(candidates)
        shared = {
            index: other
            for index, track in enumerate(self.tracks)
            if index not in matched and (other := self._shared(track, candidates)) is not None
        }
        shares = [0.0] * len(self.tracks)  # evidence for each track
        for index, track in enumerate(self.tracks):
            if index in matched:
                candidate = candidates[matched[index]]
                crosses = self.time - track.own_time < _CROSSING and any(one is candidate for one in shared.values())
                track.correct(candidate, time, is_own=not crosses)
                shares[index] = candidate.share
            elif index in shared:
                shares[index] = MIN_SHARE + (shared[index].share - MIN_SHARE) / 2
            track.share += _SHARE_RATE * (shares[index] - track.share)
        for share, track in zip(shares, self.tracks, strict=True):
            track.support(share - self._needed_share(track, yaw))
        taken = set(matched.values())
        for index, candidate in enumerate(candidates):
            if index not in taken and candidate.share > _NEW_SHARE and self._is_new(candidate):
                self.tracks.append(Track(candidate, time))
        self._remember(time)

    def _assign(self, candidates: Sequence[Candidate]) -> dict[int, int]:
        """Return the candidate of each track that has one."""
        if not self.tracks or not candidates:
            return {}
        azimuths = np.array([candidate.azimuth for candidate in candidates])
        states = np.array([track.state[0] for track in self.tracks])
        distance = np.abs(angles.difference(states[:, np.newaxis], azimuths))
        rows, columns = linear_sum_assignment(np.where(distance <= GATE, distance, 1000.0))
        return {
            int(row): int(column) for row, column in zip(rows, columns, strict=True) if distance[row, column] <= GATE
        }

    def _shared(self, track: Track, candidates: Sequence[Candidate]) -> Candidate | None:
        """Return the candidate of another track that this one, which is present, crosses; it moves on without one."""
        if track.id and self.time - track.own_time < _CROSSING:
            for candidate in candidates:
                if abs(float(angles.difference(candidate.azimuth, track.state[0]))) < SEPARATION:
                    return candidate
        return None

    def _is_new(self, candidate: Candidate) -> bool:
        """Return whether no track is near a candidate."""
        azimuths = np.array([track.state[0] for track in self.tracks])
        return bool((np.abs(angles.difference(candidate.azimuth, azimuths)) >= SEPARATION).all())

    def _needed_share(self, track: Track, yaw: float) -> float:
        """Return the share that raises the probability of a track: none suffices for the front-back image of another.

        Two tracks are images of each other if their lateral angles are equal. Both remain if the cues were clearly
        those of one, and clearly those of the other, at different times; otherwise the one with the better cues
        remains.
        """
        for other in self.tracks:
            laterals = angles.lateral(np.array([track.state[0], other.state[0]]) - yaw)
            if abs(float(laterals[0] - laterals[1])) >= _IMAGE_WIDTH or track.is_clear(self.time):
                continue
            if angles.in_front(track.state[0] - yaw) == angles.in_front(other.state[0] - yaw):
                continue
            if other.is_clear(self.time) or track.rank < other.rank:
                return math.inf
        return MIN_SHARE if track.id else _NEW_SHARE

    def _remember(self, time: float) -> None:
        kept = []
        for track in self.tracks:
            if not track.id and track.probability > PRESENT:
                track.id, self._next_id = self._next_id, self._next_id + 1
            if track.probability < FORGOTTEN:
                if track.id and self._keep:
                    self.finished.append(track)
                continue
            if self._keep:
                track.remember(time)
            kept.append(track)
        self.tracks = kept

    def present(self) -> list[Track]:
        """Return the sources that are present."""
        return [track for track in self.tracks if track.id and track.probability > PRESENT]

    def histories(self) -> list[dict[str, Any]]:
        """Return all sources that were ever present, in the order of their ids."""
        tracks = [track for track in [*self.finished, *self.tracks] if track.id]
        return [track.as_dict() for track in sorted(tracks, key=lambda track: track.id)]
