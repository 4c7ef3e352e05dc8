"""Plugins that were written for 0.2 run unchanged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .support import SHORT, python

PLUGINS = Path(__file__).with_name("plugins_0_2")


@pytest.mark.exploration
def test_members_that_the_tree_uses() -> None:
    code = """
from rosafe.representations import PROBLEMS, STAGES
from rosafe.testing import check_representation
assert not PROBLEMS, PROBLEMS
for kind in ("zeroCrossings", "everyNth", "meanSquare", "fineIld"):
    check_representation(STAGES[kind], seconds=0.1)
"""
    done = python(SHORT + code, PLUGINS)
    assert done.returncode == 0, done.stderr


def test_their_results() -> None:
    """The results of rosafe.process and of Stream, with changes of the parameters of all methods."""
    code = """
import json, numpy as np, rosafe
sound = 0.1 * np.random.default_rng(1).standard_normal((2, 8000))
outputs = ["ihc", "everyNth", "meanSquare", "ild", "fineIld"]
whole = rosafe.process(sound, 16000, outputs=outputs, parameters={"fb_nChannels": 3})
nth = 2 * whole["ihc"][..., ::4]
frames = np.lib.stride_tricks.sliding_window_view(nth, 80, axis=-1)[..., ::40, :]
stream = rosafe.Stream(16000, outputs=["everyNth"], parameters={"fb_nChannels": 3})
first = stream.process(sound[:, :4000])["everyNth"]
stream.modify("ev_step", 8)
rest = stream.process(sound[:, 4000:])["everyNth"]
print(json.dumps({
    "nth": np.array_equal(whole["everyNth"], nth), "rate": whole["everyNth_frameRate"],
    "mean": np.allclose(whole["meanSquare_mean"], frames.mean((0, -1))),
    "square": np.allclose(whole["meanSquare_square"], (frames**2).mean((0, -1))),
    "variant": np.array_equal(whole["ild"], whole["fineIld"]),
    "first": np.array_equal(first, nth[..., :1000]), "rest": rest.shape[-1],
    "describe": stream.describe()["everyNth_frameRate"],
}))
"""
    done = python(code, PLUGINS)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {
        "nth": True,
        "rate": 4000.0,
        "mean": True,
        "square": True,
        "variant": True,
        "first": True,
        "rest": 500,
        "describe": 2000.0,
    }
