"""Accuracy: errors of every representation relative to independent references.

``/usr/bin/python3 benchmarks/accuracy.py`` prints a table of the largest errors and writes it to benchmarks/results and
to docs/accuracy.md. tests/dsp/test_accuracy.py checks the limits in it. References are closed forms in 50 digits
(mpmath) and the formulas of truth.py in 80-bit arithmetic. If they exist beside the checkout, recorded outputs of the
original are compared as well; these include the errors of the original.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import mpmath
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import rosafe  # noqa: E402
from benchmarks import truth  # noqa: E402
from rosafe.dsp import kernels  # noqa: E402
from rosafe.dsp import middle_ear as ear  # noqa: E402
from rosafe.dsp.erb import erb_rate  # noqa: E402
from rosafe.dsp.windows import NAMES, window  # noqa: E402
from rosafe.representations.crosscorrelation import CrossCorrelation  # noqa: E402
from rosafe.representations.filterbank import Filterbank  # noqa: E402
from rosafe.representations.haircell import (  # noqa: E402
    METHODS,
    InnerHairCell,
)
from rosafe.representations.ild import Ild  # noqa: E402
from rosafe.representations.input import Input  # noqa: E402
from rosafe.representations.preproc import PreProc  # noqa: E402
from rosafe.representations.ratemap import Ratemap  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results" / "accuracy.md"
DOCUMENT = ROOT / "docs" / "accuracy.md"
MARKS = ("<!-- measured by benchmarks/accuracy.py -->\n", "<!-- end -->\n")
VECTORS = ROOT.parent / "shared" / "vectors"
RATES = (8000, 16000, 44100, 96000, 192000)
Array = NDArray[Any]


class Row(NamedTuple):
    """The largest error of one quantity."""

    quantity: str
    reference: str
    unit: str  # the reference value of a relative error, or the unit of an absolute one
    bound: float
    error: float


def noise(samples: int, seed: int = 1, rows: tuple[int, ...] = (2,)) -> Array:
    """Return noise with the right ear quieter, (*rows, samples)."""
    x = np.random.default_rng(seed).standard_normal((*rows, samples))
    x[1] *= 0.3
    return x


def absolute(got: Any, expected: Any) -> float:
    """Return the largest difference."""
    if np.shape(got) != np.shape(expected):
        raise ValueError(f"shape: expected {np.shape(expected)}, got {np.shape(got)}")
    return float(np.abs(np.asarray(got) - expected).max())


def of_peak(got: Any, expected: Any) -> float:
    """Return the largest difference relative to the largest number of the same row (channel and ear)."""
    absolute(got, expected)
    error, peak = (np.abs(array).max(axis=-1) for array in (np.asarray(got) - expected, np.asarray(expected)))
    return float((error / peak).max())


# --- against closed forms in 50 digits --------------------------------------------------------------------------


def scales() -> Iterator[Row]:
    """Measure ERB rate, centre frequencies and input."""
    mp = mpmath.mp.clone()
    mp.dps = 50
    q, width = mp.mpf("9.265"), mp.mpf("24.7")

    def rate(f: float) -> Any:
        return q * mp.log(1 + f / (width * q))

    def frequency(e: Any) -> Any:
        return width * q * (mp.exp(e / q) - 1)

    found = [(float(erb_rate(f)), rate(f)) for f in (1e-3, 20.0, 80.0, 997.0, 8000.0, 90000.0)]
    for step, low, high in ((1.0, 80.0, 8000.0), (0.1, 20.0, 20000.0), (2.5, 1.0, 700.0)):
        got = Filterbank(44100, fb_nERBs=step, fb_lowFreqHz=low, fb_highFreqHz=high).parameters["fb_cfHz"]
        found += [(f, frequency(rate(low) + k * mp.mpf(step))) for k, f in enumerate(got)]
    for count in (1, 2, 31, 1000):
        got = Filterbank(44100, fb_nChannels=count).parameters["fb_cfHz"]
        width_of_one = (rate(8000.0) - rate(80.0)) / max(count - 1, 1)
        found += [(f, frequency(rate(80.0) + k * width_of_one)) for k, f in enumerate(got)]
    error = max(float(abs(f - exact) / exact) for f, exact in found)
    yield Row("ERB rates and centre frequencies", "50 digits", "itself", 2e-14, error)

    samples = [-(2**31), -(2**31) + 1, -1, 0, 1, 12345, 2**31 - 1]
    got = Input(44100).process(np.array([samples, samples], np.int32))[0]
    error = max(float(abs(Fraction(float(y)) - Fraction(x, 2**31 - 1))) for x, y in zip(samples, got, strict=True))
    yield Row("input", "fractions", "absolute", 1.2e-16, error)


class Response(NamedTuple):
    """Impulse response of a gammatone filter: its peak, and (k, h[k], envelope) at about 200 of its samples."""

    peak: Any
    points: list[tuple[int, Any, Any]]
    samples: int


@functools.cache
def exact_response(rate: int, frequency: float, order: int, width: float) -> Response:
    """Return the impulse response from the closed form."""
    mp = mpmath.mp.clone()
    mp.dps = 50
    beta = 2 * mp.pi * mp.mpf(width) * (mp.mpf("24.7") + mp.mpf("0.108") * frequency) / rate
    theta = 2 * mp.pi * mp.mpf(frequency) / rate
    peak_at = int((order - 1) / beta)
    samples = min(4 * peak_at + int(12 / beta) + 10, 60_000)

    def size(k: int) -> Any:
        return 2 * (-mp.expm1(-beta)) ** order * mp.binomial(k + order - 1, order - 1) * mp.exp(-beta * k)

    near = np.arange(max(0, peak_at - 20), peak_at + 20)
    points = {*near[near < samples].tolist(), *np.linspace(0, samples - 1, 160).astype(int).tolist()}
    sizes = {k: size(k) for k in points}
    return Response(size(min(peak_at, samples - 1)), [(k, a * mp.cos(theta * k), a) for k, a in sizes.items()], samples)


def impulse_response(rate: int, frequency: float, order: int, width: float) -> float:
    """Return the error of a gammatone filter's impulse response, relative to its peak."""
    exact = exact_response(rate, frequency, order, width)
    block = np.zeros((2, exact.samples))
    block[:, 0] = 1.0, -0.5
    bank = Filterbank(rate, fb_cfHz=[frequency], fb_nGamma=order, fb_bwERBs=width)
    bank.provide = frozenset({"envelope"})
    got = bank.process(block)[:, 0]
    assert bank.provided["envelope"] is not None
    worst = mpmath.mpf(0)
    for k, value, envelope in exact.points:
        worst = max(worst, *(abs(got[i, k] / a - value) for i, a in enumerate((1, -0.5))))
        worst = max(worst, *(abs(bank.provided["envelope"][i, 0, k] / a - envelope) for i, a in enumerate((1, 0.5))))
    return float(worst / exact.peak)


