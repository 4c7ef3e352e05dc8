"""Details that `rosafe validate` and the reference vectors do not reach: other orders, windows, methods and lags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import signal as scipy_signal

from rosafe.dsp.erb import erb_rate, erb_rate_to_frequency
from rosafe.dsp.middle_ear import middle_ear_fir
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.windows import ALL_NAMES, window
from rosafe.representations.crosscorrelation import CrossCorrelation
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.haircell import InnerHairCell
from rosafe.representations.ild import Ild
from rosafe.representations.preproc import PreProc
from rosafe.representations.ratemap import Ratemap

from .bare import FloatArray, cut, run
from .stages import noise


def impulse(samples: int) -> FloatArray:
    block = np.zeros((2, samples))
    block[0, 0], block[1, 0] = 1.0, -0.5
    return block


# --- scales, windows, rounding ----------------------------------------------------------------------------------


def test_erb_scale() -> None:
    assert erb_rate(80.0) == pytest.approx(2.777591859212, abs=1e-11)
    assert erb_rate(8000.0) == pytest.approx(33.190508892713, abs=1e-11)
    frequencies = np.geomspace(1.0, 2e4, 50)
    np.testing.assert_allclose(erb_rate_to_frequency(erb_rate(frequencies)), frequencies, rtol=1e-13)


def test_rounding_is_half_away_from_zero() -> None:
    assert [round_half_away(x) for x in (0.0, 0.5, 1.5, 2.5, 220.5, 0.49999999999999994, 7.49)] == [
        0,
        1,
        2,
        3,
        221,
        0,
        7,
    ]
    assert Ild(22050.0).output_format.rate == 22050 / 221


@pytest.mark.parametrize("length", [2, 7, 882])
def test_windows(length: int) -> None:
    i = np.arange(length)
    turn = 2 * np.pi * i / (length - 1)
    rising = np.minimum(i, i[::-1])
    triangle = (2 * rising + 1) / length if length % 2 == 0 else 2 * (rising + 1) / (length + 1)
    expected = {
        "hann": 0.5 - 0.5 * np.cos(turn),
        "hamming": 0.54 - 0.46 * np.cos(turn),
        "hanning": 0.5 - 0.5 * np.cos(2 * np.pi * (i + 1) / (length + 1)),
        "blackman": 0.42 - 0.5 * np.cos(turn) + 0.08 * np.cos(2 * turn),
        "triang": triangle,
        "sqrt_win": np.sqrt(triangle),
        "rectwin": np.ones(length),
    }
    assert set(expected) == set(ALL_NAMES)
    for name, values in expected.items():
        np.testing.assert_allclose(window(name, length), values, rtol=0, atol=1e-15, err_msg=name)
    with pytest.raises(ValueError, match="bartlett"):
        window("bartlett", length)


# --- input and pre-processing -----------------------------------------------------------------------------------


def test_the_order_of_pre_processing() -> None:
    """Gain is measured on the high-passed, pre-emphasised signal; the middle ear filter is last."""
    x = noise("preProc", 2000) + 0.5
    first = PreProc(16000, pp_bRemoveDC=True, pp_bPreEmphasis=True).process(x)
    second = PreProc(16000, pp_bNormalizeRMS=True, pp_intTimeSecRMS=0.02).process(first)
    third = PreProc(16000, pp_bLevelScaling=True, pp_refSPLdB=80.0).process(second)
    last = PreProc(16000, pp_bMiddleEarFiltering=True).process(third)
    everything = PreProc(
        16000,
        pp_bRemoveDC=True,
        pp_bPreEmphasis=True,
        pp_bNormalizeRMS=True,
        pp_intTimeSecRMS=0.02,
        pp_bLevelScaling=True,
        pp_refSPLdB=80.0,
        pp_bMiddleEarFiltering=True,
    )
    np.testing.assert_allclose(everything.process(x), last, rtol=0, atol=1e-14 * np.abs(last).max())


@pytest.mark.parametrize(("rate", "cutoff"), [(48000, 1.0), (16000, 20.0), (16000, 4000.0), (44100, 1e-3)])
def test_the_high_pass_is_exact(rate: int, cutoff: float) -> None:
    """Beside the direct form with poles and state in extended precision."""
    x = noise("preProc", 1500) + 0.5
    expected = x.astype(np.longdouble)
    angles = np.pi * np.arange(5, 9, 2, dtype=np.longdouble) / 8
    analog = np.tan(np.longdouble(np.pi) * np.longdouble(cutoff) / rate) * np.exp(1j * angles)
    for pole in (1 + analog) / (1 - analog):
        section = [abs(1 + pole) ** 2 / 4 * part for part in (1, -2, 1)], [1, -2 * pole.real, abs(pole) ** 2]
        expected = scipy_signal.lfilter(*(np.array(part, np.longdouble) for part in section), expected)
    got = PreProc(rate, pp_bRemoveDC=True, pp_cutoffHzDC=cutoff).process(x)
    assert np.abs(got - expected).max() <= 2e-14 * np.abs(expected).max()


@pytest.mark.parametrize("cutoff", [5e-324, 1e-300, 1e-12, 1e-7, 1e-5])
def test_the_lowest_cutoffs_change_nothing(cutoff: float) -> None:
    x = noise("preProc", 1000) + 0.5
    got = PreProc(16000, pp_bRemoveDC=True, pp_cutoffHzDC=cutoff).process(x)
    np.testing.assert_allclose(got, x, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "rate", "peak"),
    [
        ("jepsen", 16000, -55.997),
        ("jepsen", 48000, -55.974),
        ("lopezpoveda", 16000, -66.296),
        ("lopezpoveda", 48000, -66.586),
    ],
)
def test_middle_ear_peaks_and_phases(model: str, rate: int, peak: float) -> None:
    fir = middle_ear_fir(model, rate, unity=False)
    assert fir.shape == (513,)
    assert 20 * math.log10(np.abs(np.fft.rfft(fir, 2**16)).max()) == pytest.approx(peak, abs=1e-3)
    unity = middle_ear_fir(model, rate, unity=True)
    np.testing.assert_allclose(unity / fir, 10 ** ({"jepsen": 55.9986, "lopezpoveda": 66.2888}[model] / 20), rtol=1e-12)
    if model == "jepsen":
        np.testing.assert_allclose(fir, fir[::-1], rtol=0, atol=1e-17)  # linear phase
        assert np.abs(fir).argmax() == 256
    else:
        assert np.cumsum(fir**2)[100] > 0.99 * np.sum(fir**2)  # minimum phase: the energy comes first


# --- filterbanks ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [16000, 48000])
@pytest.mark.parametrize(("order", "width"), [(1, 0.5), (7, 2.0)])
def test_gammatone_impulse_response(rate: int, order: int, width: float) -> None:
    """h[k] = 2 g^n C(k+n-1, n-1) exp(-beta k) cos(theta k), in extended precision."""
    frequencies = [80.0, 1000.0, 0.45 * rate]
    bank = Filterbank(rate, fb_cfHz=frequencies, fb_nGamma=order, fb_bwERBs=width)
    bank.provide = frozenset({"envelope"})
    samples = rate // 2
    got = run(bank, cut(impulse(samples), samples))
    pi = np.longdouble("3.141592653589793238462643383279502884197")
    k = np.arange(samples, dtype=np.longdouble)
    for channel, frequency in enumerate(np.array(frequencies, np.longdouble)):
        beta = 2 * pi * np.longdouble(width) * (np.longdouble(24.7) + np.longdouble(0.108) * frequency) / rate
        binomial = np.prod([(k + j) / j for j in range(1, order)], axis=0) if order > 1 else np.longdouble(1)
        size = 2 * (-np.expm1(-beta)) ** order * binomial * np.exp(-beta * k)
        expected = size * np.cos(2 * pi * frequency / rate * k)
        peak = float(np.abs(expected).max())
        for ear, amplitude in ((0, 1.0), (1, -0.5)):
            error = np.abs(got[ear, channel] - amplitude * expected)
            assert error.max() < 1e-12 * peak
            error = np.abs(bank.provided["envelope"][ear, channel] - abs(amplitude) * size)
            assert error.max() < 1e-12 * peak


def test_drnl_envelope_is_exact_for_a_tone_at_the_channel() -> None:
    rate, frequency = 16000.0, 700.0
    bank = Filterbank(rate, fb_cfHz=[frequency], fb_type="drnl")
    bank.provide = frozenset({"envelope"})
    tone = 1e-12 * np.sin(2 * np.pi * frequency / rate * np.arange(8000)) * np.ones((2, 1))  # the linear range
    out = bank.process(tone)
    np.testing.assert_allclose(bank.provided["envelope"][..., 4000:], np.abs(out[..., 4000:]).max(), rtol=1e-4)
    np.testing.assert_allclose(
        bank.provided["envelope"][..., 4000:] / bank.provided["envelope"][0, 0, -1], 1.0, rtol=1e-9
    )


# --- hair cells -------------------------------------------------------------------------------------------------

DAU_44100 = ([0.004603998475022464 * c for c in (1, 2, 1)], [1, -1.7990964094846684, 0.8175124033847582])


def test_hair_cell_methods() -> None:
    x = noise("ihc", 3000)
    envelope = np.abs(x) + 0.1
    half = np.maximum(x, 0)

    def lowpass(order: int, cutoff: float, signal: Any) -> Any:
        return scipy_signal.lfilter(*scipy_signal.butter(order, cutoff / 22050), signal)

    breebart = half
    for _ in range(5):
        breebart = lowpass(1, 2000, breebart)
    expected = {
        "none": x,
        "halfwave": half,
        "fullwave": np.abs(x),
        "square": x**2,
        "hilbert": envelope,
        "joergensen": lowpass(1, 150, envelope),
        "dau": scipy_signal.lfilter(*DAU_44100, half),
        "dau1996": lowpass(1, 1000, half),
        "breebart": breebart,
        "bernstein": lowpass(2, 425, np.maximum(envelope**-0.77 * x, 0) ** 2),
    }
    for method, values in expected.items():
        stage = InnerHairCell(44100, ihc_method=method)
        got = stage.process(x, envelope if stage.required_extra else None)
        np.testing.assert_allclose(got, values, rtol=0, atol=1e-12 * np.abs(values).max(), err_msg=method)


def test_bernstein_without_envelope_is_silent() -> None:
    zeros = np.zeros((2, 1, 50))
    assert not InnerHairCell(44100, ihc_method="bernstein").process(zeros, zeros).any()


# --- framed stages ----------------------------------------------------------------------------------------------

FRAMES = [("hann", 80, 40), ("hamming", 32, 50), ("blackman", 64, 9), ("sqrt_win", 2, 1), ("hanning", 100, 100)]
RATE = 16000.0


def frames_of(x: FloatArray, size: int, hop: int) -> FloatArray:
    """Return the frames (..., F, w)."""
    starts = range(0, x.shape[-1] - size + 1, hop)
    return np.stack([x[..., s : s + size] for s in starts], axis=-2)


@pytest.mark.parametrize(("name", "size", "hop"), FRAMES)
def test_ild_and_ratemap_by_definition(name: str, size: int, hop: int) -> None:
    x = np.maximum(noise("ild", 1000), 0)
    framed = {"wname": name, "wSizeSec": size / RATE, "hSizeSec": hop / RATE}
    shape = window(name, size)
    energy = np.mean((shape * frames_of(x, size, hop)) ** 2, axis=-1)
    expected = 10 * np.log10((energy[1] + 2.2204e-16) / (energy[0] + 2.2204e-16))
    got = Ild(RATE, **{f"ild_{k}": v for k, v in framed.items()}).process(x)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)

    retention = math.exp(-1 / (RATE * 0.008))
    smooth = np.zeros_like(x)
    last = np.zeros(x.shape[:-1])
    for n in range(x.shape[-1]):
        last = retention * last + (1 - retention) * x[..., n]
        smooth[..., n] = last
    frames = shape * frames_of(smooth, size, hop)
    for scaling, expected in (("power", np.mean(frames**2, axis=-1)), ("magnitude", np.mean(frames, axis=-1))):
        got = Ratemap(RATE, rm_scaling=scaling, **{f"rm_{k}": v for k, v in framed.items()}).process(x)
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(("name", "size", "hop"), FRAMES)
@pytest.mark.parametrize("reach", [1, 17, 32, 150])
def test_cross_correlation_by_direct_sums(name: str, size: int, hop: int, reach: int) -> None:
    x = noise("crossCorrelation", 500, channels=2)
    stage = CrossCorrelation(
        RATE, cc_wname=name, cc_wSizeSec=size / RATE, cc_hSizeSec=hop / RATE, cc_maxDelaySec=reach / RATE
    )
    got = stage.process(x)
    left, right = window(name, size) * frames_of(x, size, hop)
    expected = np.zeros((2, 2 * reach + 1, left.shape[1]))
    for lag in range(-min(reach, size - 1), min(reach, size - 1) + 1):
        late, early = left[..., max(lag, 0) : size + min(lag, 0)], right[..., max(-lag, 0) : size - max(lag, 0)]
        expected[:, lag + reach] = np.sum(late * early, axis=-1)
    expected /= np.sqrt(np.sum(left**2, -1) * np.sum(right**2, -1) + 2.2204e-16)[:, np.newaxis]
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.array(stage.derived["cc_lags"]), np.arange(-reach, reach + 1) / RATE, rtol=1e-15)


def test_lag_count_is_rounded_up_in_floating_point() -> None:
    lags = {rate: len(CrossCorrelation(rate).derived["cc_lags"]) for rate in (44100, 16000, 48000, 10000)}
    assert lags == {44100: 99, 16000: 37, 48000: 107, 10000: 23}


def test_many_frames_go_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    x = noise("crossCorrelation", 3000, channels=3)
    expected = CrossCorrelation(RATE).process(x)
    for batch in (1, 1000, 3000):
        monkeypatch.setattr("rosafe.dsp.framing.BATCH", batch)
        np.testing.assert_allclose(CrossCorrelation(RATE).process(x), expected, rtol=0, atol=1e-14)
