"""genomixd over HTTP, with real nodes: components, requests, events, ports, errors."""

from __future__ import annotations

import json

import pytest

from rosafe import interface
from tests import harness
from tests.web.genomix.world import Http, HttpError, World

pytestmark = pytest.mark.ros


def start_tree(http: Http) -> None:
    """Audio, input, preProc and gammatone, all running."""
    http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
    http.call("bass/Acquire", {"device": "scene:"})
    http.call("rosAFE/InputProc", {"nFramesPerBlock": 4410})
    http.call("rosAFE/PreProc")
    http.call("rosAFE/GammatoneProc", {"fb_nChannels": 4})


# --- components -------------------------------------------------------------------------------------------------


def test_load_returns_the_interface(world: World) -> None:
    reported = world.http.get("/load/rosAFE", s="load")
    assert (reported["name"], reported["component"], reported["instance"]) == ("rosAFE", "rosAFE", "rosAFE")
    assert list(reported["services"]) == [
        s.name for s in (*interface.ROSAFE.services, *interface.ROSAFE.client_side_services)
    ]
    assert reported["services"]["getSignals"]["aliases"] == ["getSignal"]
    parameter = reported["services"]["PreProc"]["parameters"]["pp_refSPLdB"]
    assert parameter["default"] == 100.0
    assert parameter["type"] == "double"
    assert parameter["range"] == "from -200 to 400"
    assert parameter["aliases"] == ["pp_refSPLdBS"]
    assert reported["ports"]["ratemapPort"]["aliases"] == ["ratemapProcPort"]
    assert reported["exceptions"]["::rosAFE::e_noData"]
    assert world.http.get("/components", s="load") == {"rosAFE": {"component": "rosAFE", "instance": "rosAFE"}}


def test_load_by_path_and_alias_and_unload(world: World) -> None:
    assert world.http.get("/load//opt/robot/lib/genom/ros/plugins/bass.so", s="p")["name"] == "bass"
    assert world.http.get("/load/bass", s="p", **{"as": "ears"})["name"] == "ears"
    assert set(world.http.get("/components", s="p")) == {"bass", "ears"}
    assert world.http.call("ears/Stop", s="p") == {}
    assert world.http.get("/unload/ears", s="p") == {}
    with pytest.raises(HttpError, match="'ears' is not loaded"):
        world.http.get("/unload/ears", s="p")
    assert set(world.http.get("/components", s="p")) == {"bass"}
    assert world.http.get("/components", s="other") == {}


def test_an_instance_has_names_of_its_own(world: World) -> None:
    with world.graph.node("bass-ros", "-i", "left"):
        reported = world.http.get("/load/bass", i="left")
        assert (reported["name"], reported["component"]) == ("left", "bass")
        world.http.call("left/Acquire", {"device": "scene:", "nFramesPerChunk": 500})
        assert world.http.call("left/Audio")["Audio"]["nFramesPerChunk"] == 500
        # An instance reports its component.
        assert world.http.get("/load/left", s="fresh")["component"] == "bass"
        with pytest.raises(HttpError, match="/left: expected the component rosAFE, got bass"):
            world.http.get("/load/rosAFE", i="left")


# --- functions --------------------------------------------------------------------------------------------------


def test_functions_return_their_outputs(world: World) -> None:
    start_tree(world.http)
    parameters = world.http.call("rosAFE/getParameters")["parameters"]
    assert [p["name"] for p in parameters["gammatone"]] == ["gammatone"]
    assert parameters["gammatone"][0]["fb_nChannels"] == 4
    assert parameters["preProc"][0]["pp_bRemoveDC"] == 0
    assert parameters["preProc"][0]["pp_coefPreEmphasis"] == 0.97
    dependencies = world.http.call("rosAFE/getDependencies", {"nameProc": "gammatone"})
    assert dependencies == {"dependencies": ["input", "preProc", "gammatone"]}
    assert world.http.call("rosAFE/getDependencies", ["preProc"]) == {"dependencies": ["input", "preProc"]}
    changed = {"nameProc": "preProc", "nameParam": "pp_bRemoveDC", "newValue": "1"}
    assert world.http.call("rosAFE/modifyParameter", changed) == {}
    assert world.http.call("rosAFE/getParameters")["parameters"]["preProc"][0]["pp_bRemoveDC"] == 1


def test_tcl_syntax(world: World) -> None:
    start_tree(world.http)
    status, body = world.http.raw("/call/rosAFE/getDependencies?syntax=tcl&input=%5B%22preProc%22%5D")
    assert (status, body) == (200, "dependencies {0 input 1 preProc}")
    status, body = world.http.raw("/call/rosAFE/getDependencies?syntax=tcl")
    assert (status, body) == (
        422,
        "ex ::rosAFE::e_noSuchProcessor what {there is no processor 'nameProc'; there are: input, preProc, gammatone}",
    )


# --- errors -----------------------------------------------------------------------------------------------------


