"""The memory of states counts like that of outputs, and is checked before it is allocated."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.dsp.signal_format import SignalFormat
from rosafe.interface import ComponentError
from rosafe.representations import STAGES
from rosafe.tree import sizes
from rosafe.tree.tree import Tree

from .support import Feed

RATE = 16000.0
CHANNELS = 20
FREQUENCIES = tuple(np.geomspace(80.0, 7000.0, CHANNELS))
FRAMES = SignalFormat(RATE, 100.0, True, 160, 320, FREQUENCIES)
SOUND = SignalFormat(RATE, RATE, False, 1, 1, FREQUENCIES)


@pytest.mark.parametrize(
    ("kind", "given", "parameters", "blocks"),
    [
        ("onsetMap", FRAMES, {"trm_minSpread": 1000, "trm_fuseWithinSec": 5.0}, [100] * 60),
        ("offsetMap", FRAMES, {}, [100] * 20),
        ("gabor", FRAMES, {}, [50] * 30),
        ("precedence", SOUND, {"prec_wSizeSec": 0.5}, [400] * 60),
        ("amsFeatures", SOUND, {"ams_dsRatio": 1, "ams_wSizeSec": 0.5}, [400] * 80),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_stage_keeps_the_memory_that_it_declares(
    kind: str, given: SignalFormat, parameters: dict[str, Any], blocks: list[int]
) -> None:
    rng = np.random.default_rng(0)
    STAGES[kind](given, **parameters).process(
        *arguments(kind, rng, 50)
    )  # allocate tables that all stages of this kind share
    tracemalloc.start()
    try:
        stage = STAGES[kind](given, **parameters)
        for number in blocks:
            stage.process(*arguments(kind, rng, number))
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    declared = sizes.state_size(stage, (2, CHANNELS))
    window = 2 * 8.0 * 2 * CHANNELS * (stage.output_format.window - given.window) / given.hop  # buffered input
    assert kept <= 1.05 * (declared + window) + 200_000
    assert declared <= 6 * kept


def arguments(kind: str, rng: np.random.Generator, number: int) -> list[Any]:
    block = rng.random((2, CHANNELS, number))
    return [block, block] if kind.endswith("Map") else [block]


MANY = {"fb_nChannels": 1000, "fb_highFreqHz": 7000.0}


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("onsetMap", {"trm_fuseWithinSec": 10.0, "rm_hSizeSec": 0.001}),
        ("gabor", {"rm_hSizeSec": 0.001}),
        ("amsFeatures", {"ams_wSizeSec": 1.0}),
    ],
)
def test_states_that_are_too_large(kind: str, parameters: dict[str, Any]) -> None:
    """They are rejected before they are allocated."""
    tracemalloc.start()
    try:
        text = f"{kind}: expected at most 1024 MiB, got [0-9]+ MiB for the state of 2x1000 values; take fewer channels"
        with pytest.raises(ValueError, match=text):
            rosafe.process(np.zeros((2, 1600)), RATE, parameters={**MANY, **parameters}, outputs=[kind])
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def test_the_autocorrelation_of_many_channels(tree: Tree, feed: Feed) -> None:
    """In a running tree, ten seconds of its output are limited. Offline, the output is as long as the sound."""
    tree.add_input("input", feed, 160, 1.0, 10.0)
    for kind, parent in (("preProc", "input"), ("gammatone", "preProc"), ("ihc", "gammatone")):
        tree.add(kind, kind, parent, {"fb_nChannels": 256, "fb_highFreqHz": 7000.0} if kind == "gammatone" else {})
    text = "expected at most 1024 MiB, got 1246 MiB for 10 s of 2x256x319 values at 100 Hz"
    with pytest.raises(ComponentError, match=text) as raised:
        tree.add("autocorrelation", "autocorrelation", "ihc")
    assert raised.value.ex == "::rosAFE::e_badNewValue"
    assert [p.name for p in tree.processors] == ["input", "preProc", "gammatone", "ihc"]


def test_states_have_their_share_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each state alone is accepted, all together are not."""
    stage, rows = STAGES["gabor"](FRAMES), (2, CHANNELS)
    one = sizes.total_size(stage, rows, 1.0)
    assert one == sizes.state_size(stage, rows) + sizes.output_size(stage, rows, 1.0)
    monkeypatch.setattr(sizes, "machine_memory", lambda: int(one * 3.5 / sizes.MAX_MEMORY_FRACTION))
    sizes.check_all([one] * 3, 1.0)
    with pytest.raises(ValueError, match=r"4 processors: expected at most .* \(50% of this machine's memory\), got"):
        sizes.check_all([one] * 4, 1.0)
