"""Result objects: attributes, tables, files, padding, types of numbers, batches, levels, deltas and warnings."""

from __future__ import annotations

import copy
import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.signal
import soundfile

import rosafe
from rosafe.interface import KINDS
from rosafe.processing.files import process_file
from rosafe.system.output import OutputError

RATE = 16000
FEW: dict[str, Any] = {"fb_nChannels": 4}
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, 8000))
FORMATS = [".npz", ".h5"]
FRAMED = ["ild", "ratemap", "crossCorrelation"]


@pytest.fixture(scope="module")
def result() -> rosafe.Result:
    return rosafe.process(SOUND, RATE, parameters=FEW, outputs=[*FRAMED, "gammatone"])


def assert_same(got: rosafe.Result, expected: rosafe.Result) -> None:
    assert (got.parameters, got.sample_rate, got.version) == (
        expected.parameters,
        expected.sample_rate,
        expected.version,
    )
    assert got.axes == expected.axes and got.clipped == expected.clipped
    assert {name: got.units[name] for name in expected.units} == expected.units
    assert got.keys() - {"source", "block_frames", "pad", "clip"} == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(got[name], value, err_msg=name)


# --- the object ---


def test_attributes(result: rosafe.Result) -> None:
    assert isinstance(result, dict) and next(iter(result)) == "gammatone"
    assert result.sample_rate == RATE and result.version == rosafe.__version__ and result.clipped == 0
    assert result.parameters["fb_nChannels"] == 4 and result.parameters["fb_highFreqHz"] == 7600.0
    assert result.parameters["ihc_method"] == "dau" and result.parameters["in_doNormalize"] is False
    assert result.axes["ratemap"] == ("ear", "channel", "time") and result.units["ild"] == "dB"
    assert result.units["fb_cfHz"] == "Hz" and result.units["ild_time"] == result.units["cc_lags"] == "s"
    again = rosafe.process(SOUND, RATE, parameters=result.parameters, outputs=["ild"])
    np.testing.assert_array_equal(again["ild"], result["ild"])


def test_parameters_after_modifications_are_the_last_ones() -> None:
    changes = [(1, "rm_decaySec", 0.02), (99, "fb_nChannels", 9)]
    got = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=1000, modifications=changes, outputs="ratemap")
    assert got.parameters["rm_decaySec"] == 0.02 and got.parameters["fb_nChannels"] == 4


def test_tables_and_text(result: rosafe.Result) -> None:
    html = result._repr_html_()
    for text in ("ratemap", "2 x 4 x 49", "ear, channel, time", "dB", "fb_nChannels", "16000 Hz", result.version):
        assert text in html
    assert "pi_rangeHz" not in html  # not used by these outputs
    assert html.count("<table>") == html.count("</table>") == 2
    assert repr(result).startswith("<rosafe.Result at 16000 Hz: gammatone (2, 4, 8000)")


def test_copies_keep_the_attributes(result: rosafe.Result) -> None:
    copies = (copy.copy(result), copy.deepcopy(result), pickle.loads(pickle.dumps(result)), result.copy())
    for other in (*copies, result | {}, {} | result):
        assert type(other) is rosafe.Result and other is not result
        assert_same(other, result)


def test_union_has_the_outputs_of_both(result: rosafe.Result) -> None:
    itd = rosafe.process(SOUND, RATE, parameters=FEW, outputs="itd")
    both = rosafe.process(SOUND, RATE, parameters=FEW, outputs=[*FRAMED, "gammatone", "itd"])
    changed = result.copy()
    changed |= itd
    for union in (result | itd, itd | result, changed, dict(result) | itd):
        assert_same(union, both)
    assert "itd" not in result and "ild" not in itd.axes
    np.testing.assert_array_equal(({"ild": 0} | result)["ild"], result["ild"])
    assert (result | {"ild": 0, "note": "x"})["note"] == "x"
    with pytest.raises(TypeError):
        result | 3


