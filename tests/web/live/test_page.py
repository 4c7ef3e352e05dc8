"""The live page in a real browser: plots show the audio of the scene, and controls change the nodes."""

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

from rosafe.audio.devices.scene import Scene
from tests.harness import Graph, Process, wait_for
from tests.web.live.browser import Browser, browser
from tests.web.live.world import Live, build, live, localizer, script

SCENE = Scene(16000, seconds=5.0)
CIRCLE = script("circle")
READ = "document.querySelector('canvas[data-kind=directions]').closest('.panel').querySelector('.read').textContent"

TRACK = script("track")
TINT = script("tint")


END = "JSON.parse(document.querySelector('canvas[data-kind=ild]').dataset.plot).to"
CHOOSE = "[...document.querySelectorAll('.node .name')].find((one) => one.textContent.startsWith(arguments[0])).click()"


def choose(shown: Browser, name: str) -> None:
    """Select a processor; a second click would end the selection."""
    if shown.run("return document.querySelector('#processor:not([hidden]) h2')?.textContent") != name:
        shown.run(CHOOSE, name)


def column_times(plot: dict[str, float], columns: int) -> np.ndarray:
    """Return the time of the audio (s) of each column of pixels."""
    return plot["from"] + (np.arange(columns) + 0.5) / columns * (plot["to"] - plot["from"])


class World:
    """The nodes, the live page, and a browser that shows it."""

    def __init__(self, graph: Graph, live: Live, browser: Browser, stack: ExitStack) -> None:
        self.graph, self.live, self.browser = graph, live, browser
        self._bass = stack
        self.bass: Process | None = None

    def start_bass(self) -> None:
        """Start bass-ros, or start it again after it was killed."""
        self._bass.close()
        self.bass = self._bass.enter_context(self.graph.node("bass-ros"))

    def rate(self) -> int:
        """Return the sample rate of the processors' input."""
        return int(self.graph.call("/rosAFE/getSignals").signals.input[0].sampleRate)

    def processors(self) -> dict[str, dict[str, str]]:
        """Return the parameters of each processor by name."""
        answer = self.graph.call("/rosAFE/getProcessors").processors
        return {one.name: {entry.name: entry.value for entry in one.parameters} for one in answer}


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
    """Show the page with audio and plots; it is loaded again only if an earlier test has left it."""
    if not world.processors():
        build(world.graph, world.live)
    browser = world.browser
    browser.resize(1300, 900)
    if not browser.run("return location.href.startsWith(arguments[0])", world.live.root):
        browser.driver.get(world.live.url)
    browser.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="plots")
    browser.run("document.querySelector('canvas[data-kind=ild]').scrollIntoView()")  # only visible plots are drawn
    return browser


def test_capture_and_tree_are_started_on_the_page(world: World) -> None:
    browser = world.browser
    browser.resize(1300, 900)
    browser.driver.get(world.live.url)
    browser.until("return document.body.textContent.includes('There are no processors yet')")
    assert "token" not in browser.driver.current_url
    browser.run("document.querySelector('#source input').value = 'file:/none/there.wav'")
    browser.press("#source .primary")
    error = browser.until("return document.querySelector('#source .error').textContent")
    assert error == "e_device: /none/there.wav: No such file or directory"
    browser.run(
        "document.querySelector('#source input').value = 'scene:?seconds=5';"
        "const [rate, chunk] = document.querySelectorAll('#source input[type=number]');"
        "rate.value = 16000; chunk.value = 1600;"
    )
    browser.press("#source .primary")
    browser.press("#plots .empty .primary")
    browser.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="plots")
    assert {"ratemap_0", "ild_0", "itd_0", "ic_0", "crosscorrelation_0"} <= world.processors().keys()
    assert browser.problems() == []


def test_the_plots_follow_the_source(world: World, shown: Browser) -> None:
    """Level differences have the colour of the side of the source."""
    shown.press("[data-span='5']")

    def has_the_colours() -> bool:  # when the plot is filled
        tint = shown.run(TINT, "ild")
        if not tint or tint["plot"]["from"] < 0.5:
            return False
        tints = np.array(tint["tints"])
        side = SCENE.azimuth(column_times(tint["plot"], len(tints)))
        left, right = tints[side > 40], tints[side < -40]
        return bool(left.size and right.size and right.mean() > 40 and left.mean() < -40)  # red is right, blue is left

    wait_for(has_the_colours, what="colours across the plot")
    assert shown.problems() == []


