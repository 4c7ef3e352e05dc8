"""The representation of docs/own-representation.md; broken plugins are reported and left out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.harness import ROOT

from .support import SHORT, python

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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the representation of the document."""
    path = tmp_path / "my representations"
    path.mkdir()
    (path / "zerocrossings.py").write_text(PYTHON_BLOCKS[0])
    return path


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


RULES = """
from rosafe.plugin import Parameter, Representation, Stage, variant
from rosafe.representations.filterbank import Filterbank
from rosafe.representations.pitch import Pitch
from rosafe.representations.ratemap import Ratemap

Bank = variant(Filterbank, "bank", "bk")
Voice = variant(Pitch, "voice", "vo")
Sizes = variant(Ratemap, "sizes", "sz")


class Peak(Stage):
    REPRESENTATION = Representation(
        kind="peak", doc="Frequency of the greatest rate", parent="sizes", axes=("ear", "feature", "time"),
        features=("peak",), background="sizes",
        parameters=(Parameter("pk_one", "double", 1.0, "x", 0.0, 2.0),),
        advice=lambda values: f"pk_one: {values['sz_decaySec'] / values['pk_one']:g}" if values["pk_one"] < 1 else "",
    )

    def output_rows(self, rows):
        return (2, 1)

    def process(self, block, extra=None):
        import numpy as np
        return np.array(self.input_format.center_frequencies)[block.argmax(axis=1)][:, np.newaxis]


class OfBank(Stage):
    REPRESENTATION = Representation(kind="ofBank", doc="Squares", parent="bank", axes=("ear", "channel", "time"))

    def process(self, block, extra=None):
        return block * block
"""


def test_rules_of_a_declaration(tmp_path: Path) -> None:
    """Levels, backgrounds, warnings and channels of plugins, and of variants with their names of parameters."""
    (tmp_path / "rules.py").write_text(RULES)
    code = """
import warnings, numpy as np, rosafe
from matplotlib.figure import Figure
from rosafe.interface import KINDS
import sys, rosafe.processing.process
from rosafe.plugin import Stage
from rosafe.processing import chain
module = sys.modules["rosafe.processing.process"]
from rosafe.representations import STAGES
from rosafe.testing import check_representation

sound = 0.1 * np.random.default_rng(1).standard_normal((2, 16000))
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    result = rosafe.process(sound, 16000, outputs=["peak", "sizes", "voice"], parameters={
        "pk_one": 0.5, "sz_scaling": "magnitude"})
    rosafe.process(sound, 16000, outputs="peak", parameters={"pk_one": 0.0})
print(*(str(one.message)[:70] for one in caught), sep="\\n")
print(KINDS["sizes"].decibels({"sz_scaling": "magnitude"}), KINDS["sizes"].decibels({"sz_scaling": "power"}))
axes = Figure().add_subplot()
rosafe.plot(result, "peak", axes)
print(axes.get_title("left"), len(axes.get_images()), axes.get_images()[0].colorbar.ax.get_ylabel())
chain.MAX_FRAMES, module.workers_to_use = 4000, lambda: 2
banks = rosafe.process(sound, 16000, outputs=["bank", "gammatone"], parameters={"bk_nChannels": 40, "fb_nChannels": 40})
print(np.array_equal(banks["bank"], banks["gammatone"]), np.array_equal(banks["bk_cfHz"], banks["fb_cfHz"]))
check_representation(STAGES["ofBank"])
class Fixed(Stage):
    REPRESENTATION = STAGES["ofBank"].REPRESENTATION
    def process(self, block, extra=None):
        assert block.shape[1] != 40
        return block * block
try:
    check_representation(Fixed)
except AssertionError as problem:
    print(problem)
"""
    done = python(f"{SHORT}{code}", tmp_path)
    assert done.stdout.splitlines() == [
        "pk_one: 0.016",
        "vo_rangeHz, ac_wSizeSec: a window of 0.02 s contains fewer than 3 peri",
        "peak: advice: ZeroDivisionError: 'float division by zero'",
        "20.0 10.0",
        "peak, left ear over the sizes 1 dB re loudest",
        "True True",
        "40 channels during the sound: plugin ofBank (<string>:32): process: AssertionError:",
    ], done.stderr