def test_attributes_are_read_as_entries(tmp_path: Path, result: rosafe.Result) -> None:
    result.save(tmp_path / "a.npz")
    for one in (result, rosafe.load(tmp_path / "a.npz")):
        assert type(one.sample_rate) is float
        assert one["parameters"] == one.parameters and one["sample_rate"] == one.get("sample_rate") == RATE
        assert one["rosafe_version"] == one.version and one["clipped"] == 0
        assert one["axes"] == one.axes and one["units"] == one.units and "units" in one
        assert "nothing" not in one and one.get("nothing", 3) == 3 and "axes" not in [*one]
        with pytest.raises(KeyError, match="nothing"):
            one["nothing"]


def test_plot_and_xarray(tmp_path: Path, result: rosafe.Result) -> None:
    pytest.importorskip("matplotlib").use("Agg")
    assert len(result.plot(["ild"]).axes) == 2  # with its colour bar
    xarray = pytest.importorskip("xarray")
    data = result.to_xarray()
    assert data.attrs["sample_rate"] == RATE and data.attrs["rosafe_version"] == rosafe.__version__
    assert json.loads(data.attrs["parameters"]) == result.parameters
    pytest.importorskip("zarr")
    data.to_zarr(tmp_path / "a.zarr")
    with xarray.open_zarr(str(tmp_path / "a.zarr"), chunks=None) as read:
        assert read.identical(data)


# --- files ---


@pytest.mark.parametrize("extension", FORMATS)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_saved_results_are_loaded_with_all_attributes(tmp_path: Path, extension: str, dtype: Any) -> None:
    result = rosafe.process(
        SOUND, 22050.5, parameters=FEW, outputs=["ild", "gammatone", "spectralFeatures"], dtype=dtype
    )
    for _ in range(2):  # an existing file is replaced
        result.save(tmp_path / f"a{extension}")
    loaded = rosafe.load(tmp_path / f"a{extension}")
    assert_same(loaded, result)
    assert loaded["ild"].dtype == result["ild"].dtype == dtype
    assert loaded["sf_requests"] == result["sf_requests"]
    loaded.save(tmp_path / f"b{extension}")
    assert_same(rosafe.load(tmp_path / f"b{extension}"), result)


def test_saving_in_formats_that_are_written_only(tmp_path: Path, result: rosafe.Result) -> None:
    one = rosafe.process(SOUND, RATE, parameters=FEW, outputs="ild")
    one.save(tmp_path / "a.csv")
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=2)
    np.testing.assert_array_equal(table.T, [one["ild_time"], *one["ild"]])
    with pytest.raises(ValueError, match="one output of two axes"):
        result.save(tmp_path / "a.csv")
    result.save(tmp_path / "a.mat")
    read = scipy.io.loadmat(tmp_path / "a.mat")
    for name in (*result.axes, "fb_cfHz", "ild_time"):
        np.testing.assert_array_equal(read[name].reshape(result[name].shape), result[name])
    assert json.loads(read["parameters"][0]) == result.parameters
    with pytest.raises(ValueError, match=r"expected a name that ends in \.npz, \.h5, \.mat, \.csv$"):
        one.save(tmp_path / "a.txt")
    with pytest.raises(ValueError, match=r"ends in .*; rosafe\.load\(RESULT\)\.to_xarray\(\)\.to_zarr\(PATH\) writes"):
        one.save(tmp_path / "a.zarr")
    with pytest.raises(OutputError, match="does not exist"):
        one.save(tmp_path / "no" / "a.npz")


@pytest.mark.parametrize(
    ("suffix", "reader"),
    [
        (".mat", "scipy.io.loadmat"),
        (".csv", "pandas.read_csv or numpy.loadtxt"),
        (".zarr", "xarray.open_zarr"),
        (".wav", "soundfile.read"),
        (".txt", "rosafe process and Result.save write them"),
    ],
)
def test_load_names_the_reader_of_other_files(tmp_path: Path, suffix: str, reader: str) -> None:
    (tmp_path / f"a{suffix}").write_text("")
    with pytest.raises(ValueError, match=rf"a\{suffix}: expected a name that ends in \.npz or \.h5, got .*; {reader}"):
        rosafe.load(tmp_path / f"a{suffix}")


# --- padding ---


