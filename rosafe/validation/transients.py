"""Comparisons of onset and offset maps with known times: with the preset, and the defaults as a limitation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from rosafe.declarations.reference import LITERATURE
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.interface.remarks import PRESETS
from rosafe.validation.comparison import INDEPENDENT, Collection, Origin, Process, late
from rosafe.validation.stimuli import TALKERS, both, noise, talker, tone

ROWS = Collection()
RATE = 16000
SECONDS = 10
DURATION = 0.15  # s, of an event
TIMES = np.arange(0.5, SECONDS - 0.5, 0.5)  # s, of the beginnings of the events
NEAR = 0.03  # s, distance of an event that is found
PRESET = PRESETS["onsets"]
STEADY = "steady white noise of 0.1"
SPARSE = "samples of 0 and, one in a thousand, 1 of a 16-bit converter"


def gated(sound: FloatArray, background: float = 1e-3) -> FloatArray:
    """Return a sound (N,) during the events, with ramps of 5 ms, in noise of 0.1 times the background, (2, N)."""
    gain = np.zeros(len(sound))
    for begin in TIMES:
        gain[round(begin * RATE) : round((begin + DURATION) * RATE)] = 1.0
    ramp = np.hanning(2 * 80)
    return both(np.convolve(gain, ramp / ramp.sum(), "same") * sound + background * noise(len(sound), 2))


def clicks() -> FloatArray:
    """Return clicks at the times of the events in weak noise, (2, N)."""
    return both(
        np.where(np.isin(np.arange(SECONDS * RATE), np.round(TIMES * RATE)), 0.5, 0.0) + 1e-4 * noise(SECONDS * RATE)
    )


def sparse() -> FloatArray:
    """Return a muted input whose last bit toggles, (2, N)."""
    return both((np.random.default_rng(3).random(SECONDS * RATE) < 1e-3) / 32768)


def excerpts() -> FloatArray:
    """Return pieces of two recorded voices at the times of the events, in noise 40 dB below, (2, N)."""
    voices = np.concatenate([talker(number) for number in (0, 1)])
    count = round(DURATION * RATE)
    levels = np.sqrt(np.convolve(voices**2, np.full(count, 1 / count), "valid"))
    loud, random = np.flatnonzero(levels > np.percentile(levels, 60)), np.random.default_rng(1)
    sound = np.zeros(SECONDS * RATE)
    for begin in np.round(TIMES * RATE).astype(int):
        first = random.choice(loud)
        piece = voices[first : first + count]
        sound[begin : begin + count] = 0.1 * piece / np.std(piece)
    return gated(sound, 1e-2)


def marked(process: Process, sound: FloatArray, output: str, parameters: Mapping[str, Any]) -> FloatArray:
    """Return the times in s, (K,), of all frames of the left ear with a mark: the middles of their windows."""
    units = process(sound, RATE, parameters, [output])[output][0]
    return np.asarray(0.01 * np.flatnonzero(units.any(axis=0)) + 0.01)


def worst(frames: FloatArray, times: FloatArray) -> float:
    """Return the largest distance of a mark to its event, or of an event to the next mark, in ms."""
    if not len(frames):
        return np.inf
    distances = np.abs(frames[:, np.newaxis] - times)
    return 1e3 * float(max(distances.min(0).max(), distances.min(1).max()))


ALL = "all frames with a mark in any channel: the largest distance of a mark to an event, or of an event to a mark"


def _timed(output: str, subject: str, sound: Any, times: FloatArray, tolerance: float) -> None:
    """Add a comparison with known times."""
    ROWS.add(
        output,
        f"preset `onsets`: {subject}",
        Origin("known times; events common to neighbouring channels", LITERATURE["turgeon2002"]),
        "ms",
        tolerance,
        late(output, 4),
        evidence=INDEPENDENT,
        criterion=ALL,
    )(lambda process: worst(marked(process, sound(), output, PRESET), times))


def bursts() -> FloatArray:
    """Return bursts of noise at the times of the events, (2, N)."""
    return gated(noise(SECONDS * RATE))


def tones() -> FloatArray:
    """Return tones at the times of the events, (2, N)."""
    return gated(tone(1000, RATE, SECONDS, 0.1))


_timed("onsetMap", "18 bursts of noise in noise 60 dB below", bursts, TIMES, 25.0)
_timed("onsetMap", "18 clicks", clicks, TIMES, 25.0)
_timed("onsetMap", "18 tones of 1 kHz in noise 60 dB below", tones, TIMES, 25.0)
_timed("offsetMap", "ends of 18 bursts of noise in noise 60 dB below", bursts, TIMES + DURATION, 60.0)


def _rate(output: str, name: str, parameters: Mapping[str, Any], subject: str, sound: Any) -> None:
    """Add the rate of false events of a sound without events as a limitation."""

    def measure(process: Process) -> float:
        frames = marked(process, sound(), output, parameters)
        return float(np.sum(np.diff(frames, prepend=-1.0) > NEAR)) / SECONDS

    criterion = f"false events: groups of marked frames that are more than {1e3 * NEAR:g} ms apart"
    source = Origin("no event is in the sound")
    ROWS.limitation(output, f"{name}: {subject}", source, "per second", criterion=criterion)(measure)


for _output in ("onsetMap", "offsetMap"):
    for _name, _parameters in (("defaults", {}), ("preset `onsets`", PRESET)):
        _rate(_output, _name, _parameters, STEADY, lambda: both(noise(SECONDS * RATE)))
        _rate(_output, _name, _parameters, SPARSE, sparse)
        _rate(_output, _name, _parameters, "exact silence", lambda: np.zeros((2, SECONDS * RATE)))


@ROWS.listed()
def defaults_distance(process: Process) -> float:
    return worst(marked(process, bursts(), "onsetMap", {}), TIMES)


def missed(process: Process, parameters: Mapping[str, Any]) -> float:
    """Return the share of the excerpts of speech without a mark."""
    frames = marked(process, excerpts(), "onsetMap", parameters)
    return float(np.mean(np.abs(frames[:, np.newaxis] - TIMES).min(axis=0) > NEAR))


def inside(process: Process, parameters: Mapping[str, Any]) -> float:
    """Return the number of groups of marks away from the beginnings of the excerpts of speech, per second."""
    frames = marked(process, excerpts(), "onsetMap", parameters)
    away = frames[np.abs(frames[:, np.newaxis] - TIMES).min(axis=1) > NEAR]
    return float(np.sum(np.diff(away, prepend=-1.0) > NEAR)) / SECONDS


EXCERPTS = "18 excerpts of recorded voices in noise 40 dB below"
for _name, _parameters in (("defaults", {}), ("preset `onsets`", PRESET)):
    for _measure, _unit, _criterion in (
        (missed, "of the events", f"share of the events without a mark within {1e3 * NEAR:g} ms"),
        (inside, "per second", f"groups of marked frames that are more than {1e3 * NEAR:g} ms from an event"),
    ):
        ROWS.limitation(
            "onsetMap",
            f"{_name}: {EXCERPTS}",
            Origin("known times of the excerpts"),
            _unit,
            criterion=_criterion,
            requires=TALKERS,
        )(partial(_measure, parameters=_parameters))
