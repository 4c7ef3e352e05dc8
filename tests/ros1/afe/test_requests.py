"""Requests as plain services: order of checks, rejected requests change nothing, defaults, removal."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

import rospy

from rosafe import process
from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE
from tests import harness
from tests.harness import wait_for
from tests.ros1.afe.session import RATE, Session, noise, own_node

CHAIN = ("PreProc", "GammatoneProc", "IhcProc", "IldProc", "RatemapProc", "CrossCorrelationProc")


def snapshot(afe: Session) -> tuple[Any, set[str]]:
    """Return the state that a rejected request must not change."""
    return afe.ok("getParameters").parameters, {t for t in afe.graph.topics() if re.match(f"/{afe.name}/\\w+Port", t)}


# --- InputProc --------------------------------------------------------------------------------------------------


def test_input_without_a_connection_is_an_error(graph: harness.Graph) -> None:
    with own_node(graph) as afe:
        assert afe.refused("InputProc") == ("::rosAFE::e_noData", {})
        assert "connect_port" in afe.process.err, "the log contains the next step"


def test_input_waits_for_a_first_message(afe: Session) -> None:
    topic = rospy.Publisher("/silent/Audio", _audio_class(), queue_size=1)
    afe.ok("connect_port", local="Audio", remote="silent/Audio")
    assert afe.refused("InputProc") == ("::rosAFE::e_noData", {})
    assert afe.processors() == {}
    wait_for(lambda: topic.get_num_connections() == 1)
    goal = afe.goal("InputProc")
    afe.wait_activities(["InputProc"])
    topic.publish(_audio_class()(sampleRate=RATE, nChunksOnPort=1, nFramesPerChunk=2, left=[0, 0], right=[0, 0]))
    goal.active()
    assert afe.processors() == {"input": ["input"]}
    assert goal.running
    topic.unregister()


def _audio_class() -> Any:
    import bass.msg

    return bass.msg.binaudio_portStruct


def test_a_second_input_replaces_the_first_and_keeps_the_tree(afe: Session) -> None:
    microphone = afe.build("PreProc", block=800)
    first = noise(800, 1)
    microphone.play(first)
    afe.read("preProc", 801)
    ids = afe.wait_activities(["InputProc", "PreProc"])
    afe.ok("InputProc", name="other", nFramesPerBlock=400)
    assert afe.processors() == {"input": ["other"], "preProc": ["preProc"]}
    later = afe.wait_activities(["InputProc", "PreProc"])
    assert len(set(ids) & set(later)) == 1, "the pre-processor continues, the old input has ended"
    second = noise(400, 2)
    microphone.play(second)
    message = afe.read("preProc", 1201)
    assert list(message.left[-400:]) == list(second[0] / (2**31 - 1))
    assert afe.ok("getDependencies", nameProc="preProc").dependencies == ["other", "preProc"]


def test_a_rejected_second_input_does_not_affect_the_first(afe: Session) -> None:
    microphone = afe.build(block=800)
    ex, detail = afe.refused("InputProc", bufferSize_s_port=math.nan)
    assert ex == "::rosAFE::e_badNewValue" and "bufferSize_s_port" in detail["what"]
    afe.listen(sample_rate=2 * RATE)
    afe.ok("PreProc")
    ex, detail = afe.refused("InputProc")
    assert ex == "::rosAFE::e_badNewValue" and str(2 * RATE) in detail["what"] and "Stop" in detail["what"]
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"]}
    assert microphone.topic != afe.topic("input")


# --- other requests: order of checks --------------------------------------------------------------------------


def test_the_order_of_checks(afe: Session) -> None:
    """Unknown parent, used name, parent of another kind, values: the first one that applies is reported."""
    afe.build("PreProc", "GammatoneProc", "IhcProc", fb_nChannels=2)
    before = snapshot(afe)
    for request_name in CHAIN:
        wrong = {"PreProc": "preProc", "GammatoneProc": "input"}.get(request_name, "preProc")
        bad: Mapping[str, Any] = {
            p.name: math.nan for p in ROSAFE.service(request_name).parameters if p.idl == "double"
        }
        missing, taken, free = "nobody", "ihc", "fresh"
        for name, parent, ex in (
            (free, missing, "e_noUpperDependencie"),
            (taken, missing, "e_noUpperDependencie"),
            (taken, wrong, "e_existsAlready"),
            (free, wrong, "e_noUpperDependencie"),
            ("INPUT", "Input", "e_noUpperDependencie"),  # names are case-sensitive
        ):
            given = {"name": name, "upperDepName": parent, **bad}
            assert afe.refused(request_name, **given) == (f"::rosAFE::{ex}", {}), (request_name, given)
    assert snapshot(afe) == before


# --- defaults ---------------------------------------------------------------------------------------------------


def test_a_window_too_short_for_the_pitch_range_is_logged_once(afe: Session) -> None:
    line = "pitch: pi_rangeHz, ac_wSizeSec: a window of 0.02 s contains fewer than 3 periods of 80 Hz"
    before = afe.process.err.count(line)
    afe.build("PreProc", "GammatoneProc", "IhcProc", "AutocorrelationProc", "PitchProc", fb_nChannels=2)
    wait_for(lambda: afe.process.err.count(line) == before + 1, what=lambda: afe.process.err)
    afe.ok("modifyParameter", nameProc="pitch", nameParam="pi_medianOrder", newValue="5")
    afe.ok("AutocorrelationProc", name="long", upperDepName="ihc", ac_wSizeSec=0.04)
    afe.ok("PitchProc", name="voices", upperDepName="long")
    assert afe.process.err.count("pi_rangeHz, ac_wSizeSec") == before + 1


def test_parameters_are_returned_exactly(afe: Session) -> None:
    afe.build("PreProc")
    given: dict[str, dict[str, Any]] = {
        "PreProc": {
            "pp_bRemoveDC": True,
            "pp_cutoffHzDC": 20.000000000000004,
            "pp_bPreEmphasis": True,
            "pp_coefPreEmphasis": 0.1 + 0.2,
            "pp_bNormalizeRMS": True,
            "pp_intTimeSecRMS": 1 / 3,
            "pp_bLevelScaling": True,
            "pp_refSPLdB": -math.pi,
            "pp_bMiddleEarFiltering": True,
            "pp_middleEarModel": "lopezpoveda",
            "pp_bUnityComp": True,
        },
        "GammatoneProc": {"fb_cfHz": [100.1, 1000 / 3, 5e3], "fb_nGamma": 3, "fb_bwERBs": 1.0179999999999998},
        "IhcProc": {"ihc_method": "dau1996"},
        "IldProc": {"ild_wname": "blackman", "ild_wSizeSec": 0.02 + 1e-17, "ild_hSizeSec": 0.1 / 7},
        "RatemapProc": {"rm_wname": "hamming", "rm_scaling": "magnitude", "rm_decaySec": 0.1 / 3, "rm_wSizeSec": 0.03},
        "CrossCorrelationProc": {"cc_maxDelaySec": 0.0011, "cc_wname": "triang", "cc_hSizeSec": 0.005},
    }
    parent = "input"
    for request, values in given.items():
        afe.ok(request, name=f"my_{request}", upperDepName=parent, **values)
        if request in ("PreProc", "GammatoneProc", "IhcProc"):
            parent = f"my_{request}"
    parameters = afe.ok("getParameters").parameters
    assert [p.name for p in parameters.preProc] == ["preProc", "my_PreProc"], "in the order of creation"
    for kind, table in CORE_REPRESENTATIONS.items():
        if table.parent:
            struct = getattr(parameters, kind)[-1]
            assert struct.name == f"my_{table.request}"
            for name, value in given[table.request].items():
                got = getattr(struct, name)
                assert (list(got) if isinstance(value, list) else got) == value, name
    flat = {name: value for values in given.values() for name, value in values.items()}
    truth = process(noise(2000), RATE, parameters=flat)
    assert list(parameters.gammatone[0].fb_cfHz) == list(truth["fb_cfHz"])
    assert parameters.gammatone[0].fb_nChannels == 3
    assert list(parameters.crossCorrelation[0].cc_lags) == list(truth["cc_lags"])
    afe.ok("modifyParameter", nameProc="input", nameParam="in_normalizeValue", newValue=str(2**64 - 1))
    (reported_input,) = afe.ok("getParameters").parameters.input
    assert (reported_input.name, reported_input.in_doNormalize, reported_input.in_normalizeValue) == (
        "input",
        True,
        2**64 - 1,
    )


# --- dependencies, modification, removal ------------------------------------------------------------------------


def test_removal_includes_descendants_and_frees_the_names(afe: Session) -> None:
    afe.build(*CHAIN, fb_nChannels=2)
    afe.ok("IldProc", name="second")
    afe.ok("GammatoneProc", name="sibling", fb_nChannels=2)
    afe.ok("removeProcessor", name="gammatone")
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"], "gammatone": ["sibling"]}
    afe.wait_activities(["InputProc", "PreProc", "GammatoneProc"])
    gone = [afe.topic(kind) for kind in ("gammatone", "ihc", "ild", "ratemap", "crossCorrelation")]
    assert not set(gone) & afe.graph.topics(), "closed when the call returns"
    for request in CHAIN[1:]:
        afe.ok(request)
    assert set(gone) <= afe.graph.topics()


def test_stop_and_start_again(afe: Session) -> None:
    afe.ok("Stop")
    microphone = afe.build(*CHAIN, block=800, fb_nChannels=2)
    microphone.play(noise(1600))
    afe.read("ild", 1601)
    for _ in range(2):
        afe.ok("Stop")
        assert afe.processors() == {}
        assert afe.ok("getSignals").signals.input == []
        afe.wait_activities([])
        assert afe.refused("PreProc")[0] == "::rosAFE::e_noUpperDependencie"
    assert microphone.subscribed, "the connection is kept"
    for request in ("InputProc", *CHAIN):
        afe.ok(request, **({"nFramesPerBlock": 800} if request == "InputProc" else {}))
    microphone.play(noise(800, 3))
    message = afe.read("ild", 2401)
    assert message.framesOnPort == 100


# --- connect_port and the rest ----------------------------------------------------------------------------------


def test_rejected_connections(afe: Session) -> None:
    microphone = afe.build(block=400)
    for local, remote, ex in (
        ("audio", microphone.topic, "no_such_inport"),
        ("", "", "no_such_inport"),
        ("dataObj", microphone.topic, "no_such_inport"),
        ("Audio", "nobody/Audio", "no_such_outport"),
        ("Audio", "", "no_such_outport"),
        ("Audio", "not a name!", "no_such_outport"),
        ("Audio", "rosAFE/genom_state", "port_io"),
    ):
        assert afe.refused("connect_port", local=local, remote=remote) == (f"::genom::{ex}", {}), (local, remote)
    signal = noise(400)
    microphone.play(signal)
    assert afe.read("input", 401).left[-1] == signal[0, -1] / (2**31 - 1), "the old connection is kept"


def test_remapped_topics(graph: harness.Graph) -> None:
    with own_node(
        graph, "bass/Audio:=/elsewhere/Audio", "/mapped/preProcPort/preProc:=/shown/here", name="mapped"
    ) as afe:
        microphone = afe.listen(topic="/elsewhere/Audio")
        afe.ok("connect_port", local="Audio", remote="bass/Audio")
        afe.build("PreProc", block=2000)
        wait_for(lambda: microphone.subscribed)
        microphone.play(noise(2000))
        message = graph.message("/shown/here", accept=lambda m: m.lastFrameIndex == 2001)
        assert message.framesOnPort == 20000
        assert afe.topic("preProc") not in graph.topics()


def test_names_are_resolved_as_in_ros(afe: Session) -> None:
    microphone = afe.listen()
    relative = microphone.topic[1:]
    for remote in (relative, microphone.topic, f"/{relative}/"):
        afe.ok("connect_port", local="Audio", remote=remote)
    wait_for(lambda: microphone.subscribed)


def test_errors_are_valid_json_for_any_name(afe: Session) -> None:
    """Quotes, backslashes, line ends and other alphabets of the request are part of the reason."""
    afe.build("PreProc")
    before = snapshot(afe)
    for name in ('say "hi"', "back\\slash", "two\nlines", "日本語", "tab\t", "a//b", "x" * 5000):
        response = afe.call("GammatoneProc", name=name)
        body = json.loads(response.genom_exdetail)
        assert body["ex"] == "::rosAFE::e_badNewValue" and (len(name) > 100 or repr(name) in body["detail"]["what"])
    assert snapshot(afe) == before