def gammatone_impulses() -> Iterator[Row]:
    """Measure impulse responses of gammatone filters."""
    plain = [(rate, f, 4, 1.018) for rate in RATES for f in (20.0, 80.0, 1000.0, 0.49 * rate)]
    yield from (
        Row(f"gammatone, impulse: {varied}", "50 digits", "peak", 1e-12, max(impulse_response(*case) for case in cases))
        for varied, cases in {
            "8 to 192 kHz, from 20 Hz on": plain,
            "fb_nGamma 1 to 128": [(rate, 80.0, n, 1.018) for rate in (16000, 192000) for n in (1, 2, 7, 33, 64, 128)],
            "fb_bwERBs 0.1 to 100": [(rate, 80.0, 4, b) for rate in (16000, 44100) for b in (0.1, 0.3, 3.0, 100.0)],
        }.items()
    )


# --- against the formulas in 80 bits ----------------------------------------------------------------------------


def preprocessing() -> Iterator[Row]:
    """Measure each step of the pre-processing."""

    def row(step: str, bound: float, pairs: list[tuple[Array, Array]]) -> Row:
        return Row(f"preProc: {step}", "80 bits", "peak", bound, max(of_peak(*pair) for pair in pairs))

    x = noise(4000) + 0.5
    exact = x.astype(truth.Long)
    for bound, cases in ((1e-12, [(16000, 20.0), (44100, 100.0)]), (1e-9, [(44100, 5.0), (192000, 20.0)])):
        yield row(
            "DC removal, " + ", ".join(f"{cutoff:g} Hz at {rate / 1000:g} kHz" for rate, cutoff in cases),
            bound,
            [
                (
                    PreProc(rate, pp_bRemoveDC=True, pp_cutoffHzDC=cutoff).process(x),
                    truth.run(truth.butterworth(4, cutoff, rate, high=True), exact),
                )
                for rate, cutoff in cases
            ],
        )
    scaled = PreProc(16000, pp_bPreEmphasis=True, pp_bLevelScaling=True, pp_refSPLdB=71.5).process(x)
    emphasised = exact - truth.Long(0.97) * np.pad(exact, ((0, 0), (1, 0)))[:, :-1]
    yield row("pre-emphasis, level", 1e-14, [(scaled, emphasised * truth.Long(10) ** (truth.Long("28.5") / 20))])
    controlled = [
        (
            PreProc(rate, pp_bNormalizeRMS=True, pp_intTimeSecRMS=tau).process(x),
            truth.gain_control(exact, rate, tau),
        )
        for rate, tau in ((16000, 0.02), (44100, 0.5))
    ]
    yield row("gain control", 1e-12, controlled)
    for model in ear.MODELS:
        pairs = []
        for rate in (8000, 16000, 44100, 96000):
            if model == "jepsen":
                taps = truth.jepsen(ear.STAPES_IMPEDANCE, rate)
            else:
                taps = truth.lopezpoveda(ear.STAPES_DISPLACEMENT, ear.STAPES_VELOCITY_EXTRAPOLATED, rate)
            pairs.append((ear.middle_ear_fir(model, rate, unity=False), taps))
        yield row(f"middle ear, {model}", 1e-13, pairs)


