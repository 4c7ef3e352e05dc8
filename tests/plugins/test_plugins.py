"""The representation of docs/own-representation.md in all interfaces; broken plugins are reported and left out."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from tests.genomix import world as worlds
from tests.harness import ROOT, wait_for

from .support import python

TEXT = (ROOT / "docs" / "own-representation.md").read_text("utf-8")
PYTHON_BLOCKS = re.findall(r"^```python\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)

BROKEN = {
    "no_such_import.py": ("import nothing_like_this", "ModuleNotFoundError"),
    "syntax.py": ("class :", "SyntaxError"),
    "leaves.py": ("import sys; sys.exit(3)", "SystemExit"),
    "declared_wrong.py": (
        "from rosafe.declarations.representation import Representation\n"
        "Representation(kind='x', doc='x', parent='ihc', axes=('channel',))\n",
        "time last",
    ),
}
TAKEN = """
from rosafe.dsp.stage import Stage
from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation


class Taken(Stage):
    REPRESENTATION = Representation(kind={kind!r}, doc="x", parent={parent!r}, axes=("ear", "channel", "time"),
        parameters=(Parameter({parameter!r}, "double", 1.0, "x", 0.0, 2.0),))

    def process(self, block, extra=None):
        return block.copy()
"""
CLASHES = {
    "same_kind.py": (("ild", "ihc", "mine_x"), "ild has 'ild' already"),
    "same_word.py": (("Ratemap", "ihc", "mine_x"), "ratemap has 'Ratemap' already"),
    "orphan.py": (("mine", "nobody", "mine_x"), "got 'nobody'"),
    "same_parameter.py": (("mine", "ihc", "fb_nERBs"), "'fb_nERBs'"),
}


def example(parent: Path) -> Path:
    """Create a folder with the representation of the document."""
    path = parent / "my representations"
    path.mkdir()
    (path / "zerocrossings.py").write_text(PYTHON_BLOCKS[0])
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the representation of the document."""
    return example(tmp_path)


def test_the_example_is_short() -> None:
    assert len(PYTHON_BLOCKS[0].splitlines()) < 40


def test_its_output(folder: Path) -> None:
    shown = python(PYTHON_BLOCKS[1], folder).stdout
    assert shown.startswith("(2, 31, 96) 100")


def test_its_results(folder: Path) -> None:
    """A sine crosses zero twice a period."""
    code = """
import json, numpy as np, rosafe
sine = np.sin(2 * np.pi * 500 * np.arange(16000) / 16000 + 0.1)
result = rosafe.process(
    np.stack((sine, 0 * sine)), 16000,
    parameters={"fb_cfHz": [500.0]}, outputs=["zeroCrossings"], block_frames=[7, 1600],
    modifications=[(6, "zc_threshold", 1.0)],
)
print(json.dumps([result["zeroCrossings"][:, 0, k].tolist() for k in (10, 90)]))
"""
    (left, right), (no_left, _) = json.loads(python(code, folder).stdout)
    assert left == pytest.approx(1000, abs=60)
    assert right == no_left == 0


def test_a_stage_that_violates_the_rules_is_detected(folder: Path) -> None:
    """The check finds state across frames that depends on block boundaries, and a late error."""
    broken = PYTHON_BLOCKS[0].replace("crossing.sum(axis=-1)", "frames.shape[-2] + 0 * crossing.sum(axis=-1)")
    (folder / "zerocrossings.py").write_text(broken)
    done = python(next(code for code in PYTHON_BLOCKS if "check_representation" in code), folder)
    assert done.returncode == 1
    assert "AssertionError: the output depends on blocks" in done.stderr


def test_broken_plugins_are_reported_and_left_out(folder: Path) -> None:
    for name, (text, _) in BROKEN.items():
        (folder / name).write_text(text)
    for name, (words, _) in CLASHES.items():
        kind, parent, parameter = words
        (folder / name).write_text(TAKEN.format(kind=kind, parent=parent, parameter=parameter))
    code = "from rosafe.representations import KINDS, PROBLEMS; import json; print(json.dumps([list(KINDS), PROBLEMS]))"
    kinds, problems = json.loads(python(code, folder).stdout)
    assert kinds[-1] == "zeroCrossings"
    assert len(problems) == len(BROKEN) + len(CLASHES)
    reasons = [(name, why) for name, (_, why) in BROKEN.items()] + [(name, why) for name, (_, why) in CLASHES.items()]
    for name, why in reasons:
        (line,) = [problem for problem in problems if f"/{name}: " in problem]
        assert why in line
        assert "\n" not in line


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    done = python("from rosafe.representations import PROBLEMS; print(PROBLEMS)", tmp_path / "none")
    assert "expected a readable folder, got: No such file" in done.stdout


