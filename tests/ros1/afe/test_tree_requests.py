"""The service `request`: builds a whole tree, or nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from rosafe.tree.setups import read
from tests.harness import Graph
from tests.ros1.afe.session import RATE, Microphone, Session, noise, own_node

BLOCK = "nFramesPerBlock: 1600"
PITCH = ["input_0", "time_0", "filterbank_0", "innerhaircell_0", "autocorrelation_0", "pitch_0"]


def tree(afe: Session) -> dict[str, str]:
    """Return the parent of each processor."""
    return {p.name: p.upperDepName for p in afe.ok("getProcessors").processors}


def parameters(afe: Session, name: str) -> dict[str, str]:
    """Return the parameters of a processor, as texts."""
    (found,) = (p for p in afe.ok("getProcessors").processors if p.name == name)
    return {p.name: p.value for p in found.parameters}


def sounding(afe: Session) -> Microphone:
    """Connect the node to a microphone that publishes audio."""
    microphone = afe.listen()
    microphone.play(noise(400))
    return microphone


def why(afe: Session, **fields: Any) -> tuple[str, str]:
    """Return exception and reason of a rejected request, and check that nothing has changed."""
    before = tree(afe)
    ex, detail = afe.refused("request", **fields)
    assert tree(afe) == before
    return ex, str(detail.get("what", ""))


def rosservice(graph: Graph, text: str) -> Any:
    """Return the output of `rosservice call`."""
    return yaml.safe_load(graph.run("rosservice", "call", "/rosAFE/request", text).stdout)


def test_a_tree_by_rosservice_while_only_bass_runs(graph: Graph) -> None:
    with graph.node("bass-ros"), graph.node("rosAFE-ros") as process:
        afe = Session(graph, process)
        acquire = "{device: 'scene:', sampleRate: 44100, nFramesPerChunk: 2205}"
        assert "genom_success: True" in graph.run("rosservice", "call", "/bass/Acquire", acquire).stdout
        values = "{representation: pitch, parameters: 'fb_nChannels: 16, pi_rangeHz: [80, 300]', connect: bass/Audio}"
        assert rosservice(graph, values) == {
            "genom_success": True,
            "genom_exdetail": "",
            "name": "pitch_0",
            "dependencies": PITCH,
            "created": PITCH,
            "reused": [],
            "unused": [],
            "port": "pitchPort",
            "topic": "/rosAFE/pitchPort/pitch_0",
        }
        assert tree(afe) == dict(zip(PITCH, ["", *PITCH], strict=False))
        assert len(parameters(afe, "filterbank_0")["fb_cfHz"].split(",")) == 16
        assert parameters(afe, "pitch_0")["pi_rangeHz"] == "[80.0, 300.0]"
        assert graph.message("/rosAFE/pitchPort/pitch_0", accept=lambda m: m.lastFrameIndex > 0).framesOnPort > 0

        modulation = rosservice(graph, "{representation: amsFeatures}")
        assert modulation["genom_success"], modulation
        assert modulation["reused"] == ["input_0", "time_0"] and modulation["created"][0] == "filterbank_1"
        assert modulation["dependencies"] == modulation["reused"] + modulation["created"]
        assert graph.message(modulation["topic"], accept=lambda m: m.lastFrameIndex > 0).framesOnPort > 0

        again = rosservice(graph, values)
        assert (again["dependencies"], again["created"], again["reused"]) == (PITCH, [], PITCH)
        known = graph.run("rosafe", "request", "pitch", "fb_nChannels=16", "pi_rangeHz=80,300", "--json").stdout
        assert json.loads(known)["reused"] == PITCH  # genomixd accepts the same parameters
        assert "Traceback" not in process.err
        afe.close()


def test_existing_processors_are_used_and_the_input_is_not_changed(afe: Session) -> None:
    sounding(afe)
    first = afe.ok("request", representation="ild", parameters=f"{{{BLOCK}, fb_cfHz: [200, 400], rm_wSizeSec: 0.03}}")
    assert first.unused == ["rm_wSizeSec"] and first.topic == f"/{afe.name}/ildPort/ild_0"
    assert parameters(afe, "input_0")["nFramesPerBlock"] == "1600"
    lines = "fb_cfHz: [200.0, 4e2]\nrm_scaling: magnitude  # not power\nnFramesPerBlock: 800"
    second = afe.ok("request", representation="RateMap", parameters=lines)
    assert second.reused == first.dependencies[:4] and second.created == ["ratemap_0"]
    assert second.unused == ["nFramesPerBlock"]
    assert parameters(afe, "ratemap_0")["rm_scaling"] == "magnitude"

    given = "in_doNormalize: false"
    ex, what = why(afe, representation="ild", parameters=given)
    assert ex == "::rosAFE::e_existsAlready" and "'input_0' has in_doNormalize" in what and "modifyParameter" in what


def test_a_request_that_fails_half_way_leaves_nothing(afe: Session) -> None:
    sounding(afe)
    beyond = f"{BLOCK}, fb_nChannels: 4, fb_highFreqHz: {RATE * 0.75}"
    ex, what = why(afe, representation="ild", parameters=beyond)  # input and time are created first
    assert ex == "::rosAFE::e_badNewValue" and "fb_highFreqHz" in what
    assert tree(afe) == {}
    afe.ok("request", representation="time", parameters=BLOCK)
    assert why(afe, representation="ild", parameters=f"{beyond}, pp_bRemoveDC: true")[0] == ex
    assert tree(afe) == {"input_0": "", "time_0": "input_0"}
    afe.wait_activities(["InputProc", "PreProc"])


def test_without_audio_nothing_is_created(graph: Graph) -> None:
    with own_node(graph, name="deaf") as afe:
        assert why(afe, representation="ild", connect="nobody/Audio")[0] == "::genom::no_such_outport"
        assert why(afe, representation="ild", connect="no topic")[0] == "::genom::no_such_outport"
        response = afe.call("request", representation="ild")
        assert json.loads(response.genom_exdetail) == {
            "ex": "::rosAFE::e_noData",
            "what": "the Audio port is not connected: call connect_port first",
        }
        assert tree(afe) == {} and afe.activities() == {}
        microphone = Microphone(graph, sample_rate=20000)
        found = afe.ok("request", representation="time", connect=microphone.topic)
        assert found.topic == "/deaf/preProcPort/time_0"
        microphone.close()


HOSTILE = {  # all others: tests/tree/setups
    "fb_nChannels: !!python/object/apply:os.system ['touch MARK']": "tags",
    "{fb_cfHz: " * 20_000: "nested too deeply",
    '{"fb_nChannels": 4, "fb_nChannels": 5}': "twice",
    '{"fb_nChannels": 4000}': "fb_nChannels: expected a number from 0 to 1024, got 4000",
    '{"fb_nChannel": 4}': "did you mean fb_nChannels?",
    "fb_nChannels: ": "one value",
    "x" * 300_000: "characters",
    "representation: ild": "unknown 'representation'",
    "fb_nChannel: 4": "did you mean fb_nChannels?",
}


@pytest.mark.parametrize(("text", "reason"), HOSTILE.items(), ids=[text[:30] for text in HOSTILE])
def test_texts_that_are_not_parameters(afe: Session, tmp_path: Path, text: str, reason: str) -> None:
    mark = tmp_path / "mark"
    ex, what = why(afe, representation="ratemap", parameters=text.replace("MARK", str(mark)))
    assert ex == "::rosAFE::e_badNewValue" and reason in what and "\n" not in what
    assert not mark.exists()


def test_unknown_representations(afe: Session) -> None:
    ex, what = why(afe, representation="pich")
    assert ex == "::rosAFE::e_badNewValue" and "pitch" in what and "did you mean pitch?" in what
    assert why(afe)[0] == ex


def test_find_and_remove_unused(afe: Session) -> None:
    sounding(afe)
    assert afe.refused("find", representation="time")[0] == "::rosAFE::e_noSuchProcessor"
    created = afe.ok("request", representation="ild", parameters=f"{BLOCK}, fb_nChannels: 4").created
    found = afe.ok("find", representation="ild", parameters="fb_nChannels: 4")
    assert (found.reused, found.created, found.topic) == (created, [], f"/{afe.name}/ildPort/ild_0")
    afe.ok("PreProc", name="mine", upperDepName="input_0")
    assert afe.ok("removeUnused", names=created).removed == created[:0:-1]
    assert tree(afe) == {"input_0": "", "mine": "input_0"}
    afe.wait_activities(["InputProc", "PreProc"])


def test_a_setup_is_built_by_the_node_completely_or_not_at_all(graph: Graph) -> None:
    """It connects the port; if a processor is refused, the previous topic is connected again."""
    with own_node(graph, name="loading") as afe:
        first, second = Microphone(graph), Microphone(graph, sample_rate=20000)
        text = "processors:\n  input: {kind: input, nFramesPerBlock: 1600}\n  preProc: {kind: preProc}\n"
        bank = "  bank: {kind: gammatone, parent: preProc, fb_highFreqHz: 9000}\n"
        for microphone in (first, second):
            microphone.play(noise(400))
        setup = f"connections: {{Audio: {first.topic}}}\n{text}"
        assert afe.ok("loadSetup", setup=setup, check=True).created == ["input", "preProc"]
        assert (tree(afe), read(afe.ok("saveSetup").setup).connections) == ({}, {})
        assert afe.ok("loadSetup", setup=setup).created == ["input", "preProc"]
        assert afe.ok("loadSetup", setup=setup).reused == ["input", "preProc"]
        assert read(afe.ok("saveSetup").setup).processors == read(text).processors
        other = setup.replace(first.topic, second.topic)
        ex, detail = afe.refused("loadSetup", setup=other)
        assert ex == "::rosAFE::e_existsAlready" and f"the tree is connected to {first.topic}" in detail["what"]
        afe.ok("Stop")
        assert afe.refused("loadSetup", setup=f"{other}{bank.replace('9000', '15000')}")[0] == "::rosAFE::e_badNewValue"
        saved = read(afe.ok("saveSetup", full=True).setup)
        assert (saved.processors, dict(saved.connections)) == ((), {"Audio": first.topic.removeprefix("/")})
        assert afe.ok("loadSetup", setup=f"{other}{bank}").created == ["input", "preProc", "bank"]
        afe.wait_activities(["InputProc", "PreProc", "GammatoneProc"])
        assert "line 2" in afe.refused("loadSetup", setup="processors:\n  a: {kind: x}")[1]["what"]
        first.close()
        second.close()
