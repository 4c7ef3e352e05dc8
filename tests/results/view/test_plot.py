"""`rosafe.plot`: values, times, frequencies, lags and units in the plots are those of the result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import rosafe
from rosafe.audio.devices.scene import Scene
from rosafe.interface import KINDS, Representation
from rosafe.results.view import plot as module
from rosafe.results.view.plot import draw, plot

RATE = 16000


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    """Return all outputs for a short scene in which the pitch is found everywhere."""
    sound = Scene(RATE, seconds=1).frames(RATE)
    parameters = {"fb_highFreqHz": 6500.0, "pi_confThres": 0.2, "ac_wSizeSec": 0.03}
    return {**rosafe.process(sound, RATE, parameters=parameters, outputs=list(KINDS)), "sample_rate": RATE}


@pytest.fixture
def ax() -> Axes:
    """Return empty axes."""
    return Figure().add_subplot()


def colour_bar(axes: Axes) -> Any:
    """Return the colour colour_bar of the image."""
    return axes.get_images()[0].colorbar


def image_values(axes: Axes) -> np.ndarray:
    """Return the values of the image."""
    return np.asarray(axes.get_images()[0].get_array())


def frame_centres(result: dict[str, Any], kind: str) -> np.ndarray:
    """Return the centre of each frame (s)."""
    return np.asarray(result[f"{kind}_time"])


@pytest.mark.parametrize("name", [name for kind in KINDS.values() for name in kind.outputs])
def test_each_output_is_plotted_and_labelled(result: dict[str, Any], ax: Axes, name: str) -> None:
    plot(result, name, ax)
    assert ax.get_title("left").startswith(name)
    assert ax.get_ylabel() or len(ax.get_yticklabels()) == len(result["sf_requests"])
    assert ax.get_xlabel() == ("time (s)" if name != "amsFeatures" else "modulation frequency (Hz)")
    if name != "amsFeatures":
        assert ax.get_xlim()[0] >= -0.01 and 0.8 < ax.get_xlim()[1] < 1.02
    unit = next(kind.outputs[name].unit for kind in KINDS.values() if name in kind.outputs)
    if ax.get_images() and unit:
        assert colour_bar(ax).ax.get_ylabel() == {"s": "ms"}.get(unit, unit)
        assert np.ptp(ax.get_images()[0].get_clim()) > 0
    FigureCanvasAgg(ax.figure).draw()


def test_interaural_differences(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "itd", ax)
    np.testing.assert_array_equal(image_values(ax), 1e3 * result["itd"])
    low, high = ax.get_images()[0].get_clim()
    assert low == -high and high == pytest.approx(1e3 * np.percentile(np.abs(result["itd"]), 99))
    left, right, bottom, top = ax.get_images()[0].get_extent()
    times = frame_centres(result, "itd")
    assert (left, right) == pytest.approx((times[0] - 0.005, times[-1] + 0.005))
    assert (bottom, top) == (-0.5, len(result["fb_cfHz"]) - 0.5)
    for tick, label in zip(ax.get_yticks(), ax.get_yticklabels(), strict=True):
        assert float(label.get_text()) == pytest.approx(result["fb_cfHz"][int(tick)], abs=0.5)
    assert float(ax.get_yticklabels()[0].get_text()) == 80 and len(ax.get_yticks()) > 4


@pytest.mark.parametrize(("name", "decibels"), [("ratemap", 10), ("ratemap", 20), ("ihc", 20), ("gammatone", 20)])
@pytest.mark.parametrize("ear", ["left", "right"])
def test_levels_are_relative_to_the_loudest_of_both_ears(
    result: dict[str, Any], ax: Axes, name: str, decibels: int, ear: str
) -> None:
    magnitude = {"rm_scaling": "magnitude"} if (name, decibels) == ("ratemap", 20) else {}
    plot({**result, "parameters": magnitude or np.array("{}")}, name, ax, ear=ear)
    size = np.abs(result[name])
    level = np.maximum(decibels * np.log10(np.maximum(size, 1e-200) / size.max()), -60)[int(ear == "right")]
    if name == "ratemap":
        np.testing.assert_allclose(image_values(ax), level, atol=1e-9)
    else:  # more samples than columns: the maximum of each column
        each = -(-RATE // module.MAX_COLUMNS)
        for column in (0, 100, 1400):
            expected = level[:, column * each : (column + 1) * each].max(axis=1)
            np.testing.assert_allclose(image_values(ax)[:, column], expected, atol=1e-9)
    assert colour_bar(ax).ax.get_ylabel() == "dB re loudest" and ear in ax.get_title("left")


def test_lags_are_in_milliseconds(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "crossCorrelation", ax)
    np.testing.assert_allclose(image_values(ax), result["crossCorrelation"].mean(axis=0), atol=1e-12)
    half = 500 / RATE
    assert ax.get_ylim() == pytest.approx((1e3 * result["cc_lags"][0] - half, 1e3 * result["cc_lags"][-1] + half))
    assert ax.get_ylabel() == "lag (ms)" and "mean over the channels" in ax.get_title("left")


def test_selected_channel_and_time(result: dict[str, Any]) -> None:
    channel, frame = int(np.abs(result["fb_cfHz"] - 500).argmin()), 40
    for name in ("autocorrelation", "amsFeatures"):
        over_time, moment = (Figure().add_subplot() for _ in range(2))
        plot(result, name, over_time, channel=500.0, ear="right")
        plot(result, name, moment, at=result[f"{name}_time"][frame] + 0.002)
        expected = [result[name][1, channel], result[name][0, :, :, frame]]
        if name == "amsFeatures":
            expected = [
                np.maximum(20 * np.log10(np.maximum(part, 1e-200) / whole.max()), -60)
                for part, whole in zip(expected, (result[name][:, channel], result[name][..., frame]), strict=True)
            ]
            labels = [float(label.get_text()) for label in over_time.get_yticklabels()]
            assert labels[0] == 4 and labels[-1] == 1024
        np.testing.assert_allclose(image_values(over_time), expected[0], atol=1e-9)
        np.testing.assert_allclose(image_values(moment), expected[1], atol=1e-9)
        assert f"{result['fb_cfHz'][channel]:.0f} Hz" in over_time.get_title("left")
        assert moment.get_ylabel() == "centre frequency (Hz)"


def test_modulation_is_plotted_at_the_loudest_moment(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "amsFeatures", ax)
    loudest = result["amsFeatures"].sum(axis=(0, 1, 2)).argmax()
    assert f"at {frame_centres(result, 'amsFeatures')[loudest]:.2f} s" in ax.get_title("left")
    strongest = np.unravel_index(image_values(ax).argmax(), image_values(ax).shape)
    assert strongest == np.unravel_index(result["amsFeatures"][0, ..., loudest].argmax(), image_values(ax).shape)


def test_pitch_lies_over_the_ratemap(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "pitch", ax)
    times, heights = ax.get_lines()[0].get_data()
    hertz = np.interp(heights, np.arange(len(result["fb_cfHz"])), result["fb_cfHz"])
    found = ~np.isnan(result["pitch"][0, 0])
    assert found.sum() > 30
    np.testing.assert_array_equal(~np.isnan(heights), found)
    np.testing.assert_allclose(hertz[found], result["pitch"][0, 0][found])
    np.testing.assert_allclose(times, frame_centres(result, "pitch"))
    assert "dB" in colour_bar(ax).ax.get_ylabel()
    assert ax.get_ylim()[1] < len(result["fb_cfHz"]) and np.nanmax(heights) < ax.get_ylim()[1]
    alone = Figure().add_subplot()
    plot({name: data for name, data in result.items() if name != "ratemap"}, "pitch", alone)
    assert not alone.get_images() and alone.get_ylabel() == "pitch (Hz)"
    np.testing.assert_array_equal(alone.get_lines()[0].get_ydata(), result["pitch"][0, 0])


@pytest.mark.parametrize(("name", "under"), [("onsetMap", "onsetStrength"), ("offsetMap", "offsetStrength")])
def test_maps_are_plotted_over_strengths(result: dict[str, Any], ax: Axes, name: str, under: str) -> None:
    plot(result, name, ax, ear="right")
    np.testing.assert_array_equal(image_values(ax), result[under][1])
    times, channels = ax.get_lines()[0].get_data()
    there = np.zeros_like(result[name][1])
    there[np.asarray(channels, int), np.searchsorted(result[f"{name}_time"], times - 1e-9)] = 1
    assert there.sum() > 20
    np.testing.assert_array_equal(there, result[name][1])
    alone = Figure().add_subplot()
    plot({key: data for key, data in result.items() if key != under}, name, alone, ear="right")
    np.testing.assert_array_equal(image_values(alone), result[name][1])


def test_each_feature_is_scaled_to_its_range(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "spectralFeatures", ax)
    assert [label.get_text() for label in ax.get_yticklabels()] == result["sf_requests"]
    row = result["sf_requests"].index("centroid")
    both = result["spectralFeatures"][:, row]
    low, high = np.percentile(both, (1, 99))
    np.testing.assert_allclose(image_values(ax)[row], np.clip((both[0] - low) / (high - low), 0, 1), atol=1e-9)


def test_waveforms_keep_their_extremes(result: dict[str, Any], ax: Axes) -> None:
    plot(result, "input", ax)
    times, wave = ax.get_lines()[0].get_data()
    assert len(wave) <= 2 * module.MAX_COLUMNS
    assert (wave.min(), wave.max()) == (result["input"][0].min(), result["input"][0].max())
    assert times[wave.argmax()] == pytest.approx(result["input"][0].argmax() / RATE, abs=2e-3)


def test_a_figure_of_several_outputs(result: dict[str, Any]) -> None:
    drawing = draw(Figure(), result, ["itd", "ratemap", "ild"])
    titles = [axes.get_title("left") for axes in drawing.axes if axes.get_title("left")]
    assert titles == ["ratemap, left ear", "ratemap, right ear", "itd", "ild"]
    limits = {axes.get_images()[0].get_clim() for axes in drawing.axes if "ratemap" in axes.get_title("left")}
    assert len(limits) == 1
    one = draw(Figure(), result, ["precedence", "moc"], "right")
    titles = [axes.get_title("left") for axes in one.axes if axes.get_title("left")]
    assert titles == ["precedence_itd", "precedence_ild", "precedence_cc, mean over the channels", "moc, right ear"]
    assert len({axes.get_position().x0 for axes in one.axes if axes.get_title("left")}) == 1


def test_a_figure_of_pyplot(result: dict[str, Any]) -> None:
    with matplotlib.rc_context({"backend": "agg"}):
        from matplotlib import pyplot

        figure = rosafe.plot(result, "ild")
        assert figure.number in pyplot.get_fignums()
        pyplot.close(figure)


def test_the_sample_rate(result: dict[str, Any]) -> None:
    bare = {"input": result["input"]}
    with pytest.raises(ValueError, match="sample_rate"):
        plot(bare, "input", Figure().add_subplot())
    for known in ({**bare, "cc_lags": result["cc_lags"]}, {**bare, "sample_rate": np.array(16000.0)}):
        axes = Figure().add_subplot()
        plot(known, "input", axes)
        assert axes.get_xlim()[1] == pytest.approx(1.0, abs=1e-3)
    axes = Figure().add_subplot()
    plot(bare, "input", axes, sample_rate=8000)
    assert axes.get_xlim()[1] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("seconds", [0.0, 0.025, 0.035])
def test_silent_and_very_short_signals(seconds: float) -> None:
    outputs = [name for name in KINDS if name != "pitch" or seconds > 0.03]
    made = rosafe.process(
        np.zeros((2, round(seconds * RATE))), RATE, parameters={"fb_highFreqHz": 6500.0}, outputs=outputs
    )
    drawing = draw(Figure(), {**made, "sample_rate": RATE})
    if seconds == 0.025:  # one frame, or none
        FigureCanvasAgg(drawing).draw()
    texts = [text.get_text() for axes in drawing.axes for text in axes.texts]
    assert ("no frames" in texts) and (seconds == 0.0) == (len(texts) > 30)
    for axes in drawing.axes:
        if axes.texts:  # no ticks without data
            assert not [*axes.get_xticks(), *axes.get_yticks()]


def test_silence_is_not_shown_as_the_loudest_level(ax: Axes) -> None:
    made = rosafe.process(np.zeros((2, 2000)), RATE, outputs="ratemap")
    plot(made, "ratemap", ax)
    assert (image_values(ax) == -60.0).all()


def test_marks_of_a_long_signal_are_narrow(result: dict[str, Any]) -> None:
    """The signal is repeated a hundred times."""
    names = ("onsetMap", "onsetStrength")
    long = {**result, **{name: np.tile(result[name], (1, 1, 100)) for name in names}}
    for name in names:
        long[f"{name}_time"] = 0.01 * np.arange(1, long[name].shape[-1] + 1)
    few, many = Figure().add_subplot(), Figure().add_subplot()
    plot(result, "onsetMap", few)
    plot(long, "onsetMap", many)
    widths = [axes.get_lines()[0].get_markeredgewidth() for axes in (few, many)]
    assert widths[0] > 3 and widths[1] < 0.2


def test_a_plugin_is_plotted(ax: Axes, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plot uses the declaration only: axes of the plugin and of its parent."""
    mine = Representation("mine", "Mine", "ratemap", ("ear", "channel", "feature", "time"), "1/s")
    monkeypatch.setitem(KINDS, "mine", mine)
    monkeypatch.setitem(module._OUTPUTS, "mine", (mine, mine.parts[0]))
    data = np.random.default_rng(2).random((2, 3, 5, 20))
    made = {"mine": data, "mine_frameRate": 50.0, "fb_cfHz": np.array([100.0, 200.0, 400.0])}
    plot(made, "mine", ax)
    np.testing.assert_allclose(image_values(ax), data[0].mean(axis=0))
    assert (ax.get_ylabel(), colour_bar(ax).ax.get_ylabel()) == ("feature", "1/s")
    assert ax.get_xlim() == pytest.approx((0.01, 0.41))
    plot(made, "mine", moment := Figure().add_subplot(), at=0.1)
    assert [label.get_text() for label in moment.get_yticklabels()] == ["100", "200", "400"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"outputs": "speech"}, r"outputs: expected outputs of the result \(input, .*\), got 'speech'"),
        ({"outputs": []}, "at least one output"),
        ({"outputs": ["itd", "ild"]}, "ax: expected one output, got itd, ild"),
        ({"outputs": "itd", "ear": "middle"}, "ear: expected one of left, right, got 'middle'"),
        ({"outputs": 5}, "outputs: expected a sequence of names, got 5"),
        ({"outputs": "itd", "ax": np.array([1])}, "ax: expected matplotlib Axes, got ndarray"),
    ],
)
def test_errors(result: dict[str, Any], ax: Axes, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plot(result, **{"ax": ax, **arguments})


@pytest.mark.parametrize("wrong", ["speech.npz", np.zeros((2, 100)), None])
def test_a_value_that_is_not_a_result_is_rejected(wrong: Any) -> None:
    functions: list[Callable[[Any], Any]] = [rosafe.plot, rosafe.to_xarray]
    for function in functions:
        with pytest.raises(ValueError, match=r"expected a result of rosafe\.process, or of rosafe\.load"):
            function(wrong)


def test_arrays_of_the_wrong_shape_are_rejected(ax: Axes) -> None:
    with pytest.raises(ValueError, match="itd: expected the axes"):
        plot({"itd": np.zeros(5)}, "itd", ax)
    with pytest.raises(ValueError, match=r"\(none\), got 'itd'"):
        plot({"fb_cfHz": np.zeros(5)}, "itd", ax)