def test_an_installed_package(folder: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    (site / "crossings-1.0.dist-info").mkdir(parents=True)
    (site / "crossings.py").write_text(PYTHON_BLOCKS[0])
    (site / "crossings-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: crossings\nVersion: 1.0\n")
    points = "[rosafe.representations]\nzerocrossings = crossings\n"
    (site / "crossings-1.0.dist-info" / "entry_points.txt").write_text(points)
    code = "from rosafe.representations import KINDS, PROBLEMS; print(list(KINDS)[-1], PROBLEMS)"
    done = python(code, folder, ROSAFE_PLUGINS="", PYTHONPATH=f"{site}:{ROOT}")
    assert done.stdout == "zeroCrossings []\n"


# --- on the graph -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """Return nodes and genomixd in an environment with the plugin and a broken one."""
    folder = example(tmp_path_factory.mktemp("world"))
    (folder / "broken.py").write_text("import nothing_like_this")
    with mock.patch.dict(os.environ, ROSAFE_PLUGINS=str(folder)), worlds.world(folder.parent) as this:
        this.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
        this.http.send("bass/Acquire", ["scene:", 20000, 1000])
        wait_for(lambda: "/bass/Audio" in this.graph.topics())
        yield this


@pytest.mark.ros
def test_all_interfaces(world: worlds.World) -> None:
    def shell(command: str) -> str:
        return world.graph.run("bash", "-c", f". {ROOT}/scripts/env.sh && {command}").stdout

    changing = "rosservice call /rosAFE/modifyParameter \"{{nameProc: zc2, nameParam: zc_threshold, newValue: '{}'}}\""

    # one request for the whole chain, from the shell
    reported = json.loads(shell("rosafe request zeroCrossings zc_wSizeSec=0.05 fb_nChannels=4 --json"))
    assert reported["created"][-1] == "zeroCrossings_0"
    parent = reported["dependencies"][-2]

    # service, topic and modifyParameter with the commands of ROS
    assert "genom_success: True" in shell(
        f"rosservice call /rosAFE/ZeroCrossingsProc '{{name: zc2, upperDepName: {parent}, zc_hSizeSec: 0.02}}'"
    )
    assert "numberOfChannels: 4" in shell("rostopic echo -n 1 /rosAFE/zeroCrossingsPort/zc2")
    refused = shell(changing.format("2"))
    assert "genom_success: False" in refused
    assert "e_badNewValue" in refused
    assert "genom_success: True" in shell(changing.format("0.5"))

    # HTTP: processors, outputs, help
    (found,) = [p for p in world.http.call("rosAFE/getProcessors")["processors"] if p["name"] == "zc2"]
    assert (found["kind"], found["upperDepName"], found["rate"]) == ("zeroCrossings", parent, 50.0)
    assert (found["shape"], found["axes"]) == ([2, 4], ["ear", "channel"])
    assert {"name": "zc_threshold", "value": "0.5"} in found["parameters"]
    (part,) = wait_for(
        lambda: (
            (parts := world.http.call("rosAFE/getRepresentation", ["zeroCrossings_0"])["parts"])[0]["data"] and parts
        )
    )
    assert (part["name"], part["axes"]) == ("zeroCrossings", ["ear", "channel", "time"])
    assert max(part["data"]) > 100
    described = world.http.get("/describe/rosAFE")
    assert described["representations"]["zeroCrossings"]["parent"] == "gammatone"
    assert "zeroCrossings" not in world.http.call("rosAFE/getParameters")["parameters"]

    # Tcl: request, port, help
    lines = world.lines(f"""
        set g [::genomix::connect $address]
        $g load rosAFE
        ::rosAFE::ZeroCrossingsProc {{name zc3 upperDepName {parent}}} &
        while {{[catch {{::rosAFE::getDependencies {{nameProc zc3}}}}]}} {{after 20}}
        show [dict get [::rosAFE::zeroCrossingsPort zc3] zeroCrossingsPort numberOfChannels]
        show [string match *zc_threshold* [::rosAFE::ZeroCrossingsProc -h]]
    """)
    assert lines[-2:] == ["4", "1"]

    # and an action
    assert "/rosAFE/ZeroCrossingsProc/goal" in {topic for topic, _ in world.graph.readers()}


@pytest.mark.ros
def test_a_broken_one_is_in_the_log_and_in_doctor(world: worlds.World) -> None:
    """The node continues; log and doctor contain the file and the error."""
    log = "".join(path.read_text("utf-8", "replace") for path in (world.graph.home / ".ros").rglob("*.log"))
    assert "broken.py: ModuleNotFoundError" in log
    reported = world.graph.run("rosafe", "doctor", check=False)
    assert "broken.py: ModuleNotFoundError" in reported.stdout
