"""A complete session: start, capture, parameter change, saved setup, all processes killed, and the same plots again."""

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

from rosafe.audio.devices.scene import Scene
from tests.harness import Graph, Process, free_port, proc, wait_for
from tests.web.live.browser import Browser, browser
from tests.web.live.world import Live

RATE, WALK = 16000, 2.0
LABELS = 110  # CSS pixels with labels at the left of a plot

# The pixels of the plots, and the time of the audio that they show.
PIXELS = """
const plots = arguments[0].map((kind) => {
  const canvas = document.querySelector(`canvas[data-kind="${kind}"]`);
  if (!canvas?.dataset.plot) return null;
  const plot = JSON.parse(canvas.dataset.plot);
  const [x0, y0, w, h] = [plot.x, plot.y, plot.w, plot.h].map(Math.round);
  return { plot, w, h, data: Array.from(canvas.getContext("2d").getImageData(x0, y0, w, h).data) };
});
return plots.every(Boolean) ? plots : null;
"""
KINDS = ("ild", "crossCorrelation")
# The time of the audio at the right edge of all plots.
END = """Math.min(...arguments[0].map((kind) => {
  const canvas = document.querySelector(`canvas[data-kind="${kind}"]`);
  return JSON.parse(canvas?.dataset.plot ?? "{}").to;
}))"""
CHOOSE = "[...document.querySelectorAll('.node .name')].find((one) => one.textContent.startsWith(arguments[0])).click()"
WRITE = """
const one = document.querySelector(`[data-parameter=${arguments[0]}]`);
one.value = arguments[1];
one.dispatchEvent(new Event("change"));
"""


@contextmanager
def up(graph: Graph, *arguments: str) -> Iterator[tuple[Process, Live, str]]:
    """Start `rosafe up --live`; yield the process, the page and the URL of genomixd."""
    ports = ("--port", str(free_port()), "--live-port", str(free_port()))
    with graph.start("rosafe", "up", *arguments, "--live", "--no-browser", *ports) as process:
        live = Live(process)
        yield process, live, f"http://127.0.0.1:{ports[1]}"


def processors(genomixd: str) -> Any:
    """Return the answer of getProcessors."""
    with urllib.request.urlopen(f"{genomixd}/call/rosAFE/getProcessors") as answer:
        return json.load(answer)["processors"]


class Observation:
    """The colours of the level differences and the brightest lag of the correlation during one walk, by its phase."""

    def __init__(self, window: Browser) -> None:
        start = float(window.until(f"return {END}", KINDS, what="plots"))
        window.until(f"return {END} > arguments[1]", KINDS, start + WALK + 0.2, what="one walk in the plots")
        ild, correlation = window.run(PIXELS, KINDS)
        self.limits = ild["plot"]["low"], ild["plot"]["high"]
        self.tints = by_phase(ild, start)  # (phases, rows, 3)
        axes, colours = correlation["plot"], by_phase(correlation, start)
        brightness = colours.sum(axis=2)
        weights = np.maximum(brightness - 0.9 * brightness.max(axis=1, keepdims=True), 0.0)
        rows = weights @ np.arange(colours.shape[1]) / weights.sum(axis=1)
        self.lags = axes["last"] - (rows + 0.5) / colours.shape[1] * (axes["last"] - axes["first"])  # s


def by_phase(plotted: Any, start: float) -> np.ndarray:
    """Return the mean colours of a plot since a time of the audio, by the phase of the walk."""
    plot, width = plotted["plot"], plotted["w"]
    pixels = np.array(plotted["data"], float).reshape(plotted["h"], width, 4)[..., :3]
    times = plot["to"] - (width - 0.5 - np.arange(width)) / width * (plot["to"] - plot["from"])
    phase = np.round(np.mod(times, WALK) / WALK * 50).astype(int) % 50
    selected = (times > start) & (np.arange(width) > LABELS)
    return np.array([pixels[:, selected & (phase == one)].mean(axis=1) for one in range(50)])


def process_tree(pid: int) -> list[int]:
    """Return a process and all its descendants."""
    parents = {}
    for entry in proc().iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # it has ended
                continue
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Write a sound file in which a source moves once from left to right."""
    path = tmp_path / "walk.wav"
    soundfile.write(path, Scene(RATE, WALK).frames(round(RATE * WALK)).T, RATE, "PCM_32")
    return path


@pytest.mark.exploration
def test_the_plots_are_the_same_after_all_processes_were_killed(walk: Path, tmp_path: Path) -> None:
    graph = Graph(f"http://127.0.0.1:{free_port()}", tmp_path)
    setup = tmp_path / "setup.yaml"
    with browser(tmp_path) as window:
        window.resize(1300, 900)
        with up(graph) as (process, live, genomixd):
            window.driver.get(live.url)
            window.press("[data-span='5']")
            window.until("return document.body.textContent.includes('Start the capture first')")
            window.run("document.querySelector('#source input').value = arguments[0]", f"file:{walk}?loop=1")
            window.press("#source .primary")
            window.press("#plots .empty .primary")
            window.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="plots")
            window.run(CHOOSE, "ild_0")
            window.until("return Boolean(document.querySelector('[data-parameter=ild_wSizeSec]'))")
            window.run(WRITE, "ild_wSizeSec", "0.0475")
            wait_for(lambda: '"0.0475"' in json.dumps(processors(genomixd)), what="the change")
            before = processors(genomixd)
            seen = Observation(window)
            window.press("#save-setup")
            wait_for(setup.exists, what="the setup")
            for pid in process_tree(process.pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        window.until("return document.querySelector('#state').textContent === 'no connection to the server'")
        window.driver.get("about:blank")
        window.problems()  # discard the connection errors
        assert np.all(seen.lags[2:20] < 0) and np.all(seen.lags[30:48] > 0) and np.ptp(seen.lags) > 1.2e-3, seen.lags
        with up(graph, str(setup)) as (_, live, genomixd):
            assert processors(genomixd) == before
            window.driver.get(live.url)
            again = Observation(window)
            assert again.limits == seen.limits
            same, opposite = (np.abs(again.tints - np.roll(seen.tints, by, axis=0)).mean() for by in (0, 25))
            assert same < 0.1 * opposite
            assert np.abs(again.lags - seen.lags)[2:48].max() < 5e-5
            assert window.problems() == []
