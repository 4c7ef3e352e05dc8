"""modifyParameter on a running tree: accepted values, and the blocks and processors that are affected."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from rosafe.interface import CORE_REPRESENTATIONS, ComponentError, format_value
from rosafe.tree import sizes
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.harness import PATIENCE, run_together
from tests.processing.test_changes import CHANGES as OF_PROCESS
from tests.representations.chain import Chain, core_chain

from .support import CHANNELS, RATE, Feed, Plain, Recorder, grow, use_plain_stages

LEAVES = ("ild", "ratemap", "crossCorrelation")
NOISE = np.random.default_rng(7).standard_normal((20, 2, 400))
# For every parameter a value that differs from the present one: here, all switches are off
CHANGES: dict[str, Any] = {name: isinstance(value, bool) or value for name, value in OF_PROCESS.items()}
OWNER = {
    p.name: kind.kind for kind in CORE_REPRESENTATIONS.values() for p in kind.parameters
}  # later kinds: tests/representations


def settle(tree: Tree, feed: Feed, listener: Recorder, *blocks: np.ndarray) -> None:
    """Feed `blocks` and wait until all processors have released their output."""
    expected = {p: len(listener.blocks[p]) + len(blocks) for p in tree.processors}
    feed.put(*blocks)
    for processor, count in expected.items():
        listener.wait_blocks(processor, count)


def chain(**parameters: Any) -> Chain:
    return core_chain(RATE, {"in_doNormalize": False, **CHANNELS, **parameters})


def assert_as(listener: Recorder, tree: Tree, kind: str, outputs: list[dict[str, np.ndarray]]) -> None:
    """Check that the processor `kind` released, block by block, the output of the bare stages."""
    released = listener.blocks[tree.find(kind)]
    assert len(released) == len(outputs)
    for block, output in zip(released, outputs, strict=True):
        assert block.data.shape == output[kind].shape
        np.testing.assert_allclose(block.data, output[kind], rtol=1e-12, atol=1e-12)


# --- values ---


@pytest.mark.parametrize(  # one of each type and processor; tests/processing has all
    "name",
    [
        *("in_normalizeValue", "pp_bRemoveDC", "pp_middleEarModel", "fb_type", "fb_cfHz", "ihc_method"),
        *("ild_wSizeSec", "rm_decaySec", "cc_maxDelaySec"),
    ],
)
def test_a_change_of_each_parameter(tree: Tree, feed: Feed, listener: Recorder, name: str) -> None:
    """It applies from the next block on, to this processor alone. The bare stages are the reference."""
    value = CHANGES[name]
    grow(tree, feed)
    processor = tree.find(OWNER[name])
    assert processor.stage.parameters[name] != value
    others = {p.name: p.stage.parameters for p in tree.processors if p is not processor}
    settle(tree, feed, listener, *NOISE[:3])
    tree.modify(OWNER[name], name, format_value(value))
    assert processor.stage.parameters[name] == value
    assert {p.name: p.stage.parameters for p in tree.processors if p is not processor} == others
    settle(tree, feed, listener, *NOISE[3:6])
    outputs = chain().blocks(list(NOISE[:6]), [(3, name, value)])
    for kind in ("preProc", "gammatone", "ihc", *LEAVES):
        assert_as(listener, tree, kind, outputs)
    assert processor.stage.parameters[name] == value


def test_values_that_are_rejected(tree: Tree, feed: Feed) -> None:
    grow(tree, feed)
    refusals = {  # texts and ranges: tests/interface
        "pp_bRemoveDC": ("2", ""),
        "in_normalizeValue": ("5.0",),
        "fb_cfHz": ("100 abc", "8000"),
        "fb_highFreqHz": ("50", "8001"),
        "ild_wSizeSec": ("1e-9", "61"),
    }
    for name, texts in refusals.items():
        processor = tree.find(OWNER[name])
        before = processor.stage.parameters
        for text in texts:
            with pytest.raises(ComponentError) as raised:
                tree.modify(OWNER[name], name, text)
            assert raised.value.ex == "::rosAFE::e_badNewValue", text
            assert raised.value.detail["what"].startswith("fb_" if name.startswith("fb_") else name)
            assert processor.stage.parameters == before


def test_the_order_of_errors(tree: Tree, feed: Feed) -> None:
    grow(tree, feed)
    for name, parameter, ex in (
        ("none", "none", "e_noSuchProcessor"),
        ("input", "pp_bRemoveDC", "e_noSuchParameter"),  # the guide's own example
        ("ild", "rm_wname", "e_noSuchParameter"),
        ("ild", "", "e_noSuchParameter"),
        ("ild", "ild_hSizeSec", "e_badNewValue"),
    ):
        with pytest.raises(ComponentError) as raised:
            tree.modify(name, parameter, "bad")
        assert raised.value.ex == f"::rosAFE::{ex}"


def test_names_and_words_of_the_original(tree: Tree, feed: Feed) -> None:
    """Its misspelt names work, and unknown choices become the default, which getParameters reports."""
    grow(tree, feed)
    for processor, parameter, text, name, value in (
        ("ratemap", "set_rm_scailing", "_magnitude", "rm_scaling", "magnitude"),
        ("ratemap", "set_rm_scailing", "_power", "rm_scaling", "power"),
        ("ratemap", "set_rm_scailing", "magnitude", "rm_scaling", "magnitude"),
        ("ratemap", "rm_scaling", "loud", "rm_scaling", "power"),
        ("preProc", "pp_refSPLdBS", "94", "pp_refSPLdB", 94.0),
        ("preProc", "pp_middleEarModel", "lopezpoveda", "pp_middleEarModel", "lopezpoveda"),
        ("preProc", "pp_middleEarModel", "jespen", "pp_middleEarModel", "jepsen"),
        ("ihc", "ihc_method", " halfwave ", "ihc_method", "halfwave"),
        ("ihc", "ihc_method", "meddis", "ihc_method", "dau"),
        ("ild", "ild_wname", "", "ild_wname", "hann"),
        ("gammatone", "fb_type", "drnl", "fb_type", "drnl"),
        ("gammatone", "fb_type", "string", "fb_type", "gammatone"),
        ("gammatone", "fb_cfHz", "700", "fb_nChannels", 1),
        ("gammatone", "fb_cfHz", "0", "fb_nChannels", 5),
        ("gammatone", "fb_cfHz", "[300; 800 2000]", "fb_nChannels", 3),
        ("gammatone", "fb_cfHz", "{}", "fb_nChannels", 5),
        ("crossCorrelation", "cc_maxDelaySec", "0.00025", "cc_lags", [m / RATE for m in range(-4, 5)]),
    ):
        tree.modify(processor, parameter, text)
        assert tree.find(processor).values()[name] == value, (parameter, text)


# --- effect ---


def test_a_rejected_change_has_no_effect_on_the_numbers(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if a stage has applied it to its copy before the tree rejects it."""

    def refuse(*_: Any) -> None:
        raise ValueError("refused")

    grow(tree, feed)
    settle(tree, feed, listener, *NOISE[:2])
    monkeypatch.setattr(sizes, "check_all", refuse)
    for name, value in CHANGES.items():
        with pytest.raises(ComponentError, match="refused"):
            tree.modify(OWNER[name], name, format_value(value))
    settle(tree, feed, listener, *NOISE[2:4])
    outputs = chain().blocks(list(NOISE[:4]))
    for kind in CORE_REPRESENTATIONS:
        assert_as(listener, tree, kind, outputs)


