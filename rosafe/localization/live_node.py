"""The common part of the localizer nodes of ROS 1 and ROS 2, without ROS: content of topics, localization, streams."""

from __future__ import annotations

import abc
import array
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import (
    OK,
    FixedHead,
    FrameQueue,
    FrameSource,
    HeadRotation,
    LocalizationLoop,
    Mute,
    Status,
    TransformedHead,
    Transforms,
)
from rosafe.localization.live_streams import LiveSound, LiveStreams
from rosafe.localization.localizer import Localizer
from rosafe.localization.settings import LocalizerSettings, Models
from rosafe.localization.speech import SPEAKS
from rosafe.localization.stored_noise import StoredNoise
from rosafe.localization.streams import RATE, SourcePart
from rosafe.localization.tracker import FORGOTTEN, PRESENT, Track

MAX_PARTS = 200  # of streams for a slow subscriber: at least a second; older ones are dropped


class MessageClasses(NamedTuple):
    """Classes of messages, whose fields are the same in ROS 1 and ROS 2."""

    header: Any
    pose: Any
    source: Any
    time: Callable[[float], Any]  # returns a clock time (s) as a field


class SourceTopics(abc.ABC):
    """Publishes sources, poses, the posterior, and the sound of each source.

    Parameters
    ----------
    messages : MessageClasses
    frame_id : str
        Coordinate frame of all azimuths.
    speech_only : bool
        Whether only sources that speak have poses.

    Attributes
    ----------
    streams : LiveStreams
        Provides the probability that a source speaks.
    """

    streams: LiveStreams

    def __init__(self, messages: MessageClasses, frame_id: str, speech_only: bool) -> None:
        self._messages, self._frame_id, self._speech_only = messages, frame_id, speech_only
        self._first_id = self._last_id = 0

    @abc.abstractmethod
    def has_subscribers(self, topic: str) -> bool:
        """Return whether `sources`, `poses`, `posterior` or `streams` has subscribers."""

    @abc.abstractmethod
    def send(self, topic: str, fields: Callable[[], Mapping[str, Any]]) -> None:
        """Publish a message; its fields are computed for subscribers only, perhaps later and more than once."""

    def begin_again(self) -> None:
        """Prepare for tracks that are numbered from 1 again: published ids continue."""
        self._first_id = self._last_id
        self.streams.begin_again(self._first_id)

    def has_stream_subscribers(self) -> bool:
        """Return whether the sound of sources is used."""
        return self.has_subscribers("streams")

    def has_speech_subscribers(self) -> bool:
        """Return whether the probability that a source speaks is used."""
        return self.has_subscribers("sources") or (self._speech_only and self.has_subscribers("poses"))

    def publish_part(self, part: SourcePart, time: float) -> None:
        """Publish the next samples of a source, of which the first is that of a clock time (s)."""
        if self.has_stream_subscribers():
            fields = {
                "header": self.header(time),
                "id": part.id,
                "azimuth": math.radians(part.azimuth),
                "sample_rate": RATE,
                "first_sample": part.first_sample,
                "samples": array.array("h", part.samples.tobytes()),
            }
            self.send("streams", lambda: fields)

    def publish(self, time: float, tracks: Sequence[Track], gain_db: float, estimate: tuple[Any, Any]) -> None:
        """Publish the state at a clock time (s): see `rosafe.localization.live.Publishing`."""
        named = [track for track in tracks if track.id and track.probability >= FORGOTTEN]
        self._last_id = max([self._last_id, *(self._first_id + track.id for track in named)])
        sources = [self._source(track, gain_db) for track in named]
        posed = [azimuth for _, azimuth, speaks in self.present(tracks) if speaks or not self._speech_only]
        azimuths, posterior = estimate
        self.send("sources", lambda: {"header": self.header(time), "sources": sources})
        self.send("poses", lambda: {"header": self.header(time), "poses": list(map(self._pose, posed))})
        self.send(
            "posterior",
            lambda: {
                "header": self.header(time),
                "azimuths": _numbers(np.radians(azimuths)),
                "probability": _numbers(posterior),
            },
        )

    def header(self, time: float) -> Any:
        """Return the header of messages at a clock time (s)."""
        return self._messages.header(stamp=self._messages.time(time), frame_id=self._frame_id)

    def present(self, tracks: Sequence[Track]) -> list[tuple[int, float, bool]]:
        """Return the id, the azimuth in degrees, and whether it speaks, of each source that is present."""
        return [
            (self._first_id + track.id, track.azimuth, self._speech(track) > SPEAKS)
            for track in tracks
            if track.id and track.probability > PRESENT
        ]

    def _speech(self, track: Track) -> float:
        return self.streams.speech(self._first_id + track.id)

    def _source(self, track: Track, gain_db: float) -> Any:
        return self._messages.source(
            id=self._first_id + track.id,
            azimuth=math.radians(track.azimuth),
            azimuth_std=math.radians(track.azimuth_std),
            probability=float(track.probability),
            level=float(track.level_db(gain_db)),
            first_seen=self._messages.time(track.first_time),
            last_seen=self._messages.time(track.last_time),
            speech=self._speech(track),
        )

    def _pose(self, azimuth: float) -> Any:
        pose = self._messages.pose()
        half = math.radians(azimuth) / 2
        pose.orientation.z, pose.orientation.w = math.sin(half), math.cos(half)
        return pose


