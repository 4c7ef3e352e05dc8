"""Requests of genomixd's clients are literal: zeros are zeros; unknown choices cause a warning or are rejected."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.harness import Process, wait_for
from tests.matlab import octave
from tests.web.genomix.world import HttpError, World

INPUT = """
    set g [genomix::connect $address]
    $g load bass; $g load rosAFE
    bass::Acquire scene: 16000
    rosAFE::connect_port Audio bass/Audio
    rosAFE::InputProc
"""
MISSPELT = "ihc: ihc_method: unknown word 'bernstien'; dau is used; the most similar known word is bernstein"


def start(world: World, *processors: str) -> None:
    world.http.call("bass/Acquire", ["scene:", 16000])
    world.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
    world.http.call("rosAFE/InputProc")
    for request in processors:
        world.http.call(f"rosAFE/{request}")


def reported_parameters(world: World, kind: str, name: str) -> dict[str, Any]:
    parameters = world.http.call("rosAFE/getParameters")["parameters"][kind]
    return next(one for one in parameters if one["name"] == name)


def is_there(world: World, name: str) -> bool:
    return name in [one["name"] for one in world.http.call("rosAFE/getProcessors")["processors"]]


# --- zeros ------------------------------------------------------------------------------------------------------


def test_a_zero_is_literal_with_call_and_send(world: World) -> None:
    start(world)
    world.http.call("rosAFE/PreProc", {"name": "called", "pp_coefPreEmphasis": 0, "pp_refSPLdB": 0})
    world.http.wait(world.http.send("rosAFE/PreProc", {"name": "sent", "pp_coefPreEmphasis": 0}), "sent")
    for name, level in (("called", 0.0), ("sent", 100.0)):
        wait_for(functools.partial(is_there, world, name))
        found = reported_parameters(world, "preProc", name)
        assert (found["pp_coefPreEmphasis"], found["pp_refSPLdB"]) == (0.0, level)


@pytest.mark.parametrize(
    ("request_name", "given", "why"),
    [
        ("GammatoneProc", {"fb_lowFreqHz": 0}, "fb_lowFreqHz: expected a number above 0, at most 1000000, got 0"),
        ("GammatoneProc", {"name": ""}, "name: '' also names a topic"),
        ("InputProc", {"nFramesPerBlock": 0}, "nFramesPerBlock: expected a number from 1 to 10000000, got 0"),
        ("InputProc", {"name": ""}, "name: expected the name of a processor, got ''"),
    ],
)
def test_invalid_zeros_and_empty_values_are_rejected(world: World, request_name: str, given: Any, why: str) -> None:
    start(world, "PreProc")
    before = world.http.call("rosAFE/getProcessors")
    with pytest.raises(HttpError) as refused:
        world.http.call(f"rosAFE/{request_name}", given)
    assert refused.value.ex == "::rosAFE::e_badNewValue" and why in refused.value.what
    sent = world.http.send(f"rosAFE/{request_name}", given)
    assert why in world.http.wait(sent, "error")["exception"]["detail"]["what"]
    assert world.http.call("rosAFE/getProcessors") == before


def test_the_values_of_get_parameters_create_an_equal_processor(world: World) -> None:
    """With a list of centre frequencies, it reports a spacing of 0."""
    start(world, "PreProc")
    world.http.call("rosAFE/GammatoneProc", {"name": "first", "fb_cfHz": [500, 900]})
    first = reported_parameters(world, "gammatone", "first")
    assert first["fb_nERBs"] == 0
    world.http.call("rosAFE/GammatoneProc", {**first, "name": "second"})
    assert reported_parameters(world, "gammatone", "second") == {**first, "name": "second"}


# --- unknown words ----------------------------------------------------------------------------------------------


# Prints the tree's entries in /diagnostics: level, message and unknown words.
DIAGNOSED = """
import json, rospy
from diagnostic_msgs.msg import DiagnosticArray
def show(message):
    for status in message.status:
        if status.name.endswith("processors"):
            level = status.level if isinstance(status.level, int) else status.level[0]
            words = [v.value for v in status.values if v.key == "unknown word"]
            print(json.dumps([level, status.message, words]), flush=True)
