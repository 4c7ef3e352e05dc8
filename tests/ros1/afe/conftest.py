"""Fixtures of the node's tests: one node for all tests of a module, without processors at the start of each."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.harness import Graph
from tests.ros1.afe.session import Session


@pytest.fixture(scope="module")
def _node(graph: Graph) -> Iterator[Session]:
    with graph.node("rosAFE-ros") as process:
        session = Session(graph, process)
        yield session
        session.close()


@pytest.fixture
def afe(_node: Session) -> Iterator[Session]:
    """Provide a node without processors. After the test it must be alive, and must have logged no traceback."""
    logged = len(_node.process.err)
    yield _node
    if _node.microphone is not None:
        _node.microphone.close()
        _node.microphone = None
    _node.ok("Stop")
    assert _node.processors() == {}
    assert "Traceback" not in _node.process.err[logged:], _node.process.err[logged:]
