"""Blocks with several parts, delayed frames, extras, and formats that change above a processor."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Part, Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Output, Stage
from rosafe.interface import ComponentError
from rosafe.representations import KINDS, STAGES
from rosafe.tree.block import Block
from rosafe.tree.parameter_updates import ParameterUpdates
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.harness import PATIENCE, wait_for

from .support import RATE, Feed, Recorder, use_plain_stages


def declared(kind: str, **differs: Any) -> Representation:
    """Return a representation that replaces an existing one."""
    there = KINDS[kind]
    settings: dict[str, Any] = {"parent": there.parent, "axes": ("ear", "time"), **differs}
    return Representation(kind=kind, doc="A test's own", **settings)


class Coarser(Stage):
    """Every n-th sample as a frame, and a number of lags for its children; squares as an extra."""

    REPRESENTATION = declared(
        "preProc",
        parameters=(
            Parameter("pp_step", "unsigned long", 2, "Samples to a frame", 1, 100),
            Parameter("pp_lags", "unsigned long", 10, "Lags", 0, 100),
        ),
    )
    INPUT = ("ear", "time")
    EXTRAS = ("squares",)
    computed: list[frozenset[str]]  # the extras that were requested with each block

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        self.computed.append(self.provide)
        frames = np.ascontiguousarray(block[:, :: self.values["pp_step"]])
        self.provided = {"squares": np.square(frames)} if "squares" in self.provide else {}
        return frames

    @cached_property
    def output_format(self) -> SignalFormat:
        step = self.values["pp_step"]
        return replace(
            self.input_format,
            rate=self.input_format.rate / step,
            framed=True,
            hop=step * self.input_format.hop,
            lags=self.values["pp_lags"],
        )


class Picky(Stage):
    """Delays frames, has two parts, and requires a number of lags and optionally the squares."""

    REPRESENTATION = declared(
        "gammatone",
        axes=(),
        parts=(Part("values", ("ear", "time")), Part("sums", ("time",))),
        parameters=(
            Parameter("fb_least", "unsigned long", 1, "Lags that there must be", 0, 100),
            Parameter("fb_held", "unsigned long", 3, "Frames held back", 0, 100),
            Parameter("fb_squares", "boolean", False, "Squares"),
        ),
    )
    INPUT = ("ear", "time")

    def __init__(self, given: SignalFormat | float, **parameters: Any) -> None:
        self.held = np.zeros((2, 0))
        super().__init__(given, **parameters)

    @property
    def required_extra(self) -> str:
        return "squares" if self.values["fb_squares"] else ""

    @property
    def look_ahead(self) -> int:
        return int(self.values["fb_held"])

    def part_rows(self, rows: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        return (rows, ())

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        assert (extra is not None) == bool(self.required_extra)
        come = np.concatenate((self.held, block if extra is None else extra), axis=-1)
        self.held = come[:, max(0, come.shape[1] - self.look_ahead) :]
        out = come[:, : come.shape[1] - self.held.shape[1]].copy()
        return out, out.sum(axis=0)

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._check(values)

    def input_format_changed(self, before: SignalFormat) -> None:
        self._check(self.values)

    def _check(self, values: dict[str, Any]) -> None:
        if self.input_format.lags < values["fb_least"]:
            raise ValueError(f"fb_least: {values['fb_least']} lags are required, got {self.input_format.lags}")


@pytest.fixture(autouse=True)
def stages(monkeypatch: pytest.MonkeyPatch) -> None:
    use_plain_stages(monkeypatch)
    monkeypatch.setattr(Coarser, "computed", [], raising=False)
    for kind, stage in (("preProc", Coarser), ("gammatone", Picky)):
        monkeypatch.setitem(STAGES, kind, stage)


FRAMES, WORKERS = 8, 2


def grow(tree: Tree, feed: Feed, **parameters: Any) -> None:
    tree.add_input("input", feed, feed.frames, 1.0, 1.0)
    tree.add("preProc", "coarser", "input", {n: v for n, v in parameters.items() if n.startswith("pp")})
    tree.add("gammatone", "picky", "coarser", {n: v for n, v in parameters.items() if n.startswith("fb")})
    tree.add("ihc", "below", "picky")


def assert_rejected(tree: Tree, text: str, name: str, parameter: str, value: str) -> None:
    before = {p: (p.stage.parameters, p.signal, p.stage) for p in tree.processors}
    with pytest.raises(ComponentError, match=text) as raised:
        tree.modify(name, parameter, value)
    assert raised.value.ex == "::rosAFE::e_badNewValue"
    assert {p: (p.stage.parameters, p.signal, p.stage) for p in tree.processors} == before


def test_parts_and_delayed_frames(tree: Tree, feed: Feed, listener: Recorder) -> None:
    """Children get the first part, histories contain all; the index is that of the newest released frame."""
    grow(tree, feed)
    picky, below = tree.find("picky"), tree.find("below")
    feed.put(count=3)
    listener.wait_blocks(below, 3)
    frames = np.arange(0.0, 24.0, 2.0)[:-3]
    assert [block.data.shape[-1] for block in listener.blocks[below]] == [1, 4, 4]
    np.testing.assert_array_equal(listener.data(below), [frames, frames])
    listener.wait_blocks(picky, 3)
    assert [block.next_index for block in listener.blocks[picky]] == [8 - 6, 16 - 6, 24 - 6]
    assert [block.next_index for block in listener.blocks[below]] == [8 - 6, 16 - 6, 24 - 6]
    for reader in ("one", "another"):
        (values, sums), index, signal = picky.history.read_new(reader)
        np.testing.assert_array_equal(values.array(), [frames, frames])
        np.testing.assert_array_equal(sums.array(), 2 * frames)
        assert (index, signal) == (18, picky.signal)
    assert picky.blocks == 3


def test_the_index_of_delayed_frames_is_never_negative(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed, fb_held=100)
    feed.put(count=2)
    listener.wait_blocks(tree.find("below"), 2)
    assert [block.next_index for block in listener.blocks[tree.find("below")]] == [0, 0]


def test_a_format_changes_with_its_block(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed)
    coarser, picky, below = (tree.find(name) for name in ("coarser", "picky", "below"))
    feed.put(count=1)
    listener.wait_blocks(below, 1)
    tree.modify("coarser", "pp_step", "4")
    assert (picky.rate, below.rate) == (RATE / 4, RATE / 4), "the reported rates are those of the next block"
    assert listener.blocks[below][0].rate == RATE / 2
    feed.put(count=1)
    listener.wait_blocks(below, 2)
    block = listener.blocks[below][1]
    assert block.rate == RATE / 4
    assert block.signal == coarser.signal == picky.signal
    assert block.next_index == 16 - 3 * 4
    first, second = (block.signal for block in listener.blocks[picky])
    assert first != second


def test_a_child_rejects_the_output_format_of_its_parent(tree: Tree, feed: Feed, listener: Recorder) -> None:
    """Also from two levels below; then no processor has changed."""
    grow(tree, feed, fb_least=5)
    assert_rejected(tree, "fb_least: 5 lags are required, got 4", "coarser", "pp_lags", "4")
    assert_rejected(tree, "fb_least: 11 lags are required, got 10", "picky", "fb_least", "11")
    tree.modify("coarser", "pp_lags", "5")
    tree.modify("coarser", "pp_lags", "20")
    tree.modify("picky", "fb_least", "20")
    assert_rejected(tree, "fb_least: 20 lags are required", "coarser", "pp_lags", "5")
    with pytest.raises(ComponentError, match="fb_least: 21"):
        tree.add("gammatone", "second", "coarser", {"fb_least": 21})
    tree.add("gammatone", "second", "coarser", {"fb_least": 3})
    tree.modify("picky", "fb_least", "1")
    assert_rejected(tree, "fb_least: 3 lags are required", "coarser", "pp_lags", "2")
    tree.remove("second")
    tree.modify("coarser", "pp_lags", "2")
    feed.put(count=2)
    listener.wait_blocks(tree.find("below"), 2)
    assert all(p.error is None for p in tree.processors)


def test_a_change_waits_for_the_format_that_it_fits(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parent has already computed a block when both change. That block is processed as before, none is lost."""
    working, go_on = threading.Event(), threading.Event()
    original = Picky.process

    def process(self: Picky, block: FloatArray, extra: FloatArray | None = None) -> Output:
        working.set()
        assert go_on.wait(PATIENCE)
        return original(self, block, extra)

    monkeypatch.setattr(Picky, "process", process)
    grow(tree, feed, fb_held=0)
    coarser, picky = tree.find("coarser"), tree.find("picky")
    feed.put(count=2)
    assert working.wait(PATIENCE)
    wait_for(lambda: coarser.state is State.WAIT_RELEASE)
    tree.modify("coarser", "pp_lags", "50")
    tree.modify("picky", "fb_least", "30")  # fits only the new format
    tree.modify("picky", "fb_held", "1")
    tree.modify("coarser", "pp_lags", "30")
    go_on.set()
    feed.put(count=2)
    listener.wait_blocks(picky, 4)
    assert [block.signal.lags for block in listener.blocks[picky]] == [10, 10, 30, 30]
    assert [block.data.shape[-1] for block in listener.blocks[picky]] == [4, 4, 3, 4]
    assert picky.stage.parameters == {"fb_least": 30, "fb_held": 1, "fb_squares": False}


