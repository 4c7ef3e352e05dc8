"""The commands of ROS with the node, as typed by a user: rosservice, rostopic, rosnode, rosmsg."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE, ros_type
from tests.harness import Graph, run_together, wait_for

PORTS = {
    f"/rosAFE/{port.name}" + ("/" + ROSAFE.service(kind.request).parameter("name").default if port.multiple else ""): (
        "rosAFE/" + ros_type(port.idl)
    )
    for kind in CORE_REPRESENTATIONS.values()
    for port in [ROSAFE.port(kind.port)]
}


@pytest.fixture(scope="module")
def session(graph: Graph) -> Iterator[Graph]:
    """Build the session of the guide with `rosservice call`: bass plays its scene, and all seven kinds run."""
    with graph.node("bass-ros"), graph.node("rosAFE-ros") as process:
        call(graph, "/rosAFE/connect_port", "{local: Audio, remote: bass/Audio}")
        call(graph, "/bass/Acquire", "{device: 'scene:', sampleRate: 20000, nFramesPerChunk: 1000}")
        call(graph, "/rosAFE/InputProc", "{nFramesPerBlock: 2000}")
        call(graph, "/rosAFE/PreProc", "{name: preProc, upperDepName: input, pp_middleEarModel: jespen}")
        call(graph, "/rosAFE/GammatoneProc", "{name: gammatone, upperDepName: preProc, fb_nChannels: 4}")
        call(graph, "/rosAFE/IhcProc", "{}")
        for request in ("IldProc", "RatemapProc", "CrossCorrelationProc"):
            call(graph, f"/rosAFE/{request}", "{}")
        yield graph
        assert "Traceback" not in process.err


def call(graph: Graph, service: str, values: str) -> str:
    """Return the output of `rosservice call` for a request that succeeds."""
    output = graph.run("rosservice", "call", service, values).stdout
    assert "genom_success: True" in output, output
    return output


def test_rosservice_list_type_info_find_args(session: Graph) -> None:
    def run(*arguments: str) -> list[str]:
        return session.run("rosservice", *arguments).stdout.split("\n")

    services = [f"/rosAFE/{service.name}" for service in ROSAFE.on_graph]
    assert set(services) <= set(run("list"))
    assert run("type", "/rosAFE/GammatoneProc")[0] == "rosAFE/GammatoneProc"
    assert "/rosAFE/IldProc" in run("find", "rosAFE/IldProc")
    information = run("info", "/rosAFE/IldProc")
    assert {"Node: /rosAFE", "Type: rosAFE/IldProc"} <= set(information)
    assert "Args: name upperDepName ild_wname ild_wSizeSec ild_hSizeSec" in information


def test_rosservice_call_shows_parameters_and_errors(session: Graph) -> None:
    output = call(session, "/rosAFE/getParameters", "{}")
    assert "fb_nChannels: 4" in output and 'pp_middleEarModel: "jepsen"' in output
    output = call(session, "/rosAFE/getDependencies", "{nameProc: ratemap}")
    assert re.findall(r"- (\w+)", output.replace('"', "")) == ["input", "preProc", "gammatone", "ihc", "ratemap"]
    for values, ex in (
        ("{name: again, upperDepName: nobody}", "e_noUpperDependencie"),
        ("{}", "e_existsAlready"),
    ):
        output = session.run("rosservice", "call", "/rosAFE/IldProc", values).stdout
        assert "genom_success: False" in output and f"::rosAFE::{ex}" in output


def test_rostopic_list_type_info_find(session: Graph) -> None:
    listed = session.run("rostopic", "list").stdout.split()
    assert set(PORTS) <= set(listed)
    assert {f"/rosAFE/IldProc/{part}" for part in ("goal", "cancel", "status", "feedback", "result")} <= set(listed)
    types = run_together(len(PORTS), lambda i: session.run("rostopic", "type", list(PORTS)[i]).stdout.strip())
    assert types == list(PORTS.values())
    information = session.run("rostopic", "info", "/rosAFE/ildPort/ild").stdout
    assert "Type: rosAFE/rosAFE_TimeFrequencySignalPortStruct" in information and "/rosAFE (http" in information
    found = session.run("rostopic", "find", "rosAFE/rosAFE_CrossCorrelationSignalPortStruct").stdout.split()
    assert "/rosAFE/crossCorrelationPort/crosscorrelation" in found  # the master keeps the type of a topic for ever
    assert "/rosAFE/ildPort/ild" not in found


def test_rostopic_echo(session: Graph) -> None:
    output = session.run("rostopic", "echo", "-n", "1", "--noarr", "/rosAFE/ildPort/ild").stdout
    assert "sampleRate: 100\n" in output and "framesOnPort: 100\n" in output and "numberOfChannels: 4\n" in output
    index = session.run("rostopic", "echo", "-n", "1", "/rosAFE/inputProcPort/lastFrameIndex").stdout
    assert int(index.split()[0]) % 1000 == 1
    whole = session.run("rostopic", "echo", "-n", "1", "/rosAFE/ildPort/ild/left/dataN[0]/data").stdout
    assert whole.count(",") == 99


def test_rosnode(session: Graph) -> None:
    assert {"/rosAFE", "/bass"} <= set(session.run("rosnode", "list").stdout.split())
    information = session.run("rosnode", "info", "/rosAFE").stdout
    for name in (*PORTS, "/rosAFE/IldProc/goal", "/bass/Audio", "/rosAFE/kill"):
        assert f" * {name}" in information
    assert "xmlrpc reply" in session.run("rosnode", "ping", "-c", "1", "/rosAFE").stdout


def test_rosmsg_and_rossrv_know_the_types(session: Graph) -> None:
    shown = session.run("rosmsg", "show", "rosAFE/rosAFE_TimeFrequencySignalPortStruct").stdout
    assert shown.splitlines()[:4] == [
        "uint32 sampleRate",
        "uint64 lastFrameIndex",
        "uint64 framesOnPort",
        "uint32 numberOfChannels",
    ]
    shown = session.run("rossrv", "show", "rosAFE/IhcProc").stdout
    assert shown.strip().splitlines() == [
        "string name",
        "string upperDepName",
        "string ihc_method",
        "---",
        "bool genom_success",
        "string genom_exdetail",
    ]


def test_goals_from_the_shell(session: Graph) -> None:
    """A goal is an ordinary message: one rostopic pub starts a processor, and another one cancels it."""
    goal = "{goal_id: {id: shell}, goal: {name: from_shell, upperDepName: ihc}}"
    with session.start("rostopic", "pub", "-l", "/rosAFE/IldProc/goal", "rosAFE/IldProcActionGoal", goal):
        wait_for(lambda: "/rosAFE/ildPort/from_shell" in session.topics())
        session.run("rostopic", "pub", "-1", "/rosAFE/IldProc/cancel", "actionlib_msgs/GoalID", "{id: shell}")
        wait_for(lambda: "/rosAFE/ildPort/from_shell" not in session.topics())
