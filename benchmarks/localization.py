"""Accuracy of `rosafe.localize`: one and two sources, a turning head, other heads, rooms; cost and latency.

Needs Debian's libmysofa1 (the MIT KEMAR head), espeak-ng and alsa-utils (speech). Writes
benchmarks/results/localization.md. Training uses synthetic sounds only, and none of these rooms.

    /usr/bin/python3 -m benchmarks.localization [SECTION ...] [--every N] [--rate HZ]

`--every N` uses each Nth direction only, and `--rate` another sample rate; then nothing is written. Two minutes on two
quiet cores: `rooms --every 6 --rate 16000`.
"""

from __future__ import annotations

import argparse
import itertools
import os
import re
import subprocess
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.signal
import soundfile

import rosafe
from benchmarks.report import processor
from rosafe.localization import angles
from rosafe.localization.filters import HOP, SourceRenderer
from rosafe.localization.rectangular_room import RectangularRoom, RoomReflections
from rosafe.localization.reverberation import Reverberation
from rosafe.localization.scene import BLOCK, DiffuseNoise

RATE = 44100  # Hz; `main` may set another one
EVERY = 1  # direction is used; `main` may set a larger number
KEMAR = "/usr/share/libmysofa/MIT_KEMAR_normal_pinna.sofa"
RESULT = Path(__file__).parent / "results" / "localization.md"
SNRS = (60, 20, 10, 5, 0, -5)
DIRECTIONS = angles.grid()
SECONDS = 5  # of speech for each direction
ROOM_SECONDS = 3.0  # of speech for each direction in a room
TURNS = 3  # seconds of speech for each direction with a turning head
LEVEL = 10 ** (-35 / 20)
VOICES = {
    "en-us+m1": "Kick the ball straight and follow through. Help the woman get back to her feet.",
    "en-gb+f5": "A pot of tea helps to pass the evening. Smoky fires lack flame and heat.",
    "en-us+m6": "The soft cushion broke the fall. The salt breeze came across from the sea.",
    "es+f1": "El perro corre por el campo verde. La casa blanca tiene una puerta roja y ventanas grandes.",
    "it+m2": "La strada lunga porta alla montagna. Domani mattina il treno parte molto presto dalla stazione.",
}
RECORDINGS = Path("/usr/share/sounds/alsa")
SURREY = Path(__file__).parents[2] / "shared" / "rooms" / "UniS_Anechoic_BRIR_16k.sofa"
RATIOS = (5.0, 0.0, -5.0)  # dB, direct to reverberant


class Place(NamedTuple):
    """A room with the head in it, the direction of the head (degrees), and the distance of the sources (m)."""

    room: RectangularRoom
    yaw: float
    distance: float


PLACES = (
    Place(RectangularRoom((3.0, 3.0, 2.5), 0.2, (1.3, 1.6, 1.2)), 20.0, 0.7),
    Place(RectangularRoom((4.0, 3.0, 2.5), 0.3, (1.8, 1.3, 1.4)), -35.0, 1.0),
    Place(RectangularRoom((5.0, 4.0, 2.7), 0.5, (2.8, 1.7, 1.2)), 70.0, 1.2),
    Place(RectangularRoom((6.0, 5.0, 3.0), 0.4, (2.7, 2.2, 1.6)), 0.0, 1.5),
    Place(RectangularRoom((8.0, 6.0, 3.0), 0.6, (3.4, 3.3, 1.5)), 130.0, 2.0),
    Place(RectangularRoom((10.0, 8.0, 3.5), 0.8, (4.6, 3.6, 1.7)), -100.0, 3.0),
)

# --- sounds -----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def head() -> rosafe.Head:
    """Return the KEMAR head."""
    return rosafe.Head.from_sofa(KEMAR)


@lru_cache(maxsize=1)
def talkers() -> list[np.ndarray]:
    """Return speech of several voices with an RMS of -25 dB; pauses are shortened to 0.1 s."""
    sounds = []
    for voice, text in VOICES.items():
        command = ["espeak-ng", "-v", voice, "-s", "160", "--stdout", text]
        data = subprocess.run(command, capture_output=True, check=True).stdout
        sounds.append(scipy.signal.resample_poly(np.frombuffer(data[44:], "<i2") / 32768.0, RATE, 22050))
    recorded = [soundfile.read(path, always_2d=True) for path in sorted(RECORDINGS.glob("*_*.wav"))]
    sounds.append(np.concatenate([scipy.signal.resample_poly(sound[:, 0], RATE, rate) for sound, rate in recorded]))
    return [_normalized(_without_pauses(sound)) for sound in sounds]


