"""Plugins that fail or do not return in a running node: log, /diagnostics, `rosafe request`, live page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from rosafe.web.live.health import Health
from tests.harness import wait_for
from tests.plugins.stages import DERIVED, PLAIN, Fault, process, text_of
from tests.plugins.support import world_with
from tests.web.genomix import world as worlds

pytestmark = pytest.mark.ros

BELOW = Fault(PLAIN.replace('"ratemap"', '"breaks"'), "", "")


def gated(name: str, *lines: str) -> str:
    """Return a method with another behaviour after the file `name` exists."""
    return f"    import os\n\n    gate = os.path.join(os.path.dirname(__file__), '{name}')\n\n" + process(*lines)


PLUGINS = {
    "breaks": Fault(
        PLAIN,
        gated("broken", "if self.os.path.exists(self.gate):", "    raise OSError('no more')", "return block * 2"),
        "",
    ),
    "below": BELOW,
    "hangs": Fault(
        PLAIN, gated("free", "while not self.os.path.exists(self.gate):", "    np.sort(block)", "return block * 2"), ""
    ),
    "formless": Fault(
        PLAIN,
        gated("formless", "return block * 2")
        + "\n\n    @property\n    def output_format(self):"
        + "\n        if self.os.path.exists(self.gate):\n            raise OSError('no format')"
        + "\n        return self.input_format",
        "",
    ),
    "moody": Fault(
        PLAIN,
        gated("moody", "return block * 2")
        + "\n\n    @property\n    def derived(self):"
        + "\n        return {} if self.os.path.exists(self.gate) else {'my_count': 1}",
        "",
        DERIVED,
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the plugins and their control files."""
    path = tmp_path_factory.mktemp("plugins")
    for kind, fault in PLUGINS.items():
        text = text_of(fault).replace('kind="mine"', f'kind="{kind}"').replace("my_", f"{kind}_")
        (path / f"{kind}.py").write_text(text)
    return path


@pytest.fixture(scope="module")
def world(folder: Path) -> Iterator[worlds.World]:
    """Return nodes with sound of a scene and a tree down to the ratemap."""
    with world_with(folder) as this:
        wait_for(lambda: started(this))
        yield this


def started(world: worlds.World) -> bool:
    """Create the tree down to the ratemap; return False before sound has arrived."""
    try:
        world.http.call("rosAFE/request", {"representation": "ratemap", "nFramesPerBlock": 2000})
    except worlds.HttpError as problem:
        assert problem.ex == "::rosAFE::e_noData"
        return False
    return True


def health(world: worlds.World) -> DiagnosticStatus:
    """Return the status of the processors in the next message."""
    for text in world.graph.run("rostopic", "echo", "-n", "3", "/diagnostics").stdout.split("---\n"):
        for status in (yaml.safe_load(text) or {}).get("status", ()):
            if status["name"] == "rosAFE: processors":
                values = [KeyValue(str(v["key"]), str(v["value"])) for v in status["values"]]
                return DiagnosticStatus(status["level"], status["name"], status["message"], "", values)
    raise AssertionError("no status of the processors")


def log(world: worlds.World) -> str:
    """Return the logs of the nodes."""
    return "".join(path.read_text("utf-8", "replace") for path in (world.graph.home / ".ros").rglob("rosAFE*.log"))


def make(world: worlds.World, kind: str, name: str, parent: str) -> None:
    """Create a processor of `kind`."""
    world.http.send(f"rosAFE/{kind.capitalize()}Proc", {"name": name, "upperDepName": parent})
    wait_for(lambda: name in names(world))


def names(world: worlds.World) -> list[str]:
    """Return the names of all processors."""
    return [p["name"] for p in world.http.call("rosAFE/getProcessors")["processors"]]


def newest(world: worlds.World, name: str) -> Any:
    """Return the index of the newest frame of a processor."""
    return world.http.call("rosAFE/getRepresentation", [name])["parts"][0]["lastFrameIndex"]