def test_rejected_arguments_are_not_sent_to_a_component(world: World) -> None:
    for given, reported in (
        ({"bogus": 1}, "expected a known parameter, got 'bogus'"),
        ({"name": 7}, "name is a string"),
    ):
        for verb in ("call", "send"):
            with pytest.raises(HttpError, match=reported) as caught:
                world.http.get(f"/{verb}/rosAFE/PreProc", given)
            assert (caught.value.status, caught.value.ex) == (400, "::genom::serialization")
    with pytest.raises(HttpError, match="local is missing; connect_port takes local"):
        world.http.call("rosAFE/connect_port")


@pytest.mark.parametrize(
    ("url", "status", "ex"),
    [
        ("/call/rosAFE/noSuch", 404, "::genom::no_such_service"),
        ("/call/rosAFE/ildPort/none", 404, "::genom::no_such_outport"),
        ("/call/rosAFE/ildPort", 404, "::genom::no_such_outport"),
        ("/call/rosAFE/ildPort/a%20b%00", 404, "::genom::no_such_outport"),
        ("/call/rosAFE/Audio", 404, "::genom::no_such_outport"),
        ("/call/nobody/getSignals", 502, "::genom::mwerr"),
        ("/call/no%20name/getSignals", 404, "::genomix::e_load"),
        ("/load/rosAFE?as=1x", 400, "::genom::serialization"),
        ("/load/rosAFE?i=..%2Fx", 404, "::genomix::e_load"),
        ("/call/rosAFE/getSignals?input=%7B", 400, "::genom::serialization"),
        ("/call/rosAFE/getSignals?syntax=xml", 400, "::genom::serialization"),
        ("/call/rosAFE/getSignals?s=a%20b", 400, "::genom::serialization"),
        ("/request/status?id=rosAFE::9999", 404, "::genomix::e_noSuchRequest"),
        ("/request/wait?id=rosAFE::9999&ms=-1", 404, "::genomix::e_noSuchRequest"),
        ("/session/start", 400, "::genom::serialization"),
        ("/nothing", 404, "::genomix::e_url"),
        ("/call", 404, "::genomix::e_url"),
    ],
)
def test_errors_have_names(world: World, url: str, status: int, ex: str) -> None:
    got, body = world.http.raw(url)
    assert (got, json.loads(body)["ex"]) == (status, ex)
    assert json.loads(body)["detail"]["what"]


# --- requests in the background ---------------------------------------------------------------------------------


def test_an_activity_is_sent_until_it_ends(world: World) -> None:
    number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
    assert number.startswith("bass::")
    assert world.http.status(number) == {"id": number, "status": "sent"}
    assert world.http.get("/requests", s="t")[number] == "sent"
    assert world.http.get("/request/wait", id=number, s="t", ms=50)["status"] == "sent"
    with pytest.raises(HttpError, match="has not finished yet"):
        world.http.get("/request/result", id=number, s="t")
    world.http.call("bass/Stop")
    assert world.http.wait(number, "done") == {"id": number, "status": "done", "output": {}}
    assert world.http.get("/request/result", id=number, s="t") == {}
    assert world.http.get("/request/clean", id=number, s="t") == {}
    with pytest.raises(HttpError) as caught:
        world.http.status(number)
    assert caught.value.ex == "::genomix::e_noSuchRequest"


def test_abort_of_a_request_in_progress(world: World) -> None:
    """An activity can be aborted before the component has received it."""
    for _ in range(10):
        number = world.http.send("bass/Acquire", {"device": "scene:"}, s="order")
        world.http.get("/request/abort", id=number, s="order")
        status = world.http.get("/request/wait", id=number, s="order", ms=9000)
        assert status["status"] == "done" or status["exception"]["ex"] == "::genom::interrupted"
    harness.wait_for(lambda: not live_activities(world, "bass"))


def test_requests_of_a_session_are_completed_after_its_end(world: World) -> None:
    world.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
    for target in ("bass/Acquire", "rosAFE/InputProc", "rosAFE/PreProc"):
        number = world.http.send(target, ["scene:"] if target == "bass/Acquire" else None, s="brief")
    world.http.get("/request/clean", id=number, s="brief")
    world.http.raw("/session/stop?s=brief")
    harness.wait_for(lambda: live_activities(world, "rosAFE") == ["InputProc", "PreProc"])
    assert live_activities(world, "bass") == ["Acquire"]


def live_activities(world: World, component: str) -> list[str]:
    tasks = world.http.call(f"{component}/genom_state")["genom_state"]["task"]
    return [activity["name"] for task in tasks for activity in task["activity"]]


