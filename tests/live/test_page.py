"""The live page in a real browser: what is seen is what the robot hears, what is done reaches it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest

pytest.importorskip("selenium", reason="python3-selenium is not installed: scripts/install --tests")

from rosafe.bass.sources.scene import scene_azimuth
from tests.harness import Graph, Process, wait_for
from tests.live.browser import Browser, browser
from tests.live.world import Live, build, live

WALK = 5.0  # s

# Of each column of a picture: the row of the pixel that is nearest to a colour, and how near; and the plot's place.
TRACK = """
const canvas = document.querySelector(`canvas[data-kind="${arguments[0]}"]`);
if (!canvas?.dataset.plot) return null;
const plot = JSON.parse(canvas.dataset.plot);
const [x0, y0, w, h] = [plot.x, plot.y, plot.w, plot.h].map(Math.round);
const { data } = canvas.getContext("2d").getImageData(x0, y0, w, h);
const wanted = arguments[1];
const rows = [], far = [];
for (let x = 0; x < w; x += 1) {
  let best = Infinity, row = -1, count = 0;
  for (let y = 0; y < h; y += 1) {
    const at = 4 * (y * w + x);
    const d = Math.abs(data[at] - wanted[0]) + Math.abs(data[at + 1] - wanted[1]) + Math.abs(data[at + 2] - wanted[2]);
    if (d < best) { best = d; row = y; count = 1; } else if (d === best) { row += y; count += 1; }
  }
  rows.push(row / count); far.push(best);
}
return { plot, rows, far };
"""
# The mean of the colours of a picture's upper third, column by column.
TINT = """
const canvas = document.querySelector(`canvas[data-kind="${arguments[0]}"]`);
if (!canvas?.dataset.plot) return null;
const plot = JSON.parse(canvas.dataset.plot);
const [x0, y0, w, h] = [plot.x, plot.y, plot.w, plot.h / 3].map(Math.round);
const { data } = canvas.getContext("2d").getImageData(x0, y0, w, h);
const tints = [];
for (let x = 0; x < w; x += 1) {
  let sum = 0;
  for (let y = 0; y < h; y += 1) sum += data[4 * (y * w + x)] - data[4 * (y * w + x) + 2];
  tints.push(sum / h);
}
return { plot, tints };
"""


END = "JSON.parse(document.querySelector('canvas[data-kind=ild]').dataset.plot).to"
CHOOSE = "[...document.querySelectorAll('.node .name')].find((one) => one.textContent.startsWith(arguments[0])).click()"


def moments(plot: dict[str, float], columns: int) -> np.ndarray:
    """The time of the audio (s) that each column of pixels shows."""
    return plot["from"] + (np.arange(columns) + 0.5) / columns * (plot["to"] - plot["from"])


class World:
    """The robot, its page, and a browser that shows it."""

    def __init__(self, graph: Graph, live: Live, browser: Browser, stack: ExitStack) -> None:
        self.graph, self.live, self.browser = graph, live, browser
        self._bass = stack
        self.bass: Process | None = None

    def start_bass(self) -> None:
        """A bass-ros, in the place of one that was killed."""
        self._bass.close()
        self.bass = self._bass.enter_context(self.graph.node("bass-ros"))

    def rate(self) -> int:
        """Of the sound that the processors take."""
        return int(self.graph.call("/rosAFE/getSignals").signals.input[0].sampleRate)

    def processors(self) -> dict[str, dict[str, str]]:
        """Their parameters by name, as getProcessors tells."""
        told = self.graph.call("/rosAFE/getProcessors").processors
        return {one.name: {entry.name: entry.value for entry in one.parameters} for one in told}


@pytest.fixture(scope="module")
def world(graph: Graph) -> Iterator[World]:
    with ExitStack() as stack:
        bass = stack.enter_context(ExitStack())
        one = stack.enter_context(browser())
        world = World(graph, None, one, bass)  # type: ignore[arg-type]
        world.start_bass()
        stack.enter_context(graph.node("rosAFE-ros"))
        world.live = stack.enter_context(live(graph))
        yield world


@pytest.fixture
def shown(world: World) -> Browser:
    """The page, with sound and pictures."""
    if not world.processors():
        build(world.graph, world.live)
    browser = world.browser
    browser.resize(1300, 900)
    browser.driver.get(world.live.url)
    browser.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="pictures")
    return browser


def test_a_new_user_starts_everything_on_the_page(world: World) -> None:
    browser = world.browser
    browser.resize(1300, 900)
    browser.driver.get(world.live.url)
    browser.until("return document.body.textContent.includes('There are no processors yet')")
    assert "token" not in browser.driver.current_url
    browser.run("document.querySelector('#source input').value = 'file:/none/there.wav'")
    browser.press("#source .primary")
    refused = browser.until("return document.querySelector('#source .error').textContent")
    assert refused == "e_device: /none/there.wav: No such file or directory"
    browser.run(
        "document.querySelector('#source input').value = 'scene:?seconds=5';"
        "const [rate, chunk] = document.querySelectorAll('#source input[type=number]');"
        "rate.value = 16000; chunk.value = 1600;"
    )
    browser.press("#source .primary")
    browser.press("#pictures .empty .primary")
    browser.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="pictures")
    assert {"ratemap_0", "ild_0", "itd_0", "ic_0", "crosscorrelation_0"} <= world.processors().keys()
    assert browser.problems() == []


def test_the_source_goes_from_left_to_right(world: World, shown: Browser) -> None:
    """The direction's line is where the scene says; level differences have the colours of its side."""

    def whole() -> Any:
        found = shown.run(TRACK, "crossCorrelation", [255, 180, 84])
        return found if found and np.mean(np.array(found["far"]) < 40) > 0.9 else None

    found = wait_for(whole, what="a line across the picture")
    plot, rows = found["plot"], np.array(found["rows"])
    near = np.array(found["far"]) < 40
    half = (plot["last"] - plot["first"]) / 2 / 32  # less than half the distance of two lags
    lags = plot["last"] + half - (rows + 0.5) / plot["h"] * (plot["last"] - plot["first"] + 2 * half)
    truth = scene_azimuth(moments(plot, len(rows)), WALK)
    assert np.ptp(truth[near]) > 150
    assert np.corrcoef(lags[near], np.sin(np.radians(truth[near])))[0, 1] > 0.95
    tint = shown.run(TINT, "ild")
    tints = np.array(tint["tints"])
    when = tint["plot"]["from"] + (np.arange(len(tints)) + 0.5) / len(tints) * (
        tint["plot"]["to"] - tint["plot"]["from"]
    )
    side = scene_azimuth(when, WALK)
    assert np.mean(tints[side > 40]) > 40 and np.mean(tints[side < -40]) < -40  # red is right, blue is left
    assert shown.problems() == []


