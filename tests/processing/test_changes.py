"""Changes of every parameter during the sound: which processors are affected; tests/dsp has the resets of stages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from tests.dsp.bare import cut
from tests.representations.chain import core_chain

RATE = 16000.0
BLOCK, BLOCKS = 700, 5
AT = 3  # the change is made before this block
SOUND = np.random.default_rng(0).standard_normal((2, BLOCK * BLOCKS)) * [[0.1], [0.03]] + 0.05

# so that every parameter matters
BASE: dict[str, Any] = {
    "in_doNormalize": True,
    "in_normalizeValue": 2,
    "pp_bRemoveDC": True,
    "pp_bPreEmphasis": True,
    "pp_bNormalizeRMS": True,
    "pp_intTimeSecRMS": 0.01,
    "pp_bLevelScaling": True,
    "pp_refSPLdB": 90.0,
    "pp_bMiddleEarFiltering": True,
    "fb_lowFreqHz": 100.0,
    "fb_highFreqHz": 4000.0,
    "fb_nERBs": 6.0,
}
CHANGES: dict[str, Any] = {
    "in_doNormalize": False,
    "in_normalizeValue": 3,
    "pp_bRemoveDC": False,
    "pp_cutoffHzDC": 50.0,
    "pp_bPreEmphasis": False,
    "pp_coefPreEmphasis": 0.5,
    "pp_bNormalizeRMS": False,
    "pp_intTimeSecRMS": 0.05,
    "pp_bLevelScaling": False,
    "pp_refSPLdB": 60.0,
    "pp_bMiddleEarFiltering": False,
    "pp_middleEarModel": "lopezpoveda",
    "pp_bUnityComp": True,
    "fb_type": "drnl",
    "fb_lowFreqHz": 200.0,
    "fb_highFreqHz": 3000.0,
    "fb_nERBs": 8.0,
    "fb_nChannels": 3,
    "fb_cfHz": [1000.0, 500.0],
    "fb_nGamma": 2,
    "fb_bwERBs": 2.0,
    "ihc_method": "hilbert",
    "rm_scaling": "magnitude",
    "rm_decaySec": 0.1,
    "cc_maxDelaySec": 0.002,
    **{f"{prefix}_wname": "hamming" for prefix in ("ild", "rm", "cc")},
    **{f"{prefix}_wSizeSec": 0.03 for prefix in ("ild", "rm", "cc")},
    **{f"{prefix}_hSizeSec": 0.007 for prefix in ("ild", "rm", "cc")},
}
KIND_OF = {parameter.name: kind.kind for kind in CORE_REPRESENTATIONS.values() for parameter in kind.parameters}


def below(kind: str) -> set[str]:
    """Return a kind and all kinds that depend on it."""
    return {kind}.union(*(below(child.kind) for child in CORE_REPRESENTATIONS.values() if child.parent == kind))


@pytest.fixture(scope="module")
def unchanged() -> dict[str, Any]:
    return rosafe.process(SOUND, RATE, parameters=BASE, block_frames=BLOCK)


@pytest.mark.parametrize("name", KIND_OF)
def test_a_change_of(name: str, unchanged: dict[str, Any]) -> None:
    kind = KIND_OF[name]
    got = rosafe.process(SOUND, RATE, parameters=BASE, block_frames=BLOCK, modifications=[(AT, name, CHANGES[name])])
    outputs = core_chain(RATE, BASE).blocks(cut(SOUND, BLOCK), [(AT, name, CHANGES[name])])
    for other in CORE_REPRESENTATIONS:
        whole = unchanged[other]
        if other not in below(kind):
            np.testing.assert_array_equal(got[other], whole, err_msg=f"{other} has noticed")
            continue
        frames = AT * BLOCK if whole.shape[-1] == SOUND.shape[1] else (AT * BLOCK - 320) // 160 + 1
        np.testing.assert_array_equal(inner(other, got[other], whole.shape)[..., :frames], whole[..., :frames])
        assert got[other].shape != whole.shape or not np.array_equal(got[other], whole), f"no effect on {other}"
        after = np.concatenate([output[other] for output in outputs[AT:]], axis=-1)
        np.testing.assert_array_equal(inner(other, got[other], after.shape)[..., -after.shape[-1] :], after)


def inner(kind: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the part of an output for this shape; the rest belongs to other numbers of channels and lags."""
    place = [slice(0, size) for size in shape[:-1]]
    if kind == "crossCorrelation":
        first = (array.shape[1] - shape[1]) // 2
        place[1] = slice(first, first + shape[1])
    return array[tuple(place)]


def test_every_parameter_is_covered() -> None:
    assert CHANGES.keys() == KIND_OF.keys()
