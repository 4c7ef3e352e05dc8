"""The picture: a real image with all four parts in it, whole or not there at all."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib
import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rosafe.bass.sources.scene import scene_azimuth
from rosafe.output import OutputError
from rosafe.view import estimates, figure
from rosafe.view.axes import save
from rosafe.view.representations import Representations
from tests.view.conftest import WALK, represented


def pixels(path: Path) -> np.ndarray:
    """The image in a PNG file, (height, width, 3), from 0 to 1."""
    return matplotlib.image.imread(path)[..., :3]


def axes_with(drawing: Figure, words: str) -> Axes:
    """The part of the picture with these words in its title."""
    return next(axes for axes in drawing.axes if words in axes.get_title("left"))


def test_picture_of_the_scene(walk: Representations, tmp_path: Path) -> None:
    drawing = figure.draw(walk, "A walk", "three seconds", lambda times: scene_azimuth(times, WALK))
    path = tmp_path / "walk.png"
    save(drawing, path)
    image = pixels(path)
    assert image.shape[0] > 800 and image.shape[1] > 1000
    assert len(np.unique((image * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 500
    texts = {text.get_text() for text in drawing.texts}
    assert {"A walk", "three seconds"} <= texts


def test_axes_say_real_centre_frequencies(walk: Representations) -> None:
    drawing = figure.draw(walk, "")
    for words in ("Left ear", "Right ear", "level difference"):
        axes = axes_with(drawing, words)
        labels = [label.get_text() for label in axes.get_yticklabels()]
        assert labels[0] == "80" and labels[-1] == "7641"
        for tick, label in zip(axes.get_yticks(), labels, strict=True):
            assert float(label) == pytest.approx(walk.center_frequencies[int(tick)], abs=0.5)


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
    begin, end, *_ = ild.get_extent()
    assert (begin, end) == pytest.approx((walk.times[0] - 0.005, walk.times[-1] + 0.005), abs=1e-9)


def test_lines_lie_at_the_estimated_lags(walk: Representations) -> None:
    drawing = figure.draw(walk, "", "", lambda times: scene_azimuth(times, WALK))
    axes = axes_with(drawing, "cross-correlation")
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    truth = estimates.lag_of_azimuth(walk.center_frequencies, scene_azimuth(walk.times, WALK))
    np.testing.assert_allclose(lines["true path"], 1e3 * truth)
    inside = np.abs(estimates.azimuth_from_correlation(walk)) < 89
    peak = 1e3 * estimates.time_difference(walk)
    np.testing.assert_allclose(lines["from the correlation's peak"][inside], peak[inside], atol=0.005)
    assert np.abs(lines["from level differences"] - lines["true path"]).mean() < 0.03


def test_silence_makes_a_picture_too(tmp_path: Path) -> None:
    save(figure.draw(represented(np.zeros((2, 16000)), 16000), "nothing"), tmp_path / "silence.png")
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


def test_too_few_frames_are_refused(walk: Representations) -> None:
    with pytest.raises(ValueError, match="1 frames are too few"):
        figure.draw(walk.tail(0.0), "")


def test_failed_save_leaves_the_old_picture(
    walk: Representations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing = figure.draw(walk.tail(0.5), "")
    path = tmp_path / "old.png"
    path.write_bytes(b"old")

    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(drawing, "savefig", full)
    with pytest.raises(OutputError, match="No space"):
        save(drawing, path)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_saved_picture_has_the_rights_of_any_new_file(walk: Representations, tmp_path: Path) -> None:
    save(figure.draw(walk.tail(0.5), ""), tmp_path / "a.png")
    (tmp_path / "b").touch()
    assert (tmp_path / "a.png").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_users_settings_of_matplotlib_do_not_change_it(walk: Representations, tmp_path: Path) -> None:
    def png() -> bytes:
        save(figure.draw(walk.tail(0.5), "x"), tmp_path / "x.png")
        return (tmp_path / "x.png").read_bytes()

    plain = png()
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "text.color": "green"}):
        assert png() == plain
