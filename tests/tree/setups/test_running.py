"""Setups on a running graph: by command, HTTP and Tcl; as transactions; the same tree after all nodes were killed."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml

from rosafe.tree.setups import SetupError, read
from tests.harness import ROOT, Graph, wait_for
from tests.tree.setups.test_files import TREE
from tests.web.genomix import world as worlds


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tree.yaml"
    path.write_text(TREE.replace("parent: input}", "parent: input, pp_coefPreEmphasis: 0}"))
    return path


def processors(graph: Graph) -> list[Any]:
    return list(graph.call("/rosAFE/getProcessors").processors)


def test_saved_killed_and_loaded_again(graph: Graph, file: Path, tmp_path: Path) -> None:
    saved = tmp_path / "saved.yaml"
    with graph.node("bass-ros") as bass, graph.node("rosAFE-ros") as afe:
        done = graph.run("rosafe", "setup", "load", str(file))
        assert done.stdout.split()[:3] == ["started", "sound", "created"]
        before = processors(graph)
        assert [p.name for p in before] == ["input", "time", "bank", "ihc", "ild"]
        values = {e.name: e.value for e in before[1].parameters}
        assert values["pp_coefPreEmphasis"] == "0.0"
        graph.run("rosafe", "setup", "save", str(saved), "--full")
        assert graph.run("rosafe", "setup", "load", str(saved)).stdout.count("reused") == 6
        refused = graph.run(
            "rosafe", "setup", "load", "-", check=False, stdin=file.read_text().replace("0.005", "0.006")
        )
        assert refused.returncode == 1
        assert "'ild' exists already and has ild_hSizeSec 0.005" in refused.stderr
        assert processors(graph) == before
        for process in (bass, afe):
            process.stop(signal.SIGKILL)
    with graph.node("bass-ros"), graph.node("rosAFE-ros"):
        graph.run("rosafe", "setup", "load", str(saved))
        assert processors(graph) == before
        assert graph.call("/bass/getAcquisition").device == "scene:"


def test_the_settings_of_the_localizer_become_its_parameters(graph: Graph, tmp_path: Path) -> None:
    """Files are relative to the setup. Settings that are not given are removed from the parameter server."""
    file = tmp_path / "robot.yaml"
    with graph.node("rosAFE-ros"):
        for settings, expected in (
            ("{head: robot.head, audio_delay: 0.02}", {"head": str(tmp_path / "robot.head"), "audio_delay": 0.02}),
            ("{head: a.sofa, mirror: false}", {"head": str(tmp_path / "a.sofa"), "mirror": False}),
            ("{head: sphere}", {"head": "sphere"}),
        ):
            file.write_text(f"localizer: {settings}\n")
            done = graph.run("rosafe", "setup", "load", str(file))
            assert done.stdout == "set      parameters of the localizer; start it with: rosafe localize\n"
            found = yaml.safe_load(graph.run("rosparam", "get", "/localizer").stdout)
            assert {name: value for name, value in found.items() if name != "created"} == expected
        graph.run("rosparam", "delete", "/localizer")


def test_save_names_what_it_leaves_out(graph: Graph, tmp_path: Path) -> None:
    with graph.node("rosAFE-ros"):
        assert "localizer" not in graph.run("rosafe", "setup", "save", "-").stderr
        with graph.start("rosafe", "localize") as localizer:
            wait_for(lambda: "ready" in localizer.err)
            saved = graph.run("rosafe", "setup", "save", str(tmp_path / "saved.yaml"))
            assert "the localizer is not saved; add a section localizer" in saved.stderr
            assert localizer.stop() == 0
    assert read((tmp_path / "saved.yaml").read_text()).localizer is None


def test_by_http_and_tcl(file: Path, tmp_path: Path) -> None:
    text = file.read_text()
    with worlds.world(tmp_path) as world:
        call = world.http.call
        with pytest.raises(worlds.HttpError) as refused:
            call("rosAFE/loadSetup", {"setup": text.replace("kind: ild", "kind: idl")})
        assert refused.value.ex == "::rosAFE::e_badNewValue"
        assert "line 12: 'ild': unknown kind 'idl'" in refused.value.what
        assert call("rosAFE/getProcessors")["processors"] == []
        assert not call("bass/getAcquisition")["running"]
        answer = call("rosAFE/loadSetup", {"setup": text})
        assert answer == {"created": ["input", "time", "bank", "ihc", "ild"], "reused": [], "sound": "started"}
        assert read(call("rosAFE/saveSetup")["setup"]) == read(text)
        first, *rest = world.lines(f"""
            set g [genomix::connect $address]
            $g load rosAFE
            puts [rosAFE::loadSetup [read [open {file}]]]
            puts [dict get [rosAFE::saveSetup {{full 1}}] setup]
        """)
        assert first.split(" reused ")[1] == "{0 input 1 time 2 bank 3 ihc 4 ild} sound reused"
        saved = "\n".join(rest)
        assert read(saved) == read(text) and "pp_cutoffHzDC: 20.0" in saved


@pytest.mark.parametrize(
    ("arguments", "code", "what"),
    [
        (("load", "/nowhere.yaml"), 1, "/nowhere.yaml: No such file"),
        (("load", "FILE", "--full"), 2, "--full is for save"),
        (("save", "FILE", "--keep", "x"), 2, "--keep is for load"),
        (("show", "FILE"), 2, "invalid choice"),
        (("save", "FILE", "-i", "nobody"), 1, "start it with: rosAFE-ros -i nobody"),
        (("load", "FILE", "--wait", "nan"), 2, "expected a number of seconds from 0 to 3600"),
    ],
)
def test_invalid_command_lines(graph: Graph, file: Path, arguments: tuple[str, ...], code: int, what: str) -> None:
    before = file.read_bytes()
    words = [str(file) if word == "FILE" else word for word in arguments]
    done = graph.run("rosafe", "setup", *words, check=False)
    assert (done.returncode, done.stdout) == (code, "")
    assert what in done.stderr
    assert done.stderr.count("\n") == 1
    assert file.read_bytes() == before


def test_all_setups_in_documents_and_examples_can_be_read() -> None:
    shown = re.findall(r"^```yaml\n(.*?)^```$", (ROOT / "docs" / "setups.md").read_text("utf-8"), re.M | re.S)
    shipped = [path.read_text("utf-8") for path in sorted((ROOT / "setups").glob("*.yaml"))]
    assert shown
    assert shipped
    for text in (*shown, *shipped):
        assert read(text).processors
    wrong = shown[0].replace("ild_hSizeSec: 0.005", "ild_hSizeSec: -1")
    with pytest.raises(SetupError, match="'ild': ild_hSizeSec: expected a number above 0, at most 60, got -1"):
        read(wrong)
