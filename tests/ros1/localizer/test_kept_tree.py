"""The processors that the localizer has created, if rosAFE (`rosAFE-ros --keep`) or the localizer is killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.harness import Graph, Process, wait_for
from tests.ros1.localizer.session import acquire, names_of, running_localizer


@pytest.mark.parametrize("also_the_localizer", [pytest.param(False, marks=pytest.mark.exploration), True])
def test_restored_processors_are_removed_at_the_end(
    graph: Graph, bass: Process, device: str, sphere_model: Path, tmp_path: Path, also_the_localizer: bool
) -> None:
    acquire(graph, device)
    name = f"kept_{int(also_the_localizer)}"
    command = ("rosAFE-ros", "-i", name, "--keep", str(tmp_path / "tree.yaml"))
    options = ("--head", str(sphere_model), "--rosafe", name)
    with running_localizer(graph, *options) as first:
        with graph.node(*command) as hearing:
            first.wait_present(40)
            (root,) = (found for found in names_of(graph, name) if found.startswith("input"))
            assert graph.call(f"/{name}/PreProc", name="mine", upperDepName=root).genom_success
            before = names_of(graph, name)
            if also_the_localizer:
                assert first.process.stop(9) == -9
            assert hearing.stop(9) == -9
        with graph.node(*command):
            wait_for(lambda: names_of(graph, name) == before, what="the tree is restored")
            if also_the_localizer:
                with running_localizer(graph, *options) as second:
                    second.wait_present(40)
                    assert names_of(graph, name) == before
                    assert second.process.stop() == 0
            else:
                first.wait_present(40)
                assert names_of(graph, name) == before
                assert first.process.stop() == 0
            assert names_of(graph, name) == {root, "mine"}
