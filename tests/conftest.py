"""Fixtures of the whole suite, based on tests/harness.py."""

from __future__ import annotations

import gc
import re
import signal
import subprocess
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import hypothesis
import pytest

from rosafe.ros1.component import generate
from tests import fork_server, harness
from tests.audio.pulseaudio import PulseServer
from tests.dsp.implementations import NUMPY, Choice, levels

# Folders whose tests start commands, browsers, compilers
STARTING = ("commands", "demo", "web/live", "packaging", "ros2", "tree/setups")
# Folders whose tests start programs as users do, not as forks
OF_THE_START = ("demo", "packaging", "soak", "ros1/startup")
STARTING_FILES = (  # the same for single files
    "ros1/bass/test_calibration.py",
    "audio/test_hostile_files.py",
    "ros1/bass/test_record.py",
    "commands/eltclsh/test_script.py",
    "commands/eltclsh/test_terminal.py",
    "web/genomix/test_packed.py",
    "ros1/localizer/test_recovery.py",
    "results/test_damaged.py",
    "processing/test_examples.py",
    "plugins/test_documents.py",
    "plugins/test_faults.py",
    "plugins/test_loading.py",
    "plugins/test_plugins.py",
    "test_harness.py",
)
LONG_FILES = (  # dozens of seconds of computation; scripts/test --fast has others for the same code
    "dsp/test_processors.py",
    "localization/test_audio_delay.py",
    "localization/test_commands.py",
    "localization/test_enhancement.py",
    "localization/test_localize.py",
    "localization/test_noise.py",
    "processing/test_blocks.py",
    "results/test_results.py",
    "processing/test_resynthesis.py",
    "localization/test_tracker.py",
    "ros1/localizer/test_calibration.py",
    "ros1/localizer/test_long_silence.py",
    "processing/test_stream.py",
    "validation/test_validate.py",
    "results/view/test_plot.py",
)
LONGEST_FILES = (  # they begin first, so that no process works on one of them while the others have nothing to do
    "packaging/test_lint.py",
    "packaging/test_catkin.py",
    "packaging/test_wheel.py",
    "packaging/test_kernels.py",
    "ros1/localizer/test_attacks.py",
    "ros1/localizer/test_recovery.py",
    "ros1/localizer/test_node.py",
    "ros1/afe/test_attacks.py",
    "ros1/startup/test_startup.py",
    "demo/test_readme.py",
    "dsp/test_kernels.py",
)
NO_KERNELS = (  # tests of stages that have no kernel: the same code runs with kernels and without
    "representations/test_interaural.py",
    "representations/test_moc.py",
    "representations/test_pitch.py",
    "representations/test_transients.py",
)
EACH_VARIANT = 4  # of the cases of a test, each fourth is repeated with numpy, or with kernels of an older processor
EACH_CASE = {  # of the cases of these tests, each n-th one runs in the normal suite; all with scripts/test --long
    "commands/test_corpus.py::test_names_that_are_not_utf8": 2,
    "dsp/test_kernels.py::test_autocorrelation": 4,
    "dsp/test_processors.py::test_every_kernel": 3,
    "web/genomix/test_guide.py::test_usage_patterns_of_published_scripts": 2,
    "web/genomix/test_namespaces.py::test_commands": 2,
    "web/genomix/test_trouble.py::test_known_components_continue_without_a_master": 2,
    "ros1/localizer/test_attacks.py::test_frames_with_strange_values_and_indices": 2,
    "ros1/localizer/test_ear_check.py::test_the_command": 2,
    "ros1/startup/test_startup.py::test_an_unreachable_address_is_reported": 2,
    "ros1/startup/test_startup.py::test_instance": 2,
    "ros1/startup/test_startup.py::test_wrong_instance_name": 3,
    "ros1/localizer/test_node.py::test_offline_and_live_agree": 2,
    "processing/test_examples.py::test_an_example": 2,
    "processing/test_process.py::test_results_are_freed_with_their_last_reference": 3,
    "packaging/test_catkin.py::test_executables": 2,
    "plugins/test_documents.py::test_examples": 2,
    "plugins/test_versions.py::test_a_client_with_another_plugin": 2,
    "tree/setups/test_parsing_time.py::test_time_is_bounded": 4,
    "tree/setups/test_parsing_time.py::test_time_is_linear": 5,
    "tree/test_schedules.py::test_any_order_of_events": 2,
    "results/view/test_plot.py::test_silent_and_very_short_signals": 3,
}
ELSEWHERE = ("aarch64", "nehalem", "clang")  # kernels under qemu, or built by another compiler

hypothesis.settings.register_profile("suite", deadline=None)  # a busy machine may take long for any example
hypothesis.settings.load_profile("suite")
generate.ensure_messages()  # test modules import rosAFE.msg and bass.msg at their top


@pytest.fixture(scope="session", autouse=True)
def _default_signals() -> None:
    """Run in every process that runs tests, before it starts other processes; not in the coordinator of xdist."""
    harness.let_children_have_default_signals()


