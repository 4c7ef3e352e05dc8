"""Nine plugins work in all interfaces: Python, ROS, HTTP, Tcl, setups and the live page."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.harness import wait_for
from tests.plugins.stages import FRAMED, PLAIN, SAMPLES, Fault, text_of
from tests.plugins.support import python, world_with
from tests.plugins.test_documents import plugins
from tests.web.genomix import world as worlds
from tests.web.live.world import live, page

OF_THE_PAGE = ("zeroCrossings", "bands", "slowRatemap")
WITH_HOOKS = ("everyNth", "meanSquare", "fineIld")
SHORT = {"factors": PLAIN, "samples": SAMPLES, "means": FRAMED}
KINDS = (*OF_THE_PAGE, *WITH_HOOKS, *SHORT)
NAMES = {kind: f"{'nth' if kind == 'everyNth' else kind}_0" for kind in KINDS}  # of the processors that are requested


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the nine plugins."""
    path = tmp_path_factory.mktemp("plugins") / "my plugins"
    path.mkdir()
    for name in ("zerocrossings.py", "bands.py", "slowratemap.py"):
        (path / name).write_text(plugins()[name])
    hooks = Path(__file__).with_name("plugins_with_hooks") / "hooks.py"
    (path / hooks.name).write_text(hooks.read_text())
    for kind, text in SHORT.items():
        plugin = text_of(Fault(text, "", "")).replace('kind="mine"', f'kind="{kind}"')
        plugin = plugin.replace("my_", f"{kind}_").replace('"my"', f'"{kind}"')
        (path / f"{kind}.py").write_text(plugin)
    return path


def test_in_python(folder: Path) -> None:
    code = f"""
import json, numpy as np, rosafe
from rosafe.interface import KINDS
sound = 0.1 * np.random.default_rng(1).standard_normal((2, 8000))
names = {KINDS!r}
result = rosafe.process(sound, 16000, outputs=names)
stream = rosafe.Stream(16000, outputs=names)
blocks = [stream.process(block) for block in np.array_split(sound, 7, axis=1)]
outputs = [output for name in names for output in KINDS[name].outputs]
joined = {{name: np.concatenate([block[name] for block in blocks], axis=-1) for name in outputs}}
print(json.dumps({{name: bool(np.allclose(joined[name], result[name]) and result[name].any()) for name in outputs}}))
"""
    done = python(code, folder)
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout)
    assert all(reported.values()) and len(reported) == len(KINDS) + 2


@pytest.fixture(scope="module")
def world(folder: Path) -> Iterator[worlds.World]:
    """Return nodes and genomixd in an environment with the plugins and a broken one."""
    (folder / "broken.py").write_text("import nothing_like_this")
    with world_with(folder) as this:
        yield this
    (folder / "broken.py").unlink()


@pytest.mark.ros
def test_in_a_running_node(world: worlds.World, folder: Path) -> None:
    # the live page creates and plots each of them
    async def scenario(address: Any) -> None:
        async with page(address) as client:
            for kind in KINDS:
                answer: dict[str, Any] = {}
                while "ok" not in answer:  # until sound has arrived
                    answer = await client.request("build", representation=kind, nFramesPerBlock=2000)
                    assert "ok" in answer or "e_noData" in answer["error"], answer
            views = await client.subscribe(*({"what": "picture", "name": name} for name in NAMES.values()))
            while not all(client.pieces.get(view["number"]) for view in views):
                await client.receive()

    with live(world.graph) as shown:
        asyncio.run(asyncio.wait_for(scenario(shown), 120))

    # HTTP and ROS
    there = {p["name"]: p for p in world.http.call("rosAFE/getProcessors")["processors"]}
    topics = world.graph.topics()
    for name in NAMES.values():
        assert there[name]["topic"] in topics
        parts = world.http.call("rosAFE/getRepresentation", [name])["parts"]
        assert parts and all(part["lastFrameIndex"] > 0 for part in parts)
    answer = world.graph.run("rosservice", "call", "/rosAFE/getDependencies", "{nameProc: meanSquare_0}").stdout
    assert "nth_0" in answer

    # Tcl
    lines = world.lines(
        "set g [::genomix::connect $address]\n$g load rosAFE\n"
        + "\n".join(
            f"show [dict exists [::rosAFE::{kind}Port {name}] {kind}Port sampleRate]" for kind, name in NAMES.items()
        )
    )
    assert lines[-len(KINDS) :] == ["1"] * len(KINDS)

    # setups
    setup = folder.parent / "setup.yaml"
    world.graph.run("rosafe", "setup", "save", str(setup))
    world.http.call("rosAFE/Stop")
    assert world.http.call("rosAFE/getProcessors")["processors"] == []
    world.graph.run("rosafe", "setup", "load", str(setup))
    wait_for(lambda: set(NAMES.values()) <= {p["name"] for p in world.http.call("rosAFE/getProcessors")["processors"]})
    world.http.call("rosAFE/Stop")


@pytest.mark.ros
def test_a_broken_one_is_in_the_log_and_in_doctor(world: worlds.World) -> None:
    """The node continues; log and doctor contain the file and the error."""
    log = "".join(path.read_text("utf-8", "replace") for path in (world.graph.home / ".ros").rglob("*.log"))
    assert "broken.py: ModuleNotFoundError" in log
    reported = world.graph.run("rosafe", "doctor", check=False)
    assert "broken.py: ModuleNotFoundError" in reported.stdout
