"""A client and a node with different plugins: both report it, without a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosafe.tree.setups import read
from tests.harness import SCRIPTS, Graph, wait_for
from tests.web.genomix.world import Http, HttpError, port_of

from .test_declarations import GOOD

pytestmark = pytest.mark.ros


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Return folders without a plugin, with one, and with another version of it."""
    made = tuple(tmp_path / name for name in ("none", "first", "second"))
    for folder in made:
        folder.mkdir()
    (made[1] / "mine.py").write_text(GOOD.format(kind="mine"))
    other = GOOD.format(kind="mine").replace('"mine_gain", "double", 1.0', '"mine_gain", "string", "1"')
    (made[2] / "mine.py").write_text(other.replace(", minimum=0.0, maximum=2.0", ""))
    return made[0], made[1], made[2]


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (0, "started without the plugin mine; set ROSAFE_PLUGINS and restart it"),
        (2, "started with another version of the plugin mine"),
    ],
)
def test_a_client_with_another_plugin(
    bass_node: object, graph: Graph, folders: tuple[Path, Path, Path], number: int, reason: str
) -> None:
    """The command, and requests of genomixd: synchronous, asynchronous, from Tcl, and as a whole tree.

    Requests for other kinds are not affected.
    """
    command = (str(SCRIPTS / "genomixd"), "-v", "-p", "0")
    with (
        graph.node("rosAFE-ros", "-i", "versions", ROSAFE_PLUGINS=str(folders[number])),
        graph.start(*command, ROSAFE_PLUGINS=str(folders[1])) as server,
    ):
        graph.call("/bass/Acquire", device="scene:", sampleRate=8000)
        done = graph.run("rosafe", "request", "mine", "-i", "versions", check=False, ROSAFE_PLUGINS=str(folders[1]))
        graph.call("/bass/Stop")
        assert done.returncode == 1
        assert f"versions was {reason}" in done.stderr
        assert "Traceback" not in done.stderr and "is not running" not in done.stderr
        http = Http(port_of(server))
        http.get("/load/rosAFE", i="versions", s="t")
        for given in ("m", ["m", "ihc"]):
            with pytest.raises(HttpError) as raised:
                http.call("versions/MineProc", given if isinstance(given, list) else {"name": given}, s="t")
            assert reason in raised.value.what
        failed = http.wait(http.send("versions/MineProc"), "error")
        assert reason in str(failed["exception"])
        script = f"""
            package require genomix
            set g [::genomix::connect 127.0.0.1:{http.port}]
            $g load rosAFE -i versions
            puts [catch {{::versions::MineProc {{}}}} message]$message
            puts [::versions::getParameters]
        """
        path = graph.home / "versions.tcl"
        path.write_text(script)
        called, parameters = graph.run("tclsh", str(path)).stdout.splitlines()
        assert called.startswith("1") and reason in called
        assert parameters.startswith("parameters")
        assert "Traceback" not in server.err


def test_a_saved_tree_without_its_plugin(graph: Graph, folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """The rest is restored; log and /diagnostics report the missing plugin and the search path; a copy is complete."""
    file = tmp_path / "tree.yaml"
    text = (
        "connections: {Audio: /bass/Audio}\nprocessors:\n  input: {kind: input}\n  preProc: {kind: preProc}\n"
        "  filters: {kind: gammatone}\n  hair: {kind: ihc, parent: filters}\n"
        "  one: {kind: mine, parent: hair, mine_gain: 0.5}\n  two: {kind: grandchild, parent: one}\n"
    )
    file.write_text(text)
    with graph.node("rosAFE-ros", "-i", "lacking", "--keep", str(file), ROSAFE_PLUGINS=str(folders[0])) as process:
        wait_for(lambda: "left out of the tree" in process.err)
        said = next(line for line in process.err.splitlines() if "left out of the tree" in line)
        wait_for(lambda: "waiting for sound" in graph.run("rostopic", "echo", "-n", "1", "/diagnostics").stdout)
    assert "one (plugin 'mine' not found)" in said
    assert "two (plugin 'grandchild' not found)" in said
    assert f"ROSAFE_PLUGINS is {folders[0]}" in said
    assert Path(f"{file}.complete").read_text() == text


def test_what_is_below_a_missing_one_is_left_out_too() -> None:
    absent: list[str] = []
    setup = read(
        "processors: {input: {kind: input}, a: {kind: nothing, parent: input}, preProc: {kind: preProc, parent: a}}",
        absent,
    )
    assert [one.name for one in setup.processors] == ["input"]
    assert absent == ["a (plugin 'nothing' not found)", "preProc (descendant of a)"]