def test_changes_accumulate_until_the_next_block(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    settle(tree, feed, listener, *NOISE[:2])
    changes = [("fb_nERBs", "3"), ("fb_bwERBs", "1.5"), ("fb_nChannels", "4"), ("fb_highFreqHz", "3000")]
    for name, text in changes:
        tree.modify("gammatone", name, text)
    with pytest.raises(ComponentError):
        tree.modify("gammatone", "fb_lowFreqHz", "3500")  # rejected because of a change that waits for the next block
    settle(tree, feed, listener, *NOISE[2:4])
    outputs = chain().blocks(list(NOISE[:4]), [(2, name, float(text)) for name, text in changes])
    assert_as(listener, tree, "gammatone", outputs)
    assert_as(listener, tree, "crossCorrelation", outputs)


def test_a_change_does_not_wait_for_a_block_and_does_not_affect_it(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, go_on = threading.Event(), threading.Event()

    class Slow(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            before = dict(self.parameters)
            working.set()
            assert go_on.wait(PATIENCE)
            assert self.parameters == before
            return block * self.parameters["rm_decaySec"]

    use_plain_stages(monkeypatch, ratemap=Slow)
    grow(tree, feed)
    tree.modify("ratemap", "rm_decaySec", "1")
    feed.put(*np.ones((2, 2, 10)))
    assert working.wait(PATIENCE)
    tree.modify("ratemap", "rm_decaySec", "2")
    ratemap = tree.find("ratemap")
    assert ratemap.state is State.EXEC
    assert ratemap.stage.parameters["rm_decaySec"] == 2.0
    go_on.set()
    listener.wait_blocks(ratemap, 2)
    assert [block.data[0, 0] for block in listener.blocks[ratemap]] == [1.0, 2.0]


def test_values_read_during_changes_are_consistent(tree: Tree, feed: Feed) -> None:
    grow(tree, feed)
    correlation = tree.find("crossCorrelation")

    def work(user: int) -> bool:
        for step in range(200):
            if user < 2:
                tree.modify("crossCorrelation", "cc_maxDelaySec", str(0.001 * (1 + (user + step) % 3)))
            else:
                values = correlation.values()
                if values["cc_lags"][-1] != np.ceil(values["cc_maxDelaySec"] * RATE) / RATE:
                    return False
        return True

    feed.put(*NOISE)
    assert all(run_together(4, work))


def test_another_number_of_channels_reaches_the_leaves(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    settle(tree, feed, listener, *NOISE[:2])
    tree.modify("gammatone", "fb_nChannels", "9")
    assert {p.kind: p.output_shape for p in tree.processors if p.kind in LEAVES} == {
        "ild": (9,),
        "ratemap": (2, 9),
        "crossCorrelation": (9, 37),
    }
    settle(tree, feed, listener, *NOISE[2:5])
    assert [block.data.shape[1] for block in listener.blocks[tree.find("ratemap")]] == [5, 5, 9, 9, 9]
