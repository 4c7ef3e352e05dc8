"""Back to sound: the error of `rosafe.resynthesize` and `rosafe.Resynthesizer`, and the effect of masks on two talkers.

Needs Debian's libmysofa1 (the MIT KEMAR head), espeak-ng and alsa-utils (speech). The constants of the method were
chosen with other voices and sentences. Writes benchmarks/results/resynthesis.md.

    /usr/bin/python3 -m benchmarks.resynthesis
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal

import rosafe
from benchmarks.localization import RATE, head, speech, table, talkers
from benchmarks.report import processor

RESULT = Path(__file__).parent / "results" / "resynthesis.md"
RATES = (8000, 16000, 44100, 48000)
BANKS: dict[str, dict[str, Any]] = {
    "1 ERB (default)": {},
    "2 ERB": {"fb_nERBs": 2.0},
    "40 channels": {"fb_nChannels": 40},
    "64 channels, 80 Hz to 7 kHz": {"fb_nChannels": 64, "fb_highFreqHz": 7000.0},
    "1 ERB, middle ear": {"pp_bMiddleEarFiltering": True},
}
DELAYS = (0.002, 0.004, 0.008, 0.016, 0.032)
SECONDS = 3.0
DIRECTIONS = ((0, 60), (0, -60), (0, 30), (0, 90), (30, -30), (-45, 20), (60, 0))  # target, other
MASKS = ("ideal ratio mask", "estimated, matched head", "estimated, sphere")


def db(ratio: Any) -> Any:
    return 10 * np.log10(ratio)


def band_limited(rate: int, parameters: dict[str, Any]) -> np.ndarray:
    """Return two talkers (2, N) between 1.2 times the lowest and 0.8 times the highest centre frequency."""
    ears = np.stack([speech(number, SECONDS) for number in (0, 5)])
    ears = scipy.signal.resample_poly(ears, rate // 100, RATE // 100, axis=1)
    ears *= scipy.signal.windows.tukey(ears.shape[1], 0.1)
    ears = np.pad(ears, ((0, 0), (rate // 2, rate // 2)))
    frequencies = rosafe.process(ears[:, :100], rate, parameters=parameters, outputs=["gammatone"])["fb_cfHz"]
    spectrum = np.fft.rfft(ears)
    bins = np.fft.rfftfreq(ears.shape[1], 1 / rate)
    spectrum[:, (bins < 1.2 * frequencies[0]) | (bins > 0.8 * frequencies[-1])] = 0
    return np.asarray(np.fft.irfft(spectrum, ears.shape[1]))


def section_error() -> tuple[str, dict[str, float]]:
    rows: dict[str, list[str]] = {}
    figures = {}
    for name, parameters in BANKS.items():
        for rate in RATES:
            if parameters.get("fb_highFreqHz", 0) > 0.475 * rate:
                rows.setdefault(name, []).append("")
                continue
            ears = band_limited(rate, parameters)
            result = rosafe.process(ears, rate, parameters=parameters, outputs=["gammatone"])
            begin = time.process_time()
            found = rosafe.resynthesize(result)
            cost = (time.process_time() - begin) / (ears.shape[1] / rate)
            error = float(db(np.sum((found - ears) ** 2) / np.sum(ears**2)))
            figures[f"{name}, {rate} Hz"] = error
            rows.setdefault(name, []).append(f"{error:.0f}, {cost:.2f}")
    text = (
        "## Error of `rosafe.resynthesize`\n\nSpeech between 1.2 times the lowest and 0.8 times the highest centre "
        "frequency, with silence at its end. Error relative to the input in dB, and seconds of processor time for a "
        f"second of two ears ({processor()}).\n\n" + table("filterbank", [f"{rate} Hz" for rate in RATES], rows)
    )
    return text, figures


def section_causal() -> tuple[str, dict[str, float]]:
    rate = 16000
    ears = band_limited(rate, {})
    rows: dict[str, list[str]] = {"error in dB": [], "`error_db`": [], "processor time in s per s": []}
    for delay in DELAYS:
        stream = rosafe.Stream(rate, outputs=["gammatone"])
        blocks = [stream.process(ears[:, first : first + 160])["gammatone"] for first in range(0, ears.shape[1], 160)]
        resynthesizer = rosafe.Resynthesizer(rate, delay=delay)
        begin = time.process_time()
        found = np.concatenate([resynthesizer.process(block) for block in blocks], axis=1)
        cost = (time.process_time() - begin) / (ears.shape[1] / rate)
        late = resynthesizer.delay_samples
        error = db(np.sum((found[:, late:] - ears[:, :-late]) ** 2) / np.sum(ears**2))
        for row, text in zip(rows, (f"{error:.0f}", f"{resynthesizer.error_db:.0f}", f"{cost:.3f}"), strict=True):
            rows[row].append(text)
    text = (
        "## Error of `rosafe.Resynthesizer`\n\nThe same speech at 16 kHz with the default filterbank, in blocks of "
        "10 ms.\n\n" + table("delay", [f"{1000 * delay:g} ms" for delay in DELAYS], rows)
    )
    return text, {}


def si_sdr(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the scale-invariant signal-to-distortion ratio of each ear in dB."""
    scale = np.sum(estimate * reference, axis=-1) / np.sum(reference**2, axis=-1)
    target = scale[:, np.newaxis] * reference
    return np.asarray(db(np.sum(target**2, axis=-1) / np.sum((estimate - target) ** 2, axis=-1)))