def _without_pauses(sound: np.ndarray) -> np.ndarray:
    step = RATE // 100
    frames = sound[: len(sound) // step * step].reshape(-1, step)
    level = 10 * np.log10(np.mean(frames**2, axis=1) + 1e-12)
    loud = level > level.max() - 40
    kept = [index for index in range(len(frames)) if loud[max(0, index - 10) : index + 1].any()]
    return frames[kept].reshape(-1)


def _normalized(sound: np.ndarray) -> np.ndarray:
    return sound * (LEVEL / np.sqrt(np.mean(sound**2)))


def speech(number: int, seconds: float) -> np.ndarray:
    """Return speech that begins at a random place."""
    sound = talkers()[number % len(talkers())]
    begin = np.random.default_rng(number).integers(len(sound))
    return _normalized(np.resize(np.roll(sound, -begin), round(seconds * RATE)))


def white(number: int, seconds: float) -> np.ndarray:
    """Return white noise."""
    return LEVEL * np.random.default_rng(1000 + number).standard_normal(round(seconds * RATE))


@lru_cache(maxsize=1)
def noise_pool() -> np.ndarray:
    """Return 30 s of diffuse white noise with a power of 1 before the head."""
    diffuse = DiffuseNoise(head().filters(RATE), 1.0, 99)
    return np.concatenate([diffuse.block() for _ in range(30 * RATE // BLOCK)], axis=1)


def in_noise(ears: np.ndarray, snr_db: float, number: int, sources: int = 1) -> np.ndarray:
    """Return the sound with diffuse noise; the SNR is that of the sources before the head."""
    pool = noise_pool()
    begin = np.random.default_rng(2000 + number).integers(pool.shape[1] - ears.shape[1])
    return ears + pool[:, begin : begin + ears.shape[1]] * LEVEL * np.sqrt(sources) * 10 ** (-snr_db / 20)


# --- trials -----------------------------------------------------------------------------------------------------


def at_seconds(result: dict[str, Any], step: float = 1.0) -> list[tuple[float, float]]:
    """Return azimuth and confidence at the end of each second."""
    ends = np.arange(1, result["time"][-1] + 0.02, step)
    index = [int(np.abs(result["time"] - end).argmin()) for end in ends]
    return [(float(result["azimuth"][i]), float(result["confidence"][i])) for i in index]


def one_source(task: tuple[str, float, float, str, float]) -> list[tuple[float, float, float]]:
    """Localize one source; return truth, azimuth and confidence of each second."""
    sound, azimuth, snr, model, seconds = task
    number = zlib.crc32(f"{sound}{azimuth}{snr}".encode())
    source = (speech if sound == "speech" else white)(number, seconds)
    ears = in_noise(head().render(source, RATE, azimuth), snr, number)
    result = rosafe.localize(ears, RATE, model if model == "sphere" else head(), 1.0)
    return [(azimuth, *estimate) for estimate in at_seconds(result, 0.5)]


def turning(task: tuple[float, float]) -> list[tuple[float, float, float]]:
    """Localize one source while the head turns by 20 degrees in each second."""
    azimuth, snr = task
    found = []
    for second in range(TURNS):
        number = zlib.crc32(f"turn{azimuth}{snr}{second}".encode())
        yaw = np.linspace(0, 20, RATE)
        ears = in_noise(head().render(speech(number, 1.0), RATE, azimuth - yaw), snr, number)
        result = rosafe.localize(ears, RATE, head(), 1.0, head_yaw=[[0, 0], [1, 20]])
        found.append((azimuth, float(result["azimuth"][-1]), float(result["confidence"][-1])))
    return found


def two_sources(task: tuple[float, float, int]) -> list[tuple[bool, int]]:
    """Localize two talkers; return for each second whether the tracks have both, and how many others there are."""
    first, second, number = task
    voices = [speech(len(VOICES) * 7 * number + offset, 10.0) for offset in (0, 1 + number % 5)]
    ears = sum(head().render(v, RATE, a) for v, a in zip(voices, (first, second), strict=True))
    result = rosafe.localize(in_noise(ears, 20, number, 2), RATE, head(), 1.0)
    return both_found(result["tracks"], voices, (first, second))


def both_found(
    tracks: list[dict[str, Any]], voices: list[np.ndarray], truth: tuple[float, float]
) -> list[tuple[bool, int]]:
    """Return the outcome of `two_sources` from the tracks."""
    active = np.stack([_active(voice) for voice in voices])
    outcome = []
    for begin in range(1, 10):
        if active[:, begin * 100 : begin * 100 + 100].mean(axis=1).min() < 0.5:
            continue
        azimuths = _present(tracks, begin, begin + 1)
        errors = np.abs(angles.difference(np.array(azimuths)[:, np.newaxis], np.array(truth)))
        found = len(azimuths) > 0 and errors.min(axis=0).max() <= 10
        outcome.append((bool(found), int((errors.min(axis=1) > 10).sum())))
    return outcome


def _active(voice: np.ndarray) -> np.ndarray:
    step = RATE // 100
    level = 10 * np.log10(np.mean(voice[: len(voice) // step * step].reshape(-1, step) ** 2, axis=1) + 1e-12)
    return level > -35 - 20


def _present(tracks: list[dict[str, Any]], begin: float, end: float) -> list[float]:
    """Return the mean azimuths of the sources that are present in at least half of an interval."""
    found = []
    for track in tracks:
        inside = (track["time"] > begin) & (track["time"] <= end) & (track["probability"] > 0.5)
        if inside.sum() >= 0.5 * (end - begin) / 0.1 - 1e-9:
            phase = np.radians(track["azimuth"][inside])
            found.append(float(np.degrees(np.arctan2(np.sin(phase).mean(), np.cos(phase).mean()))))
    return found


# --- rooms ---


@lru_cache(maxsize=len(PLACES) * 4)
def reflections(number: int, ratio: float | None, heard: str) -> RoomReflections:
    """Return the reflections of one of `PLACES` at a head, with a direct-to-reverberant ratio or that of the place."""
    room = replace(PLACES[number].room, drr_db=ratio)
    return RoomReflections(room, named_head(heard).filters(RATE), RATE, number)


@lru_cache(maxsize=8)
def named_head(name: str) -> rosafe.Head:
    """Return a head for a name of `HEADS`."""
    if name == "kemar":
        return head()
    if name == "surrey":
        return rosafe.Head.from_sofa(SURREY, mirror=True)
    return rosafe.Head.sphere() if name == "sphere" else rosafe.Head.pair(float(name.removeprefix("pair:")))


def in_room(
    number: int, ratio: float, heard: str, sounds: Sequence[tuple[np.ndarray, float]], turn: float = 0.0
) -> np.ndarray:
    """Return both ears (2, N) for sounds with azimuths relative to the head, which turns by `turn` until the end."""
    place, frames = PLACES[number], len(sounds[0][0])
    blocks = -(-frames // BLOCK)
    yaw = place.yaw + turn * np.arange(0, blocks * BLOCK + 1, HOP) / frames
    reverberation = Reverberation(reflections(number, ratio, heard), [place.distance] * len(sounds), BLOCK)
    sources = [SourceRenderer(named_head(heard).filters(RATE)) for _ in sounds]
    ears = np.zeros((2, blocks * BLOCK))
    for first in range(0, blocks * BLOCK, BLOCK):
        at = yaw[first // HOP : (first + BLOCK) // HOP + 1]
        part = ears[:, first : first + BLOCK]
        for index, (renderer, (sound, azimuth)) in enumerate(zip(sources, sounds, strict=True)):
            samples = np.zeros(BLOCK)
            samples[: len(sound[first : first + BLOCK])] = sound[first : first + BLOCK]
            world = np.full(len(at), place.yaw + azimuth)
            part += renderer.process(samples, angles.wrap(world - at))
            part += reverberation.add(index, samples, world, at)
        part += reverberation.tail()
    return ears[:, :frames]


class RoomTrial(NamedTuple):
    """One talker in a room: place, ratio (dB), azimuth, head of the sound and of the model, turn in a second."""

    place: int
    ratio: float
    azimuth: float
    heard: str = "kemar"
    model: str = "kemar"
    turn: float = 0.0


def room_trial(task: RoomTrial) -> tuple[list[tuple[float, float, float]], list[int]]:
    """Localize a talker; return truth, azimuth and confidence of each second, and the number of other tracks."""
    seconds = 1.0 if task.turn else ROOM_SECONDS
    number = zlib.crc32(f"room{task.azimuth}{task.ratio}{task.place}{task.turn}".encode())
    ears = in_room(task.place, task.ratio, task.heard, [(speech(number, seconds), task.azimuth)], task.turn)
    yaw = [[0, 0], [1, task.turn]] if task.turn else 0.0
    result = rosafe.localize(in_noise(ears, 60, number), RATE, named_head(task.model), 1.0, head_yaw=yaw)
    estimates = [(task.azimuth, *estimate) for estimate in at_seconds(result)]
    truth = np.array([task.azimuth, angles.lateral(task.azimuth)] if task.model != "kemar" else [task.azimuth])
    others = []
    for begin in range(1, int(seconds)):
        azimuths = np.array(_present(result["tracks"], begin, begin + 1))[:, np.newaxis]
        others.append(int((np.abs(angles.difference(azimuths, truth)).min(axis=1) > 10).sum()))
    return estimates, others


def room_pair(task: tuple[int, float, float, float]) -> list[tuple[bool, int]]:
    """Localize two talkers of equal level in a room: place, ratio (dB) and azimuths."""
    place, ratio, first, second = task
    number = zlib.crc32(f"two{task}".encode()) % 1000
    voices = [speech(len(VOICES) * 7 * number + offset, 10.0) for offset in (0, 1 + number % 5)]
    ears = in_room(place, ratio, "kemar", list(zip(voices, (first, second), strict=True)))
    result = rosafe.localize(in_noise(ears, 60, number, 2), RATE, head(), 1.0)
    return both_found(result["tracks"], voices, (first, second))


# --- figures ----------------------------------------------------------------------------------------------------


def figures(trials: Iterable[tuple[float, float, float]], poles: bool = True) -> dict[str, float]:
    """Return the share within 5 degrees, front-back confusions and RMS of the lateral angle.

    With `poles`, 0 and 180 degrees count as one direction.
    """
    truth, azimuth, _ = np.array(list(trials)).T
    error = np.abs(angles.difference(azimuth, truth))
    right = error <= 5.001
    pole = np.isin(np.round(truth), (0, 180))
    if poles:
        right |= pole & (np.abs(angles.lateral(azimuth)) <= 5.001)
    lateral = angles.lateral(azimuth) - angles.lateral(truth)
    side = np.abs(np.abs(truth) - 90) > 1
    confused = side & ((np.abs(truth) < 90) != (np.abs(azimuth) < 90))
    if poles:
        confused &= ~pole
    return {
        "within": float(np.mean(right)),
        "confused": float(np.mean(confused)),
        "rms": float(np.sqrt(np.mean(lateral**2))),
        "trials": len(truth),
    }


def calibration(trials: list[tuple[float, float, float]]) -> list[tuple[str, int, float]]:
    """Return for ranges of the confidence the number of estimates and the share of right ones."""
    truth, azimuth, confidence = np.array(trials).T
    pole = np.isin(np.round(truth), (0, 180))
    right = np.abs(angles.difference(azimuth, truth)) <= 5.001
    right |= pole & (np.abs(angles.lateral(azimuth)) <= 5.001)
    rows = []
    for low, high in ((0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 0.99), (0.99, 1.01)):
        chosen = (confidence >= low) & (confidence < high)
        share = float(right[chosen].mean()) if chosen.any() else float("nan")
        rows.append((f"{low:g} to {min(high, 1):g}", int(chosen.sum()), share))
    return rows


def table(title: str, columns: Iterable[Any], rows: dict[str, list[str]]) -> str:
    """Return a Markdown table."""
    names = [str(column) for column in columns]
    lines = [f"| {title} | {' | '.join(names)} |", "|---|" + "--:|" * len(names)]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(values)} |" for name, values in rows.items())]) + "\n"


def metric_rows(found: dict[Any, dict[str, float]]) -> dict[str, list[str]]:
    """Return rows of a table for figures by column."""
    return {
        "within 5 degrees": [f"{value['within']:.3f}" for value in found.values()],
        "front-back confusions": [f"{value['confused']:.3f}" for value in found.values()],
        "lateral angle, RMS in degrees": [f"{value['rms']:.1f}" for value in found.values()],
        "trials": [f"{value['trials']:.0f}" for value in found.values()],
    }


# --- sections ---------------------------------------------------------------------------------------------------

Map = Callable[..., Iterable[Any]]


def _by_snr(run: Map, sound: str, model: str, snrs: Iterable[float], seconds: float) -> dict[float, list[Any]]:
    tasks = [(sound, float(azimuth), snr, model, seconds) for snr in snrs for azimuth in DIRECTIONS]
    trials: dict[float, list[Any]] = {}
    for task, found in zip(tasks, run(one_source, tasks), strict=True):
        trials.setdefault(task[2], []).extend(found)
    return trials


def _whole_seconds(trials: dict[float, list[Any]], seconds: int) -> dict[float, list[Any]]:
    """Return the trials at whole seconds of those at half seconds."""
    each = 2 * seconds - 1  # from one task
    return {
        snr: [trial for begin in range(0, len(found), each) for trial in found[begin : begin + each : 2]]
        for snr, found in trials.items()
    }


def section_speech(run: Map) -> str:
    trials = _by_snr(run, "speech", "kemar", SNRS, SECONDS)
    everything = [trial for found in trials.values() for trial in found]
    trials = _whole_seconds(trials, SECONDS)
    calibrated = calibration(everything)
    rows = {"estimates": [str(n) for _, n, _ in calibrated], "right": [f"{share:.3f}" for _, _, share in calibrated]}
    return (
        "## Speech, matched head\n\nOne second of speech from each of 72 directions, five seconds per direction. 0 and "
        "180 degrees count as one: the head is exactly symmetric.\n\n"
        + table("SNR (dB)", SNRS, metric_rows({snr: figures(found) for snr, found in trials.items()}))
        + f"\n{_poles(trials)}\n\n### Calibration of the confidence\n\nAll trials above, every half second; goal: 0.80 "
        "to 0.98 of the estimates from 0.85 to 0.95 are right.\n\n"
        + table("confidence", [name for name, _, _ in calibrated], rows)
    )


def _poles(trials: dict[float, list[Any]]) -> str:
    shares = []
    for snr, found in trials.items():
        pole = [trial for trial in found if round(abs(trial[0])) in (0, 180)]
        front = np.mean([abs(azimuth) <= 5 for _, azimuth, _ in pole])
        shares.append(f"{front:.2f} at {snr:g} dB")
    return "Sources at 0 and 180 degrees reported within 5 degrees of the front: " + ", ".join(shares) + "."


def section_noise(run: Map) -> str:
    trials = _whole_seconds(_by_snr(run, "noise", "kemar", SNRS, 2), 2)
    return "## White noise as the source, matched head\n\n" + table(
        "SNR (dB)", SNRS, metric_rows({snr: figures(found) for snr, found in trials.items()})
    )


def section_mismatch(run: Map) -> str:
    snrs = (60, 20, 5)
    trials = _whole_seconds(_by_snr(run, "speech", "sphere", snrs, 2), 2)
    found = {}
    for snr, trial in trials.items():
        mirrored = [(float(angles.lateral(truth)), azimuth, sure) for truth, azimuth, sure in trial]
        found[snr] = figures(mirrored, poles=False)
    return (
        "## Mismatched head: the model of the sphere, sounds through KEMAR\n\nDirections are compared by their lateral "
        "angle, as the sphere cannot distinguish front from back.\n\n" + table("SNR (dB)", snrs, metric_rows(found))
    )


def section_turning(run: Map) -> str:
    snrs = (20, 10, 5, 0)
    tasks = [(float(azimuth), float(snr)) for snr in snrs for azimuth in DIRECTIONS]
    trials: dict[float, list[Any]] = {}
    for task, found in zip(tasks, run(turning, tasks), strict=True):
        trials.setdefault(task[1], []).extend(found)
    return (
        "## Head turns by 20 degrees within the second\n\nSpeech, matched head; 0 and 180 degrees are directions like "
        "any other. Goals down to 0 dB: at least 0.97 within 5 degrees, at most 0.01 confusions.\n\n"
        + table("SNR (dB)", snrs, metric_rows({snr: figures(found, poles=False) for snr, found in trials.items()}))
    )


def section_two(run: Map) -> str:
    rows = {}
    for name, pairs in {
        "30 degrees apart, within 60 degrees": [(a, a + 30) for a in range(-60, 31, 5)],
        "30 degrees apart, elsewhere": [(a, a + 30) for a in range(65, 271, 15)],
        "60 degrees apart, all around": [(a, a + 60) for a in range(-180, 180, 20)],
        "15 degrees apart, within 60 degrees": [(a, a + 15) for a in range(-60, 46, 15)],
    }.items():
        tasks = [(float(angles.wrap(a)), float(angles.wrap(b)), number) for number, (a, b) in enumerate(pairs)]
        outcome = [second for found in run(two_sources, tasks) for second in found]
        both, wrong = np.array(outcome, float).T
        rows[name] = [f"{both.mean():.3f}", f"{wrong.mean():.2f}", str(len(outcome))]
    return (
        "## Two talkers of equal level at 20 dB\n\nSeconds in which each sounds at least half of the time. Both are "
        "found if a track within 10 degrees of each is present for half of the second. Goal: 0.90 for the first "
        "row.\n\n" + table("positions", ("both found", "other tracks", "seconds"), rows)
    )


def section_rooms(run: Map) -> str:
    tasks = [RoomTrial(*one) for one in itertools.product(range(len(PLACES)), RATIOS, map(float, DIRECTIONS[::EVERY]))]
    trials: dict[tuple[int, float], list[Any]] = {}
    others: dict[float, list[int]] = {}
    for task, (found, wrong) in zip(tasks, run(room_trial, tasks), strict=True):
        trials.setdefault((task.place, task.ratio), []).extend(found)
        others.setdefault(task.ratio, []).extend(wrong)
    each = {
        ratio: figures(itertools.chain(*(trials[place, ratio] for place in range(len(PLACES))))) for ratio in RATIOS
    }
    rows = metric_rows(each)
    rows["tracks elsewhere, mean number"] = [f"{np.mean(others[ratio]):.3f}" for ratio in RATIOS]
    places = {}
    for number, place in enumerate(PLACES):
        within = [f"{figures(trials[number, ratio])['within']:.3f}" for ratio in RATIOS]
        places[_description(place)] = [f"{_natural_ratio(number):.1f}", *within]
    calibrated = calibration(list(itertools.chain(*trials.values())))
    shares = {"estimates": [str(n) for _, n, _ in calibrated], "right": [f"{share:.3f}" for *_, share in calibrated]}
    return (
        "## Rooms: one talker, matched head\n\n"
        f"Speech in {len(PLACES)} rectangular rooms, from {len(DIRECTIONS[::EVERY])} directions, {ROOM_SECONDS:g} s "
        "each, estimates from one second. Image sources and a diffuse tail through KEMAR "
        "(rosafe/localization/rectangular_room.py); training uses none of these rooms and no image sources. The "
        "reflections are scaled to the ratio of direct to reverberant energy. Noise at 60 dB. These rooms lack "
        "furniture, walls that absorb some frequencies more than others, talkers that radiate to one side, and "
        "elevated reflections with the ears' responses for their elevation (they have those of the horizontal "
        "plane with the same lateral angle). 0 and 180 degrees count as one.\n\n"
        + table("direct-to-reverberant ratio (dB)", RATIOS, rows)
        + "\nEach room: sides, reverberation time, position of the head from the corner behind, right and below, its "
        "direction, and the distance of the talker; the ratio that follows from the distance; shares within 5 degrees "
        "at the ratios above.\n\n"
        + table("room", ("own ratio (dB)", *(f"{ratio:g} dB" for ratio in RATIOS)), places)
        + "\nCalibration of the confidence, all trials above:\n\n"
        + table("confidence", [name for name, _, _ in calibrated], shares)
    )


def _description(place: Place) -> str:
    sides = " x ".join(f"{side:g}" for side in place.room.size)
    position = ", ".join(f"{at:g}" for at in place.room.head)
    return (
        f"{sides} m, {place.room.rt60:g} s, head at ({position}) m, turned by {place.yaw:g} degrees, "
        f"{place.distance:g} m away"
    )


def _natural_ratio(number: int) -> float:
    """Return the mean direct-to-reverberant ratio in dB of all directions of a place."""
    place, room, filters = PLACES[number], reflections(number, None, "kemar"), head().filters(RATE)
    ratios = []
    for azimuth in DIRECTIONS[::6]:
        early, gain = room.of_source(place.yaw + azimuth, place.distance, place.yaw)
        rest = np.sum(early**2) + gain**2 * np.sum(room.tail**2)
        ratios.append(10 * np.log10(np.sum(filters.response(float(azimuth)) ** 2) / rest))
    return float(np.mean(ratios))


def section_rooms_turning(run: Map) -> str:
    places = range(len(PLACES))
    directions = list(itertools.product(map(float, DIRECTIONS[::EVERY]), (0, 1, 2)))
    tasks = [
        RoomTrial((index + second) % len(places), ratio, azimuth, turn=20.0)
        for ratio in RATIOS
        for index, (azimuth, second) in enumerate(directions)
    ]
    trials: dict[float, list[Any]] = {}
    for task, (found, _) in zip(tasks, run(room_trial, tasks), strict=True):
        trials.setdefault(task.ratio, []).extend(found[-1:])
    return (
        "## Rooms: the head turns by 20 degrees within the second\n\nSpeech, matched head, the rooms above in turn; 0 "
        "and 180 degrees are directions like any other.\n\n"
        + table(
            "direct-to-reverberant ratio (dB)",
            RATIOS,
            metric_rows({ratio: figures(found, poles=False) for ratio, found in trials.items()}),
        )
    )


def section_rooms_heads(run: Map) -> str:
    rows: dict[str, list[str]] = {}
    for title, heard, model in _heads():
        front = title.endswith("front half")
        directions = [float(azimuth) for azimuth in DIRECTIONS[::EVERY] if abs(azimuth) <= 90 or not front]
        directions = [azimuth for azimuth in directions if abs(azimuth) <= 60 or not heard.startswith("pair")]
        rosafe.localize(np.zeros((2, RATE)), RATE, named_head(model))  # learn before the workers need it
        tasks = [
            RoomTrial(index % len(PLACES), ratio, azimuth, heard, model)
            for ratio in RATIOS
            for index, azimuth in enumerate(directions)
        ]
        trials: dict[float, list[Any]] = {}
        for task, (found, _) in zip(tasks, run(room_trial, tasks), strict=True):
            trials.setdefault(task.ratio, []).extend(found)
        for ratio, found in trials.items():
            if front or model != "kemar":  # compared by the lateral angle
                found = [(float(angles.lateral(a)), float(angles.lateral(b)), sure) for a, b, sure in found]
            metrics = figures(found, poles=False)
            row = [f"{metrics['within']:.3f}", f"{metrics['rms']:.1f}", f"{metrics['trials']:.0f}"]
            rows[f"{title}, {ratio:g} dB"] = row
    missing = "" if SURREY.exists() else " The Surrey head is missing here."
    return (
        "## Rooms: other heads and microphones\n\nSpeech as above, the rooms in turn, one for each direction. "
        f"Directions are compared by their lateral angle. Pairs: up to 60 degrees from straight ahead.{missing}\n\n"
        + table("sound, model, ratio", ("within 5 degrees", "RMS in degrees", "trials"), rows)
    )


def _heads() -> Iterable[tuple[str, str, str]]:
    """Yield a title, the head of the sound and that of the model."""
    yield "KEMAR, sphere", "kemar", "sphere"
    if SURREY.exists():
        yield "Surrey head, its own model, front half", "surrey", "surrey"
        yield "Surrey head, KEMAR, front half", "surrey", "kemar"
    if hasattr(rosafe.Head, "pair"):
        for spacing in (0.058, 0.1):
            yield f"pair of {100 * spacing:g} cm, its own model", f"pair:{spacing:g}", f"pair:{spacing:g}"


def section_rooms_two(run: Map) -> str:
    pairs = [(a, a + apart) for apart in (30, 60, 90) for a in range(-90, 91 - apart, 15)][::EVERY]
    tasks = [
        (index % len(PLACES), ratio, float(first), float(second))
        for ratio in RATIOS
        for index, (first, second) in enumerate(pairs)
    ]
    outcome: dict[float, list[tuple[bool, int]]] = {}
    for task, found in zip(tasks, run(room_pair, tasks), strict=True):
        outcome.setdefault(task[1], []).extend(found)
    columns = [np.array(outcome[ratio], float).T for ratio in RATIOS]
    rows = {
        "both found": [f"{both.mean():.3f}" for both, _ in columns],
        "other tracks, mean number": [f"{wrong.mean():.2f}" for _, wrong in columns],
        "seconds": [str(len(both)) for both, _ in columns],
    }
    return (
        "## Rooms: two talkers of equal level, 30 to 90 degrees apart in the front half\n\nMatched head, the rooms "
        "above in turn, 10 s for each pair of positions. Counted as without a room.\n\n"
        + table("direct-to-reverberant ratio (dB)", RATIOS, rows)
    )


def section_other(run: Map) -> str:
    """Noise without a direction, learning, cost, latency."""
    random = np.random.default_rng(5)
    independent = rosafe.localize(LEVEL * random.standard_normal((2, 30 * RATE)), RATE, head(), 1.0)
    diffuse = rosafe.localize(LEVEL * noise_pool()[:, : 25 * RATE], RATE, head(), 1.0)
    rows = {}
    for name, result in (("independent at both ears", independent), ("diffuse", diffuse)):
        low = float(np.mean(result["confidence"] < 0.3))
        rows[name] = [f"{low:.3f}", f"{np.percentile(result['confidence'], 95):.3f}", str(len(result["tracks"]))]
    sound = in_noise(head().render(speech(3, 20.0), RATE, 30.0), 20, 3)
    costs = {}
    for seconds in (0.5, 1.0):
        begin = time.process_time()
        rosafe.localize(sound, RATE, head(), seconds)
        costs[seconds] = (time.process_time() - begin) / 20
    step = head().render(np.concatenate((np.zeros(RATE), speech(4, 2.0))), RATE, 60.0)
    found = rosafe.localize(in_noise(step, 20, 4), RATE, head(), 0.5)
    late = found["time"][(found["time"] > 1.0) & (np.abs(found["azimuth"] - 60) <= 5)][0] - 1.0
    track = min(t["time"][t["probability"] > 0.5][0] for t in found["tracks"] if (t["probability"] > 0.5).any()) - 1.0
    return (
        "## Noise without a direction\n\n"
        + table("noise", ("confidence below 0.3", "95th percentile", "tracks"), rows)
        + "\n## Latency and cost\n\n"
        f"A source that begins is reported within 5 degrees after {1000 * late:.0f} ms, and as a track after "
        f"{1000 * track:.0f} ms (SNR 20 dB, seconds=0.5). A frame ends 20 ms after its beginning.\n\n"
        f"Processor time for a second of sound at 44.1 kHz ({processor()}): {costs[0.5]:.3f} s with seconds=0.5, "
        f"{costs[1.0]:.3f} s with seconds=1.\n"
    )


MARK = "<!-- section {} -->"  # line above a section of the result
SECTIONS: dict[str, Callable[[Map], str]] = {
    "speech": section_speech,
    "turning": section_turning,
    "two": section_two,
    "rooms": section_rooms,
    "rooms_turning": section_rooms_turning,
    "rooms_two": section_rooms_two,
    "rooms_heads": section_rooms_heads,
    "other": section_other,
    "noise": section_noise,
    "mismatch": section_mismatch,
}


def main() -> None:
    """Measure the named sections, or all, and write the result; sections that are not named keep their text."""
    global EVERY, RATE
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use each Nth direction; writes nothing")
    parser.add_argument("--rate", type=int, default=RATE, metavar="HZ", help="another sample rate; writes nothing")
    options = parser.parse_args()
    if unknown := set(options.sections) - set(SECTIONS):
        parser.error(f"SECTION: expected some of {', '.join(SECTIONS)}, got {', '.join(sorted(unknown))}")
    written = (options.every, options.rate) == (EVERY, RATE)
    EVERY, RATE = options.every, options.rate
    texts = written_sections() if options.sections else {}
    rosafe.localize(np.zeros((2, RATE)), RATE, head())  # learn before the workers start
    with ProcessPoolExecutor(int(os.environ.get("WORKERS", "2"))) as pool:
        for name in options.sections or SECTIONS:
            begin = time.monotonic()
            texts[name] = SECTIONS[name](lambda function, tasks: pool.map(function, tasks, chunksize=4))
            print(texts[name], f"({name}: {time.monotonic() - begin:.0f} s)\n", sep="\n", flush=True)
            ordered = [f"{MARK.format(section)}\n{texts[section]}" for section in SECTIONS if section in texts]
            intro = "# Localization\n\nMeasured by benchmarks/localization.py; method: docs/localization.md.\n\n"
            if written:
                RESULT.write_text(intro + "\n".join(ordered))


def written_sections() -> dict[str, str]:
    """Return the sections of the present result by name."""
    _, *parts = re.split(MARK.format(r"(\w+)") + "\n", RESULT.read_text("utf-8"))
    return {name: f"{text.rstrip()}\n" for name, text in zip(parts[::2], parts[1::2], strict=True)}


if __name__ == "__main__":
    main()
