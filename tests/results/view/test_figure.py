"""The figure of a binaural signal: content of its four parts, and saving it completely or not at all."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rosafe
from rosafe.results.view import figure
from rosafe.results.view.axes import save
from rosafe.results.view.representations import Representations
from tests.results.view.conftest import OUTPUTS, aligned, tail


def pixels(path: Path) -> np.ndarray:
    """Return the image of a PNG file, (height, width, 3), from 0 to 1."""
    return matplotlib.image.imread(path)[..., :3]


def axes_with(drawing: Figure, text: str) -> Axes:
    """Return the axes whose title contains `text`."""
    return next(axes for axes in drawing.axes if text in axes.get_title("left"))


TRUTH = np.linspace(85.0, -85.0, 250)


def directions() -> dict[str, np.ndarray]:
    """Return directions as of `rosafe.localize`: the posterior has one direction at each time."""
    grid = np.arange(-175.0, 181.0, 5.0)
    nearest = np.abs(grid - TRUTH[:, np.newaxis]).argmin(axis=1)
    times = 0.25 + np.arange(len(TRUTH)) / 100
    return {"time": times, "azimuth": grid[nearest], "azimuths": grid, "posterior": np.eye(len(grid))[nearest]}


def test_the_figure_of_the_scene(walk: Representations, tmp_path: Path) -> None:
    drawing = figure.draw(walk, "A walk", "three seconds", directions(), {"talker": TRUTH})
    path = tmp_path / "walk.png"
    save(drawing, path)
    image = pixels(path)
    assert image.shape[0] > 800 and image.shape[1] > 1000
    assert len(np.unique((image * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 500
    texts = {label.get_text() for label in drawing.texts}
    assert {"A walk", "three seconds"} <= texts


def test_images_show_the_data(walk: Representations) -> None:
    drawing = figure.draw(walk, "")
    ild = axes_with(drawing, "level difference").get_images()[0]
    np.testing.assert_array_equal(ild.get_array(), walk.ild)
    assert ild.norm.vmin == -ild.norm.vmax < 0
    left, right = (axes_with(drawing, f"{ear} ear").get_images()[0] for ear in ("Left", "Right"))
    level = 10 * np.log10(walk.ratemap / walk.ratemap.max())
    np.testing.assert_allclose(left.get_array(), np.maximum(level[0], -60), atol=1e-9)
    np.testing.assert_allclose(right.get_array(), np.maximum(level[1], -60), atol=1e-9)
    assert left.get_clim() == right.get_clim()
    start, end, *_ = ild.get_extent()
    assert (start, end) == pytest.approx((walk.times[0] - 0.005, walk.times[-1] + 0.005), abs=1e-9)


def test_posterior_estimate_and_truth_are_drawn(walk: Representations) -> None:
    axes = axes_with(figure.draw(walk, "", "", directions(), {"talker": TRUTH}), "Direction")
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    np.testing.assert_array_equal(lines["true direction: talker"], TRUTH)
    np.testing.assert_array_equal(lines["estimate"], directions()["azimuth"])
    posterior = axes.get_images()[0].get_array()
    assert posterior is not None and posterior.shape == (72, len(TRUTH)) and posterior.max() == 0.0
    assert axes.get_ylim() == (-90, 90) and axes.get_yticklabels()[-1].get_text() == "90° left"
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["90° right", "45° right", "ahead", "45° left", "90° left"]


def test_sources_behind_the_head_are_drawn(walk: Representations) -> None:
    axes = axes_with(figure.draw(walk, "", "", directions(), {"behind": TRUTH + 100}), "Direction")
    assert axes.get_ylim() == (-180, 180)


def test_a_figure_of_silence(tmp_path: Path) -> None:
    silence = aligned(rosafe.process(np.zeros((2, 16000)), 16000, outputs=OUTPUTS))
    save(figure.draw(silence, "nothing"), tmp_path / "silence.png")
    assert pixels(tmp_path / "silence.png").shape[2] == 3


@pytest.mark.parametrize("channels", [1, 2, 100])
def test_any_number_of_channels(channels: int, tmp_path: Path) -> None:
    count = 30
    shown = Representations(
        np.arange(count) / 100,
        np.geomspace(100, 7000, channels),
        np.arange(-18, 19) / 16000,
        np.random.default_rng(0).random((2, channels, count)),
        np.zeros((channels, count)),
        np.random.default_rng(1).random((37, count)),
    )
    save(figure.draw(shown, "x"), tmp_path / "x.png")


def test_too_few_frames_are_rejected(walk: Representations) -> None:
    with pytest.raises(ValueError, match="expected at least 2 frames, got 1"):
        figure.draw(tail(walk, 0.0), "")


def test_matplotlib_settings_of_the_user_have_no_effect(walk: Representations, tmp_path: Path) -> None:
    def png() -> bytes:
        save(figure.draw(tail(walk, 0.5), "x"), tmp_path / "x.png")
        return (tmp_path / "x.png").read_bytes()

    plain = png()
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "text.color": "green"}):
        assert png() == plain