def test_pictures_move_and_a_frozen_one_does_not(shown: Browser) -> None:
    look = "return document.querySelector('canvas[data-kind=ild]').toDataURL()"
    first = shown.run(look)
    shown.until(f"return arguments[0] !== ({look.removeprefix('return ')})", first)
    shown.press("#freeze")
    # Three turns of the drawing later nothing has moved.
    still = """
    const done = arguments[arguments.length - 1];
    const canvas = document.querySelector('canvas[data-kind=ild]');
    const head = () => JSON.parse(canvas.dataset.plot).to;
    requestAnimationFrame(() => requestAnimationFrame(() => {
      const before = head();
      let left = 30;
      const step = () => (left -= 1) ? requestAnimationFrame(step) : done(head() - before);
      step();
    }));
    """
    assert shown.driver.execute_async_script(still) == 0
    shown.press("#freeze")
    at = shown.run(f"return {END}")
    shown.until(f"return {END} > arguments[0] + 0.5", at)


def test_the_cursor_reads_numbers_with_units(shown: Browser) -> None:
    shown.run(
        "const canvas = document.querySelector('canvas[data-kind=ild]'); const box = canvas.getBoundingClientRect();"
        "const place = { clientX: box.left + box.width * 0.8, clientY: box.top + 40 };"
        "canvas.dispatchEvent(new PointerEvent('pointermove', place))"
    )
    read = "return document.querySelector('canvas[data-kind=ild]').closest('.panel').querySelector('.read').textContent"

    def numbers() -> list[str]:
        words: list[str] = [word for word in shown.run(read).split(" · ") if " " in word]
        return words if len(words) == 3 else []

    words = wait_for(numbers, what="a read-out")
    assert [word.rsplit(" ", 1)[1] for word in words] == ["s", "kHz", "dB"], words


