"""Fixtures: a world with nodes that the tests of a module share, idle at the beginning of each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.genomix import world as worlds
from tests.matlab import octave


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """One world for all tests of a module."""
    octave.needed()
    with worlds.world(tmp_path_factory.mktemp("world")) as world:
        yield world


@pytest.fixture
def world(shared_world: worlds.World) -> Iterator[worlds.World]:
    """The module's world, with idle components."""
    yield shared_world
    shared_world.reset()