def filterbanks() -> Iterator[Row]:
    """Measure the response of both types of filterbank to noise."""
    frequencies = [80.0, 440.0, 3000.0]
    for name, bound in (("output", 1e-12), ("envelope", 1e-12)):
        error = 0.0
        for rate, order, width in ((16000, 4, 1.018), (44100, 4, 1.018), (48000, 2, 0.5)):
            x = noise(2500)
            bank = Filterbank(rate, fb_cfHz=frequencies, fb_nGamma=order, fb_bwERBs=width)
            bank.provide = frozenset({"envelope"})
            got = bank.process(x)
            exact = truth.gammatone(x.astype(truth.Long), rate, frequencies, order, width)
            found, expected = (got, exact[0]) if name == "output" else (bank.provided["envelope"], exact[1])
            error = max(error, of_peak(found, expected))
        yield Row(f"gammatone, noise: {name}", "80 bits", "peak", bound, error)
    error = 0.0
    for rate, frequency, velocity in ((16000, 300.0, 1e-10), (44100, 1000.0, 1e-6), (44100, 4000.0, 1e-3)):
        x = velocity * noise(2000)
        got = Filterbank(rate, fb_type="drnl", fb_cfHz=[frequency]).process(x)[:, 0]
        error = max(error, of_peak(got, truth.drnl(x.astype(truth.Long), rate, frequency)))
    yield Row("drnl, noise of 1e-10 to 1e-3 m/s", "80 bits", "peak", 1e-11, error)


def hair_cells() -> Iterator[Row]:
    """Measure each method, with noise and its envelope."""
    for method in METHODS:
        error = 0.0
        for rate in (8000, 44100):
            x = noise(1500, rows=(2, 2))
            envelope = np.abs(noise(1500, seed=2, rows=(2, 2))) + np.abs(x)
            stage = InnerHairCell(rate, ihc_method=method)
            got = stage.process(x, envelope if stage.required_extra else None)
            exact = truth.hair_cell(method, x.astype(truth.Long), envelope.astype(truth.Long), rate)
            error = max(error, of_peak(got, exact))
        yield Row(f"ihc: {method}", "80 bits", "peak", 1e-13, error)