def _numbers(values: Any) -> array.array[float]:
    """Return numbers for a field float64[], which rclpy assigns at once; a list is checked number by number."""
    return array.array("d", np.asarray(values, np.float64).tobytes())


class LiveLocalizer:
    """Localizes and separates the sound that `connect` provides, from `start` to `close`.

    Parameters
    ----------
    settings : LocalizerSettings
    topics : SourceTopics
    status : Status
    transforms : Transforms or None
        From the frame of the head to that of the world; None: azimuths are relative to the head.
    clock : callable
        Returns the clock time in s.
    suspicious : callable
        Called if messages do not fit the processors that were requested.
    ending : threading.Event
        Set when the node ends: a model that is being learned is given up.

    Attributes
    ----------
    mute : Mute
    model_for : callable
        Returns the model of the head for a sample rate (Hz); it may take long. Raises ValueError if the head has none,
        and InterruptedError if the node ends.
    is_stalled : callable
        Returns whether no more frames arrive.

    Raises
    ------
    ValueError
        A file of the settings is unsuitable: one line.
    """

    def __init__(
        self,
        settings: LocalizerSettings,
        topics: SourceTopics,
        status: Status,
        transforms: Transforms | None,
        clock: Callable[[], float],
        suspicious: Callable[[], None],
        ending: threading.Event,
    ) -> None:
        self._status, self._ending, self._seconds = status, ending, settings.seconds
        models = Models(settings)
        models.report = self._report_learning
        self.model_for = models.model_for
        self._noise = StoredNoise(settings.noise, status)
        status.value("head", settings.head)
        self.mute = Mute(settings.audio_delay, status, clock)
        self._streams = topics.streams = LiveStreams(
            topics.publish_part, topics.has_stream_subscribers, topics.has_speech_subscribers, status
        )
        head: HeadRotation = FixedHead()
        if transforms is not None:
            names = settings.world_frame, settings.head_frame
            head = TransformedHead(transforms, *names, settings.audio_delay, status)
        update = self._streams.update
        queue = FrameQueue(head, self.mute)
        self._loop = LocalizationLoop(self._localizer_for, topics, queue, status, suspicious, clock, update)
        self.is_stalled = self._loop.is_stalled

    def start(self) -> None:
        """Start the threads."""
        self._loop.start()
        self._streams.start()

    def close(self) -> None:
        """End the threads."""
        self._loop.close()
        self._streams.close()

    def connect(
        self,
        model: DirectionModel,
        open_sound: Callable[[], LiveSound],
        open_source: Callable[[Callable[[], None]], FrameSource],
    ) -> None:
        """Use sound, and a source of frames that is opened with a function to call for new ones."""
        self._streams.connect(model, open_sound)
        self._loop.connect(model, open_source)

    def disconnect(self) -> None:
        """Use no sound and no frames."""
        self._loop.connect(None)
        self._streams.connect(None)

    def _localizer_for(self, model: DirectionModel) -> Localizer:
        localizer = Localizer(model.sample_rate, model, self._seconds, keep_history=False)
        self._noise.apply(localizer)
        return localizer

    def _report_learning(self, part: float) -> None:
        """Report the progress of learning in steps of 10 %."""
        if self._ending.is_set():
            raise InterruptedError("the node ends")
        self._status.set("rosAFE", OK, f"learning the directions of the head: {10 * int(10 * part)} %")