def test_a_parameter_changed_on_the_page_reaches_the_node(world: World, shown: Browser) -> None:
    shown.until("return document.querySelectorAll('.node .name').length > 4")
    shown.run(CHOOSE, "ratemap_0")
    write = (
        "const one = document.querySelector('[data-parameter=rm_decaySec]'); one.value = arguments[0];"
        "one.dispatchEvent(new Event('change'))"
    )
    shown.until("return Boolean(document.querySelector('[data-parameter=rm_decaySec]'))")
    shown.run(write, "0.0125")
    wait_for(lambda: world.processors()["ratemap_0"]["rm_decaySec"] == "0.0125", what="the change")
    shown.run(write, "-3")
    error = "return [...document.querySelectorAll('#processor .error')].map((one) => one.textContent).join('')"
    refused = shown.until(error)
    assert "e_badNewValue" in refused and "rm_decaySec" in refused
    assert world.processors()["ratemap_0"]["rm_decaySec"] == "0.0125"
    assert shown.run("return document.querySelector('[data-parameter=rm_decaySec]').value") == "0.0125"


def test_a_representation_is_added_shown_and_removed(world: World, shown: Browser) -> None:
    shown.press("#tree .more")
    shown.run(
        "const kind = document.querySelector('dialog select'); kind.value = 'onsetStrength';"
        "kind.dispatchEvent(new Event('change'));"
    )
    shown.press("dialog .primary")
    shown.until("return Boolean(document.querySelector('canvas[data-kind=onsetStrength][data-plot]'))")
    assert "onsetStrength_0" in world.processors()
    shown.run(CHOOSE, "onsetStrength_0")
    shown.press("#processor .more")
    shown.press("dialog .primary")
    wait_for(lambda: "onsetStrength_0" not in world.processors(), what="its end")
    shown.until("return !document.querySelector('canvas[data-kind=onsetStrength]')")


def test_one_picture_too_many_says_so(world: World, shown: Browser) -> None:
    names = [f"ild_{number}" for number in range(90, 104)]
    for name in names:
        assert world.graph.call("/rosAFE/IldProc", name=name, upperDepName="innerhaircell_0").genom_success
    count = "return document.querySelectorAll('.node').length"
    shown.until(f"{count} >= arguments[0]", len(names) + 8)
    shown.run("for (const one of document.querySelectorAll('.node .eye[aria-pressed=false]')) one.click()")
    last = "const [panel] = [...document.querySelectorAll('.panel canvas')].slice(-1); "
    shown.until(last + "return panel.title.includes('close another')")
    opened = "[...document.querySelectorAll('.node .eye[aria-pressed=true]')]"
    shown.run(f"for (const one of {opened}.slice(0, 12)) one.click()")
    shown.until(last + "panel.scrollIntoView(); return panel.title === '' && Boolean(panel.dataset.plot)")
    for name in names:
        assert world.graph.call("/rosAFE/removeProcessor", name=name).genom_success
    shown.run("localStorage.clear()")


