"""The envelope of the filterbank: computed only while a hair cell requires it, and never missing for that one."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from rosafe.dsp.stage import Output
from rosafe.representations import STAGES
from rosafe.representations.haircell import InnerHairCell
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.dsp.bare import joined, single
from tests.harness import PATIENCE, wait_for

from .support import RATE, Feed, Recorder, grow
from .test_changes import NOISE, assert_as, chain, settle

WORKERS = 2  # enough for a parent to compute its next block while a child is blocked


@pytest.fixture
def provided(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Record for each block whether the filterbank computed the envelope."""
    answers: list[bool] = []
    original = STAGES["gammatone"].process

    def process(self: Any, block: np.ndarray, extra: None = None) -> Output:
        answers.append("envelope" in self.provide)
        return original(self, block)

    monkeypatch.setattr(STAGES["gammatone"], "process", process)
    return answers


def suffix(listener: Recorder, processor: Processor, whole: np.ndarray) -> int:
    """Check that the processor released the end of `whole`. Return the number of missing blocks of 400 before it."""
    released = listener.data(processor)
    start = whole.shape[-1] - released.shape[-1]
    np.testing.assert_allclose(released, whole[..., start:], rtol=0, atol=1e-12)
    assert start % 400 == 0
    return start // 400


def test_the_envelope_is_computed_only_while_a_child_requires_it(
    tree: Tree, feed: Feed, listener: Recorder, provided: list[bool]
) -> None:
    grow(tree, feed)
    settle(tree, feed, listener, *NOISE[:3])
    late = tree.add("ihc", "late", "gammatone", {"ihc_method": "hilbert"})
    wait_for(lambda: late.blocks == 1)  # it has got the last block, without an envelope
    assert listener.blocks[late] == []
    settle(tree, feed, listener, NOISE[3])
    settle(tree, feed, listener, *NOISE[4:6])
    tree.remove("late")
    settle(tree, feed, listener, *NOISE[6:8])
    assert provided == [False] * 3 + [True] * 3 + [False] * 2
    outputs = joined(chain(ihc_method="hilbert").blocks(list(NOISE[:6])))
    assert suffix(listener, late, outputs["ihc"]) == 3
    assert_as(listener, tree, "ihc", chain().blocks(list(NOISE[:8])))


