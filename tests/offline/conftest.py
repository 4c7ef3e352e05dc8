"""No call of `rosafe.process` leaves a thread behind, whatever its end."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rosafe.offline import chain
from tests.tree.support import tree_threads


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    yield
    assert tree_threads() == set()


@pytest.fixture
def blocks_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """None are put together, and the tree has no branches."""
    monkeypatch.setattr(chain, "MAX_BYTES", 0)
    monkeypatch.setattr(chain, "MAX_FRAMES", 10**9)
