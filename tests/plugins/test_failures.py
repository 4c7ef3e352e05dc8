"""Stages that fail or do not return in the tree: they are reported, and the others continue."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.dsp.plugin_checks import PluginError, checked
from rosafe.interface import KINDS, ComponentError
from rosafe.representations import STAGES
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.harness import wait_for
from tests.plugins.stages import FAULTS, PLAIN, Fault, loaded, process, text_of
from tests.tree.support import CHANNELS, RATE, Feed, Recorder, end, grow

Use = Callable[[Fault], Path]


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Use:
    """Register a plugin and a child of it in this process, as the registry does."""

    def install(fault: Fault) -> Path:
        for kind, text in (
            ("mine", text_of(fault)),
            ("below", text_of(Fault(PLAIN.replace('"ratemap"', '"mine"'), "", ""))),
        ):
            path = tmp_path / f"{kind}.py"
            path.write_text(text.replace('"mine", doc', f'"{kind}", doc').replace("my_factor", f"{kind}_factor"))
            stage = checked(loaded(path, kind))
            monkeypatch.setitem(STAGES, kind, stage)
            monkeypatch.setitem(KINDS, kind, stage.REPRESENTATION)
        return tmp_path / "mine.py"

    return install


@pytest.fixture
def tree() -> Iterator[tuple[Tree, Recorder, Feed]]:
    """Return the tree of the guide."""
    listener, feed = Recorder(), Feed(frames=1600)
    tree = Tree(listener, workers=2)
    grow(tree, feed)
    yield tree, listener, feed
    end(tree, listener)


def feed_sound(frames: int) -> np.ndarray:
    """Put sound into the tree."""
    return np.broadcast_to(np.arange(frames, dtype=float), (2, frames))


def test_a_failure_names_the_place_and_the_children(use: Use, tree: tuple[Tree, Recorder, Feed]) -> None:
    this, listener, feed = tree
    path = use(FAULTS["writes"])
    mine = this.add("mine", "first", "ratemap")
    below = this.add("below", "second", "first")
    feed.put(count=2)
    listener.wait(lambda: {mine, below} <= set(listener.ends))
    assert isinstance(mine.error, PluginError)
    assert below.error is None
    (failure,) = this.failures
    assert str(failure).startswith(f"first (mine) failed: plugin mine ({path}:")
    assert "read-only" in str(failure)
    assert str(failure).endswith("; ended with it: second")
    with pytest.raises(ComponentError, match=r"no processor 'first': first \(mine\) failed"):
        this.find("first")
    # The output of the parent equals that of a tree without the plugin, and the others continue.
    feed.put(count=2)
    ratemap = this.find("ratemap")
    listener.wait_blocks(ratemap, 4)
    expected = rosafe.process(feed_sound(6400), RATE, parameters=CHANNELS, outputs=["ratemap"], block_frames=1600)
    np.testing.assert_array_equal(listener.data(ratemap), expected["ratemap"])
    # A new processor with that name has a new state.
    this.add("mine", "first", "ratemap")
    assert this.failures == []


def test_values_that_cannot_be_reported_end_their_processor(use: Use, tree: tuple[Tree, Recorder, Feed]) -> None:
    this, listener, _ = tree
    fault = FAULTS["derived raises"]
    body = fault.body.replace("return", "return {'my_count': 1} if not Mine.late else")
    use(fault._replace(body=f"    late = False\n{body}"))
    mine = this.add("mine", "first", "ratemap")
    type(mine.stage).PLUGIN.late = True  # type: ignore[attr-defined]
    this.modify("gammatone", "fb_nChannels", "6")  # affects all processors below it
    assert mine in listener.ends
    assert "derived: ZeroDivisionError" in str(this.failures[0])
    assert this.find("ratemap").output_shape == (2, 6)


def test_a_stage_that_does_not_return_blocks_no_other(use: Use, tree: tuple[Tree, Recorder, Feed]) -> None:
    this, listener, feed = tree
    released = threading.Event()
    use(Fault(PLAIN, "    waits = None\n" + process("self.waits.wait()", "return block * 2"), ""))
    mine = this.add("mine", "first", "ratemap")
    type(mine.stage).PLUGIN.waits = released  # type: ignore[attr-defined]
    feed.put(count=1)
    wait_for(lambda: mine.state is State.EXEC)
    this.skip(mine, mine.blocks)
    feed.put(count=5)
    listener.wait_blocks(this.find("crossCorrelation"), 6)
    listener.wait_blocks(this.find("ratemap"), 6)
    assert mine.state is State.EXEC
    assert listener.blocks[mine] == []
    # It continues after it returns.
    released.set()
    listener.wait_blocks(mine, 1)
    feed.put(count=2)
    listener.wait(lambda: listener.blocks[mine] and listener.blocks[mine][-1].number == 7)
    assert len(listener.blocks[mine]) < 8