def test_a_request_for_a_plugin_that_fails_gives_the_reason(world: worlds.World, folder: Path) -> None:
    (folder / "broken").touch()
    done = world.graph.run("rosafe", "request", "breaks", check=False)
    assert done.returncode == 1
    place = rf"{re.escape(str(folder))}/breaks.py:\d+"
    assert re.search(rf"breaks_0 \(breaks\) failed: plugin breaks \({place}\): process: OSError: no more", done.stderr)
    assert "Traceback" not in done.stderr
    assert "breaks_0" not in names(world)
    (folder / "broken").unlink()


def test_a_failure_is_an_error_with_the_names_of_the_children(world: worlds.World, folder: Path) -> None:
    make(world, "breaks", "first", "ratemap_0")
    make(world, "below", "second", "first")
    before = log(world).count("Traceback")
    (folder / "broken").touch()
    status = wait_for(lambda: (now := health(world)).level == DiagnosticStatus.ERROR and now)
    (folder / "broken").unlink()
    reported = next(v.value for v in status.values if v.key == "failed first")
    assert re.match(
        rf"first \(breaks\) failed: plugin breaks \({folder}/breaks.py:\d+\): process: OSError: no more", reported
    )
    assert "; ended with it: second" in reported
    assert {"first", "second"}.isdisjoint(names(world))
    text = log(world)
    assert text.count("Traceback") - before == 1
    assert len(re.findall(r"\[ERROR\].*first \(breaks\) failed", text)) == 1
    page = Health("/rosAFE", "/bass", "/localizer")
    page._subscriber = object()
    page._receive(DiagnosticArray(status=[status]))
    assert reported in page.status()["failures"]
    make(world, "breaks", "first", "ratemap_0")
    wait_for(lambda: not any(v.key == "failed first" for v in health(world).values))
    world.http.call("rosAFE/removeProcessor", ["first"])


def test_a_stage_that_does_not_return_is_reported_and_blocks_no_other(world: worlds.World, folder: Path) -> None:
    make(world, "hangs", "stuck", "ratemap_0")
    text = wait_for(lambda: next((v.value for v in health(world).values if v.key == "slow stuck"), ""))
    assert text.startswith(f"stuck (plugin hangs ({folder}/hangs.py)) is slow: one call has been running for")
    assert "stuck (plugin hangs" in log(world)
    index = newest(world, "ratemap_0")
    wait_for(lambda: newest(world, "ratemap_0") > index + 5 * 2000)
    world.http.call("rosAFE/removeProcessor", ["stuck"])
    assert "stuck" not in names(world)
    (folder / "free").touch()


def test_a_format_that_fails_ends_its_processor_alone(world: worlds.World, folder: Path) -> None:
    """Its port has a subscriber, so that its next frame decides when blocks are processed."""
    make(world, "formless", "rigid", "ratemap_0")
    with world.graph.start("rostopic", "echo", "/rosAFE/formlessPort/rigid/framesOnPort") as subscriber:
        wait_for(lambda: subscriber.out, what=lambda: str(subscriber))
        (folder / "formless").touch()
        failure = r"\[ERROR\].*rigid \(formless\) failed: plugin formless .*output_format: OSError: no format"
        wait_for(lambda: re.search(failure, log(world)), what=lambda: log(world))
    assert "rigid" not in names(world)
    assert "bad callback" not in log(world)
    index = newest(world, "ratemap_0")
    wait_for(lambda: newest(world, "ratemap_0") > index + 5 * 2000)


def test_values_that_cannot_be_reported_affect_no_other_processor(world: worlds.World, folder: Path) -> None:
    make(world, "moody", "other", "ratemap_0")
    (folder / "moody").touch()
    assert "ratemap_0" in names(world)
    assert "other" not in names(world)
    saved = world.graph.run("rosafe", "setup", "save", str(folder / "setup.yaml"))
    assert saved.returncode == 0
    assert "ratemap_0" in (folder / "setup.yaml").read_text()
    assert "derived: TypeError: derived: moody_count is missing" in log(world)
