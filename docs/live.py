"""Take the screenshots docs/live*.png: the live page with the built-in scene, in a real browser."""

from __future__ import annotations

import io
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rosafe.localization import model_cache
from rosafe.ros1.component import generate
from tests.harness import shared_graph, wait_for
from tests.web.live.browser import Browser, browser
from tests.web.live.world import live

SHOTS = (
    # name, width, height, theme, selected part
    ("live", 1440, 1000, "dark", ""),
    ("live-light", 1440, 1040, "light", "processor"),
    ("live-narrow", 380, 800, "dark", ""),
)
WALK = 10  # s; the source moves from left to right in this time, and back in the same time
FULL = (
    "const seen = [...document.querySelectorAll('canvas[data-plot]')]"
    ".filter((one) => one.getBoundingClientRect().top < innerHeight);"
    "const ends = seen.map((one) => JSON.parse(one.dataset.plot).to);"
    f"return ends.every((end) => end > arguments[0] && end % {2 * WALK} >= {WALK} && end % {2 * WALK} < {WALK + 0.5})"
)
CHOOSE = "[...document.querySelectorAll('.node .name')].find((one) => one.textContent.startsWith('ratemap_0')).click()"


def main(folder: Path) -> None:
    generate.ensure_messages()
    with tempfile.TemporaryDirectory() as home, ExitStack() as stack:
        graph = stack.enter_context(shared_graph(Path(home)))
        stack.enter_context(graph.node("bass-ros"))
        stack.enter_context(graph.node("rosAFE-ros"))
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        for kind in ("ratemap", "ild", "itd", "ic", "pitch"):
            graph.run("rosafe", "request", kind)
        models = str(model_cache.folder().parent)  # those of the user: learning one takes half a minute
        stack.enter_context(graph.start("rosafe", "localize", XDG_CACHE_HOME=models))
        graph.message("/localizer/sources", accept=lambda message: bool(message.sources), timeout=300.0)
        page = stack.enter_context(live(graph))
        window = stack.enter_context(browser())
        for name, width, height, theme, part in SHOTS:
            shoot(window, page.url, width, height, theme, part, folder / f"{name}.png")


def shoot(window: Browser, url: str, width: int, height: int, theme: str, part: str, path: Path) -> None:
    window.resize(width, height, theme)
    window.driver.get(url)
    window.until("return document.querySelectorAll('canvas[data-plot]').length >= 2")
    start = window.run("return JSON.parse(document.querySelector('canvas[data-plot]').dataset.plot).to")
    if part == "processor":
        window.run(CHOOSE)
    wait_for(lambda: window.run(FULL, start + WALK))
    image = Image.open(io.BytesIO(window.driver.get_screenshot_as_png())).convert("RGB")
    image.save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
