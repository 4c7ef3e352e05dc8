"""Gabor features: the reference vector, a direct implementation of the definition, and ratemaps with known features."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.gabor import Gabor, RunningZScore, filters, patterns

from .chain import FloatArray, cut

REACH = 19


def given_signal(channels: int, rate: float = 3.0) -> SignalFormat:
    """Return the format of ratemaps with 3 frames per second: 5 s are 15 frames."""
    frequencies = tuple(np.geomspace(100.0, 5000.0, channels))
    return SignalFormat(12000.0, rate, True, round(12000 / rate), 8000, frequencies, "gammatone")


def rates(frames: int, channels: int = 5, seed: int = 0) -> FloatArray:
    """Return rates that vary by 60 dB, some of them 0."""
    rng = np.random.default_rng(seed)
    x = rng.exponential(size=(2, channels, frames)) * 10.0 ** rng.uniform(-6, 0, (2, 1, frames))
    x[rng.random(x.shape) < 0.1] = 0.0
    return x


# --- the definition -----------------------------------------------------------------------------------------------


def axis(size: int, delta: float) -> list[float]:
    z = 8 * delta / 3.5
    step, found = (1 + z / 2) / (1 - z / 2), [math.pi / 2]
    while found[-1] / step > 3.5 * math.pi / size:
        found.append(found[-1] / step)
    return found


def weights_by_definition(channels: int) -> FloatArray:
    """Compute W (G, C, 39) element by element; frame u is at index u + 19."""
    made = []
    for omega in [0.0, *sorted(axis(40, 0.2))]:
        along = axis(3 * channels, 0.3)
        for kappa in sorted([-k for k in along] + [0.0] + along):
            if omega == 0 and kappa < 0:
                continue
            spans, waves = [], []
            for frequency, most in ((kappa, 3 * channels), (omega, 40)):
                length = 3.5 * math.pi / abs(frequency) if frequency else math.inf
                if length > most:
                    length, frequency = most, 0.0
                extent = [n for n in range(-200, 201) if abs(n) < length / 2]
                spans.append(np.array([0.5 + 0.5 * math.cos(2 * math.pi * n / length) for n in extent]))
                waves.append((frequency, np.array(extent)))
            e = spans[0][:, np.newaxis] * spans[1]
            g = e * np.exp(1j * (waves[0][0] * waves[0][1][:, np.newaxis] + waves[1][0] * waves[1][1]))
            g = g - e * g.mean() / e.mean() if waves[0][0] or waves[1][0] else g * (1 + 1j)
            g = g / np.abs(np.fft.fft2(g)).max()
            k0, n0 = g.shape[0] // 2, g.shape[1] // 2
            q = max(1, g.shape[0] // 4)
            for c in range(channels):
                if (c - channels // 2) % q:
                    continue
                w, m = np.zeros((channels, 39), complex), np.zeros((channels, 39))
                for other in range(channels):
                    for u in range(-19, 20):
                        if 0 <= k0 + c - other < g.shape[0] and 0 <= n0 + u < g.shape[1]:
                            w[other, u + 19] = g[k0 + c - other, n0 + u]
                            m[other, u + 19] = abs(g[k0 + c - other, n0 + u])
                if (g.real < 0).any():
                    w = w - m / m.sum() * w.sum()
                made.append(w.real)
    return np.array(made)


def by_definition(x: FloatArray, dynamic_range: float, remembered: int) -> FloatArray:
    """Compute z (2, G, F - 19) of rates (2, C, F)."""
    channels, frames = x.shape[1:]
    w, x = weights_by_definition(channels), np.maximum(x, 0)
    s = np.empty(x.shape)
    for ear, k in np.ndindex(2, frames):
        most = x[ear, :, max(0, k - remembered + 1) : k + 1].max()
        s[ear, :, k] = 10 * np.log10(x[ear, :, k] + 10 ** (-dynamic_range / 10) * most + 2.2204e-16)
    y, z = np.zeros((2, len(w), frames - 19)), np.zeros((2, len(w), frames - 19))
    for k in range(frames - 19):
        for u in range(-19, 20):
            y[..., k] += np.einsum("gc,ec->eg", w[..., u + 19], s[..., max(0, k - u)])
        past = y[..., max(0, k - remembered + 1) : k + 1]
        mean, sigma = past.mean(axis=-1), past.std(axis=-1)
        steady = sigma <= 1e-9 * (1 + np.abs(mean))
        z[..., k] = np.where(steady, 0, (y[..., k] - mean) / np.where(steady, 1, sigma))
    return z


@pytest.mark.parametrize("channels", [1, 2, 3, 5, 8, 17])
def test_weights_follow_the_definition(channels: int) -> None:
    made, expected = patterns(channels), weights_by_definition(channels)
    assert len(made.places) == len(expected)
    for (first, number, reach, begin), expected_weights in zip(made.places.tolist(), expected, strict=True):
        dense = np.zeros((channels, 39))
        weights = made.weights[begin : begin + number * (2 * reach + 1)].reshape(number, -1)
        dense[first : first + number, REACH - reach : REACH + reach + 1] = weights
        np.testing.assert_allclose(dense, expected_weights[:, ::-1], rtol=0, atol=1e-15)  # W[u] belongs to frame k - u


def test_filters() -> None:
    """Filters have zero mean, except one; the maximum gain is 1."""
    omegas = axis(40, 0.2)[::-1]
    np.testing.assert_allclose(omegas, [0.38887, 0.61931, 0.98631, 1.57080], atol=5e-6)
    made = list(filters(23))
    for number, g in enumerate(made):
        assert np.abs(np.fft.fft2(g)).max() == pytest.approx(1)
        assert (abs(g.sum()) < 1e-12) == (number > 0)
        assert g.shape[0] % 2 == g.shape[1] % 2 == 1 and g.shape[1] <= 39
    assert len(made) == 5 + 4 * 9


@pytest.mark.parametrize(
    ("channels", "rate", "dynamic_range"), [(5, 3.0, 80.0), (1, 0.01, 20.0), (8, 0.5, 1000.0), (3, 100.0, 20.0)]
)
def test_the_result_follows_the_definition(channels: int, rate: float, dynamic_range: float) -> None:
    """With windows of 15, 1 and 3 frames, and longer than the signal; 2.5 is rounded to 3."""
    x = rates(70, channels)
    stage = Gabor(given_signal(channels, rate), gb_maxDynamicRangeDB=dynamic_range)
    remembered = {3.0: 15, 0.01: 1, 0.5: 3, 100.0: 500}[rate]
    got, expected = stage.process(x), by_definition(x, dynamic_range, remembered)
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)
    assert not got[..., 0].any()


def test_negative_rates_count_as_0() -> None:
    x = rates(50) - 0.01
    np.testing.assert_array_equal(Gabor(given_signal(5)).process(x), Gabor(given_signal(5)).process(np.maximum(x, 0)))


def test_a_ripple_is_found_by_its_filter() -> None:
    """Levels that vary at the frequency of one filter: its feature varies most, around the middle channel."""
    channels, (omega, kappa) = 23, (axis(40, 0.2)[1], axis(69, 0.3)[1])
    time, place = np.arange(400), np.arange(channels)[:, np.newaxis]
    level = 10 * np.cos(omega * time + kappa * place)
    stage = Gabor(given_signal(channels), gb_maxDynamicRangeDB=200.0)
    made = patterns(channels)
    features = []
    for first, number, reach, begin in made.places.tolist():
        weights = made.weights[begin : begin + number * (2 * reach + 1)].reshape(number, -1)
        frames = np.lib.stride_tricks.sliding_window_view(level[first : first + number], 2 * reach + 1, axis=-1)
        features.append(np.einsum("cu,cfu->f", weights, frames).std())
    z = stage.process(np.stack([10 ** (level / 10)] * 2))
    assert z.shape == (2, 311, 381) and np.abs(z).max() < 5
    best = int(np.argmax(features))
    shapes = [(g.shape, number) for number, g in enumerate(filters(channels))]
    counts = [len(range(channels // 2 % max(1, k // 4), channels, max(1, k // 4))) for (k, _), _ in shapes]
    which = int(np.searchsorted(np.cumsum(counts), best, side="right"))
    along = axis(69, 0.3)
    order = [(0.0, k) for k in [0.0, *sorted(along)]]
    order += [(w, k) for w in sorted(axis(40, 0.2)) for k in sorted([-k for k in along] + [0.0] + along)]
    assert order[which] == (omega, kappa)
    # the ripple moves down if kappa and omega have the same sign, as the filter does: not its mirror image
    assert features[best] > 3 * features[best - sum(counts[:which]) + sum(counts[: order.index((omega, -kappa))])]


# --- deviations ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 3, 50, 500])
def test_deviations_are_those_of_the_window(length: int) -> None:
    """With any mean; errors do not accumulate, and windows are independent."""
    rng = np.random.default_rng(length)
    values = rng.standard_normal((1300, 9)) * 10.0 ** rng.integers(-3, 4, 9) + rng.choice([0.0, 1e3], 9)
    values[400:700] *= 1e6  # values outside the window have no effect
    values[900:, 2] = 7.0
    values[900:, 3] = 7.0 + 1e-12 * rng.standard_normal(400)
    made = RunningZScore(length, np.empty((0, 9)))
    got = np.concatenate([made.process(block.T) for block in cut(values.T, [17, 0, 1, 101])])
    for k in range(1300):
        past = values[max(0, k - length + 1) : k + 1]
        mean, sigma = past.mean(axis=0), past.std(axis=0)
        steady = sigma <= 1e-9 * (1 + np.abs(mean))
        sigma = np.where(steady, 1, sigma)
        errors = np.abs(got[k] - np.where(steady, 0, (values[k] - mean) / sigma))
        assert (errors <= 1e-12 + 1e-14 * np.abs(mean) / sigma).all()
    assert not got[900 + length :, 2:4].any()


@pytest.mark.parametrize("after", [1, 20, 33])
@pytest.mark.parametrize("come", [0, 3, 20, 47])
def test_another_window_keeps_past_values(come: int, after: int) -> None:
    values = np.random.default_rng(come).standard_normal((200, 4))
    before = RunningZScore(20, np.empty((0, 4)))
    before.process(values[:come])
    made = before.resized(after)
    got, wide = made.process(values[come:]), before.process(values[come:])
    first = max(0, come - 20)  # older values are not restored
    for k in range(come, 200):
        past = values[max(first, k - after + 1) : k + 1]
        expected = (values[k] - past.mean(axis=0)) / np.where(past.std(axis=0) > 0, past.std(axis=0), 1)
        np.testing.assert_allclose(got[k - come], expected, rtol=0, atol=1e-11)
    expected = RunningZScore(20, np.empty((0, 4))).process(values)[come:]
    np.testing.assert_array_equal(wide, expected)  # the original is not affected


# --- streams ------------------------------------------------------------------------------------------------------


def test_the_output_is_19_frames_late() -> None:
    stage = Gabor(given_signal(5))
    assert stage.look_ahead == 19
    assert [stage.output_count(count) for count in (0, 1, 19, 20, 100)] == [0, 0, 0, 1, 81]
    for frames in (0, 1, 17, 1):
        assert stage.process(rates(frames)).shape == (2, stage.derived["gb_nFeatures"], 0)
    assert stage.process(rates(1)).shape[-1] == 1
    assert stage.process(rates(0)).shape[-1] == 0
    assert stage.process(rates(7)).shape[-1] == 7


@pytest.mark.filterwarnings("error")
def test_silence_and_steady_sound() -> None:
    for level in (0.0, 1e-300, 1e-9, 1.0, 1e100):
        stage = Gabor(given_signal(5))
        for frames in (1, 2, 40, 30):
            assert not stage.process(np.full((2, 5, frames), level)).any()
    stage = Gabor(given_signal(5))
    one_ear = rates(60)
    one_ear[0] = 0
    made = stage.process(one_ear)
    assert not made[0].any() and made[1, :, 1:].all()
    for _ in range(3):
        made = stage.process(np.zeros((2, 5, 60)))
        assert np.isfinite(made).all()
    assert not made.any()
    rng = np.random.default_rng(0)
    wide = 10.0 ** rng.uniform(-320, 300, (2, 5, 90)) * rng.choice([-1, 0, 1], (2, 5, 90))
    assert np.isfinite(stage.process(wide)).all()


# --- parameters ---------------------------------------------------------------------------------------------------


def test_a_change_of_the_range_keeps_the_state() -> None:
    """Levels computed before are kept."""
    x = rates(100)
    stage = Gabor(given_signal(5))
    first = stage.process(x[..., :50])
    stage.configure(gb_maxDynamicRangeDB=15.0)
    second = stage.process(x[..., 50:])
    wide, narrow = (Gabor(given_signal(5), gb_maxDynamicRangeDB=value).process(x) for value in (80.0, 15.0))
    np.testing.assert_array_equal(first, wide[..., :31])
    assert second.shape[-1] == 50
    later = 50 + REACH  # from here on, all levels have the new range; the window of 15 frames follows later
    assert np.abs(second[..., :3] - narrow[..., 31:34]).max() > 0.1
    np.testing.assert_allclose(second[..., later + 14 - 31 :], narrow[..., later + 14 :], rtol=0, atol=1e-9)


def test_another_step_of_the_parent_keeps_past_values() -> None:
    """5 s are then another number of frames; past frames are kept."""
    x = rates(120)
    stage = Gabor(given_signal(5, 3.0))
    first = stage.process(x[..., :50])
    stage.set_input_format(given_signal(5, 1.0))
    second = stage.process(x[..., 50:])
    assert (stage.look_ahead, stage.output_format.rate) == (19, 1.0)
    np.testing.assert_array_equal(first, Gabor(given_signal(5, 3.0)).process(x)[..., :31])
    # a maximum 5 frames ago counts for 15 frames before the change, and for 5 after it
    expected = by_definition(x, 80.0, 5)
    np.testing.assert_allclose(second[..., 50 + REACH + 4 - 31 :], expected[..., 50 + REACH + 4 :], rtol=0, atol=1e-8)
