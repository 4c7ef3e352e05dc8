"""Heads: rendering, interaural cues, SOFA files that are suitable or not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import eval_legendre, spherical_jn, spherical_yn

import rosafe
from rosafe.localization import angles
from rosafe.localization.sphere import sphere_responses
from tests.localization.conftest import KEMAR

h5py = pytest.importorskip("h5py")
RATE = 44100


def write_sofa(path: Path, change: Callable[[dict[str, Any]], None] = lambda values: None) -> Path:
    """Write a SOFA file with 36 directions, each ear an impulse; `change` modifies its contents."""
    azimuths = np.arange(0, 360, 10.0)
    responses = np.zeros((36, 2, 64))
    delays = np.round(10 - 10 * np.stack((np.sin(np.radians(azimuths)), -np.sin(np.radians(azimuths))), 1)).astype(int)
    for row, pair in enumerate(delays):
        responses[row, [0, 1], pair + 4] = 1.0
    values = {
        "convention": "SimpleFreeFieldHRIR",
        "position_type": "spherical",
        "position_units": "degree, degree, metre",
        "Data.IR": responses,
        "Data.SamplingRate": np.array([44100.0]),
        "Data.Delay": np.zeros((1, 2)),
        "SourcePosition": np.stack((azimuths, np.zeros(36), np.full(36, 1.4)), 1),
        "ReceiverPosition": np.array([[0, 0.09, 0], [0, -0.09, 0]])[..., np.newaxis],
    }
    change(values)
    with h5py.File(path, "w") as file:
        file.attrs["SOFAConventions"] = values.pop("convention")
        kind, units = values.pop("position_type"), values.pop("position_units")
        for name, value in values.items():
            if isinstance(value, dict):
                file.create_group(name)
            elif value is not None:
                file[name] = value
        if "SourcePosition" in file:
            file["SourcePosition"].attrs.update({"Type": kind, "Units": units})
    return path


def _series(frequency: float, incidence: float) -> complex:
    """Return the direct sum of Duda and Martens (1998), equation 4, for numpy's sign of the phase."""
    size = 2 * np.pi * frequency * 0.0875 / 343.0
    orders = np.arange(int(size) + 15)
    derivative = spherical_jn(orders, size, True) + 1j * spherical_yn(orders, size, True)
    terms = (-1j) ** (orders - 1) * (2 * orders + 1) * eval_legendre(orders, np.cos(incidence)) / derivative
    return complex(np.conj(terms.sum()) / size**2)


@pytest.mark.parametrize("rate", [16000, 44100])
def test_the_sphere_is_the_series_of_duda_and_martens(rate: int) -> None:
    """Levels within 0.1 dB and delays within 5 us of the series, and values of the paper's model at two points."""
    head = rosafe.Head.sphere()
    frequencies = np.array([100.0, 200.0, 500.0, 1000.0, 3000.0, 6000.0])
    for azimuth in (0.0, 30.0, 37.5, 90.0, 150.0, -60.0):
        response = head.filters(rate).response(azimuth)
        turns = np.exp(-2j * np.pi * np.outer(np.arange(response.shape[1]) / rate, frequencies))
        left, right = response @ turns
        delay = 40 / rate + 0.0875 / 343.0  # until an impulse would be at the centre
        for ear, side in ((left, 90.0), (right, -90.0)):
            incidence = np.radians(azimuth - side)
            expected = np.array([_series(frequency, incidence) for frequency in frequencies])
            ratio = ear / (expected * np.exp(-2j * np.pi * frequencies * delay))
            assert np.abs(20 * np.log10(np.abs(ratio))).max() < 0.1
            assert np.abs(np.angle(ratio) / (2 * np.pi * frequencies)).max() < 5e-6
        if azimuth == 90.0:
            assert np.angle(left[1] / right[1]) / (2 * np.pi * 200) == pytest.approx(778e-6, abs=2e-6)
        if azimuth == 30.0:
            assert 20 * np.log10(np.abs(left[4] / right[4])) == pytest.approx(6.13, abs=0.1)


def test_the_sphere_is_symmetric_front_to_back() -> None:
    responses = sphere_responses(np.array([20.0, 160.0, -75.0, -105.0]), RATE)
    assert np.array_equal(responses[0], responses[1]) and np.array_equal(responses[2], responses[3])


def test_rendering_at_a_measured_direction_is_the_convolution(kemar: rosafe.Head) -> None:
    with h5py.File(KEMAR) as file:
        position = file["SourcePosition"][()]
        row = int(np.flatnonzero((np.abs(position[:, 1]) < 0.1) & (position[:, 0] == 30))[0])
        response = file["Data.IR"][row]
    signal = np.random.default_rng(1).standard_normal(3000)
    ears = kemar.render(signal, RATE, 30)
    for ear in range(2):
        assert np.allclose(ears[ear], np.convolve(signal, response[ear])[:3000], atol=1e-12)
    assert np.allclose(kemar.render(signal, RATE, np.full(3000, 30.0)), ears, atol=1e-12)
    assert np.allclose(kemar.render(signal, RATE, 390), ears, atol=1e-12)