def test_directions_are_shown_with_the_truth(world: World, shown: Browser) -> None:
    """The page says how to start the localizer. Then source, posterior and truth are at their azimuths."""
    hint = "document.querySelector('canvas[data-kind=directions]').title"
    shown.until(f"return {hint} === 'no localizer is running; start it with: rosafe localize'")
    with localizer(world.graph, offset=40.0):
        seen = wait_for(lambda: shown.run(CIRCLE), what="a source in the circle")
        (azimuth,), (truth,) = seen["present"], seen["truth"]
        assert azimuth - truth == pytest.approx(40, abs=1) and abs(truth) < 60
        for place, angle in ((seen["sourcePlace"], azimuth), (seen["truthPlace"], truth)):
            expected = -0.9 * np.sin(np.radians(angle)), -0.9 * np.cos(np.radians(angle))  # right and downwards
            assert place == pytest.approx(expected, abs=0.06)
        shown.until("return document.querySelector('#state').textContent.includes('live · source ')")
        shown.until(f"return {READ}.startsWith('source 7: ') && {READ}.endsWith('± 3° (0.90), speaks')")
        found = wait_for(lambda: line_of_source(shown), what="a line of the source")
    rows, near = np.array(found["rows"]), np.array(found["far"]) < 40
    azimuths = found["plot"]["high"] - (rows + 0.5) / found["plot"]["h"] * 360
    errors = np.abs(azimuths - SCENE.azimuth(column_times(found["plot"], len(rows))) - 40)[near]
    assert np.median(errors) < 5 and np.ptp(azimuths[near]) > 50
    shown.until(f"return {hint} !== ''")  # the localizer has ended
    shown.press("#directions")
    shown.until("return !document.querySelector('canvas[data-kind=directions]')")
    shown.press("#directions")
    shown.until("return Boolean(document.querySelector('canvas[data-kind=directions]'))")
    assert shown.problems() == []


def line_of_source(shown: Browser) -> Any:
    """Return the line of source 7 over time if it is 3.2 seconds long: 57 degrees also around a turn of the source."""
    found = shown.run(TRACK, "directions", [255, 180, 84])
    if not found:
        return None
    seconds = np.mean(np.array(found["far"]) < 40) * (found["plot"]["to"] - found["plot"]["from"])
    return found if seconds > 3.2 else None


def test_plots_scroll_until_they_are_frozen(shown: Browser) -> None:
    look = "return document.querySelector('canvas[data-kind=ild]').toDataURL()"
    first = shown.run(look)
    shown.until(f"return arguments[0] !== ({look.removeprefix('return ')})", first)
    shown.press("#freeze")
    # Nothing moves during the next 30 animation frames.
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


def test_the_readout_has_units(shown: Browser) -> None:
    shown.run(
        "const canvas = document.querySelector('canvas[data-kind=ild]'); const box = canvas.getBoundingClientRect();"
        "const place = { clientX: box.left + box.width * 0.8, clientY: box.top + 40 };"
        "canvas.dispatchEvent(new PointerEvent('pointermove', place))"
    )
    read = "return document.querySelector('canvas[data-kind=ild]').closest('.panel').querySelector('.read').textContent"

    def numbers() -> list[str]:
        parts: list[str] = [part for part in shown.run(read).split(" · ") if " " in part]
        return parts if len(parts) == 3 else []

    parts = wait_for(numbers, what="a readout")
    assert [part.rsplit(" ", 1)[1] for part in parts] == ["s", "kHz", "dB"], parts


