"""`rosafe localize --check`: whether the ears are connected as they should be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head_check import HeadCheck
from rosafe.localization.live import NewFrames
from rosafe.ros1.localizer.measurement import FrameListener, ear_levels

DIRECTIONS = ("left", "ahead", "right")
QUIET_SECONDS = 2.0  # of quiet, at the beginning
PAUSE_SECONDS = 0.5  # of quiet before each sound
WAIT_SECONDS = 30.0  # for a sound
SOUND_FRAMES = 50  # of sound for each direction: half a second
ABOVE_QUIET_DB = 10.0  # of a frame, in one ear
SILENT_DB = 3.0  # an ear that is not above its level in quiet by more is silent
SILENT_DIFFERENCE_DB = 40.0  # between the ears, with sound from ahead: the weaker one is silent
MIN_SIDE_MS, MIN_SIDE_DB = 0.2, 3.0  # between a sound from the left and one from the right
MAX_GAIN_DB = 2.0
ORDINARY_SECONDS = 60.0  # of ordinary sound
UNQUIET_DB = 15.0  # between the soft and the loud frames at the beginning: it is not quiet
LOW_CHANNELS = 0.4  # of the channels: the time difference is that of the low frequencies
CURRENT_COHERENCE = 0.9  # of a frame whose time difference counts


@dataclass(frozen=True)
class HeardSound:
    """The sound from one direction.

    Attributes
    ----------
    level_db : tuple of float
        Of the left and the right ear, dB full scale.
    above_db : tuple of float
        The same, above the level in quiet.
    lead_ms : float
        Time by which the left ear leads, ms; NaN if it is not known.
    """

    level_db: tuple[float, float]
    above_db: tuple[float, float]
    lead_ms: float

    @property
    def difference_db(self) -> float:
        """Level of the left ear above that of the right one, dB."""
        return self.level_db[0] - self.level_db[1]


@dataclass(frozen=True)
class EarReport:
    """The result of the check: lines for the terminal, and the faults."""

    lines: tuple[str, ...]
    problems: tuple[str, ...]


def heard_sound(levels: FloatArray, quiet: FloatArray, itd: FloatArray, coherence: FloatArray) -> HeardSound:
    """Return the properties of a sound.

    Parameters
    ----------
    levels : ndarray, (F, 2)
        Of the left and the right ear, dB full scale.
    quiet : ndarray, (2,)
        The same in quiet.
    itd, coherence : ndarray, (C, F)
        The representations `itd` (s, negative if the left ear leads) and `ic`.
    """
    mean = 10 * np.log10(np.mean(10 ** (levels / 10), axis=0))
    low = slice(0, max(1, round(LOW_CHANNELS * len(itd))))
    clear = itd[low][coherence[low] > CURRENT_COHERENCE]
    lead = -1000 * float(np.median(clear)) if len(clear) else float("nan")
    left, right = (float(level) for level in mean)
    return HeardSound((left, right), (left - float(quiet[0]), right - float(quiet[1])), lead)


def assess(heard: Mapping[str, HeardSound]) -> EarReport:
    """Return the report on the sounds from the left, from ahead and from the right."""
    lines = [_line(direction, heard[direction]) for direction in DIRECTIONS]
    silent = [
        name
        for ear, name in enumerate(("left", "right"))
        if all(sound.above_db[ear] < SILENT_DB for sound in heard.values())
        or heard["ahead"].level_db[1 - ear] - heard["ahead"].level_db[ear] > SILENT_DIFFERENCE_DB
    ]
    if silent:
        problems = [f"the {name} ear is silent: check its microphone, cable and channel" for name in silent]
        return EarReport((*lines, *problems), tuple(problems))
    problems = _order_problems(heard["left"], heard["right"])
    if not problems:
        lines.append("ears: the left and the right one are not swapped")
    left, ahead, right = (heard[direction].difference_db for direction in DIRECTIONS)
    gain = ahead / 2 + (left + right) / 4
    louder, weaker = ("left", "right") if gain > 0 else ("right", "left")
    lines.append(f"gain: the {louder} ear is {abs(gain):.1f} dB louder")
    if abs(gain) > MAX_GAIN_DB:
        problems.append(
            f"the gains differ by {abs(gain):.1f} dB: raise that of the {weaker} ear, or lower that of the {louder} one"
        )
    return EarReport((*lines, *problems), tuple(problems))


def _line(direction: str, sound: HeardSound) -> str:
    left, right = sound.level_db
    time = "" if np.isnan(sound.lead_ms) else f", the left ear leads by {sound.lead_ms:+.2f} ms"
    return (
        f"{direction + ':':6} left ear {left:.1f} dB, right ear {right:.1f} dB, difference {left - right:+.1f} dB{time}"
    )


def _order_problems(left: HeardSound, right: HeardSound) -> list[str]:
    """Return whether the ears are swapped, from the differences between the sounds from the left and the right."""
    time = left.lead_ms - right.lead_ms
    level = left.difference_db - right.difference_db
    by_time = 0 if np.isnan(time) or abs(time) < MIN_SIDE_MS else int(np.sign(time))
    by_level = 0 if abs(level) < MIN_SIDE_DB else int(np.sign(level))
    if by_time + by_level < 0:
        return ["the ears are swapped: exchange the channels"]
    if by_time + by_level > 0:
        return []
    if by_time or by_level:
        return ["times and levels contradict each other: check that each microphone is in its ear, and repeat"]
    return [
        "the sounds from the left and from the right do not differ: check that there are two microphones, and repeat"
    ]


def check_ears(listener: FrameListener, say: Callable[[str], None]) -> EarReport | None:
    """Ask for a sound from each direction, and return the report; None if one was not heard.

    Parameters
    ----------
    listener : FrameListener
        The frames.
    say : callable
        Called with a line for the person at the robot.

    Raises
    ------
    NoFramesError
        rosAFE computes no frames.
    """
    say(f"quiet, please: for {QUIET_SECONDS:g} s")
    levels = np.concatenate([ear_levels(*item) for item in listener.listen(QUIET_SECONDS)])
    if np.ptp(np.quantile(levels, (0.1, 0.9), axis=0), axis=0).max() > UNQUIET_DB:
        say("it is not quiet: the sound of this place is used")
        return check_ordinary(listener, ORDINARY_SECONDS, say)
    quiet = np.median(levels, axis=0)
    heard = {}
    loud, everything = _Checked(), _Checked()
    for direction in DIRECTIONS:
        where = "straight ahead of the head" if direction == "ahead" else f"the {direction} of the head"
        say(f"now a sound from {where}: speak, clap or rattle, about a metre away")
        sound = _next_sound(listener, quiet, loud, everything)
        if sound is None and (ordinary := everything.report()) is not None:
            say("no sound was louder than the sound of this place, which is used")
            return ordinary
        if sound is None:
            say(f"no sound was heard from {where} for {WAIT_SECONDS:g} s: both ears are silent, or it was too soft")
            return None
        heard[direction] = sound
        say(_line(direction, sound))
        if direction != DIRECTIONS[-1]:
            _wait_for_pause(listener, quiet)
    report, cues = assess(heard), loud.report()
    if report.problems or cues is None:
        return report
    return EarReport((*report.lines, *cues.problems), cues.problems)


def check_ordinary(listener: FrameListener, seconds: float, say: Callable[[str], None]) -> EarReport | None:
    """Return the report on ordinary sound or a walk around the head; None if there was too little.

    Parameters and errors are those of `check_ears`; `seconds` is the time to listen.
    """
    say(f"listening for {seconds:g} s: walk once around the head and speak, first to its left, or let people talk")
    checked = _Checked()
    for model, frames in listener.listen(seconds):
        checked.update(model, frames)
    report = checked.report()
    if report is None:
        say("there was too little sound from one direction at a time: repeat it, closer or louder")
    return report


class _Checked:
    """The check of the cues of frames, as soon as there are some."""

    def __init__(self) -> None:
        self._check: HeadCheck | None = None

    def update(self, model: DirectionModel, frames: NewFrames) -> None:
        """Add frames."""
        self._check = self._check or HeadCheck(model)
        self._check.update(frames.features)

    def report(self) -> EarReport | None:
        """Return the report; None without enough sound."""
        found = self._check.report() if self._check is not None else None
        if found is None:
            return None
        problems = (found.problem,) if found.problem else ()
        return EarReport((*found.lines, *problems), problems)


def _is_loud(levels: FloatArray, quiet: FloatArray) -> np.ndarray:
    """Return which frames (F, 2) are above the level in quiet, in one ear."""
    return np.asarray((levels - quiet > ABOVE_QUIET_DB).any(axis=1))


def _next_sound(
    listener: FrameListener, quiet: FloatArray, checked: _Checked, everything: _Checked
) -> HeardSound | None:
    """Return the next half second of sound, which may have pauses, and check its cues; None if there is none."""
    loud: list[tuple[DirectionModel, NewFrames]] = []
    listener.discard()
    for model, frames in listener.listen(WAIT_SECONDS):
        loud.append((model, frames.select(_is_loud(ear_levels(model, frames), quiet))))
        checked.update(*loud[-1])
        everything.update(model, frames)
        if sum(len(part.middles) for _, part in loud) >= SOUND_FRAMES:
            joined = NewFrames.joined([part for _, part in loud])
            return heard_sound(
                np.concatenate([ear_levels(*item) for item in loud]),
                quiet,
                joined.features["itd"],
                joined.features["ic"],
            )
    return None


def _wait_for_pause(listener: FrameListener, quiet: FloatArray) -> None:
    silent = 0
    for model, frames in listener.listen(WAIT_SECONDS):
        loud = np.flatnonzero(_is_loud(ear_levels(model, frames), quiet))
        silent = silent + len(frames.middles) if not len(loud) else len(frames.middles) - 1 - int(loud[-1])
        if silent * float(model.parameters["cc_hSizeSec"]) >= PAUSE_SECONDS:
            return