def framed() -> Iterator[Row]:
    """Measure windows, and the three framed stages on the output of a hair cell, with various windows and hops."""
    error = max(absolute(window(name, size), truth.window(name, size)) for name in NAMES for size in (2, 7, 882))
    yield Row("windows", "80 bits", "absolute", 1e-15, error)
    rate, x = 16000, np.maximum(noise(2000, rows=(2, 2)), 0)
    exact = x.astype(truth.Long)
    errors: dict[str, list[float]] = {"ild": [], "power": [], "magnitude": [], "correlation": []}
    for name, size, hop in (("hann", 320, 160), ("hamming", 64, 100), ("blackman", 100, 7), ("sqrt_win", 882, 331)):
        shape = truth.window(name, size)

        def parameters(prefix: str) -> dict[str, Any]:
            values = {"wname": name, "wSizeSec": size / rate, "hSizeSec": hop / rate}  # noqa: B023
            return {f"{prefix}_{key}": value for key, value in values.items()}

        got: Array = Ild(rate, **parameters("ild")).process(x)
        errors["ild"].append(absolute(got, truth.level_difference(exact, shape, hop)))
        for scaling in ("power", "magnitude"):
            got = Ratemap(rate, rm_scaling=scaling, **parameters("rm")).process(x)
            expected = truth.ratemap(exact, shape, hop, rate, 0.008, scaling == "power")
            errors[scaling].append(of_peak(got, expected))
        for reach in (17, 150):
            got = CrossCorrelation(rate, cc_maxDelaySec=reach / rate, **parameters("cc")).process(x)
            errors["correlation"].append(absolute(got, truth.correlation(exact, shape, hop, reach)))
    yield Row("ild", "80 bits", "dB", 1e-11, max(errors["ild"]))
    for scaling in ("power", "magnitude"):
        yield Row(f"ratemap: {scaling}", "80 bits", "peak", 1e-12, max(errors[scaling]))
    yield Row("crossCorrelation, direct sums", "80 bits", "absolute", 1e-13, max(errors["correlation"]))


# --- the whole chain --------------------------------------------------------------------------------------------


def whole_chain() -> Iterator[Row]:
    """Measure `rosafe.process` with its defaults at 16 kHz, in one block and in many."""
    rate, parameters = 16000, {"fb_nERBs": 4.0}
    signal = 0.1 * noise(1800)
    got = rosafe.process(signal, rate, parameters=parameters)
    shape = truth.window("hann", 320)
    banded = truth.gammatone(signal.astype(truth.Long), rate, got["fb_cfHz"], 4, 1.018)
    ihc = truth.hair_cell("dau", *banded, rate)
    exact = {
        "ihc": (of_peak, "peak", 1e-12, ihc),
        "ild": (absolute, "dB", 1e-9, truth.level_difference(ihc, shape, 160)),
        "ratemap": (of_peak, "peak", 1e-12, truth.ratemap(ihc, shape, 160, rate, 0.008, power=True)),
        "crossCorrelation": (absolute, "absolute", 1e-11, truth.correlation(ihc, shape, 160, 18)),
    }
    for kind, (error, unit, bound, expected) in exact.items():
        yield Row(f"chain: {kind}", "80 bits", unit, bound, error(got[kind], expected))
    worst = 0.0
    for sizes in ([1], [7, 500, 1, 33], [159, 161]):
        pieces = rosafe.process(signal, rate, parameters=parameters, block_frames=sizes)
        worst = max(worst, *(absolute(pieces[kind], got[kind]) for kind in exact))
    yield Row("chain in blocks of 1 to 500 samples", "in one block", "absolute", 1e-12, worst)


# --- against the original ---------------------------------------------------------------------------------------


