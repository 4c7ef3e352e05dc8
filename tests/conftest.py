"""Fixtures of the whole suite; tests/harness.py is what stands behind them."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosafe.component import generate
from tests import harness
from tests.bass.pulse import PulseServer

STARTING = ("cli", "demo", "live", "packaging", "setups")  # folders whose tests start commands, browsers, compilers
ELSEWHERE = ("aarch64", "nehalem", "clang")  # kernels under qemu, or of the other compiler

generate.ensure_messages()  # test modules import rosAFE.msg and bass.msg at their top


@pytest.fixture(scope="session", autouse=True)
def _default_signals() -> None:
    """In every process that runs tests, before it starts anything; not in the one that only starts those."""
    harness.let_children_have_default_signals()


@pytest.fixture(scope="session")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[harness.Graph]:
    """The ROS graph that all tests of this process share: a master on a free port."""
    with harness.shared_graph(tmp_path_factory.mktemp("home")) as graph:
        yield graph


@pytest.fixture
def private_graph(tmp_path: Path) -> Iterator[tuple[harness.Graph, harness.MasterProcess]]:
    """A ROS graph of the test's own, and its master, which may be killed and started again."""
    with harness.private_graph(tmp_path) as pair:
        yield pair


@pytest.fixture
def bass_node(graph: harness.Graph) -> Iterator[harness.Process]:
    """A running bass-ros, new for the test."""
    with graph.node("bass-ros") as process:
        yield process


@pytest.fixture
def rosafe_node(graph: harness.Graph) -> Iterator[harness.Process]:
    """A running rosAFE-ros, new for the test."""
    with graph.node("rosAFE-ros") as process:
        yield process


@pytest.fixture
def pulse(tmp_path: Path) -> Iterator[PulseServer]:
    """A sound card: a PulseAudio server of the test's own, which may be killed and started again."""
    server = PulseServer(tmp_path)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def small_disk(tmp_path: Path) -> tuple[Path, list[str]]:
    """A folder, and the beginning of a command line: for that command the folder is a file system of 4 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = 'mount -t tmpfs -o size=4m none "$0" && exec "$@"'
    before = ["unshare", "--mount", "sh", "-c", mount, str(folder)]
    tried = subprocess.run([*before, "true"], capture_output=True, text=True, check=False)
    if tried.returncode != 0:
        pytest.skip(f"no file system can be mounted here: {tried.stderr.strip()}")
    return folder, before


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `scripts/test --fast` leaves out: tests on a ROS graph, and those that build, install or lint.

    Their files and the other long ones come first, so that none is left for one process alone at the end.
    """
    for item in items:
        uses_graph = {"graph", "private_graph"} & set(getattr(item, "fixturenames", ()))
        if uses_graph or item.path.relative_to(harness.ROOT).parts[1] in STARTING:
            item.add_marker("ros")
        call = getattr(item, "callspec", None)
        if call is not None and call.params.get("level") in ELSEWHERE:
            item.add_marker("long")
    slow = {item.path for item in items if item.get_closest_marker("ros") or item.get_closest_marker("long")}
    items.sort(key=lambda item: item.path not in slow)
