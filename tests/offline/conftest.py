"""No call of `rosafe.process` leaves a thread behind, whatever its end."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.tree.support import tree_threads


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    yield
    assert tree_threads() == set()
