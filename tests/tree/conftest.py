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
def feed(request: pytest.FixtureRequest) -> Feed:
    """A source with blocks of `FRAMES` of the module, if it has them."""
    return Feed(**{"frames": request.module.FRAMES} if hasattr(request.module, "FRAMES") else {})


@pytest.fixture
def workers(request: pytest.FixtureRequest) -> int | None:
    """Number of workers: that of a test, or `WORKERS` of its module; None for one on each core."""
    return getattr(request, "param", getattr(request.module, "WORKERS", None))


@pytest.fixture
def tree(listener: Recorder, workers: int | None) -> Iterator[Tree]:
    tree = Tree(listener, workers)
    yield tree
    end(tree, listener)