def test_functions_and_ports_in_the_background(world: World) -> None:
    start_tree(world.http)
    number = world.http.send("rosAFE/getDependencies", ["input"])
    assert world.http.wait(number, "done")["output"] == {"dependencies": ["input"]}
    number = world.http.send("rosAFE/genom_state")
    assert world.http.wait(number, "done")["output"]["genom_state"]["task"][0]["name"] == "init"
    number = world.http.send("rosAFE/gammatonePort/gammatone")
    status = world.http.wait(number, "done")
    assert status["large"] > 65536
    result = world.http.get("/request/result", id=number, s="t")
    assert len(result["gammatonePort"]["left"]["dataN"]) == 4
    with pytest.raises(HttpError) as caught:
        bad = world.http.send("rosAFE/removeProcessor", ["nobody"])
        world.http.wait(bad, "error")
        world.http.get("/request/result", id=bad, s="t")
    assert caught.value.ex == "::rosAFE::e_noSuchProcessor"


def test_a_oneway_request_has_no_status(world: World) -> None:
    start_tree(world.http)
    assert world.http.get("/send/rosAFE/removeProcessor", ["gammatone"], s="t1", oneway=1) == {}
    assert world.http.get("/requests", s="t1") == {}
    harness.wait_for(lambda: not world.http.call("rosAFE/getParameters")["parameters"]["gammatone"])


# --- sessions and events ----------------------------------------------------------------------------------------


def test_start_and_stop(world: World) -> None:
    assert world.http.raw("/session/start?s=foo") == (200, "foo")
    world.http.get("/load/bass", s="foo")
    assert world.http.raw("/session/stop?s=foo") == (200, "")
    assert world.http.get("/components", s="foo") == {}
    assert world.http.raw("/session/stop?s=never-there") == (200, "")


def test_listeners_get_events(world: World) -> None:
    with world.http.listening(s="ears") as events:
        number = world.http.send("bass/Acquire", {"device": "scene:"}, s="ears")
        assert next(events) == ("request", json.dumps({"id": number, "status": "sent"}, separators=(",", ":")))
        world.http.call("bass/Stop")
        name, data = next(events)
        assert (name, json.loads(data)) == ("request", {"id": number, "status": "done", "output": {}})
        number = world.http.send("rosAFE/removeProcessor", ["a\nb"], s="ears")
        name, data = next(events)
        assert json.loads(data)["exception"]["ex"] == "::rosAFE::e_noSuchProcessor"
        world.http.get("/unload/bass", s="ears")
        assert next(events) == ("unload", '{"component":"bass"}')
        world.http.raw("/session/stop?s=ears")
        assert next(events) == ("quit", "")
        assert list(events) == []


# --- ports ------------------------------------------------------------------------------------------------------


def test_ports_return_the_latest_message(world: World) -> None:
    start_tree(world.http)
    first = world.http.call("bass/Audio")["Audio"]["lastFrameIndex"]
    harness.wait_for(lambda: world.http.call("bass/Audio")["Audio"]["lastFrameIndex"] > first)
    world.http.call("bass/Stop")
    audio = world.http.call("bass/Audio")["Audio"]
    published = world.graph.run("rostopic", "echo", "-n1", "--noarr", "/bass/Audio").stdout
    assert f"lastFrameIndex: {audio['lastFrameIndex']}\n" in published
    assert len(audio["left"]) == audio["nChunksOnPort"] * audio["nFramesPerChunk"]
    # A new processor with an old name: the port has its data immediately.
    world.http.call("rosAFE/removeProcessor", ["gammatone"])
    world.http.call("rosAFE/GammatoneProc", {"fb_nChannels": 2})
    assert world.http.call("rosAFE/gammatonePort/gammatone")["gammatonePort"]["numberOfChannels"] == 2


def test_a_port_without_a_sample_is_zeros(world: World) -> None:
    assert world.http.call("rosAFE/dataObj")["dataObj"] == {kind: [] for kind in interface.CORE_REPRESENTATIONS}


def test_a_missing_element_is_not_logged_by_the_node(world: World) -> None:
    """A node that gets a request for a missing topic would log kilobytes with all its topics."""
    with world.graph.node("rosAFE-ros", "-i", "quiet") as node:
        world.http.call("bass/Acquire", ["scene:"])
        world.http.call("quiet/request", ["filterbank", {"fb_nChannels": 2}])
        assert "gammatonePort" in world.http.call("quiet/gammatonePort/filterbank_0")
        world.http.call("quiet/removeProcessor", ["filterbank_0"])
        for element in ("dummyName", "filterbank_0", "FILTERBANK_0", "a/b"):
            with pytest.raises(HttpError, match="has no element"):
                world.http.call(f"quiet/gammatonePort/{element}")
        assert world.lines("""
            set g [genomix::connect $address]
            $g load rosAFE -i quiet
            set request [::quiet::preProcPort dummyName &]
            show [$request wait]
        """) == ["error"]
        assert node.complaints == ""


def test_elements_that_are_superfluous_or_misspelt_as_in_the_guide(world: World) -> None:
    start_tree(world.http)
    assert "inputProcPort" in world.http.call("rosAFE/inputProcPort/input")
    assert world.http.call("rosAFE/preProcPort/preproc")["preProcPort"]["framesOnPort"] == 44100
    with pytest.raises(HttpError, match="no element 'other'; there are: preProc"):
        world.http.call("rosAFE/preProcPort/other")
