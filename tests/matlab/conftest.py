"""Fixtures: nodes shared by the tests of a module, idle at the start of each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.conftest import world

__all__ = ["world"]


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """Start the nodes for all tests of a module."""
    octave.require_program()
    with worlds.world(tmp_path_factory.mktemp("world")) as world:
        yield world