def test_a_parameter_is_changed_on_the_page(world: World, shown: Browser) -> None:
    """A rejected value is replaced by the one accepted before, also if the page has not received the new tree."""
    shown.until("return document.querySelectorAll('.node .name').length > 4")
    choose(shown, "ratemap_0")
    field = "const one = document.querySelector('[data-parameter=rm_decaySec]');"
    write = f"{field} one.value = arguments[0]; one.dispatchEvent(new Event('change'));"
    accepted = """
    const done = arguments[arguments.length - 1], field = one.closest('.field');
    const check = () => { if (field.classList.contains('done')) done(true); };
    new MutationObserver(check).observe(field, { attributes: true });
    """
    shown.until(f"{field} return Boolean(one)")
    shown.run(
        "const parse = JSON.parse;"
        "JSON.parse = (text) => { const read = parse(text); return read?.about === 'tree' ? { about: '' } : read; };"
    )
    try:
        assert shown.driver.execute_async_script(write + accepted, "0.0125")
        assert world.processors()["ratemap_0"]["rm_decaySec"] == "0.0125"
        shown.run(write, "-3")
        error = "return [...document.querySelectorAll('#processor .error')].map((one) => one.textContent).join('')"
        message = shown.until(error)
        assert "e_badNewValue" in message and "rm_decaySec" in message
        assert world.processors()["ratemap_0"]["rm_decaySec"] == "0.0125"
        assert shown.run(f"{field} return one.value") == "0.0125"
    finally:
        shown.driver.get(world.live.url)  # it receives trees again


def test_a_field_with_the_focus_shows_the_value_of_the_component(world: World, shown: Browser) -> None:
    """Changes by other clients are shown, but do not replace a value that the user has typed, until it is rejected."""
    shown.until("return document.querySelectorAll('.node .name').length > 4")
    choose(shown, "ratemap_0")
    field = "const one = document.querySelector('[data-parameter=rm_decaySec]');"
    shown.until(f"{field} one?.focus(); return Boolean(one) && document.activeElement === one")

    def modify(name: str, value: str) -> None:
        values = {"nameProc": "ratemap_0", "nameParam": name, "newValue": value}
        assert world.graph.call("/rosAFE/modifyParameter", **values).genom_success

    modify("rm_decaySec", "0.016")
    shown.until(f"{field} return one.value === '0.016'")
    shown.run(f"{field} one.value = '-3'")
    modify("rm_decaySec", "0.02")
    modify("rm_scaling", "magnitude")
    shown.until("return document.querySelector('[data-parameter=rm_scaling]').value === 'magnitude'")
    assert shown.run(f"{field} return document.activeElement === one && one.value") == "-3"
    shown.run(f"{field} one.dispatchEvent(new Event('change'))")
    shown.until(f"{field} return one.value === '0.02'")
    assert "e_badNewValue" in shown.run(f"{field} return one.closest('.field').querySelector('.error').textContent")


def add(shown: Browser, kind: str) -> None:
    """Add a representation, and wait for its plot."""
    shown.press("#tree .more")
    shown.run(
        "const kind = document.querySelector('dialog select'); kind.value = arguments[0];"
        "kind.dispatchEvent(new Event('change'));",
        kind,
    )
    shown.press("dialog .primary")
    shown.until(  # only visible plots are drawn
        "const canvas = document.querySelector(`canvas[data-kind=${arguments[0]}]`);"
        "canvas?.scrollIntoView(); return Boolean(canvas?.dataset.plot)",
        kind,
    )


def test_a_representation_is_added_and_removed(world: World, shown: Browser) -> None:
    add(shown, "onsetStrength")
    assert "onsetStrength_0" in world.processors()
    panel = "document.querySelector('canvas[data-kind=onsetStrength]').closest('.panel')"
    shown.run(f"{panel}.querySelector('[aria-label=close]').click()")
    add(shown, "onsetStrength")  # it exists, so that the page has its tree before the answer
    assert "onsetStrength_1" not in world.processors()
    choose(shown, "onsetStrength_0")
    shown.press("#processor .more")
    shown.press("dialog .primary")
    wait_for(lambda: "onsetStrength_0" not in world.processors(), what="its removal")
    shown.until("return !document.querySelector('canvas[data-kind=onsetStrength]')")