def reference_vectors() -> Iterator[Row]:
    """Compare with the original, except for `joergensen`, for which the original computes envelopes in another way."""
    tolerances = {"preProc": 1e-13, "preProc with DC removal": 1e-5, "gammatone": 2e-6, "ihc": 5e-6}
    tolerances |= {"ratemap": 1e-6, "ild": 1e-3, "crossCorrelation": 1e-4}
    errors = dict.fromkeys(tolerances, 0.0)
    for case in json.loads((VECTORS / "manifest.json").read_text()):
        if case["name"].startswith("P09"):
            continue
        with np.load(VECTORS / case["file"]) as arrays:
            expected = dict(arrays)
        parameters = {"pp_bUnityComp": case["all_params"]["pp_bUnityComp"], **case["params"]}
        how = {"block_frames": case["chunks"], "modifications": case["mods"]}
        got = rosafe.process(expected["signal"], case["fs"], parameters=parameters, **how)
        times, channels = expected["time_idx"], expected["chan_idx"]
        without_dc = not parameters.get("pp_bRemoveDC")
        pre = "preProc" if without_dc else "preProc with DC removal"
        error = absolute(got["preProc"][:, times], expected["preProc"]) / np.abs(expected["preProc"]).max()
        errors[pre] = max(errors[pre], error)
        if not without_dc:  # its error affects the whole chain
            continue
        for kind in ("gammatone", "ihc"):
            errors[kind] = max(errors[kind], of_peak(got[kind][:, channels][..., times], expected[kind]))
        error = absolute(got["ratemap"], expected["ratemap"]) / expected["ratemap"].max()
        errors["ratemap"] = max(errors["ratemap"], error)
        errors["ild"] = max(errors["ild"], absolute(got["ild"], expected["ild"]))
        error = absolute(got["crossCorrelation"][channels], expected["crosscorrelation"])
        errors["crossCorrelation"] = max(errors["crossCorrelation"], error)
    for quantity, error in errors.items():
        unit = {"ild": "dB", "crossCorrelation": "absolute"}.get(quantity, "peak")
        yield Row(quantity, "the original", unit, tolerances[quantity], error)


# --- the table --------------------------------------------------------------------------------------------------

MEASUREMENTS: tuple[Callable[[], Iterator[Row]], ...] = (
    scales,
    preprocessing,
    gammatone_impulses,
    filterbanks,
    hair_cells,
    framed,
    whole_chain,
)


def table(rows: list[Row]) -> str:
    """Return the rows in Markdown."""
    lines = ["| | reference | error relative to | largest | at most |", "|---|---|---|--:|--:|"]
    for row in rows:
        unit = {"dB": "(in dB)", "absolute": "1"}.get(row.unit, row.unit)
        lines.append(f"| {row.quantity} | {row.reference} | {unit} | {row.error:.1e} | {row.bound:.1e} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measure, print and write. Return 1 if an error exceeds its limit."""
    parser = argparse.ArgumentParser(description="Measure the errors of all representations.")
    parser.add_argument("--print", action="store_true", help="print only, without writing files")
    options = parser.parse_args()
    print(kernels.status().detail, file=sys.stderr)
    measurements = [*MEASUREMENTS, *([reference_vectors] if VECTORS.is_dir() else [])]
    rows = [row for measure in measurements for row in measure()]
    text = table(rows)
    print(text, end="")
    if not options.print:
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(f"# Measured errors\n\nWritten by benchmarks/accuracy.py; see docs/accuracy.md.\n\n{text}")
        before, _, rest = DOCUMENT.read_text().partition(MARKS[0])
        DOCUMENT.write_text(before + MARKS[0] + text + MARKS[1] + rest.partition(MARKS[1])[2])
    beyond = [row.quantity for row in rows if not math.isfinite(row.error) or row.error > row.bound]
    print(
        *(f"error exceeds its limit: {quantity}" for quantity in beyond),
        sep="\n",
        end="\n" if beyond else "",
        file=sys.stderr,
    )
    return 1 if beyond else 0


if __name__ == "__main__":
    sys.exit(main())
