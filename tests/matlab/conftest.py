"""Fixtures: nodes shared by the tests of a module, idle at the start of each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.matlab import octave
from tests.web.genomix import world as worlds


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """Start the nodes for all tests of a module."""
    octave.require_program()
    with worlds.world(tmp_path_factory.mktemp("world")) as world:
        yield world


@pytest.fixture
def world(shared_world: worlds.World) -> Iterator[worlds.World]:
    """Return the nodes of the module, and reset them after the test."""
    yield shared_world
    shared_world.reset()