def test_changes_that_fit_only_with_a_format_between_them() -> None:
    """The new format requires a change, and another change requires the new format."""
    few, many = (replace(SignalFormat.sound(RATE), lags=lags) for lags in (5, 20))
    changes = ParameterUpdates(Picky(many, fb_least=20))
    for name, value in (("fb_least", 3), ("fb_held", 1)):
        changes.enqueue(changes.preview(name, value), name, value)
    changes.final_stage = changes.preview_input(few)
    changes.enqueue(changes.preview("fb_least", 5), "fb_least", 5)
    with pytest.raises(ValueError, match="fb_least"):
        changes.preview("fb_least", 6)
    stage = changes.stage_for_block(Block(0, (np.zeros((2, 4)),), 4, few))
    assert stage is not None
    assert stage.parameters == {"fb_least": 5, "fb_held": 1, "fb_squares": False}
    assert changes.stage_for_block(Block(1, (np.zeros((2, 4)),), 8, few)) is stage


def test_a_block_of_an_unusable_format_is_skipped() -> None:
    """A stage was created for the next format, and gets a block of the previous one."""
    few, many = (replace(SignalFormat.sound(RATE), lags=lags) for lags in (5, 20))
    changes = ParameterUpdates(Picky(many, fb_least=20))
    planned = changes.final_stage
    assert changes.stage_for_block(Block(0, (np.zeros((2, 4)),), 4, few)) is None
    assert changes.final_stage is planned
    assert changes.stage_for_block(Block(1, (np.zeros((2, 4)),), 8, many)) is planned


