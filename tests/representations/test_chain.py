"""The helper for chains gives the same results as the chain of the seven original stages."""

from __future__ import annotations

import numpy as np
import pytest

from tests.dsp.bare import Chain as Original
from tests.dsp.bare import joined

from .chain import Chain, process

RATE = 16000.0
PARAMETERS = {"fb_nChannels": 3, "fb_highFreqHz": 4000.0}
CHANGES = [(1, "ihc_method", "hilbert"), (2, "rm_decaySec", 0.02), (3, "ihc_method", "dau")]


def test_the_originals_chain() -> None:
    sound = np.random.default_rng(3).standard_normal((2, 4000))
    got = process(sound, RATE, ["gammatone", "ratemap", "ild"], PARAMETERS, [1000, 0, 700, 1300], CHANGES)
    chain = Original(RATE, {**PARAMETERS, "in_doNormalize": False})
    expected = joined(chain.run(np.split(sound, [1000, 1000, 1700, 3000], axis=-1), CHANGES))
    for kind in ("gammatone", "ratemap", "ild"):
        np.testing.assert_array_equal(got[kind], expected[kind])
    assert got["ratemap_frameRate"] == 100.0
    assert got["fb_cfHz"] == chain.stages["gammatone"].parameters["fb_cfHz"]


def test_an_error_in_any_stage_changes_nothing() -> None:
    chain = Chain(RATE, ["ihc"], PARAMETERS)
    with pytest.raises(ValueError, match=r"^fb_cfHz: "):
        chain.modify("fb_cfHz", [9000.0])
    assert chain.stages["gammatone"].parameters["fb_nChannels"] == 3


def test_lags_stay_in_the_middle() -> None:
    sound = np.random.default_rng(3).standard_normal((2, 2000))
    got = process(sound, RATE, ["crossCorrelation"], PARAMETERS, 1000, [(1, "cc_maxDelaySec", 0.002)])
    narrow = got["crossCorrelation"][..., :5]
    assert narrow.shape == (3, 65, 5)
    assert not narrow[:, :14].any()
    assert (narrow[:, 14:51] != 0).all()
