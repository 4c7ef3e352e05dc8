"""Check after each test that no thread of `rosafe.process` is left."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rosafe.processing import chain
from tests.tree.support import tree_threads


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    yield
    assert tree_threads() == set()


@pytest.fixture
def blocks_not_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks are not merged, and the tree has no branches."""
    monkeypatch.setattr(chain, "MAX_BYTES", 0)
    monkeypatch.setattr(chain, "MAX_FRAMES", 10**9)
