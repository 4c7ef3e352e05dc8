"""Generate the reference vectors: `python3 -m tests.vectors.make`. This uses numpy and scipy, and nothing of rosafe.

Each formula is implemented as differently from rosafe as possible: filters as convolutions with closed-form impulse
responses or as sums over all samples, frames one by one, correlations as plain sums.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal
import scipy.special

HERE = Path(__file__).parent
EPSILON = 2.2204e-16
THIN = 13  # every 13th sample of signals at the audio rate is kept

Case = dict[str, Any]
CASES: dict[str, Case] = {
    "speechlike_dau": {"rate": 16000, "seconds": 0.4, "seed": 1, "cf": [120.0, 500.0, 1300.0, 4000.0]},
    "noise_conditioned": {
        "rate": 22050,
        "seconds": 0.3,
        "seed": 2,
        "cf": [90.0, 2000.0],
        "parameters": {
            "pp_bRemoveDC": True,
            "pp_bPreEmphasis": True,
            "pp_coefPreEmphasis": 0.9,
            "pp_bLevelScaling": True,
            "pp_refSPLdB": 110.0,
            "fb_nGamma": 3,
            "fb_bwERBs": 1.3,
            "rm_scaling": "magnitude",
            "rm_decaySec": 0.02,
            "ild_wname": "hamming",
            "ild_hSizeSec": 0.007,
            "cc_maxDelaySec": 0.0004,
        },
    },
}
DEFAULTS: Case = {
    "pp_bRemoveDC": False,
    "pp_bPreEmphasis": False,
    "pp_coefPreEmphasis": 0.97,
    "pp_bLevelScaling": False,
    "pp_refSPLdB": 100.0,
    "fb_nGamma": 4,
    "fb_bwERBs": 1.018,
    "rm_scaling": "power",
    "rm_decaySec": 0.008,
    "ild_wname": "hann",
    "ild_hSizeSec": 0.01,
    "cc_maxDelaySec": 0.0011,
}


def sound(case: Case) -> np.ndarray:
    """Return int32 samples (2, N): gliding harmonics with pauses and noise, later and softer in the right ear."""
    rate, count = case["rate"], int(case["rate"] * case["seconds"])
    rng = np.random.default_rng(case["seed"])
    t = np.arange(count) / rate
    pitch = 2 * np.pi * np.cumsum(110 + 60 * t) / rate
    voice = sum(np.sin(k * pitch + k) / k for k in range(1, 20)) * (np.sin(2 * np.pi * 4 * t) > -0.3)
    left = 0.05 * voice + 0.01 * rng.standard_normal(count) + 0.02
    right = 0.6 * np.roll(left, 7) + 0.002 * rng.standard_normal(count)
    return np.round(np.stack((left, right)) * 2**30).astype(np.int32)


def half_up(value: float) -> int:
    return int(np.floor(value + 0.5))


def preproc(x: np.ndarray, rate: float, p: Case) -> np.ndarray:
    if p["pp_bRemoveDC"]:
        zeros, poles, gain = scipy.signal.butter(4, 20.0, "highpass", fs=rate, output="zpk")
        x = by_partial_fractions(zeros, poles, gain, x)
    if p["pp_bPreEmphasis"]:
        x = x - p["pp_coefPreEmphasis"] * np.concatenate((np.zeros((2, 1)), x[:, :-1]), axis=1)
    return x * 10 ** ((100 - p["pp_refSPLdB"]) / 20) if p["pp_bLevelScaling"] else x


def by_partial_fractions(zeros: np.ndarray, poles: np.ndarray, gain: float, x: np.ndarray) -> np.ndarray:
    """Convolve with the impulse response, a sum of one exponential for each pole."""
    k = np.arange(x.shape[1])
    response = np.zeros(len(k), complex)
    for i, pole in enumerate(poles):
        residue = gain * np.prod(1 - zeros / pole) / np.prod(1 - np.delete(poles, i) / pole)
        response += residue * pole**k
    response[0] += gain * np.prod(zeros) / np.prod(poles)
    return np.array([np.convolve(ear, response.real)[: len(ear)] for ear in x])


def gammatone(x: np.ndarray, rate: float, f: float, order: int, width: float) -> np.ndarray:
    """Convolve with 2 g**n binomial(k + n - 1, n - 1) exp(-beta k) cos(theta k)."""
    k = np.arange(x.shape[1])
    beta = 2 * np.pi * width * (24.7 + 0.108 * f) / rate
    response = scipy.special.binom(k + order - 1, order - 1) * np.exp(-beta * k) * np.cos(2 * np.pi * f / rate * k)
    response *= 2 * (1 - np.exp(-beta)) ** order
    return np.array([np.convolve(ear, response)[: len(ear)] for ear in x])


def dau(x: np.ndarray, rate: float) -> np.ndarray:
    b, a = scipy.signal.butter(2, 1000.0, fs=rate)
    return scipy.signal.lfilter(b, a, np.maximum(x, 0.0))


def window(name: str, size: int) -> np.ndarray:
    i = np.arange(size)
    if name == "hamming":
        return 0.54 - 0.46 * np.cos(2 * np.pi * i / (size - 1))
    return 0.5 - 0.5 * np.cos(2 * np.pi * i / (size - 1))


def frames(count: int, size: int, hop: int) -> list[slice]:
    return [slice(at, at + size) for at in range(0, count - size + 1, hop)]


def compute(case: Case) -> dict[str, np.ndarray]:
    """Compute all outputs of a case, for the whole signal."""
    rate, p = case["rate"], {**DEFAULTS, **case.get("parameters", {})}
    samples = sound(case)
    out = {"signal": samples, "input": samples / (2**31 - 1)}
    out["preProc"] = preproc(out["input"], rate, p)
    channels = [gammatone(out["preProc"], rate, f, p["fb_nGamma"], p["fb_bwERBs"]) for f in case["cf"]]
    out["gammatone"] = np.stack(channels, axis=1)
    ihc = out["ihc"] = dau(out["gammatone"], rate)
    count, size = ihc.shape[-1], 2 * half_up(0.02 * rate / 2)

    win = window(p["ild_wname"], size)
    energies = [
        np.mean((win * ihc[..., f]) ** 2, axis=-1) for f in frames(count, size, half_up(p["ild_hSizeSec"] * rate))
    ]
    out["ild"] = np.stack([10 * np.log10((e[1] + EPSILON) / (e[0] + EPSILON)) for e in energies], axis=-1)

    retention = np.exp(-1 / (rate * p["rm_decaySec"]))
    weights = (1 - retention) * retention ** np.arange(count)
    smooth = np.array([[np.convolve(row, weights)[:count] for row in ear] for ear in ihc])
    win, hop = window("hann", size), half_up(0.01 * rate)
    power = 2 if p["rm_scaling"] == "power" else 1
    rates = [np.mean((win * smooth[..., f]) ** power, axis=-1) for f in frames(count, size, hop)]
    out["ratemap"] = np.stack(rates, axis=-1)

    reach = int(np.ceil(p["cc_maxDelaySec"] * rate))
    lags = range(-reach, reach + 1)
    correlations = np.zeros((len(case["cf"]), len(lags), len(rates)))
    for k, f in enumerate(frames(count, size, hop)):
        for c in range(len(case["cf"])):
            left, right = win * ihc[0, c, f], win * ihc[1, c, f]
            norm = np.sqrt(np.sum(left**2) * np.sum(right**2) + EPSILON)
            for index, m in enumerate(lags):
                shifted = left[m:] if m >= 0 else left[:m]
                other = right[: size - m] if m >= 0 else right[-m:]
                correlations[c, index, k] = np.sum(shifted * other) / norm
    out["crossCorrelation"] = correlations
    out["itd"], out["ic"] = peaks(correlations, reach, rate)
    levels = 10 * np.log10(np.maximum(out["ratemap"], 1e-200))
    rise = np.diff(levels, axis=-1, prepend=levels[..., :1])
    out["onsetStrength"] = np.clip(rise, 0.0, 30.0)
    out["offsetStrength"] = np.clip(-rise, 0.0, 30.0)
    return out


def peaks(correlations: np.ndarray, reach: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return time (s) and height of the parabola through the maximum of the correlation and its neighbours."""
    times = np.zeros((correlations.shape[0], correlations.shape[2]))
    heights = np.zeros_like(times)
    for c, k in np.ndindex(times.shape):
        curve = correlations[c, :, k]
        i = int(np.argmax(curve))
        shift, heights[c, k] = 0.0, curve[i]
        if 0 < i < 2 * reach:
            before, here, after = curve[i - 1 : i + 2]
            shift = 0.5 * (before - after) / (before - 2 * here + after)
            heights[c, k] = here - 0.25 * (before - after) * shift
        times[c, k] = 0.0 if np.all(curve == curve[0]) else (i - reach + shift) / rate
    return times, heights


def kept(name: str, data: np.ndarray) -> np.ndarray:
    """Return the part of an output that is stored in the file."""
    return data[..., ::THIN] if name in ("input", "preProc", "gammatone", "ihc") else data


def main() -> None:
    """Write the vectors."""
    for name, case in CASES.items():
        outputs = compute(case)
        np.savez_compressed(HERE / f"{name}.npz", **{key: kept(key, data) for key, data in outputs.items()})


if __name__ == "__main__":
    main()
