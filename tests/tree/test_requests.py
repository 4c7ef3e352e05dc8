"""Requests to the tree: errors and their order, names, removal, another input, stop, sizes, failures."""

from __future__ import annotations

import gc
import threading
import tracemalloc
from typing import Any

import numpy as np
import pytest

from rosafe.interface import CORE_REPRESENTATIONS, ComponentError
from rosafe.representations import STAGES
from rosafe.tree import sizes
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.dsp.bare import single
from tests.harness import PATIENCE, run_together, wait_for

from .support import RATE, Feed, Plain, Recorder, grow, use_plain_stages


def assert_rejected(tree: Tree, ex: str, what: str, request: Any, *arguments: Any) -> None:
    """Check that `request` raises `::rosAFE::<ex>` with the text `what`, and changes nothing."""
    before = [(p, p.parent, p.state is State.REMOVED, p.stage.parameters) for p in tree.processors]
    with pytest.raises(ComponentError) as raised:
        request(*arguments)
    assert raised.value.ex == f"::rosAFE::{ex}"
    assert what in str(raised.value)
    assert [(p, p.parent, p.state is State.REMOVED, p.stage.parameters) for p in tree.processors] == before


# --- add ---


def test_the_tree_of_the_guide(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    assert [p.name for p in tree.processors] == [p.kind for p in tree.processors] == list(CORE_REPRESENTATIONS)
    assert tree.dependencies("ratemap") == ["input", "preProc", "gammatone", "ihc", "ratemap"]
    assert tree.dependencies("input") == ["input"]
    assert tree.input is tree.find("input")
    rows = {p.kind: p.output_shape for p in tree.processors}
    assert rows["input"] == rows["preProc"] == (2,)
    assert rows["gammatone"] == rows["ihc"] == rows["ratemap"] == (2, 5)
    assert (rows["ild"], rows["crossCorrelation"]) == ((5,), (5, 37))
    assert [p.rate for p in tree.processors] == [RATE] * 4 + [100.0] * 3
    feed.put(count=4)
    for processor in tree.processors:
        listener.wait_blocks(processor, 4)
        assert listener.data(processor).shape == (*processor.output_shape, 640 if processor.rate == RATE else 3)
        assert processor.next_index == 640


def test_errors_of_a_processor_request_in_their_order(tree: Tree, feed: Feed) -> None:
    assert_rejected(tree, "e_noUpperDependencie", "no processor 'input'", tree.add, "preProc", "preProc", "input")
    grow(tree, feed)
    bad = {"fb_highFreqHz": 1e5}
    # the order of checks: unknown parent, name in use, parent of the wrong kind, values
    for ex, what, *arguments in (
        ("e_noUpperDependencie", "no processor 'none'", "gammatone", "gammatone", "none", bad),
        ("e_existsAlready", "'ild' exists already, of kind ild", "gammatone", "ild", "ihc", bad),
        (
            "e_noUpperDependencie",
            "'ihc': expected a processor of kind preProc, got kind ihc",
            "gammatone",
            "x",
            "ihc",
            bad,
        ),
        ("e_badNewValue", "fb_highFreqHz", "gammatone", "x", "preProc", bad),
        ("e_badNewValue", "ihc_method", "ihc", "x", "gammatone", {"ihc_method": "unknown"}),
    ):
        assert_rejected(tree, ex, what, tree.add, *arguments)
    for name in ("Ild", "", "ild "):  # names are used literally
        assert tree.add("ild", name, "ihc").name == name


def test_unknown_names(tree: Tree, feed: Feed) -> None:
    assert_rejected(tree, "e_noSuchProcessor", "no processor 'x'", tree.dependencies, "x")
    grow(tree, feed)
    for request, *arguments in ((tree.find,), (tree.dependencies,), (tree.remove,), (tree.modify, "fb_nERBs", "1")):
        assert_rejected(tree, "e_noSuchProcessor", "no processor 'x'", request, "x", *arguments)


def test_one_of_eight_gets_the_name(tree: Tree, feed: Feed) -> None:
    tree.add_input("input", feed, 160, 1.0, 1.0)

    def ask(user: int) -> str:
        try:
            return tree.add("preProc", "requested", "input").name
        except ComponentError as problem:
            return problem.ex

    answers = run_together(8, ask)
    assert sorted(answers) == ["::rosAFE::e_existsAlready"] * 7 + ["requested"]
    assert len(tree.processors) == 2


# --- remove ---


def test_removal_begins_with_the_leaves_and_frees_the_names(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    removed = tree.remove("gammatone")
    assert [p.name for p in removed] == ["ild", "ratemap", "crossCorrelation", "ihc", "gammatone"]
    assert listener.ends == removed
    assert all(p.state is State.REMOVED and p.error is None for p in removed)
    assert [p.name for p in tree.processors] == ["input", "preProc"]
    assert_rejected(tree, "e_noSuchProcessor", "'ihc'", tree.remove, "ihc")
    tree.add("preProc", "gammatone", "input")  # the name may now have another kind
    feed.put(count=2)
    listener.wait_blocks(tree.find("gammatone"), 2)
    assert [p.name for p in tree.processors] == ["input", "preProc", "gammatone"]


def test_the_input_cannot_be_removed(tree: Tree, feed: Feed) -> None:
    grow(tree, feed)
    assert_rejected(tree, "e_noSuchProcessor", "call Stop", tree.remove, "input")


def test_the_end_of_a_removed_processor_changes_nothing(tree: Tree, feed: Feed) -> None:
    tree.add_input("input", feed, 160, 1.0, 1.0)
    old = tree.add("preProc", "a", "input")
    tree.end(old)
    new = tree.add("preProc", "a", "input")
    tree.end(old)
    assert tree.find("a") is new
    tree.end(new)
    assert [p.name for p in tree.processors] == ["input"]


def test_stop_and_restart(tree: Tree, listener: Recorder) -> None:
    tree.stop()
    for rate in (16000.0, 44100.0, 16000.0):
        feed = Feed(rate)
        grow(tree, feed)
        feed.put(count=5)
        listener.wait_blocks(tree.find("ild"), 5)
        before = tree.processors
        tree.stop()
        assert feed.stopped
        assert tree.processors == []
        assert tree.input is None
        assert all(p.join(PATIENCE) for p in before)
    assert len(listener.ends) == 21


# --- another input ---


def test_children_continue_with_the_new_input_and_their_states(tree: Tree, listener: Recorder) -> None:
    """Filters and buffered samples continue as if the two signals were one."""
    noise = np.random.default_rng(1).standard_normal((2, 4 * 500))
    first, second = Feed(frames=500), Feed(frames=500)
    grow(tree, first)
    tree.modify("preProc", "pp_bRemoveDC", "1")
    old, leaves = tree.find("input"), [tree.find(kind) for kind in ("preProc", "ild", "ratemap")]
    first.put(noise[:, :500], noise[:, 500:1000])
    for leaf in leaves:
        listener.wait_blocks(leaf, 2)
    new = tree.add_input("another", second, 250, 2.0, 3.0, {"in_doNormalize": False})
    assert listener.ends == [old]
    assert first.stopped
    assert [p.name for p in tree.processors][:2] == ["another", "preProc"]
    assert tree.dependencies("ild") == ["another", "preProc", "gammatone", "ihc", "ild"]
    assert (tree.port_seconds, tree.history_seconds) == (2.0, 3.0)
    second.put(noise[:, 1000:1500], noise[:, 1500:])
    listener.wait_blocks(new, 2)
    whole = noise
    for kind in ("preProc", "gammatone", "ihc"):
        processor = tree.find(kind)
        whole = single(STAGES[kind](RATE, **processor.stage.parameters).process(whole))
        listener.wait_blocks(processor, 4)
        np.testing.assert_allclose(listener.data(processor), whole, rtol=0, atol=1e-12)
    for leaf in leaves[1:]:
        listener.wait_blocks(leaf, 4)
        frames = STAGES[leaf.kind](RATE, **leaf.stage.parameters).process(whole)
        np.testing.assert_allclose(listener.data(leaf), frames, rtol=0, atol=1e-9)
    second.put(*np.zeros((100, 2, 500)))
    listener.wait_blocks(tree.find("preProc"), 104)
    assert tree.find("preProc").history.read_new("reader").parts[0].frames == 3 * RATE


def test_an_input_of_another_rate_or_with_a_name_in_use_is_rejected(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    for ex, what, name, other in (
        ("e_badNewValue", "the tree runs at 16000 Hz, Audio is at 44100 Hz", "input", Feed(44100.0)),
        ("e_existsAlready", "'ild' exists already, of kind ild", "ild", Feed()),
    ):
        assert_rejected(tree, ex, what, tree.add_input, name, other, 160, 1.0, 1.0)
        assert other.stopped
    assert not feed.stopped
    feed.put(count=3)
    listener.wait_blocks(tree.find("ild"), 3)


def test_a_childless_input_can_be_replaced_by_one_of_any_rate(tree: Tree, feed: Feed) -> None:
    tree.add_input("input", feed, 160, 1.0, 1.0)
    tree.add_input("input", Feed(44100.0), 160, 1.0, 1.0)
    assert feed.stopped
    assert tree.sample_rate == 44100.0
    assert [p.rate for p in tree.processors] == [44100.0]


def test_a_tree_whose_source_has_ended_is_replaced(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    before = tree.processors
    feed.put(count=1)
    feed.end()
    for processor in before:
        assert processor.join(PATIENCE)
    tree.add_input("input", Feed(), 160, 1.0, 1.0)
    names = ["ild", "ratemap", "crossCorrelation", "ihc", "gammatone", "preProc", "input"]
    assert [p.name for p in listener.ends] == names
    assert [p.name for p in tree.processors] == ["input"]


# --- sizes ---


def test_too_large_sizes_are_rejected(tree: Tree, feed: Feed) -> None:
    large = "expected at most 1024 MiB, got"
    assert_rejected(tree, "e_badNewValue", large, tree.add_input, "input", Feed(1e9), 160, 600.0, 1.0)
    grow(tree, feed)
    tree.modify("gammatone", "fb_nChannels", "100")
    for kind, parameters in (
        ("ild", {"ild_wSizeSec": 60.0}),
        ("ratemap", {"rm_wSizeSec": 50.0}),
        ("crossCorrelation", {"cc_maxDelaySec": 10.0}),
    ):
        assert_rejected(tree, "e_badNewValue", large, tree.add, kind, "x", "ihc", parameters)
    assert_rejected(tree, "e_badNewValue", f"ild_wSizeSec: {large}", tree.modify, "ild", "ild_wSizeSec", "60")
    assert_rejected(tree, "e_badNewValue", large, tree.modify, "crossCorrelation", "cc_maxDelaySec", "9")
    for block, port_seconds in ((160, 500.0), (10_000_000, 1.0)):  # because of the descendants
        assert_rejected(tree, "e_badNewValue", large, tree.add_input, "input", Feed(), block, port_seconds, 1.0)
    tree.modify("gammatone", "fb_nChannels", "5")
    tree.modify("crossCorrelation", "cc_maxDelaySec", "0.5")
    assert_rejected(tree, "e_badNewValue", large, tree.modify, "gammatone", "fb_nChannels", "1000")


def test_all_processors_together_have_a_share_of_the_memory(
    tree: Tree, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A request that would exceed it changes nothing: a new processor, a longer port or more channels."""
    monkeypatch.setattr(sizes, "machine_memory", lambda: 2**25)
    share = "expected at most 16 MiB (50% of this machine's memory), got"
    grow(tree, feed)
    tree.modify("gammatone", "fb_nChannels", "10")
    for number in range(50):
        try:
            tree.add("gammatone", f"more{number}", "preProc", {"fb_nChannels": 10, "fb_highFreqHz": 4000.0})
        except ComponentError as problem:
            assert "at most 16 MiB" in str(problem)
            break
    assert 1 < number < 49
    before = [p.name for p in tree.processors]
    assert_rejected(tree, "e_badNewValue", share, tree.modify, "gammatone", "fb_nChannels", "30")
    assert_rejected(tree, "e_badNewValue", share, tree.add_input, "input", Feed(), 160, 1.5, 1.0)
    assert [p.name for p in tree.processors] == before
    tree.modify("gammatone", "fb_nChannels", "5")
    tree.remove("more0")
    tree.add("gammatone", "more0", "preProc", {"fb_nChannels": 10, "fb_highFreqHz": 4000.0})
    tree.add_input("input", Feed(), 160, 0.5, 0.5)  # now the present processors need half as much
    tree.modify("gammatone", "fb_nChannels", "30")


def test_three_hundred_cycles_leak_no_memory(tree: Tree, feed: Feed, listener: Recorder) -> None:
    tree.add_input("input", feed, 160, 0.1, 0.0)  # the window of the input is full after 10 cycles

    def cycle() -> None:
        tree.add("preProc", "preProc", "input")
        tree.add("gammatone", "gammatone", "preProc", {"fb_nChannels": 2, "fb_highFreqHz": 4000.0})
        feed.put(count=1)
        listener.wait_blocks(tree.find("gammatone"), 1)
        for processor in tree.remove("preProc"):
            assert processor.join(PATIENCE)
        listener.forget()

    def memory() -> int:
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        for _ in range(30):
            cycle()
        before = memory()
        for _ in range(270):
            cycle()
        assert memory() - before < 200_000  # a leaked processor takes about 4000
    finally:
        tracemalloc.stop()
    assert len(tree.processors) == 1


# --- failures ---


class Failing(Plain):
    def compute(self, block: np.ndarray) -> np.ndarray:
        if self.parameters.get("fails") and block[0, 0] >= 160:
            raise ArithmeticError("out of luck")
        return block


def test_a_failing_stage_ends_its_processor_and_the_descendants(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_plain_stages(monkeypatch, preProc=Failing)
    root = tree.add_input("input", feed, 160, 1.0, 1.0)
    failing = tree.add("preProc", "failing", "input", {"fails": True})
    below = tree.add("gammatone", "below", "failing")
    other = tree.add("preProc", "other", "input")
    feed.put(count=4)
    listener.wait(lambda: failing in listener.ends)
    assert listener.ends == [below, failing]
    assert isinstance(failing.error, ArithmeticError)
    assert below.error is None
    listener.wait_blocks(other, 4)
    assert len(listener.blocks[failing]) == 1
    wait_for(lambda: tree.processors == [root, other])
    tree.add("preProc", "failing", "input")


def test_a_failing_input_ends_everything(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_plain_stages(monkeypatch, input=Failing)
    root = tree.add_input("input", feed, 160, 1.0, 1.0, {"fails": True})
    tree.add("preProc", "below", "input")
    feed.put(count=4)
    wait_for(lambda: not tree.processors)
    assert isinstance(root.error, ArithmeticError)
    assert feed.stopped


@pytest.mark.parametrize("when", ["on_added", "on_released"])
def test_a_listener_that_fails(
    tree: Tree, feed: Feed, listener: Recorder, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the processor for which it failed is removed from the tree."""
    original = getattr(Recorder, when)

    def fail(self: Recorder, processor: Processor, *block: Block) -> None:
        if processor.name == "unlucky":
            raise OSError("no space left on device")
        original(self, processor, *block)

    monkeypatch.setattr(Recorder, when, fail)
    root = tree.add_input("input", feed, 160, 1.0, 1.0)
    if when == "on_added":
        with pytest.raises(OSError, match="no space"):
            tree.add("preProc", "unlucky", "input")
    else:
        unlucky = tree.add("preProc", "unlucky", "input")
        feed.put(count=1)
        wait_for(lambda: tree.processors == [root])
        assert isinstance(unlucky.error, OSError)
    lucky = tree.add("preProc", "lucky", "input")
    feed.put(count=3)
    listener.wait_blocks(lucky, 3)
    assert tree.processors == [root, lucky]


def test_threads_that_cannot_be_started(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first worker is required. Without further workers, the tree works too."""

    def no_thread(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        with pytest.raises(RuntimeError, match="can't start"):
            tree.add_input("input", feed, 160, 1.0, 1.0)
        assert tree.processors == []
    feed = Feed()
    tree.add_input("input", feed, 160, 1.0, 1.0)
    monkeypatch.setattr(threading.Thread, "start", no_thread)
    siblings = [tree.add("preProc", name, "input") for name in "abc"]
    feed.put(count=5)
    for one in siblings:
        listener.wait_blocks(one, 5)


# --- signals since the last call ---


def test_signals_since_the_last_call(tree: Tree, feed: Feed, listener: Recorder) -> None:
    tree.add_input("input", feed, 160, 1.0, 0.05, {"in_doNormalize": False})
    assert tree.history_seconds == 0.05  # five blocks of 160 at 16 kHz
    one = tree.add("preProc", "one", "input")
    (view,), index, signal = one.history.read_new("reader")
    assert (view.shape, index, signal) == ((2, 0), 0, one.signal)
    feed.put(count=2)
    listener.wait_blocks(one, 2)
    for expected in (np.arange(320), np.arange(0)):
        (view,), index, signal = one.history.read_new("reader")
        np.testing.assert_array_equal(view.array(), [expected, expected])
        assert (index, signal.rate) == (320, RATE)
    feed.put(count=8)
    listener.wait_blocks(one, 10)
    (view,), index, _ = one.history.read_new("reader")
    np.testing.assert_array_equal(view.array()[0], np.arange(1600 - 800, 1600))
    assert index == 1600


def test_histories_contain_two_blocks_at_least(tree: Tree, listener: Recorder) -> None:
    feed = Feed(frames=1600)
    tree.add_input("input", feed, 1600, 1.0, 0.01)
    assert tree.history_seconds == 0.2
    feed.put(count=3)
    listener.wait_blocks(tree.find("input"), 3)
    assert tree.find("input").history.read_new("reader").parts[0].frames == 3200