@pytest.mark.parametrize("method", ["joergensen", "bernstein"])
def test_a_late_child_never_computes_without_the_envelope(
    tree: Tree, feed: Feed, listener: Recorder, method: str
) -> None:
    """It begins one to three blocks later, and then misses none."""
    grow(tree, feed)
    feed.put(*NOISE[:8])
    listener.wait_blocks(tree.find("gammatone"), 2)
    late = tree.add("ihc", "late", "gammatone", {"ihc_method": method})
    below = tree.add("ild", "below", "late")
    feed.put(*NOISE[8:])
    listener.wait_blocks(tree.find("gammatone"), 20)
    listener.wait(lambda: all(listener.blocks[p] and listener.blocks[p][-1].number == 19 for p in (late, below)))
    numbers = [block.number for block in listener.blocks[late]]
    assert numbers == list(range(numbers[0], 20))
    assert [block.number for block in listener.blocks[below]][-3:] == [17, 18, 19]
    # the filter after the envelope begins with zeros
    filterbank = chain().stages["gammatone"]
    hair_cell = STAGES["ihc"](RATE, ihc_method=method)
    for number, block in enumerate(NOISE):
        filterbank.provide = frozenset({"envelope"})
        data = single(filterbank.process(block))
        if number >= numbers[0]:
            expected = hair_cell.process(data, filterbank.provided["envelope"])
            got = listener.blocks[late][number - numbers[0]].data
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Let the hair cell wait with its first block for the second event; the first one is set then."""
    working, go_on = threading.Event(), threading.Event()
    original = InnerHairCell.process

    def process(self: InnerHairCell, block: np.ndarray, *envelope: np.ndarray) -> np.ndarray:
        working.set()
        assert go_on.wait(PATIENCE)
        return original(self, block, *envelope)

    monkeypatch.setattr(InnerHairCell, "process", process)
    return working, go_on


def test_a_released_block_without_the_envelope_is_processed_by_the_old_method(
    tree: Tree, feed: Feed, listener: Recorder, held: tuple[threading.Event, threading.Event]
) -> None:
    """The filterbank has already computed the next block when the method changes."""
    working, go_on = held
    grow(tree, feed)
    filterbank, ihc = tree.find("gammatone"), tree.find("ihc")
    feed.put(*NOISE[:2])
    assert working.wait(PATIENCE)
    wait_for(lambda: filterbank.state is State.WAIT_RELEASE)
    tree.modify("ihc", "ihc_method", "hilbert")
    feed.put(*NOISE[2:4])
    go_on.set()
    listener.wait_blocks(ihc, 4)
    assert_as(listener, tree, "ihc", chain().blocks(list(NOISE[:4]), [(2, "ihc_method", "hilbert")]))


def test_a_block_without_the_envelope_is_not_lost(
    tree: Tree, feed: Feed, listener: Recorder, held: tuple[threading.Event, threading.Event]
) -> None:
    """The filterbank has computed it for a method that is changed again."""
    working, go_on = held
    grow(tree, feed)
    filterbank, ihc = tree.find("gammatone"), tree.find("ihc")
    tree.modify("ihc", "ihc_method", "hilbert")
    feed.put(NOISE[0])
    assert working.wait(PATIENCE)
    tree.modify("ihc", "ihc_method", "fullwave")
    feed.put(NOISE[1])
    wait_for(lambda: filterbank.state is State.WAIT_RELEASE)
    tree.modify("ihc", "ihc_method", "hilbert")
    feed.put(NOISE[2])
    go_on.set()
    listener.wait_blocks(ihc, 3)
    changes = [(0, "ihc_method", "hilbert"), (1, "ihc_method", "fullwave"), (2, "ihc_method", "hilbert")]
    assert_as(listener, tree, "ihc", chain().blocks(list(NOISE[:3]), changes))


def test_a_switch_while_blocks_are_processed(tree: Tree, feed: Feed, listener: Recorder) -> None:
    """Every block is processed by the old or the new method, none is missing, and the last method is kept."""
    grow(tree, feed)
    ihc = tree.find("ihc")
    feed.put(*NOISE[:15])
    for number, method in enumerate(("hilbert", "none", "hilbert", "none", "hilbert", "fullwave", "hilbert")):
        listener.wait_blocks(ihc, 1 + 2 * number)
        tree.modify("ihc", "ihc_method", method)
    listener.wait_blocks(ihc, 15)
    settle(tree, feed, listener, *NOISE[15:])
    methods = ("dau", "hilbert", "none", "fullwave")
    outputs = {method: chain(ihc_method=method).blocks(list(NOISE)) for method in methods}
    names = []
    for number, block in enumerate(listener.blocks[ihc]):
        fits = [m for m in methods[1:] if np.allclose(block.data, outputs[m][number]["ihc"], rtol=0, atol=1e-12)]
        names += fits or ["dau"]
    assert names[0] == "dau"
    assert names[-5:] == ["hilbert"] * 5
    assert len(names) == 20


def test_a_switch_and_its_reversal_before_a_block_have_no_effect(
    tree: Tree, feed: Feed, listener: Recorder, provided: list[bool]
) -> None:
    grow(tree, feed)
    settle(tree, feed, listener, *NOISE[:2])
    tree.modify("ihc", "ihc_method", "hilbert")
    tree.modify("ihc", "ihc_method", "fullwave")
    settle(tree, feed, listener, *NOISE[2:5])
    assert provided == [False] * 5
    assert_as(listener, tree, "ihc", chain().blocks(list(NOISE[:5]), [(2, "ihc_method", "fullwave")]))
