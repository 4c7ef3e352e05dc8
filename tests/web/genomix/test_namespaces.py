"""Two robots with one master: launch/rosafe.launch in two namespaces, and clients inside and outside of them."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.sax.saxutils import quoteattr

import pytest
import soundfile

from rosafe.tree import setups
from tests.harness import Graph, free_port, wait_for
from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.world import Http, World
from tests.web.live import world as pages

pytestmark = pytest.mark.ros

RATES = {"robot1": 16000, "robot2": 8000}
SETUP = """
sound: {{device: "scene:", sampleRate: {rate}, nFramesPerChunk: {rate}}}
processors:
  input: {{kind: input, nFramesPerBlock: 800}}
  {name}: {{kind: preProc}}
"""
LAUNCH = """<group ns="{name}">
  <remap from="unused" to="elsewhere"/>
  <include file="$(find rosAFE)/launch/rosafe.launch">
    <arg name="port" value="{port}"/><arg name="setup" value={setup}/><arg name="keep" value={keep}/>
  </include>
</group>"""


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """Launch two robots, and run a genomixd outside of their namespaces. The names of files have blanks and quotes."""
    folder = tmp_path_factory.mktemp("two") / 'it\'s a "robot" \\ '
    folder.mkdir()
    ports = {name: free_port() for name in RATES}
    groups = []
    for name, rate in RATES.items():
        setup, keep = folder / f"{name}.yaml", folder / f"{name} kept.yaml"
        setup.write_text(SETUP.format(rate=rate, name=f"of_{name}"))
        groups.append(
            LAUNCH.format(name=name, port=ports[name], setup=quoteattr(str(setup)), keep=quoteattr(str(keep)))
        )
    launch = folder / "two.launch"
    launch.write_text(f"<launch>{''.join(groups)}</launch>")
    with (
        worlds.world(folder.parent, nodes=False) as outside,
        outside.graph.start("roslaunch", str(launch)) as process,
    ):
        wait_for(lambda: process.out.count("created  of_robot") == 2 or not process.alive, what=lambda: str(process))
        inside = {name: World(outside.graph, outside.master, process, port) for name, port in ports.items()}
        yield SimpleNamespace(outside=outside, graph=outside.graph, folder=folder, **inside)
        assert process.stop(signal.SIGINT) == 0
        assert "Traceback" not in process.out + process.err, process


def processors(http: Http, target: str, **query: Any) -> list[str]:
    return [one["name"] for one in http.call(f"{target}/getProcessors", **query)["processors"]]


def test_genomixd_uses_the_components_of_its_namespace(robots: SimpleNamespace) -> None:
    assert {"/robot1/genomixd", "/robot2/genomixd", "/genomixd"} <= robots.graph.nodes()
    for name, rate in RATES.items():
        http = getattr(robots, name).http
        assert processors(http, "rosAFE") == ["input", f"of_{name}"]
        assert http.get("/load/rosAFE")["node"] == f"/{name}/rosAFE"
        assert http.get("/load/rosAFE")["instance"] == "rosAFE"
        assert http.call("bass/getAcquisition")["sampleRate"] == rate
        answer = http.call("rosAFE/request", ["ild", {"fb_nChannels": 2}])
        assert answer["topic"] == f"/{name}/rosAFE/ildPort/{answer['dependencies'][-1]}"
        http.call("rosAFE/removeProcessor", {"name": "filterbank_0"})
        assert setups.read(http.call("rosAFE/saveSetup")["setup"]).connections == {"Audio": "bass/Audio"}
        kept = (robots.folder / f"{name} kept.yaml").read_text()
        assert setups.read(kept).connections == {"Audio": "bass/Audio"}


def test_instances_of_other_namespaces(robots: SimpleNamespace) -> None:
    http, first = robots.outside.http, robots.robot1.http
    about = http.get("/load/rosAFE", i="robot1/rosAFE")
    assert (about["name"], about["instance"], about["node"]) == ("robot1_rosAFE", "robot1/rosAFE", "/robot1/rosAFE")
    assert processors(http, "robot1_rosAFE") == ["input", "of_robot1"]
    for name in ("robot2", "robot1", "robot2"):  # without a name, the instance counts
        assert processors(http, "rosAFE", i=f"{name}/rosAFE") == ["input", f"of_{name}"]
    for component in ("robot2/rosAFE", "%2Frobot2%2FrosAFE"):
        status, body = http.raw(f"/load/{component}")
        assert (status, json.loads(body)["node"]) == (200, "/robot2/rosAFE"), body
    assert processors(first, "rosAFE", i="/robot2/rosAFE") == ["input", "of_robot2"]
    for path in ("rosAFE", "/opt/openrobots/lib/genom/ros/plugins/rosAFE", "robot3/rosAFE"):
        with pytest.raises(worlds.HttpError, match=r"rosAFE is not running: /(robot3/)?rosAFE/"):
            http.get(f"/load/{path}")
    for wrong in ("~rosAFE", "robot 1/rosAFE", "robot1//rosAFE", "1robot/rosAFE"):
        with pytest.raises(worlds.HttpError, match="expected the name of a component or instance"):
            http.get("/load/rosAFE", i=wrong)


def test_tcl(robots: SimpleNamespace) -> None:
    script = """
        set g [genomix::connect $address]
        proc processors {name} {
            lmap one [dict values [dict get [${name}::getProcessors] processors]] {dict get $one name}
        }
        foreach words {{rosAFE -i robot1/rosAFE} {rosAFE -i /robot2/rosAFE as second} robot2/rosAFE} {
            set name [$g load {*}$words]
            show $name [processors $name]
        }
        show [dict get [robot1_rosAFE::preProcPort of_robot1] preProcPort sampleRate]
        show [lindex [failure {$g load rosAFE}] 1 0]
    """
    lines = [
        "robot1_rosAFE|input of_robot1",
        "second|input of_robot2",
        "robot2_rosAFE|input of_robot2",
        "16000",
        "GENOM",
    ]
    assert robots.outside.lines(script) == lines
    script = """
        set g [genomix::connect $address]
        $g load bass
        $g load rosAFE
        rosAFE::connect_port Audio bass/Audio
        show [dict get [bass::Audio] Audio sampleRate]
    """
    assert robots.robot2.lines(script) == ["8000"]


def test_octave(robots: SimpleNamespace, tmp_path: Path) -> None:
    script = """
        client = genomix.client();
        first = client.load('rosAFE', '-i', 'robot1/rosAFE');
        second = client.load('robot2/rosAFE');
        bass = client.load('bass', '-i', '/robot2/bass');
        names = @(afe) cellfun(@(one) one.name, afe.getProcessors().result.processors, 'UniformOutput', false);
        show('first', names(first));
        show('second', names(second));
        bass.Stop();
        request = acquireAudio(bass, second, 8000, 1, 8000, 'scene:');
        show('status', request.status);
        show('rate', bass.getAcquisition().result.sampleRate);
    """
    outside = robots.outside
    done = outside.graph.run(*octave.command(tmp_path, script), **octave.environment(outside), timeout=120)
    assert octave.values(done.stdout) == {
        "first": ["input", "of_robot1"],
        "second": ["input", "of_robot2"],
        "status": "sent",
        "rate": 8000,
    }, done


@pytest.mark.parametrize("inside", [True, False])
def test_commands(robots: SimpleNamespace, tmp_path: Path, inside: bool) -> None:
    graph: Graph = robots.graph
    namespace, option = ("robot2", ()) if inside else ("", ("-i", "robot2/rosAFE"))
    done = graph.run("rosafe", "request", "ratemap", "fb_nChannels=2", *option, ROS_NAMESPACE=namespace)
    assert "created  ratemap_0" in done.stdout and "/robot2/rosAFE/ratemapPort/ratemap_0" in done.stdout
    done = graph.run("rosafe", "setup", "save", "-", *option, ROS_NAMESPACE=namespace)
    assert "of_robot2" in done.stdout and "of_robot1" not in done.stdout
    setup = tmp_path / "setup.yaml"
    setup.write_text(done.stdout + "localizer: {seconds: 0.25}\n")
    assert (
        "reused   of_robot2"
        in graph.run("rosafe", "setup", "load", str(setup), *option, ROS_NAMESPACE=namespace).stdout
    )
    assert graph.run("rosparam", "get", "/robot2/localizer/seconds").stdout.strip() == "0.25"
    robots.robot2.http.call("rosAFE/removeProcessor", {"name": "filterbank_0"})
    target = () if inside else ("--node", "robot2/rosAFE")
    assert "of_robot2" in graph.run("rosafe", "trace", "--seconds", "1", *target, ROS_NAMESPACE=namespace).stdout
    sound = tmp_path / "sound.wav"
    topic = () if inside else ("--topic", "robot2/bass/Audio")
    graph.run("rosafe", "record", str(sound), "--seconds", "0.5", *topic, ROS_NAMESPACE=namespace)
    assert soundfile.info(str(sound)).samplerate == 8000
    done = graph.run("rosafe", "request", "ild", "-i", "robot3/rosAFE", check=False)
    assert "robot3/rosAFE is not running" in done.stderr


@pytest.mark.parametrize("inside", [True, False])
def test_live_page(robots: SimpleNamespace, inside: bool) -> None:
    command = ("rosafe", "live", "--port", "0", "--no-browser", *(() if inside else ("-i", "robot2/rosAFE")))
    env = {"ROS_NAMESPACE": "/robot2"} if inside else {}
    with robots.graph.start(*command, "unused:=elsewhere", **env) as process:
        live = pages.Live(process)
        seen = pages.asyncio.run(_state(live))
    assert seen == ["input", "of_robot2"]


async def _state(live: pages.Live) -> list[str]:
    """Return the processors that the page shows, when it has a status of both nodes."""
    async with pages.page(live) as client:
        while not all(client.latest.get("status", {}).get(name) for name in ("bass", "rosafe")):
            await client.receive()
        return [one["name"] for one in (await client.until("tree"))["processors"]]


def test_up_refuses_the_genomixd_of_another_namespace(robots: SimpleNamespace) -> None:
    with robots.graph.start("rosafe", "up", "--port", str(robots.robot1.port), ROS_NAMESPACE="/robot2") as process:
        wait_for(lambda: "genomixd" in process.out, what=lambda: str(process))
        assert "of the namespace /robot1" in process.out, process
        process.stop(signal.SIGINT)