def test_two_windows_and_a_reload(world: World, shown: Browser) -> None:
    driver = shown.driver
    first = driver.current_window_handle
    driver.switch_to.new_window("window")
    shown.resize(1300, 900)
    driver.get(world.live.url)
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="the second window")
    driver.refresh()
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="the second one again")
    assert "token" not in driver.current_url and driver.get_cookies() == []
    driver.close()
    driver.switch_to.window(first)
    at = shown.run(f"return {END}")
    shown.until(f"return {END} > arguments[0]", at)


def test_the_token_goes_to_no_other_server(world: World, shown: Browser) -> None:
    """To none of another port, and a window without it, or with an old one, is told what to do."""
    driver, heard = shown.driver, []

    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(str(self.headers) + self.path)
            self.send_response(200)
            self.end_headers()

    first = driver.current_window_handle
    with ThreadingHTTPServer(("127.0.0.1", 0), Other) as other:
        thread = threading.Thread(target=other.serve_forever)
        thread.start()
        try:
            driver.get(f"http://127.0.0.1:{other.server_port}/")
            assert shown.run("return sessionStorage.length + localStorage.length") == 0
        finally:
            other.shutdown()
            thread.join()
    assert heard and not any(world.live.token in one or "cookie" in one.lower() for one in heard)
    driver.switch_to.new_window("window")
    state = "return document.querySelector('#state').textContent.includes('open the URL')"
    driver.get(world.live.root)
    shown.until(state)
    shown.run("sessionStorage.setItem('rosafe.token', 'old')")
    driver.refresh()
    shown.until(state)
    assert shown.run("return document.querySelectorAll('.node').length") == 0
    driver.close()
    driver.switch_to.window(first)
    driver.get(world.live.root)  # the same window: it has the token still
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="pictures")
    shown.problems()  # the refused sockets


def test_malformed_sound_is_shown(world: World, shown: Browser) -> None:
    import rospy

    from bass.msg import binaudio_portStruct

    world.graph.client()
    message = binaudio_portStruct(sampleRate=16000, nChunksOnPort=1, nFramesPerChunk=2, left=[1, 2], right=[1])
    publisher = rospy.Publisher("/bass/Audio", binaudio_portStruct, queue_size=1)

    def told() -> bool:
        publisher.publish(message)
        return "2 left and 1 right samples" in str(shown.run("return document.querySelector('#state').textContent"))

    try:
        wait_for(told, what=lambda: str(world.live.process))
    finally:
        publisher.unregister()
    shown.until("return document.querySelector('#state').dataset.state === 'live'")
    assert "Traceback" not in world.live.process.err


@pytest.mark.parametrize("width", [380, 2560])
def test_every_width_has_room(shown: Browser, width: int) -> None:
    shown.resize(width, 800)
    shown.until("return innerWidth === arguments[0]", width)
    assert shown.run("return document.documentElement.scrollWidth") <= width
    for tab in ("control", "pictures"):
        if width < 900:
            shown.press(f"button[data-tab={tab}]")
        edges = "[...document.querySelectorAll('.card, .panel')].map((one) => one.getBoundingClientRect().right)"
        assert shown.run(f"return Math.max(...{edges})") <= width


def test_bass_killed_and_back(world: World, shown: Browser) -> None:
    assert world.bass is not None
    world.bass.stop(signal.SIGKILL)
    shown.until("return document.querySelector('#state').textContent.includes('bass is not running')")
    world.start_bass()
    shown.until("return document.querySelector('#state').textContent.includes('nothing is acquired')")
    shown.run(
        "document.querySelector('#source input').value = 'scene:?seconds=5';"
        "const [rate, chunk] = document.querySelectorAll('#source input[type=number]');"
        f"rate.value = {world.rate()}; chunk.value = 1600;"
    )
    shown.press("#source .primary")
    shown.until("return document.querySelector('#state').dataset.state === 'live'")
    at = shown.run(f"return {END}")
    wait_for(lambda: shown.run(f"return {END}") != at, what="pictures that move again")