@pytest.fixture(autouse=True)
def _restored_process() -> Iterator[None]:
    """Restore the signal handlers and the variables that decide about forks; commands in this process change them.

    With the handler of a command, a process of `multiprocessing` that is forked later would not end at SIGTERM.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in handlers.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)
    fork_server.restore_environment()


@pytest.fixture(scope="session")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[harness.Graph]:
    """The ROS graph shared by all tests of this process: a master on a free port."""
    with harness.shared_graph(tmp_path_factory.mktemp("home")) as graph:
        yield graph


@pytest.fixture
def private_graph(tmp_path: Path) -> Iterator[tuple[harness.Graph, harness.MasterProcess]]:
    """A separate ROS graph for the test, and its master, which may be killed and started again."""
    with harness.private_graph(tmp_path) as pair:
        yield pair


@pytest.fixture
def bass_node(graph: harness.Graph) -> Iterator[harness.Process]:
    """A running bass-ros, started for the test."""
    with graph.node("bass-ros") as process:
        yield process


@pytest.fixture
def rosafe_node(graph: harness.Graph) -> Iterator[harness.Process]:
    """A running rosAFE-ros, started for the test."""
    with graph.node("rosAFE-ros") as process:
        yield process


@pytest.fixture
def pulse(tmp_path: Path) -> Iterator[PulseServer]:
    """A simulated sound card: a PulseAudio server for the test, which may be killed and started again."""
    server = PulseServer(tmp_path)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def small_disk(tmp_path: Path) -> tuple[Path, list[str]]:
    """A folder and a command prefix: for commands with this prefix the folder is a file system of 4 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = 'mount -t tmpfs -o size=4m none "$0" && exec "$@"'
    prefix = ["unshare", "--mount", "sh", "-c", mount, str(folder)]
    tried = subprocess.run([*prefix, "true"], capture_output=True, text=True, check=False)
    if tried.returncode != 0:
        pytest.skip(f"mounting a file system failed: {tried.stderr.strip()}")
    return folder, prefix


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import the tests of whole folders that `scripts/test --fast` excludes."""
    excluded = "not ros" in config.option.markexpr and collection_path.parent == harness.ROOT / "tests"
    return True if excluded and _is_in(collection_path, STARTING) else None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Select how programs start, before the fixtures of the test are created."""
    of_the_start = _is_in(item.path, OF_THE_START)
    harness.forks = not of_the_start or item.get_closest_marker("forks") is not None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests that `scripts/test --fast` excludes: those with a ROS graph, and those that build, install or lint.

    Their files and other long ones run first, so that the last long file does not occupy a single process at the end.
    """
    for item in items:
        file = item.path.relative_to(harness.ROOT / "tests")
        uses_graph = {"graph", "private_graph", "world"} & set(getattr(item, "fixturenames", ()))
        if uses_graph or _is_in(item.path, STARTING) or str(file) in STARTING_FILES:
            item.add_marker("ros")
        only_in_long_runs = item.get_closest_marker("soak") or item.get_closest_marker("exploration")
        if only_in_long_runs or _implementation(item) in ELSEWHERE or str(file) in LONG_FILES:
            item.add_marker("long")
        if _is_variant(item):
            item.add_marker("variant")
    _deselect_repetitions(items, config)
    _mark_repetitions(items)
    slow = {item.path for item in items if item.get_closest_marker("ros") or item.get_closest_marker("long")}
    order = {harness.ROOT / "tests" / file: number - len(LONGEST_FILES) for number, file in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: order.get(item.path, int(item.path not in slow)))


@cache  # thousands of tests are in few files
def _is_in(path: Path, folders: tuple[str, ...]) -> bool:
    """Return whether a file or folder of tests is one of `folders` or in one of them."""
    return any(path.is_relative_to(harness.ROOT / "tests" / folder) for folder in folders)


def pytest_collection_finish() -> None:
    """Leave the collected tests out of garbage collections, which would examine them again and again.

    Imported modules may have changed variables that decide about forks (`rosafe.ros2` sets the threads of OpenBLAS).
    """
    fork_server.restore_environment()
    gc.collect()
    gc.freeze()


def _implementation(item: pytest.Item) -> Choice | None:
    """Return the implementation that a test selects by its argument `level`; levels of sound are floats."""
    level = item.callspec.params.get("level") if hasattr(item, "callspec") else None
    return level if isinstance(level, int | str) else None


def _is_variant(item: pytest.Item) -> bool:
    """Return whether a test repeats another one with numpy, or with kernels of an older set of instructions."""
    level = _implementation(item)
    older = isinstance(level, int) and level not in (NUMPY, max(levels(), default=NUMPY))
    return older or (hasattr(item, "callspec") and item.callspec.params.get("implementation") == "numpy")


def _deselect_repetitions(items: list[pytest.Item], config: pytest.Config) -> None:
    """Deselect tests with numpy instead of kernels that do not depend on this fixture.

    They check declared limits of parameters, select implementations themselves, or are about stages without a kernel.
    """

    def repeated(item: pytest.Item) -> bool:
        if not hasattr(item, "callspec") or item.callspec.params.get("implementation") != "numpy":
            return False
        name = item.name.partition("[")[0]
        limits = re.search("invalid|bad_|rejected|wrong_|sample_rates", name)
        without_kernel = str(item.path.relative_to(harness.ROOT / "tests")) in NO_KERNELS
        return limits is not None or without_kernel or _implementation(item) is not None

    kept = [item for item in items if not repeated(item)]
    config.hook.pytest_deselected(items=[item for item in items if repeated(item)])
    items[:] = kept


def _mark_repetitions(items: list[pytest.Item]) -> None:
    """Leave most cases of some tests to `scripts/test --long`: see `EACH_VARIANT` and `EACH_CASE`."""
    numbers: Counter[tuple[str, str]] = Counter()
    for item in items:
        test, variant = item.nodeid.partition("[")[0].removeprefix("tests/"), ""
        each = EACH_CASE.get(test, 1)
        if item.get_closest_marker("variant") or _implementation(item) == "aarch64":
            params = item.callspec.params  # type: ignore[attr-defined]
            variant, each = str(_implementation(item) or params.get("implementation")), EACH_VARIANT
        if numbers[test, variant] % each:
            item.add_marker("exploration")
        numbers[test, variant] += 1