rospy.init_node("reader", anonymous=True)
rospy.Subscriber("/diagnostics", DiagnosticArray, show)
rospy.spin()
"""


def diagnosed(reader: Process, text: str, there: bool = True) -> list[Any]:
    """Wait until `text` is (or is not) in the message; return level, message and unknown words of the tree's health."""
    first = len(_complete_lines(reader))

    def found() -> list[Any]:
        entries: list[list[Any]] = [json.loads(line) for line in _complete_lines(reader)[first:]]
        return next((entry for entry in entries if (text in entry[1]) == there), [])

    return wait_for(found, what=lambda: repr(reader))


def _complete_lines(reader: Process) -> list[str]:
    return reader.out.rpartition("\n")[0].splitlines()


@pytest.fixture
def reader(world: World) -> Iterator[Process]:
    """A program that prints the diagnostics of the tree."""
    with world.graph.start("python3", "-c", DIAGNOSED) as process:
        yield process


def test_a_misspelt_choice_causes_a_warning(world: World, reader: Process) -> None:
    start(world, "PreProc", "GammatoneProc")
    assert world.http.call("rosAFE/IhcProc", {"ihc_method": "bernstien"}) == {"warning": MISSPELT}
    assert reported_parameters(world, "ihc", "ihc")["ihc_method"] == "dau"
    assert world.afe is not None and world.afe.err.count("[WARN]") and MISSPELT in world.afe.err
    number = world.http.send("rosAFE/IhcProc", {"name": "two", "ihc_method": "Bernstein"})
    wanted = MISSPELT.replace("ihc:", "two:", 1).replace("bernstien", "Bernstein")
    wait_for(lambda: world.http.status(number).get("warning") == wanted, what=lambda: str(world.http.status(number)))
    assert world.http.status(number) == {"id": number, "status": "sent", "warning": wanted}
    assert diagnosed(reader, "more unknown") == [1, f"{MISSPELT} (and 1 more unknown words)", [MISSPELT, wanted]]
    change = {"nameProc": "two", "nameParam": "ihc_method", "newValue": "halfwav"}
    changed_parameters = "two: ihc_method: unknown word 'halfwav'; dau is used; the most similar known word is halfwave"
    assert world.http.call("rosAFE/modifyParameter", change) == {"warning": changed_parameters}
    number = world.http.send("rosAFE/modifyParameter", change)
    assert world.http.wait(number, "done")["warning"] == changed_parameters
    # corrected values and removed processors cause no further warnings
    world.http.call("rosAFE/modifyParameter", {**change, "newValue": "halfwave"})
    assert diagnosed(reader, "more unknown", there=False) == [1, MISSPELT, [MISSPELT]]
    world.http.call("rosAFE/removeProcessor", ["ihc"])
    assert diagnosed(reader, MISSPELT, there=False) == [0, "4 processors", []]


def test_known_choices_and_accepted_misspellings_cause_no_warning(world: World) -> None:
    start(world)
    assert world.afe is not None
    said = len(world.afe.err)
    assert world.http.call("rosAFE/PreProc", {"name": "slip", "pp_middleEarModel": "jespen"}) == {}
    assert world.http.call("rosAFE/modifyParameter", ["slip", "pp_middleEarModel", "lopezpoveda"]) == {}
    done = world.graph.run("rosservice", "call", "/rosAFE/GammatoneProc", "{upperDepName: slip, fb_type: gamma}")
    assert "genom_success: True" in done.stdout and "genom_exdetail: ''" in done.stdout, "as in the original"
    assert "gammatone: fb_type: unknown word 'gamma'; gammatone is used" in world.afe.err[said:]
    assert world.afe.err[said:].count("[WARN]") == 1


