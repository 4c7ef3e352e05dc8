"""The whole walk of a new user: up, the page, sound, a change, a setup; all killed; up again, and the same picture."""

from __future__ import annotations

import json
import os
import signal
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("selenium", reason="python3-selenium is not installed: scripts/install --tests")

import soundfile

from rosafe.bass.sources.scene import Scene
from tests.harness import Graph, Process, free_port, proc, wait_for
from tests.live.browser import Browser, browser
from tests.live.world import Live

RATE, WALK = 16000, 2.0
LABELS = 110  # CSS pixels at the left of a picture where its labels stand

# What the pictures show, column by column of their pixels, and when of the audio that was.
PIXELS = """
const pictures = arguments[0].map((kind) => {
  const canvas = document.querySelector(`canvas[data-kind="${kind}"]`);
  if (!canvas?.dataset.plot) return null;
  const plot = JSON.parse(canvas.dataset.plot);
  const [x0, y0, w, h] = [plot.x, plot.y, plot.w, plot.h].map(Math.round);
  return { plot, w, h, data: Array.from(canvas.getContext("2d").getImageData(x0, y0, w, h).data) };
});
return pictures.every(Boolean) ? pictures : null;
"""
KINDS = ("ild", "crossCorrelation")
# Up to when of the audio all of them are.
END = """Math.min(...arguments[0].map((kind) => {
  const canvas = document.querySelector(`canvas[data-kind="${kind}"]`);
  return JSON.parse(canvas?.dataset.plot ?? "{}").to;
}))"""
ORANGE = (255, 180, 84)
CHOOSE = "[...document.querySelectorAll('.node .name')].find((one) => one.textContent.startsWith(arguments[0])).click()"
WRITE = """
const one = document.querySelector(`[data-parameter=${arguments[0]}]`);
one.value = arguments[1];
one.dispatchEvent(new Event("change"));
"""


@contextmanager
def up(graph: Graph, *arguments: str) -> Iterator[tuple[Process, Live, str]]:
    """`rosafe up --live` with what it tells of page and genomixd."""
    ports = ("--port", str(free_port()), "--live-port", str(free_port()))
    with graph.start("rosafe", "up", *arguments, "--live", "--no-browser", *ports) as process:
        live = Live(process)
        yield process, live, f"http://127.0.0.1:{ports[1]}"


def processors(genomixd: str) -> Any:
    """What getProcessors answers."""
    with urllib.request.urlopen(f"{genomixd}/call/rosAFE/getProcessors") as answer:
        return json.load(answer)["processors"]


class Seen:
    """What the pictures show of one walk, by its phase: the colours of level differences, the line of the direction."""

    def __init__(self, window: Browser) -> None:
        begun = float(window.until(f"return {END}", KINDS, what="pictures"))
        window.until(f"return {END} > arguments[1]", KINDS, begun + WALK + 0.2, what="a walk on the pictures")
        ild, correlation = window.run(PIXELS, KINDS)
        self.limits = ild["plot"]["low"], ild["plot"]["high"]
        self.tints = folded(ild, begun)  # (phases, rows, 3)
        axes, colours = correlation["plot"], folded(correlation, begun)
        rows = np.abs(colours - ORANGE).sum(axis=2).argmin(axis=1)
        self.lags = axes["last"] - (rows + 0.5) / colours.shape[1] * (axes["last"] - axes["first"])  # s


def folded(seen: Any, begun: float) -> np.ndarray:
    """The colours of a picture since a time of the audio, by the phase of the walk."""
    plot, wide = seen["plot"], seen["w"]
    pixels = np.array(seen["data"], float).reshape(seen["h"], wide, 4)[..., :3]
    when = plot["to"] - (wide - 0.5 - np.arange(wide)) / wide * (plot["to"] - plot["from"])
    phase = np.round(np.mod(when, WALK) / WALK * 50).astype(int) % 50
    wanted = (when > begun) & (np.arange(wide) > LABELS)
    return np.array([pixels[:, wanted & (phase == one)].mean(axis=1) for one in range(50)])


def family(pid: int) -> list[int]:
    """A process with all that it has started."""
    parents = {}
    for entry in proc().iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # it has ended meanwhile
                continue
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A sound file: a source walks once from left to right."""
    path = tmp_path / "walk.wav"
    soundfile.write(path, Scene(RATE, WALK).frames(round(RATE * WALK)).T, RATE, "PCM_32")
    return path


def test_the_same_picture_after_everything_was_killed(walk: Path, tmp_path: Path) -> None:
    graph = Graph(f"http://127.0.0.1:{free_port()}", tmp_path)
    setup = tmp_path / "setup.yaml"
    with browser(tmp_path) as window:
        window.resize(1300, 900)
        with up(graph) as (process, live, genomixd):
            window.driver.get(live.url)
            window.press("[data-span='5']")
            window.until("return document.body.textContent.includes('Start the sound first')")
            window.run("document.querySelector('#source input').value = arguments[0]", f"file:{walk}?loop=1")
            window.press("#source .primary")
            window.press("#pictures .empty .primary")
            window.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="pictures")
            window.run(CHOOSE, "ild_0")
            window.until("return Boolean(document.querySelector('[data-parameter=ild_wSizeSec]'))")
            window.run(WRITE, "ild_wSizeSec", "0.0475")
            wait_for(lambda: '"0.0475"' in json.dumps(processors(genomixd)), what="the change")
            before = processors(genomixd)
            seen = Seen(window)
            window.press("#save-setup")
            wait_for(setup.exists, what="the setup")
            for pid in family(process.pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        window.until("return document.querySelector('#state').textContent === 'no connection to the server'")
        window.driver.get("about:blank")
        window.problems()  # that nobody answers
        assert np.all(seen.lags[2:20] < 0) and np.all(seen.lags[30:48] > 0) and np.ptp(seen.lags) > 1.2e-3, seen.lags
        with up(graph, str(setup)) as (_, live, genomixd):
            assert processors(genomixd) == before
            window.driver.get(live.url)
            now = Seen(window)
            assert now.limits == seen.limits
            away, other = (np.abs(now.tints - np.roll(seen.tints, by, axis=0)).mean() for by in (0, 25))
            assert away < 0.1 * other
            assert np.abs(now.lags - seen.lags)[2:48].max() < 5e-5
            assert window.problems() == []