def improvements(first: int, second: int, azimuths: tuple[int, int]) -> list[float]:
    """Return the improvement by each of `MASKS` in dB, mean of both ears."""
    dry = [speech(number + 60 * place, SECONDS) for place, number in enumerate((first, second))]
    target, other = (head().render(sound, RATE, azimuth) for sound, azimuth in zip(dry, azimuths, strict=True))
    mixture = target + other
    power = [rosafe.process(one, RATE, outputs=["ratemap"])["ratemap"].sum(axis=0) for one in (target, other)]
    result = rosafe.process(mixture, RATE, outputs=["gammatone"])
    masks = [power[0] / (power[0] + power[1] + 1e-30)]
    masks += [rosafe.direction_mask(mixture, RATE, azimuths[0], model) for model in (head(), "sphere")]
    before = si_sdr(mixture, target)
    return [float(np.mean(si_sdr(rosafe.resynthesize(result, mask), target) - before)) for mask in masks]


def section_talkers() -> tuple[str, dict[str, float]]:
    voices = range(len(talkers()))
    pairs = list(itertools.permutations(voices, 2))
    rows: dict[str, list[str]] = {}
    figures = {}
    for azimuths in DIRECTIONS:
        chosen = pairs if azimuths == DIRECTIONS[0] else pairs[:: len(voices)]
        found = np.array([improvements(first, second, azimuths) for first, second in chosen])
        for name, values in zip(MASKS, found.T, strict=True):
            figures[f"{name}, {azimuths[0]} and {azimuths[1]}"] = float(values.mean())
        rows[f"{azimuths[0]}°, {azimuths[1]}°"] = [
            *(f"{values.mean():.1f} ({values.min():.1f} to {values.max():.1f})" for values in found.T),
            str(len(chosen)),
        ]
        print(azimuths, rows[f"{azimuths[0]}°, {azimuths[1]}°"], flush=True)
    text = (
        "## Two talkers\n\nImprovement of the scale-invariant signal-to-distortion ratio in dB, mean of both ears: "
        "mean over pairs of six talkers, and range. Target and other have equal level before the filters of KEMAR; "
        f"{SECONDS:g} s each, 44.1 kHz, the default filterbank. Both ears have the same mask. Goals for the first row: "
        "at least 7 with the ideal ratio mask, at least 5 with an estimated one.\n\n"
        + table("target, other", (*MASKS, "pairs"), rows)
    )
    return text, figures


def main(names: list[str]) -> None:
    """Measure all sections, or the named ones, and write the result."""
    sections = {"error": section_error, "causal": section_causal, "talkers": section_talkers}
    store = RESULT.with_suffix(".json")
    known: dict[str, Any] = json.loads(store.read_text()) if store.exists() else {}
    for name in names or sections:
        text, figures = sections[name]()
        known[name] = {"text": text, "figures": {key: round(value, 2) for key, value in figures.items()}}
        print(text, flush=True)
        texts = [known[section]["text"] for section in sections if section in known]
        intro = "# Back to sound\n\nMeasured by benchmarks/resynthesis.py; method: docs/resynthesis.md.\n\n"
        RESULT.write_text(intro + "\n".join(texts))
        store.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
