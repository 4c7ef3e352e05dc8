"""Precedence: the reference vector, a direct implementation of the definition, and sounds with a known direction."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.precedence import PAIRS, Precedence, fading, weights

from .chain import FloatArray

RATE = 2000.0  # 1 ms are 2 samples, 10 ms 20
PARTS = ("itd", "ild", "cc")


def given_signal(channels: int, rate: float = RATE) -> SignalFormat:
    return SignalFormat(
        rate, rate, center_frequencies=tuple(np.geomspace(60.0, 900.0, channels)), filterbank="gammatone"
    )


def framed(size: int, hop: int, rate: float = RATE, **more: Any) -> dict[str, Any]:
    return {"prec_wSizeSec": size / rate, "prec_hSizeSec": hop / rate, **more}


def sound(
    samples: int, channels: int = 3, seed: int = 0, echo: int = 7, gain: float = 0.6, shift: int = 1
) -> FloatArray:
    """Return noise with an echo in each channel, later and quieter in the right ear, and independent noise."""
    rng = np.random.default_rng(seed)
    dry = rng.standard_normal((channels, samples + 50))
    wet = dry + gain * np.roll(dry, echo, axis=-1)
    ears = np.stack((wet, 0.7 * np.roll(wet, shift, axis=-1))) + 0.1 * rng.standard_normal((2, *wet.shape))
    return np.ascontiguousarray(ears[..., 50:])


# --- the definition -----------------------------------------------------------------------------------------------


def xc(a: FloatArray, b: FloatArray, reach: int) -> FloatArray:
    """Return sum a[n + m] b[n] for m = -reach ... reach."""
    made = []
    for m in range(-reach, reach + 1):
        length = max(0, min(len(a) - max(0, m), len(b) + min(0, m)))
        made.append(float(a[max(0, m) :][:length] @ b[max(0, -m) :][:length]))
    return np.array(made)


def by_definition(x: FloatArray, signal: SignalFormat, size: int, hop: int, delay: float) -> tuple[Any, ...]:
    """Compute itd, ild and cc of (2, C, N) by the steps of the specification, and the pairs, delays and gains."""
    rate, frequencies = signal.sample_rate, signal.center_frequencies
    most, last, reach = math.ceil(delay * rate), math.floor(0.01 * rate + 0.5), math.ceil(rate / 1000)
    first, unit = math.floor(0.75 * rate / 1000), math.floor(rate / 1000 + 0.5)
    window = 0.5 * (1 - np.cos(2 * np.pi * np.arange(1, size + 1) / (size + 1)))
    channels = len(frequencies)
    running = np.zeros((2, channels, last + 1))
    pairs = np.zeros((4, 2 * reach + 1))
    results: list[list[FloatArray]] = [[], [], []]
    chosen = []
    for begin in range(0, x.shape[-1] - size + 1, hop):
        frames, clean, found = window * x[..., begin : begin + size], [], []
        for ear in range(2):
            for c in range(channels):
                running[ear, c] += xc(frames[ear, c], frames[ear, c], last)[last:] / max(frequencies[c], 100.0)
            peaks = frames[ear].max(axis=-1)
            active = int((peaks > 10 ** (-12 / 20) * peaks.max()).sum())
            greatest = running[ear].max(axis=-1)
            s = np.zeros(last + 1)
            for c in range(channels):
                if active > 5:
                    s += running[ear, c]
                elif greatest[c] > 0.001 * greatest.max():
                    s += running[ear, c] / greatest[c]
            d = first + int(np.argmax(s[first:]))
            ratio = min(max(s[d] / s.max(), 0.0), 0.5) if s.max() > 0 else 0.0
            beta = next(b / 100 for b in range(101) if (b / 100) / (1 + (b / 100) ** 2) >= ratio)
            beta = min(beta, 0.9)
            t = 1.0
            if d > 6 * unit:
                t = (1 - (d - 1 - 6 * unit) / (14 * unit - 1)) ** 4 if d <= 20 * unit else 0.0
            small = np.zeros((channels + 1, size + 5 * d))
            large = np.zeros((channels + 1, max(0, size - d)))
            together = np.concatenate((frames[ear], frames[ear].sum(axis=0)[np.newaxis]))
            for i in range(6):
                small[:, i * d : i * d + size] += (-beta * t) ** i * together
                for n in range(large.shape[1]):
                    if n + (6 - i) * d < size:
                        large[:, n] += (-1) ** (i + 1) * beta ** (6 - i) * t ** (5 - i) * together[:, n + (6 - i) * d]
            clean.append((small, large))
            found.append((d, beta, t, active))
        for p, (left, right) in enumerate([(0, 0), (1, 1), (0, 1), (1, 0)]):
            pairs[p] += xc(clean[0][left][-1], clean[1][right][-1], reach)
        best = int(np.argmax(pairs.max(axis=-1)))
        left, right = [(0, 0), (1, 1), (0, 1), (1, 0)][best]
        cc, itd, ild = np.zeros((channels, 2 * most + 1)), np.zeros(channels), np.zeros(channels)
        for c in range(channels):
            l_c, r_c = clean[0][left][c], clean[1][right][c]
            g = min(frequencies[c], 1200.0)
            weight = 10 ** ((0.0938272 * g - 0.000112586 * g**2 + 3.99154e-8 * g**3) / 10) / 276
            energies = float(l_c @ l_c), float(r_c @ r_c)
            cc[c] = xc(l_c, r_c, most) / math.sqrt(energies[0] * energies[1] + 2.2204e-16) * weight
            if cc[c].max() > cc[c].min():
                itd[c] = (int(np.argmax(cc[c])) - most) / rate
            if min(energies) > 0:
                ild[c] = 10 * math.log10(energies[1] / energies[0])
        for result, value in zip(results, (itd, ild, cc), strict=True):
            result.append(value)
        chosen.append((best, *found))
    return (*(np.stack(result, axis=-1) for result in results), chosen)


def sines(seed: int, samples: int = 300) -> FloatArray:
    """Return different periods in both ears, and noise: without real echoes, each pair is the best one at times."""
    time, rng = np.arange(samples), np.random.default_rng(seed)
    tones = np.stack([np.sin(2 * np.pi * time / (8 + seed % 5)), np.sin(2 * np.pi * time / (9 + seed % 7) + seed)])
    return 0.3 * rng.standard_normal((2, 3, samples)) + tones[:, np.newaxis]


def some_loud(seed: int = 0) -> FloatArray:
    """Return twelve channels, of which eight, four, and again eight are active, and one is almost silent."""
    x = sound(500, 12, seed)
    x[:, 5] *= 1e-4
    x[:, 8:] *= 0.05
    x[:, 4:8, 150:350] *= 0.05
    return x


def clicks() -> FloatArray:
    """Return clicks so far apart that they do not correlate."""
    x = np.zeros((2, 3, 400))
    x[0, :, 50::100], x[1, :, 52::100] = 1.0, -0.5
    return x


CASES: dict[str, tuple[FloatArray, int, int, float]] = {
    "noise": (np.random.default_rng(5).standard_normal((2, 3, 300)), 60, 30, 0.002),
    "echo": (sound(300), 60, 30, 0.001),
    "late echo": (sound(400, echo=14, gain=0.9), 80, 30, 0.003),
    "later echo": (sound(400, seed=3, echo=19, gain=1.5), 80, 30, 0.003),
    "opposite ears": (sound(300, seed=1) * [[[1.0]], [[-1.0]]], 60, 30, 0.002),
    "hop beyond the window": (sound(500), 50, 77, 0.002),
    "a window of the reach": (sound(200), 20, 7, 0.002),
    "lags without overlap": (sound(200), 30, 40, 0.08),
    "clicks": (clicks(), 60, 30, 0.002),
    "one channel": (sound(300, 1), 60, 30, 0.002),
    "many channels": (sound(300, 9), 60, 30, 0.002),
    "few active channels": (some_loud(), 60, 30, 0.002),
    **{f"sines {seed}": (sines(seed), 60, 30, 0.002) for seed in range(6)},
}


@functools.cache
def spelt_out(name: str) -> tuple[Any, ...]:
    x, size, hop, delay = CASES[name]
    return by_definition(x, given_signal(x.shape[1]), size, hop, delay)


@pytest.mark.parametrize("name", CASES)
def test_the_result_follows_the_definition(name: str) -> None:
    x, size, hop, delay = CASES[name]
    seconds = size / RATE + 1e-6  # a window of 0.01 s is not allowed
    signal = given_signal(x.shape[1])
    stage = Precedence(signal, prec_wSizeSec=seconds, prec_hSizeSec=hop / RATE, prec_maxDelaySec=delay)
    got, expected = stage.process(x), spelt_out(name)
    for part, computed, theirs, tolerance in zip(PARTS, got, expected[:3], (1e-15, 1e-10, 1e-11), strict=True):
        assert computed.shape == theirs.shape
        np.testing.assert_allclose(computed, theirs, rtol=0, atol=tolerance, err_msg=part)


def test_the_cases_cover_all_branches() -> None:
    """Each pair of filters, echoes with and without fading, few and many channels, gains up to the limit."""
    pairs: set[int] = set()
    delays: set[tuple[bool, bool]] = set()
    gains: set[float] = set()
    active: set[bool] = set()
    for name in CASES:
        for best, *ears in spelt_out(name)[3]:
            pairs.add(best)
            for delay, gain, faded, count in ears:
                delays.add((delay > 13, faded < 1))
                gains.add(gain)
                active.add(count > 5)
    assert pairs == {0, 1, 2, 3} == set(range(len(PAIRS)))
    assert delays == {(False, False), (True, True)}
    assert {0.0, 0.9} < gains
    assert active == {False, True}


def test_fading() -> None:
    """(1 - (d - 1 - 6 Q) / (14 Q - 1))**4 between 6 and 20 ms."""
    delays = np.array([1, 264, 265, 266, 500, 880, 881, 2000])
    expected = [1, 1, 1, (1 - 1 / 615) ** 4, (1 - 235 / 615) ** 4, 0, 0, 0]
    np.testing.assert_allclose(fading(delays, 44), expected, rtol=1e-13, atol=1e-15)


def test_weights() -> None:
    got = weights(np.array([100.0, 500.0, 1200.0, 5000.0]))
    np.testing.assert_allclose(got, [0.024478, 0.860485, 0.318678, 0.318678], atol=5e-7)


# --- sounds -------------------------------------------------------------------------------------------------------


def test_the_gain_makes_no_difference() -> None:
    for x in (some_loud(), sines(1), sound(400, 9, echo=14, gain=0.9)):
        itd, ild, cc = Precedence(given_signal(x.shape[1]), **framed(60, 30)).process(1e10 * x)
        for scale in (1e-4, 1.0, 1e60):
            got = Precedence(given_signal(x.shape[1]), **framed(60, 30)).process(scale * x)
            np.testing.assert_array_equal(got[0], itd)
            np.testing.assert_allclose(got[1], ild, rtol=0, atol=1e-11)
            if scale > 1:  # for quieter sound, eps reduces correlations
                np.testing.assert_allclose(got[2], cc, rtol=0, atol=1e-11)


def test_level_differences() -> None:
    """Without an echo: exactly the ratio of the ears; positive if the right ear is louder."""
    x = np.random.default_rng(0).standard_normal((1, 3, 400)) * [[[1.0]], [[2.0]]]
    itd, ild, cc = Precedence(given_signal(3), **framed(60, 30)).process(x)
    np.testing.assert_allclose(ild, 20 * math.log10(2), rtol=1e-12)
    assert not itd.any()
    middle = cc[:, cc.shape[1] // 2]  # samples of 1 on average: eps is negligible
    np.testing.assert_allclose(
        middle, np.repeat(weights(np.geomspace(60.0, 900.0, 3))[:, np.newaxis], 12, 1), rtol=1e-9
    )


@pytest.mark.filterwarnings("error")
def test_silence() -> None:
    stage = Precedence(given_signal(3), **framed(60, 30))
    for made in stage.process(np.zeros((2, 3, 600))):
        assert made.shape[-1] > 10 and not made.any()
    stage, fresh = (Precedence(given_signal(3), **framed(60, 60)) for _ in range(2))
    stage.process(np.zeros((2, 3, 600)))  # adds nothing
    for got, expected_part in zip(stage.process(sound(600)), fresh.process(sound(600)), strict=True):
        np.testing.assert_allclose(got, expected_part, rtol=0, atol=1e-11)
    for ear in range(2):
        x = sound(600)
        x[ear] = 0
        for made in Precedence(given_signal(3), **framed(60, 30)).process(x):
            assert not made.any()
        x[ear, 1] = sound(600)[ear, 1]
        itd, ild, cc = Precedence(given_signal(3), **framed(60, 30)).process(x)
        assert not itd[::2].any() and not ild[::2].any() and not cc[::2].any()
        assert cc[1].any() and np.isfinite(ild).all()
    stage = Precedence(given_signal(3), **framed(60, 30))
    stage.process(sound(600))
    for _ in range(3):
        itd, ild, cc = stage.process(np.zeros((2, 3, 600)))
    assert not itd.any() and not ild.any() and not cc.any()


@pytest.mark.filterwarnings("error")
def test_almost_silence() -> None:
    rng = np.random.default_rng(0)
    for scale in (5e-324, 1e-310, 1e-160, 1e-146, 1e-144, 1e-100, 1e70, 1e300):
        stage = Precedence(given_signal(3), **framed(60, 30))
        for _ in range(3):
            for made in stage.process(scale * rng.choice([-1.0, 0.0, 1.0], (2, 3, 300))):
                assert np.isfinite(made).all()
    wide = 10.0 ** rng.uniform(-300, 300, (2, 3, 900)) * rng.choice([-1, 1], (2, 3, 900))
    levels = 10.0 ** rng.uniform(-150, 70, (2, 3, 1))
    for x in (wide, levels * rng.standard_normal((2, 3, 900))):
        for made in Precedence(given_signal(3), **framed(60, 30)).process(x):
            assert np.isfinite(made).all()
    single = np.zeros((2, 3, 300))
    single[..., 100] = 1.0  # one click: no echo
    itd, _, cc = Precedence(given_signal(3), **framed(60, 30)).process(single)
    assert not itd.any()
    assert set(np.flatnonzero(cc.any(axis=(0, 2)))) == {cc.shape[1] // 2}


# --- streams ------------------------------------------------------------------------------------------------------


def test_many_frames_in_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """With any number of frames at a time."""
    whole = Precedence(given_signal(3), **framed(60, 3)).process(sound(3000))
    monkeypatch.setattr("rosafe.representations.precedence.BATCH", 1000)
    for got, expected in zip(Precedence(given_signal(3), **framed(60, 3)).process(sound(3000)), whole, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)


def test_the_format_of_the_output() -> None:
    stage = Precedence(44100.0)
    output = stage.output_format
    assert (output.framed, output.hop, output.window, output.rate, output.lags) == (True, 441, 882, 100.0, 45)
    assert stage.derived["prec_lags"] == [m / 44100 for m in range(-45, 46)]
    stage.configure(prec_maxDelaySec=0.0005)
    assert (stage.output_format.lags, stage.part_rows((2, 31))[2]) == (23, (31, 47))
    declared = Precedence.REPRESENTATION
    assert (declared.request, declared.port, declared.parent) == ("PrecedenceProc", "precedencePort", "gammatone")
    assert declared.binaural and [part.name for part in declared.parts] == list(PARTS)


# --- parameters ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"prec_wSizeSec": 100 / RATE},
        {"prec_wSizeSec": 40 / RATE},
        {"prec_hSizeSec": 20 / RATE},
        {"prec_maxDelaySec": 0.003},
        {"prec_maxDelaySec": 0.001},  # a parameter that is set counts as changed
    ],
    ids=str,
)
def test_a_change_resets_sums_and_keeps_the_buffer(change: dict[str, Any]) -> None:
    """The start of the next frame does not change; its sums are those of a first frame."""
    x = sound(900)
    before = framed(80, 40)
    stage = Precedence(given_signal(3), **before)
    assert stage.process(x[..., :410])[0].shape[-1] == 9  # frames at 0 ... 320; the next one at 360
    stage.configure(**change)
    expected = Precedence(given_signal(3), **{**before, **change}).process(x[..., 360:])
    for got, expected_part in zip(stage.process(x[..., 410:]), expected, strict=True):
        np.testing.assert_allclose(got, expected_part, rtol=0, atol=1e-11)


def test_rates_that_are_too_low() -> None:
    for rate in (1000.0, 1333.0):
        with pytest.raises(ValueError, match=r"^sample_rate: .*precedence"):
            Precedence(rate)
    assert Precedence(1334.0).process(np.ones((2, 1, 100)))[0].shape == (1, 6)
    with pytest.raises(ValueError, match=r"^prec_maxDelaySec: expected at most 2147483647 samples, got "):
        Precedence(1e9, prec_maxDelaySec=10.0)


@pytest.mark.parametrize(("name", "value"), [("prec_wSizeSec", 0.01), ("prec_hSizeSec", 1e-6)])
def test_windows_and_steps_that_are_too_short(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        Precedence(RATE, **{name: value})