def test_tcl_shows_the_warning_on_a_terminal(world: World) -> None:
    script = """
        rosAFE::PreProc
        rosAFE::GammatoneProc
        show [rosAFE::IhcProc {ihc_method bernstien}]
        set quiet [rosAFE::IhcProc {name quiet ihc_method bernstein} &]
        set ::tcl_interactive 1
        set r [rosAFE::IhcProc {name two ihc_method bernstien} &]
        while {[$r warning] eq ""} {after 10 {set go 1}; vwait go}
        show [$r status] [$r warning]
        show [$quiet warning]
    """
    done = world.tcl(INPUT + script)
    second = MISSPELT.replace("ihc:", "two:", 1)
    assert done.stdout.splitlines() == [f"warning {{{MISSPELT}}}", f"sent|{second}", ""]
    assert done.stderr.splitlines() == [f"rosAFE::IhcProc &: warning: {second}"]


def test_matlab_has_the_warning_in_the_request(world: World) -> None:
    start(world, "PreProc", "GammatoneProc")
    script = """
        client = genomix.client();
        rosAFE = client.load('rosAFE');
        r = rosAFE.IhcProc('ihc', 'gammatone', 'bernstien');
        disp(r);
        show('called', {r.status, r.warning, r.result});
        r = rosAFE.IhcProc('-a', 'two', 'gammatone', 'bernstien');
        show('sent', {r.status, r.warning});
        r = rosAFE.modifyParameter('two', 'ihc_method', 'dau');
        show('known', r.warning);
        r = rosAFE.PreProc('zero', 'input', 0, 20, 0, 0);
        parameters = rosAFE.getParameters().result.parameters;
        show('zero', parameters.preProc{2}.pp_coefPreEmphasis);
    """
    printed = octave.run(world, script)
    shown = octave.values(printed)
    assert f"warning: {MISSPELT}\n" in printed
    assert shown["called"] == ["done", MISSPELT, {}]
    assert shown["sent"] == ["sent", MISSPELT.replace("ihc:", "two:", 1)]
    assert shown["known"] == ""
    assert shown["zero"] == 0


@pytest.mark.parametrize("by", ["option", "parameter"])
def test_strict_mode_rejects_unknown_choices(world: World, by: str) -> None:
    name = f"strict_{by}"
    options = ("--strict",) if by == "option" else ("_strict_words:=true",)
    with world.graph.node("rosAFE-ros", "-i", name, *options):
        call = world.http.call
        call("bass/Acquire", ["scene:", 16000])
        call(f"{name}/connect_port", ["Audio", "bass/Audio"])
        for request in ("InputProc", "PreProc", "GammatoneProc", "IhcProc"):
            assert call(f"{name}/{request}") == {}
        for request, given in (
            ("IhcProc", {"name": "two", "ihc_method": "bernstien"}),
            ("modifyParameter", {"nameProc": "ihc", "nameParam": "ihc_method", "newValue": "bernstien"}),
        ):
            with pytest.raises(HttpError) as refused:
                call(f"{name}/{request}", given)
            assert refused.value.ex == "::rosAFE::e_badNewValue"
            assert refused.value.what.startswith("ihc_method: expected one of none, halfwave")
            assert refused.value.what.endswith("; did you mean bernstein?")
        assert call(f"{name}/PreProc", {"name": "slip", "pp_middleEarModel": "jespen"}) == {}
        if by == "parameter":  # whose present value counts
            world.graph.run("rosparam", "set", f"/{name}/strict_words", "false")
            wait_for(lambda: _granted(world, name), what="unknown choices that are replaced")


def _granted(world: World, name: str) -> bool:
    change = {"nameProc": "ihc", "nameParam": "ihc_method", "newValue": "bernstien"}
    try:
        return "dau is used" in world.http.call(f"{name}/modifyParameter", change)["warning"]
    except HttpError:
        return False