@pytest.mark.parametrize("frames", [1, 100, 1600, 3333])
@pytest.mark.parametrize("rate", [8000, RATE])
def test_padded_outputs_have_a_frame_for_each_hop(frames: int, rate: int) -> None:
    """Complete frames keep their bits, and outputs with one hop share one time axis."""
    sound = SOUND[:, :frames]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        whole = rosafe.process(sound, rate, parameters=FEW, outputs=list(KINDS))
        padded = rosafe.process(sound, rate, parameters=FEW, outputs=list(KINDS), pad=True, block_frames=[700, 1])
    hops = {name: round(rate / padded.get(f"{name.split('_')[0]}_frameRate", rate)) for name in padded.axes}
    for name, hop in hops.items():
        assert padded[name].shape[-1] == -(-frames // hop), name
        np.testing.assert_array_equal(padded[name][..., : whole[name].shape[-1]], whole[name], err_msg=name)
    for kind in ("pitch", "gabor", "onsetMap", "precedence", "spectralFeatures"):
        np.testing.assert_array_equal(padded[f"{kind}_time"], padded["ild_time"])


def test_padding_continues_the_signal_with_zeros() -> None:
    longer = np.concatenate((SOUND, np.zeros((2, 4000))), axis=1)
    for outputs in (["gabor"], ["pitch"], ["ild"]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            padded = rosafe.process(SOUND, RATE, parameters=FEW, outputs=outputs, pad=True)
            expected = rosafe.process(longer, RATE, parameters=FEW, outputs=outputs)
        np.testing.assert_array_equal(padded[outputs[0]], expected[outputs[0]][..., :50])


def test_padding_after_a_change_of_the_hop() -> None:
    changes = [(2, "rm_hSizeSec", 0.016)]
    options: dict[str, Any] = {"block_frames": 2000, "modifications": changes, "outputs": ["ratemap"]}
    whole = rosafe.process(SOUND, RATE, parameters=FEW, **options)
    padded = rosafe.process(SOUND, RATE, parameters=FEW, pad=True, **options)
    count = whole["ratemap"].shape[-1]
    assert padded["ratemap"].shape[-1] > count
    np.testing.assert_array_equal(padded["ratemap"][..., :count], whole["ratemap"])
    assert padded["ratemap_time"][-1] - 0.01 < 0.5 <= padded["ratemap_time"][-1] + 0.016


@pytest.mark.parametrize("extension", [".npz", ".h5"])
def test_padded_files(tmp_path: Path, extension: str) -> None:
    soundfile.write(tmp_path / "a.wav", SOUND.T, RATE, subtype="PCM_16")
    target = tmp_path / f"a{extension}"
    process_file(tmp_path / "a.wav", target, FEW, outputs=["ild", "onsetMap"], pad=True)
    samples = soundfile.read(tmp_path / "a.wav", dtype="int16")[0]
    expected = rosafe.process(samples, RATE, parameters=FEW, outputs=["ild", "onsetMap"], pad=True)
    loaded = rosafe.load(target)
    assert_same(loaded, expected)
    assert loaded["pad"] and loaded["ild"].shape == (4, 50)
    assert process_file(tmp_path / "a.wav", target, FEW, outputs=["ild", "onsetMap"], pad=True, resume=True).skipped
    with pytest.raises(OutputError, match="other pad"):
        process_file(tmp_path / "a.wav", target, FEW, outputs=["ild", "onsetMap"], resume=True)


@pytest.mark.parametrize("frames", [0, 1, 2000, 8000])
def test_finish_completes_a_stream(frames: int) -> None:
    kinds = ["input", "ratemap", "gabor", "onsetMap"]
    expected = rosafe.process(SOUND[:, :frames], RATE, parameters=FEW, outputs=kinds, pad=True)
    stream = rosafe.Stream(RATE, FEW, kinds)
    for _ in range(2):  # the second sound begins at zero again
        made = [stream.process(SOUND[:, first : min(frames, first + 777)]) for first in range(0, frames, 777)]
        made.append(stream.finish())
        for name in ("input", "ratemap", "gabor", "onsetMap", "gabor_time"):
            np.testing.assert_array_equal(np.concatenate([one[name] for one in made], axis=-1), expected[name])


# --- numbers ---


@pytest.mark.parametrize("changes", [[], [(1, "fb_nChannels", 5)]])
def test_float32_is_the_rounded_result(changes: list[Any]) -> None:
    options: dict[str, Any] = {"parameters": FEW, "block_frames": 3000, "modifications": changes}
    exact = rosafe.process(SOUND, RATE, **options)
    rounded = rosafe.process(SOUND, RATE, dtype=np.float32, **options)
    for name in exact.axes:
        assert rounded[name].dtype == np.float32
        np.testing.assert_array_equal(rounded[name], exact[name].astype(np.float32))
        np.testing.assert_allclose(rounded[name], exact[name], rtol=1e-6)
    assert rounded["ild_time"].dtype == np.float64
    for bad in ("int16", "no such type", np.float16):
        with pytest.raises(ValueError, match="dtype: expected float64 or float32, got "):
            rosafe.process(SOUND, RATE, dtype=bad)


# --- clipping ---


def float_file(path: Path, peak: float) -> np.ndarray:
    sound = (peak * SOUND / np.abs(SOUND).max()).astype(np.float32)
    soundfile.write(path, sound.T, RATE, subtype="FLOAT")
    return sound


@pytest.mark.parametrize("extension", FORMATS)
def test_clipped_samples_are_counted_and_stored(tmp_path: Path, extension: str) -> None:
    sound = float_file(tmp_path / "a.wav", 2.2)
    count = int(np.count_nonzero(np.abs(sound) > 1))
    done = process_file(tmp_path / "a.wav", tmp_path / f"a{extension}", FEW, 500)
    assert done.clipped == count > 100
    loaded = rosafe.load(tmp_path / f"a{extension}")
    assert loaded.clipped == loaded["clipped"] == count
    clipped = rosafe.process(np.clip(sound, -1, 1), RATE, parameters=FEW, outputs=["ild"])
    np.testing.assert_allclose(loaded["ild"], clipped["ild"], atol=1e-5)


@pytest.mark.parametrize("extension", FORMATS)
def test_floats_without_clipping(tmp_path: Path, extension: str) -> None:
    sound = float_file(tmp_path / "a.wav", 2.2)
    target = tmp_path / f"a{extension}"
    assert process_file(tmp_path / "a.wav", target, FEW, 500, clip=False).clipped == 0
    loaded = rosafe.load(target)
    assert_same(loaded, rosafe.process(sound, RATE, parameters=FEW, outputs=FRAMED))
    assert process_file(tmp_path / "a.wav", target, FEW, 500, clip=False, resume=True).skipped
    with pytest.raises(OutputError, match=r"other (clip|parameters)"):
        process_file(tmp_path / "a.wav", target, FEW, 500, resume=True)


# --- warnings and advice ---


def test_windows_too_short_for_the_pitch_range() -> None:
    match = r"pi_rangeHz, ac_wSizeSec: a window of 0\.02 s contains fewer than 3 periods of 80 Hz"
    with pytest.warns(UserWarning, match=match) as caught:
        rosafe.process(SOUND, RATE, parameters=FEW, outputs="pitch")
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match=match) as caught:
        rosafe.Stream(RATE, FEW, "pitch")
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rosafe.process(SOUND, RATE, parameters={**FEW, "pi_rangeHz": [150, 400]}, outputs="pitch")
        rosafe.process(SOUND, RATE, parameters={**FEW, **rosafe.PRESETS["speech"]}, outputs="pitch")
        rosafe.process(SOUND, RATE, parameters=FEW, outputs="autocorrelation")


def glottal_vowel(rng: np.random.Generator, low: float, high: float, snr: float) -> tuple[np.ndarray, np.ndarray]:
    """A glide of glottal pulses with jitter and shimmer through random formants, in noise, and its pitch."""
    begin, end = rng.uniform(low, high, 2)
    pitch = np.geomspace(begin, end, int(0.4 * RATE))
    cycles = np.cumsum(pitch) / RATE
    cycles += np.interp(cycles, np.arange(200), 0.01 * rng.standard_normal(200))
    opened = cycles % 1 / rng.uniform(0.4, 0.8)
    flow = np.where(opened < 1, opened**2 - opened**3, 0.0) * rng.normal(1, 0.05, 200)[cycles.astype(int)]
    sound = np.diff(flow, prepend=0)
    for formant in (rng.uniform(250, 900), rng.uniform(950, 2300), rng.uniform(2500, 3400)):
        radius = np.exp(-np.pi * rng.uniform(50, 150) / RATE)
        sound = scipy.signal.lfilter([1], [1, -2 * radius * np.cos(2 * np.pi * formant / RATE), radius**2], sound)
    sound = sound / sound.std() + 10 ** (-snr / 20) * rng.standard_normal(len(sound))
    return 0.1 * sound, pitch


@pytest.mark.parametrize(
    ("low", "high"), [(80, 120), (120, 180), (180, 250), (250, 300), (300, 350), (350, 395), (395, 400)]
)
def test_the_preset_for_speech_on_random_vowels(low: int, high: int) -> None:
    """At least 97 % of the frames are within 50 cents, at 20 and 10 dB."""
    rates = []
    for seed in range(4):
        sound, pitch = glottal_vowel(np.random.default_rng([low, seed]), low, high, (20, 10)[seed % 2])
        result = rosafe.process(sound, RATE, parameters=rosafe.PRESETS["speech"], outputs="pitch")
        expected = np.interp(result["pitch_time"], np.arange(len(pitch)) / RATE, pitch)
        rates.append(np.mean(np.abs(1200 * np.log2(result["pitch"][0, 0] / expected)[4:-4]) <= 50))
    assert np.mean(rates) >= 0.97


def test_outputs_without_frames() -> None:
    with pytest.warns(UserWarning, match="ild, ratemap: no frames: the sound is shorter than the windows"):
        rosafe.process(SOUND[:, :300], RATE, parameters=FEW, outputs=["ild", "ratemap", "input"])
    with pytest.warns(UserWarning, match=r"^ild: no frames: the sound has no samples$"):
        rosafe.process(SOUND[:, :0], RATE, parameters=FEW, outputs="ild", pad=True)


@pytest.mark.parametrize("pad", ["x", None, 2, 0.5, [True]])
def test_pad_is_a_boolean(pad: Any) -> None:
    with pytest.raises(ValueError, match=r"^pad: expected a boolean, got "):
        rosafe.process(SOUND, RATE, parameters=FEW, outputs="ild", pad=pad)


def test_misplaced_arguments() -> None:
    for call in (rosafe.process, lambda sound, rate, **named: rosafe.Stream(rate, **named)):
        with pytest.raises(
            TypeError, match=r"'fb_nChannels'; pass parameters as parameters=\{'fb_nChannels': \.\.\.\}"
        ):
            call(SOUND, RATE, fb_nChannels=32)
        with pytest.raises(TypeError, match=r"unexpected keyword argument 'volume'$"):
            call(SOUND, RATE, volume=3)
    for rate, meant in ((16, "16000"), (44.1, "44100")):
        with pytest.raises(ValueError, match=rf"^sample_rate: expected Hz, got {rate:g}; did you mean {meant}\?"):
            rosafe.process(SOUND, rate)
        with pytest.raises(ValueError, match=rf"^sample_rate: expected Hz, got {rate:g}; did you mean {meant}\?"):
            rosafe.Stream(rate)


# --- features and batches ---


def test_levels() -> None:
    values = np.array([2.0, 0.2, 0.0])
    np.testing.assert_allclose(rosafe.to_db(values, reference="max"), [0, -20, -80])
    np.testing.assert_allclose(rosafe.to_db(values, power=True, floor=-5), [10 * np.log10(2), -5, -5])
    assert rosafe.to_db(values, floor=None)[2] == -np.inf
    assert rosafe.to_db(values.astype(np.float32)).dtype == np.float32
    assert (rosafe.to_db(np.zeros(3), reference="max") == -80).all()
    assert rosafe.to_db([1, 10], 10.0).tolist() == [-20.0, 0.0]
    np.testing.assert_allclose(rosafe.to_db([1e308, 5e-324], 1e-5, None), [6260, 20 * np.log10(5e-324) + 100])
    np.testing.assert_array_equal(
        rosafe.to_db(np.array([1e4, 0.0], np.float16), 1e-9), np.array([260, -80], np.float16)
    )
    bad: Any
    for bad in (0.0, -1.0, "mean", np.nan, np.inf, None, np.ones(3)):
        with pytest.raises(ValueError, match=r"^reference: expected a positive finite number or \"max\", got "):
            rosafe.to_db(values, bad)
    with pytest.raises(ValueError, match=r"^reference: "):
        rosafe.to_db([1.0, np.inf], "max")
    for bad in ("x", np.nan, [0.0]):
        with pytest.raises(ValueError, match=r"^floor: expected a finite number of dB or None, got "):
            rosafe.to_db(values, floor=bad)
    for bad in ([1j], ["1"], [None]):
        with pytest.raises(ValueError, match=r"^values: expected real numbers, got "):
            rosafe.to_db(bad)
    with pytest.raises(ValueError, match=r"^values: expected no negative numbers, got -1"):
        rosafe.to_db([-1.0])


def test_deltas() -> None:
    frames = np.arange(20.0)
    curve = np.stack((3 * frames, frames**2))
    np.testing.assert_allclose(rosafe.deltas(curve)[0], 3, atol=1e-9)
    np.testing.assert_allclose(rosafe.deltas(curve)[1, 4:-4], 2 * frames[4:-4], atol=1e-9)
    np.testing.assert_allclose(rosafe.deltas(curve, order=2)[1], 2, atol=1e-9)
    np.testing.assert_allclose(rosafe.deltas(curve.T, 5, axis=0), rosafe.deltas(curve, 5).T)
    for width, order in ((4, 1), (1, 1), (21, 1), (3, 3), (5, 0)):
        with pytest.raises(ValueError, match=r"^width: expected an odd number of frames"):
            rosafe.deltas(curve, width, order)
    wrong: Any
    for name, wrong in (("width", 5.0), ("width", None), ("order", 1.5), ("order", True), ("axis", 0.0), ("axis", 2)):
        with pytest.raises(ValueError, match=rf"^{name}: expected .*, got {wrong}$"):
            rosafe.deltas(curve, **{name: wrong})
    for wrong in (np.nan, 1e308):  # NaN as the pitch of an unvoiced frame
        curve[0, 3] = wrong
        with pytest.raises(ValueError, match=r"^values: expected finite numbers up to 1e\+200, got larger ones, NaN"):
            rosafe.deltas(curve)
    for wrong in ({}, [1j] * 9, [10**400] * 9, [[0], [0, 1]]):
        with pytest.raises(ValueError, match=r"^values: expected real numbers, got "):
            rosafe.deltas(wrong)


def test_a_batch_equals_single_calls() -> None:
    sounds = [SOUND, SOUND[:, :3000], SOUND[0]]
    results = rosafe.process_batch(sounds, RATE, parameters=FEW, outputs="ratemap", pad=True)
    for sound, result in zip(sounds, results, strict=True):
        assert_same(result, rosafe.process(sound, RATE, parameters=FEW, outputs="ratemap", pad=True))
    assert len(rosafe.process_batch(np.zeros((3, 2, 400)), RATE, parameters=FEW, outputs="ild")) == 3
    with pytest.raises(ValueError, match=r"^sound 1: signal: expected finite"):
        rosafe.process_batch([SOUND, np.full(10, np.nan)], RATE)


def test_warnings_of_a_batch() -> None:
    """A warning about all sounds is issued once; others name the sounds; all refer to the line of the caller."""
    sounds = [SOUND, SOUND[:, :100], SOUND[0]]
    with pytest.warns(UserWarning) as caught:
        rosafe.process_batch(sounds, RATE, parameters=FEW, outputs="pitch")
    assert {one.filename for one in caught} == {__file__}
    texts = [str(one.message) for one in caught]
    assert [text.partition(":")[0] for text in texts] == ["pi_rangeHz, ac_wSizeSec", "sounds 1"]
    with pytest.raises(TypeError, match=r"^process_batch\(\) got an unexpected keyword argument 'fb_nChannels'; pass"):
        rosafe.process_batch(sounds, RATE, fb_nChannels=4)
