"""One ear is computed alone, with the bits of two equal ears."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.dsp import kernels
from rosafe.interface import KINDS
from rosafe.processing import chain
from rosafe.representations import BUILTIN, STAGES

RATE = 16000
MONAURAL = [kind for kind in KINDS if kind in BUILTIN and not KINDS[kind].binaural]
SOUND = 0.1 * np.random.default_rng(7).standard_normal((2, 3 * RATE))
PARAMETERS: list[dict[str, Any]] = [
    {"fb_nChannels": 8},
    {
        "fb_nChannels": 5,
        "ihc_method": "bernstein",
        "ams_fbType": "lin",
        **dict.fromkeys(("pp_bNormalizeRMS", "pp_bPreEmphasis", "pp_bMiddleEarFiltering", "pp_bRemoveDC"), True),
    },
    {"fb_nChannels": 3, "fb_type": "drnl", "ihc_method": "hilbert", "rm_scaling": "magnitude"},
]


def assert_first_ear(one: Any, two: Any) -> None:
    """Assert that `one` contains the numbers of the first ear of `two`, to the last bit."""
    assert one.keys() == two.keys()
    for name, values in one.items():
        both = two[name]
        if KINDS.get(name) and KINDS[name].outputs[name].axes[0] == "ear":
            assert len(values) == 1
            both = both[:1]
        np.testing.assert_array_equal(values, both, err_msg=name)


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """The numbers of rows of all blocks that the filterbank has filtered."""
    found: set[int] = set()
    filterbank = STAGES["gammatone"]
    process = filterbank.process

    def watched(self: Any, block: np.ndarray, *arguments: Any) -> Any:
        found.add(len(block))
        return process(self, block, *arguments)

    monkeypatch.setattr(filterbank, "process", watched)
    return found


@pytest.mark.filterwarnings("ignore:pi_rangeHz")
@pytest.mark.parametrize("parameters", PARAMETERS)
def test_each_representation_of_one_ear(parameters: dict[str, Any], rows: set[int]) -> None:
    sound = SOUND if parameters.get("fb_type") != "drnl" else SOUND[:, :RATE]
    one = rosafe.process(sound[1], RATE, parameters=parameters, outputs=MONAURAL)
    assert rows == {1}
    assert_first_ear(one, rosafe.process(sound[[1, 1]], RATE, parameters=parameters, outputs=MONAURAL))
    assert rows == {1, 2}


def test_padding_of_one_ear() -> None:
    one, two = (rosafe.process(s, RATE, outputs="ratemap", pad=True) for s in (SOUND[0], SOUND[[0, 0]]))
    assert one["ratemap"].shape[-1] == -(-SOUND.shape[1] // 160)
    assert_first_ear(one, two)


@pytest.mark.skipif(not kernels.compiled(), reason="without kernels the last bits depend on blocks")
def test_a_stream_of_one_ear_then_of_two(rows: set[int]) -> None:
    """`reset` allows another number of ears; the default outputs for two ears include those that compare them."""
    stream = rosafe.Stream(RATE, {"fb_nChannels": 4})
    for sound, ears in ((SOUND[0], {1}), (SOUND, {2}), (SOUND[1], {1})):
        rows.clear()
        blocks = [stream.process(sound[..., at : at + 1000]) for at in range(0, SOUND.shape[1], 1000)]
        assert rows == ears
        whole = rosafe.process(sound, RATE, parameters={"fb_nChannels": 4})
        for name in blocks[0]:
            joined = np.concatenate([block[name] for block in blocks], axis=-1)
            np.testing.assert_array_equal(joined, whole[name], err_msg=name)
        stream.modify("fb_nChannels", 4)
        stream.reset()


def test_plugins_get_two_equal_ears(monkeypatch: pytest.MonkeyPatch, rows: set[int]) -> None:
    """They may rely on two rows. Here the ratemap is treated as a plugin."""
    expected = rosafe.process(SOUND[0], RATE, outputs="ratemap")
    monkeypatch.setattr(chain, "BUILTIN", {kind for kind in BUILTIN if kind != "ratemap"})
    rows.clear()
    result = rosafe.process(SOUND[0], RATE, outputs="ratemap")
    assert rows == {2}
    np.testing.assert_array_equal(result["ratemap"], expected["ratemap"])
