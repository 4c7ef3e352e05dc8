"""Fixtures: a tree, its listener and its source. The tree is stopped after the test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rosafe.dsp import kernels
from rosafe.tree.tree import Tree

from .support import Feed, Recorder, end


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """Compile the kernels before the first test."""
    kernels.compiled()


@pytest.fixture
def listener() -> Recorder:
    return Recorder()


@pytest.fixture
def feed() -> Feed:
    return Feed()


@pytest.fixture
def workers() -> int | None:
    """Number of workers; None for one on each core."""
    return None


@pytest.fixture
def tree(listener: Recorder, workers: int | None) -> Iterator[Tree]:
    tree = Tree(listener, workers)
    yield tree
    end(tree, listener)
