"""Fixtures: a world with nodes that the tests of a module share, and private ones for tests that break theirs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.web.genomix import world as worlds


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[worlds.World]:
    """One world for all tests of a module."""
    with worlds.world(tmp_path_factory.mktemp("world")) as world:
        yield world


@pytest.fixture
def world(shared_world: worlds.World) -> Iterator[worlds.World]:
    """The module's world, with idle components."""
    yield shared_world
    shared_world.reset()


@pytest.fixture
def empty_world(tmp_path: Path) -> Iterator[worlds.World]:
    """A private world without components."""
    with worlds.world(tmp_path, nodes=False) as world:
        yield world