def test_left_is_positive(kemar: rosafe.Head) -> None:
    signal = np.random.default_rng(1).standard_normal(RATE)
    for head in (rosafe.Head.sphere(), kemar):
        left, right = head.render(signal, RATE, 70).std(axis=1)
        assert left > 1.5 * right
        assert head.itd([500.0], [70.0])[0, 0] < -400e-6 and head.ild([4000.0], [70.0])[0, 0] < -5


def test_moving_sources_have_no_clicks(kemar: rosafe.Head) -> None:
    """A tone stays a tone: no energy away from its frequency, beyond the Doppler shift."""
    time = np.arange(2 * RATE) / RATE
    tone = np.sin(2 * np.pi * 1000 * time)
    ears = kemar.render(tone, RATE, np.linspace(-90, 90, len(tone)))
    spectrum = np.abs(np.fft.rfft(ears[:, RATE // 4 :] * np.hanning(len(tone) - RATE // 4), axis=1)) ** 2
    frequency = np.fft.rfftfreq(len(tone) - RATE // 4, 1 / RATE)
    away = np.abs(frequency - 1000) > 100
    assert (10 * np.log10(spectrum[:, away].sum(axis=1) / spectrum.sum(axis=1)) < -60).all()


def test_directions_between_measured_ones_are_interpolated(kemar: rosafe.Head) -> None:
    frequencies = [300.0, 500.0, 1000.0]
    fine = kemar.itd(frequencies, np.arange(-30, 31, 1.0))
    assert (np.diff(fine, axis=0) < 1e-9).all()
    middle = kemar.itd(frequencies, [12.5])[0]
    around = kemar.itd(frequencies, [10.0, 15.0])
    assert np.allclose(middle, around.mean(axis=0), atol=5e-6)


@pytest.mark.parametrize("rate", [16000, 48000, 96000])
def test_a_head_is_resampled(kemar: rosafe.Head, rate: int) -> None:
    """Level and delay at low frequencies do not depend on the sample rate."""
    reference = kemar.filters(44100).response(60.0)
    response = kemar.filters(rate).response(60.0)
    for frequency in (300.0, 1000.0, 3000.0):
        gains = [
            (r * np.exp(-2j * np.pi * frequency * np.arange(r.shape[1]) / fs)).sum(axis=1)
            for r, fs in ((reference, 44100), (response, rate))
        ]
        assert np.abs(gains[1] - gains[0]).max() < 5e-3 * np.abs(gains[0]).max()


def test_ears_follow_the_receiver_positions(tmp_path: Path) -> None:
    def swap(values: dict[str, Any]) -> None:
        values["ReceiverPosition"] = values["ReceiverPosition"][::-1]
        values["Data.IR"] = values["Data.IR"][:, ::-1]

    plain = rosafe.Head.from_sofa(write_sofa(tmp_path / "a.sofa"))
    swapped = rosafe.Head.from_sofa(write_sofa(tmp_path / "b.sofa", swap))
    assert np.array_equal(plain.filters(RATE).responses, swapped.filters(RATE).responses)
    assert plain.itd([1000.0], [90.0])[0, 0] < -400e-6
    assert plain.is_symmetric() and plain.key == swapped.key


def test_delays_of_the_file_are_applied(tmp_path: Path) -> None:
    def delay(values: dict[str, Any]) -> None:
        values["Data.Delay"] = np.array([[0.0, 8.0]])

    head = rosafe.Head.from_sofa(write_sofa(tmp_path / "a.sofa", delay))
    assert head.itd([1000.0], [0.0])[0, 0] == pytest.approx(-8 / 44100, abs=2e-6)


def _set(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(values: dict[str, Any]) -> None:
        values[name] = value(values[name]) if callable(value) else value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("convention", "GeneralFIR"), "expected the SOFA convention SimpleFreeFieldHRIR, got 'GeneralFIR'"),
        (_set("Data.IR", lambda ir: ir[:, :1]), "Data.IR of shape"),
        (_set("Data.IR", None), "the variable Data.IR, got none"),
        (_set("Data.IR", lambda ir: ir * np.nan), "finite numbers"),
        (
            _set("SourcePosition", lambda at: at * 1e300),
            "finite numbers up to 1e+06 in SourcePosition, got larger ones",
        ),
        (_set("Data.IR", lambda ir: ir * 0), "a peak from 1e-06 to 1e+06, got 0"),
        (_set("Data.IR", lambda ir: ir * 1e200), "a peak from"),
        (_set("Data.IR", lambda ir: ir.astype(complex)), "Data.IR: expected an array of real numbers"),
        (_set("Data.IR", lambda ir: ir.astype("S")), "Data.IR: expected an array of real numbers"),
        (_set("Data.SamplingRate", np.array([10.0])), "sample rate"),
        (_set("SourcePosition", lambda p: p + np.array([0, 45, 0])), "horizontal plane"),
        (_set("SourcePosition", lambda p: p * np.array([0.4, 1, 1])), "a gap of"),
        (_set("SourcePosition", lambda p: p[:5]), "36 rows in SourcePosition"),
        (_set("ReceiverPosition", np.zeros((2, 3, 1))), "one receiver on the left"),
        (_set("Data.Delay", np.array([[0.0, 1e5]])), "delays of at most"),
        (_set("SourcePosition", {}), "SourcePosition: expected an array"),
        (_set("position_type", "cylindrical"), "spherical or cartesian SourcePosition, got 'cylindrical'"),
        (_set("position_units", "radian, radian, metre"), "degrees and metres, got 'radian, radian, metre'"),
    ],
)
def test_unsuitable_files_are_rejected(tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str) -> None:
    path = write_sofa(tmp_path / "bad.sofa", change)
    with pytest.raises(ValueError) as caught:
        rosafe.Head.from_sofa(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and message in text and "\n" not in text


@pytest.mark.parametrize("name", ["Data.SamplingRate", "Data.Delay", "SourcePosition", "Data.IR"])
def test_absurd_dimensions_are_refused_before_memory_is_allocated(tmp_path: Path, name: str) -> None:
    path = write_sofa(tmp_path / "large.sofa")
    with h5py.File(path, "r+") as file:
        first = file[name].shape[:-1]
        shape = (*(2**31 if size > 2 else size for size in first), 2**33 if first else 2**31)
        attributes = dict(file[name].attrs)
        del file[name]
        file.create_dataset(name, shape, "f8", chunks=(1,) * len(shape)).attrs.update(attributes)  # nothing is stored
    with pytest.raises(ValueError, match=f"{name}: expected at most"):
        rosafe.Head.from_sofa(path)


def test_the_number_of_directions_is_limited(tmp_path: Path) -> None:
    count = 721

    def many(values: dict[str, Any]) -> None:
        values["Data.IR"] = np.ones((count, 2, 16))
        values["SourcePosition"] = np.stack((np.arange(count) * 360 / count, np.zeros(count), np.ones(count)), 1)

    with pytest.raises(ValueError, match="at most 720 directions in the horizontal plane, got 721"):
        rosafe.Head.from_sofa(write_sofa(tmp_path / "many.sofa", many))


def test_other_files_are_rejected(tmp_path: Path) -> None:
    text = tmp_path / "text.sofa"
    text.write_text("no SOFA file")
    cut = tmp_path / "cut.sofa"
    cut.write_bytes(write_sofa(tmp_path / "whole.sofa").read_bytes()[:3000])
    for path in (text, cut, tmp_path, tmp_path / "none.sofa"):
        with pytest.raises(ValueError) as caught:
            rosafe.Head.from_sofa(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("signal", "rate", "azimuth", "message"),
    [
        (np.zeros((2, 5)), RATE, 0, "signal: expected"),
        (np.array([0, np.nan]), RATE, 0, "signal: expected finite"),
        (np.zeros(5), 0, 0, "sample_rate: expected"),
        (np.zeros(5), RATE, [0, 1], "azimuth: expected"),
        (np.zeros(5), RATE, np.nan, "azimuth: expected"),
        (np.zeros(5), RATE, 1e308, "azimuth: expected .* from -1000000 to 1000000 degrees, got 1e"),
        (np.full(5, 1e308), RATE, 0, r"signal: expected finite samples up to 1e\+70"),
    ],
)
def test_arguments_of_render_are_checked(signal: np.ndarray, rate: float, azimuth: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rosafe.Head.sphere().render(signal, rate, azimuth)


def test_azimuths_of_cues_are_checked() -> None:
    for azimuths in (1e308, [np.nan], [[0.0, 1.0]], ["left"]):
        with pytest.raises(ValueError, match="azimuth: expected one finite number or a list"):
            rosafe.Head.sphere().itd([500.0], azimuths)


def test_frequencies_of_cues_are_checked() -> None:
    frequencies: Any
    for frequencies in (1e308, 0.0, np.nan, 10**400, 1j, {}, "a", [[500.0], [1, 2]], None):
        with pytest.raises(ValueError, match="frequencies: expected"):
            rosafe.Head.sphere().ild(frequencies)


def test_rendering_nothing() -> None:
    for azimuth in (np.array(30.0), np.zeros(0)):
        assert rosafe.Head.sphere().render(np.zeros(0), RATE, azimuth).shape == (2, 0)


def test_angles() -> None:
    assert angles.wrap([190, -180, 180, 540, 0]).tolist() == [-170, 180, 180, 180, 0]
    assert angles.lateral([0, 30, 90, 150, 180, -150, -90]).tolist() == [0, 30, 90, 30, 0, -30, -90]
    assert angles.unwrap(np.array([170.0, -170.0, -150.0])).tolist() == [170, 190, 210]
    assert len(angles.grid()) == 72 and angles.grid()[-1] == 180