def test_the_final_stage_is_not_changed_by_a_block_of_the_previous_format() -> None:
    few, many = (replace(SignalFormat.sound(RATE), lags=lags) for lags in (5, 20))
    changes = ParameterUpdates(Picky(many, fb_least=1))
    stage = changes.stage_for_block(Block(0, (np.zeros((2, 4)),), 4, few))
    assert stage is not None
    assert (stage.output_format.lags, changes.final_stage.output_format.lags) == (5, 20)


def test_extras_are_provided_to_the_children_that_require_them(tree: Tree, feed: Feed, listener: Recorder) -> None:
    grow(tree, feed, fb_held=0)
    picky = tree.find("picky")
    feed.put(count=1)
    listener.wait_blocks(picky, 1)
    tree.modify("picky", "fb_squares", "1")
    feed.put(count=1)
    listener.wait_blocks(picky, 2)
    tree.modify("picky", "fb_squares", "0")
    feed.put(count=1)
    listener.wait_blocks(picky, 3)
    assert Coarser.computed == [frozenset(), {"squares"}, frozenset()]
    frames = np.arange(0.0, 24.0, 2.0)
    frames[4:8] **= 2
    np.testing.assert_array_equal(listener.data(picky)[0], frames)
    assert [set(block.extras) for block in listener.blocks[tree.find("coarser")]] == [set(), {"squares"}, set()]


def test_an_extra_that_the_parent_does_not_have_is_rejected(
    tree: Tree, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    grow(tree, feed)
    monkeypatch.setattr(Coarser, "EXTRAS", ())
    assert_rejected(tree, "gammatone needs the squares of preProc, which has none", "picky", "fb_squares", "1")
    with pytest.raises(ComponentError, match="needs the squares"):
        tree.add("gammatone", "second", "coarser", {"fb_squares": True})


def test_memory_includes_all_parts_and_all_descendants(tree: Tree, feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of the rate above a processor increases the output of all descendants."""
    grow(tree, feed, pp_step=100)
    before = tree.processors
    monkeypatch.setattr("rosafe.tree.sizes.machine_memory", lambda: 2 * int(8 * RATE * (2 + 0.02 + 0.03 + 0.02 + 0.1)))
    assert_rejected(
        tree, "4 processors: expected at most .* for 1 s of output, and the states", "coarser", "pp_step", "1"
    )
    tree.modify("coarser", "pp_step", "99")
    assert tree.processors == before