def test_the_limit_of_open_plots_is_reported(world: World, shown: Browser) -> None:
    shown.run("localStorage.clear()")
    shown.driver.get(world.live.url)  # with the default plots
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="plots")
    names = [f"ild_{number}" for number in range(90, 104)]
    for name in names:
        assert world.graph.call("/rosAFE/IldProc", name=name, upperDepName="innerhaircell_0").genom_success
    count = "return document.querySelectorAll('.node').length"
    shown.until(f"{count} >= arguments[0]", len(names) + 8)
    shown.run("for (const one of document.querySelectorAll('.node .eye[aria-pressed=false]')) one.click()")
    last = "const [panel] = [...document.querySelectorAll('.panel canvas')].slice(-1); "
    shown.until(last + "panel.scrollIntoView(); return panel.title.includes('close another')")
    opened = "[...document.querySelectorAll('.node .eye[aria-pressed=true]')]"
    shown.run(f"for (const one of {opened}.slice(0, 12)) one.click()")
    shown.until(last + "panel.scrollIntoView(); return panel.title === '' && Boolean(panel.dataset.plot)")
    for name in names:
        assert world.graph.call("/rosAFE/removeProcessor", name=name).genom_success
    shown.run("localStorage.clear()")
    shown.driver.get(world.live.url)


def test_two_windows_and_a_reload(world: World, shown: Browser) -> None:
    driver = shown.driver
    first = driver.current_window_handle
    driver.switch_to.new_window("window")
    shown.resize(1300, 900)
    driver.get(world.live.url)
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="the second window")
    driver.refresh()
    shown.until(
        "return document.querySelectorAll('canvas[data-plot]').length >= 3", what="the second window after a reload"
    )
    assert "token" not in driver.current_url and driver.get_cookies() == []
    driver.close()
    driver.switch_to.window(first)
    at = shown.run(f"return {END}")
    shown.until(f"return {END} > arguments[0]", at)


def test_the_token_is_not_sent_to_other_servers(world: World, shown: Browser) -> None:
    """A server on another port does not get it; a window without it, or with an old one, shows what to do."""
    driver, requests = shown.driver, []

    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requests.append(str(self.headers) + self.path)
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
    assert requests and not any(world.live.token in one or "cookie" in one.lower() for one in requests)
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
    driver.get(world.live.root)  # this window still has the token
    shown.until("return document.querySelectorAll('canvas[data-plot]').length >= 3", what="plots")
    shown.problems()  # discard the errors of the rejected sockets


def test_malformed_audio_is_reported(world: World, shown: Browser) -> None:
    import rospy

    from bass.msg import binaudio_portStruct

    world.graph.client()
    message = binaudio_portStruct(sampleRate=16000, nChunksOnPort=1, nFramesPerChunk=2, left=[1, 2], right=[1])
    publisher = rospy.Publisher("/bass/Audio", binaudio_portStruct, queue_size=1)

    def reported() -> bool:
        publisher.publish(message)
        return "2 left and 1 right samples" in str(shown.run("return document.querySelector('#state').textContent"))

    try:
        wait_for(reported, what=lambda: str(world.live.process))
    finally:
        publisher.unregister()
    shown.until("return document.querySelector('#state').dataset.state === 'live'")
    assert "Traceback" not in world.live.process.err


@pytest.mark.parametrize("width", [380, 2560])
def test_nothing_exceeds_the_width_of_the_window(shown: Browser, width: int) -> None:
    shown.resize(width, 800)
    shown.until("return innerWidth === arguments[0]", width)
    assert shown.run("return document.documentElement.scrollWidth") <= width
    for tab in ("control", "plots"):
        if width < 900:
            shown.press(f"button[data-tab={tab}]")
        edges = "[...document.querySelectorAll('.card, .panel')].map((one) => one.getBoundingClientRect().right)"
        assert shown.run(f"return Math.max(...{edges})") <= width


@pytest.mark.exploration
def test_bass_is_killed_and_started_again(world: World, shown: Browser) -> None:
    assert world.bass is not None
    world.bass.stop(signal.SIGKILL)
    shown.until("return document.querySelector('#state').textContent.includes('bass is not running')")
    world.start_bass()
    shown.until("return document.querySelector('#state').textContent.includes('the capture is stopped')")
    shown.run(
        "document.querySelector('#source input').value = 'scene:?seconds=5';"
        "const [rate, chunk] = document.querySelectorAll('#source input[type=number]');"
        f"rate.value = {world.rate()}; chunk.value = 1600;"
    )
    shown.press("#source .primary")
    shown.until("return document.querySelector('#state').dataset.state === 'live'")
    at = shown.run(f"return {END}")
    wait_for(lambda: shown.run(f"return {END}") != at, what="plots that scroll again")
