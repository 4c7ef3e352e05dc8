"""Numbers of the plugin of docs/own-representation.md, and the rules of a declaration."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.harness import ROOT

from .support import SHORT, python

TEXT = (ROOT / "docs" / "own-representation.md").read_text("utf-8")
PYTHON_BLOCKS = re.findall(r"^```python\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the representation of the document."""
    path = tmp_path / "my representations"
    path.mkdir()
    (path / "zerocrossings.py").write_text(PYTHON_BLOCKS[0])
    return path


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


RULES = """
from rosafe.plugin import Parameter, Representation, Stage, variant
from rosafe.representations.gammatone import Filterbank
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
