"""The live page's server on a real graph: who gets in, what is sent, and at what cost."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import aiohttp
import numpy as np
import pytest

from rosafe.http_server.refusal import HttpRefusal
from rosafe.live.access import TokenAuth
from tests.harness import ROOT, Graph, Process, wait_for
from tests.live.world import Live, build, live, page

ILD = {"what": "picture", "name": "ild_0"}
LEVELS = {"what": "levels"}
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


class World:
    """The robot and its page."""

    def __init__(self, graph: Graph, bass: Process, live: Live) -> None:
        self.graph, self.bass, self.live = graph, bass, live


@pytest.fixture(scope="module")
def world(graph: Graph) -> Iterator[World]:
    """Nodes, the scene, a tree, and the page."""
    with ExitStack() as stack:
        bass = stack.enter_context(graph.node("bass-ros"))
        stack.enter_context(graph.node("rosAFE-ros"))
        page = stack.enter_context(live(graph))
        build(graph, page)
        yield World(graph, bass, page)


# --- who gets in ---


def status(world: World, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
    """Of a request over a plain socket, and the whole answer."""
    host, port = world.live.address.rsplit(":", 1)
    lines = {"Host": world.live.address, "Connection": "close", **headers}
    request = f"{method} {path} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(request.encode("latin-1"))
        answer = b""
        while part := connection.recv(65536):
            answer += part
    text = answer.decode("utf-8", "replace")
    return int(text.split()[1]), text


def test_no_data_without_the_token(world: World) -> None:
    """The files of the page are for all; a wrong token is refused everywhere, a missing one at the socket."""
    wrong = ("?token=", "?token=x", f"?token={world.live.token}x", f"?token={world.live.token[:-1]}", "?Token=x")
    for path in ("/socket", *(f"/socket{one}" for one in wrong), *(f"/{one}" for one in wrong[:4])):
        code, text = status(world, path, **UPGRADE)
        assert code == 403 and "rosafe live" in text and world.live.token not in text, path
    code, text = status(world, f"/socket?token={world.live.token}")  # no WebSocket
    assert code == 400
    for path in ("/", "/main.js", f"/?token={world.live.token}"):
        code, text = status(world, path)
        assert code == 200 and world.live.token not in text and "Connection: close" in text, path
        assert "default-src 'none'" in text and "frame-ancestors 'none'" in text and "no-referrer" in text
        assert "set-cookie" not in text.lower()
    assert status(world, "/../server.py")[0] == status(world, "/%2e%2e/server.py")[0] == 404
    assert status(world, "/none")[0] == 404
    assert status(world, "/", "POST")[0] == 405


@pytest.mark.parametrize("value", ["x", "token", "whole token"])
def test_no_cookie_opens_the_socket(world: World, value: str) -> None:
    """Browsers send cookies to every port of a host: servers of other users get them."""
    token = {"x": "x", "token": f"token={world.live.token}", "whole token": world.live.token}[value]
    port = world.live.port
    cookie = f"rosafe_live_{port}={token}; token={token}; {token}"
    assert status(world, "/socket", **UPGRADE, Cookie=cookie)[0] == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "robot.evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
    ],
)
def test_pages_from_elsewhere_are_refused(world: World, headers: dict[str, str]) -> None:
    assert status(world, f"/socket?token={world.live.token}", **{**UPGRADE, **headers})[0] == 403
    assert status(world, "/", **headers)[0] == 403


def test_the_door_takes_no_odd_characters_for_the_token() -> None:
    door = TokenAuth({"robot"})
    door.check({"Host": "robot:8090"}, {"token": door.token})
    for query in ({"token": "\udcff\0ä"}, {"token": ""}, {}):
        with pytest.raises(HttpRefusal, match="token"):
            door.check_token(query)


def test_the_log_has_no_token(world: World) -> None:
    status(world, f"/nothing?token={world.live.token}")
    assert world.live.token not in world.live.process.err


def test_a_port_that_is_taken_is_one_line(world: World) -> None:
    port = world.live.address.rsplit(":", 1)[1]
    done = world.graph.run("rosafe", "live", "--port", port, "--no-browser", check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "--port" in done.stderr
    done = world.graph.run("rosafe", "live", "--port", "0", "--host", "192.0.2.1", "--no-browser", check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "192.0.2.1" in done.stderr


def test_without_a_master_it_says_what_to_do(graph: Graph) -> None:
    done = graph.run("rosafe", "live", "--no-browser", check=False, ROS_MASTER_URI="http://127.0.0.1:1")
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "roscore" in done.stderr


@pytest.mark.parametrize(
    "text",
    ["no JSON", "[]", '{"id": 1}', '{"id": "x", "do": "look"}', "[" * 50_000],
    ids=["text", "list", "half", "number", "deep"],
)
def test_what_is_no_request_ends_the_connection_and_nothing_else(world: World, text: str) -> None:
    async def scenario() -> None:
        async with page(world.live) as bad, page(world.live) as good:
            await bad.socket.send_str(text)
            with pytest.raises(ConnectionError):
                while True:
                    await bad.hear()
            assert "there is no request" in (await good.ask("explode"))["error"]

    asyncio.run(scenario())


# --- what is sent ---


def test_pictures_are_those_of_the_port(world: World) -> None:
    """Every column of the level differences is a frame of the port, to within half a step of the quantiser."""

    async def scenario(messages: list[Any]) -> tuple[dict[str, Any], list[tuple[int, int, float, np.ndarray]]]:
        async with page(world.live) as client:
            (view,) = await client.look(ILD)
            number = view["number"]
            while sum(piece[3].shape[1] for piece in client.pieces.get(number, [])) < 220 or len(messages) < 4:
                await client.hear()
            return view, client.pieces[number]

    with world.graph.collect("/rosAFE/ildPort/ild_0") as messages:
        view, pieces = asyncio.run(scenario(messages))
    assert view["unit"] == "dB" and view["rate"] == 100 and len(view["along"]) == view["rows"]
    columns = np.concatenate([piece[3] for piece in pieces], axis=1)
    step = max(np.nanmax(piece[3]) - np.nanmin(piece[3]) for piece in pieces) / 254
    places = [columns[:, at : at + 30] for at in range(columns.shape[1] - 29)]
    found = []  # of each message: how far its newest 30 frames are from the nearest columns, where those end, its index
    for message in list(messages):
        frames = np.array([channel.data for channel in message.left.dataN])[:, -30:]
        far = np.nan_to_num([np.abs(place - frames).max() for place in places], nan=np.inf)
        found.append((far.min(), int(far.argmin()) + 30, message.lastFrameIndex))
    far, after, index = min(found)
    assert far <= 0.51 * step
    first, _, end, values = pieces[-1]
    moment = end - (columns.shape[1] - after) / view["rate"]  # that these columns reach up to
    assert moment == pytest.approx(index / 16000, abs=0.011)
    assert first / view["rate"] == pytest.approx(end - values.shape[1] / view["rate"], abs=0.02)


def test_the_direction_is_that_of_the_scene(world: World) -> None:
    from rosafe.bass.sources.scene import scene_azimuth

    async def scenario() -> tuple[dict[str, Any], list[tuple[int, int, float, np.ndarray]]]:
        async with page(world.live) as client:
            (view,) = await client.look({"what": "direction", "name": "crosscorrelation_0"})
            # of three seconds in which a source was heard; a processor that is new has heard nothing yet
            while sum(np.isfinite(piece[3]).sum() for piece in client.pieces.get(view["number"], [])) < 300:
                await client.hear()
            return view, client.pieces[view["number"]]

    view, pieces = asyncio.run(scenario())
    assert view["from"] == ["itd_0", "ic_0"]
    errors = []
    for _, _, end, values in pieces:
        times = end - (values.shape[1] - np.arange(values.shape[1])) / view["rate"]
        azimuths = np.interp(values[0], view["lags"], view["azimuths"])
        errors.append(np.abs(azimuths - scene_azimuth(times, 5.0)))
    heard = np.concatenate(errors)
    assert np.nanmedian(heard) < 8


def test_a_page_gets_at_most_25_pictures_and_200_kilobytes_a_second(world: World) -> None:
    keys = [{"what": "picture", "name": name} for name in ("ratemap_0", "ild_0", "crosscorrelation_0", "input_0")]

    async def scenario() -> tuple[float, float]:
        async with page(world.live) as client:
            await client.look(LEVELS, *keys)
            begun, bytes_, pictures = time.monotonic(), client.bytes, client.pictures
            while time.monotonic() < begun + 3:
                await client.look(LEVELS, *keys, anew=True)  # there is always more to send than may be
                for _ in range(5):
                    await client.hear()
            seconds = time.monotonic() - begun
            return (client.bytes - bytes_) / seconds, (client.pictures - pictures) / seconds

    kilobytes, pictures = asyncio.run(scenario())
    assert 0 < pictures <= 25.5
    assert 1000 < kilobytes <= 215_000  # a message more may lie in the time


def ports_of_the_page(graph: Graph) -> set[str]:
    return {topic for topic, node in graph.readers() if node.startswith("/rosafe_live")}


def test_nothing_is_subscribed_that_nobody_looks_at(world: World) -> None:
    wait_for(lambda: not ports_of_the_page(world.graph), what=lambda: str(world.graph.readers()))

    async def scenario() -> None:
        async with page(world.live) as one, page(world.live) as two:
            await one.look(ILD, LEVELS)
            await two.look(ILD)
            both = {"/rosAFE/ildPort/ild_0", "/bass/Audio"}
            await asyncio.to_thread(lambda: wait_for(lambda: both <= ports_of_the_page(world.graph)))
            await one.look()
            await asyncio.to_thread(lambda: wait_for(lambda: "/bass/Audio" not in ports_of_the_page(world.graph)))
            assert "/rosAFE/ildPort/ild_0" in ports_of_the_page(world.graph)

    asyncio.run(scenario())
    wait_for(lambda: not ports_of_the_page(world.graph), what="an end of all subscriptions")


def test_twenty_pages_see_the_same(world: World) -> None:
    async def one(live: Live) -> set[int]:
        async with page(live) as client:
            (view,) = await client.look(ILD)
            while len(client.pieces.get(view["number"], [])) < 5:
                await client.hear()
            return {view["number"]}

    async def scenario() -> list[set[int]]:
        return await asyncio.gather(*(one(world.live) for _ in range(20)))

    assert len(set.union(*asyncio.run(scenario()))) == 1


# --- what is asked for ---


def test_requests_and_their_refusals(world: World) -> None:
    async def scenario() -> None:
        async with page(world.live) as client:
            assert (await client.until("hello"))["kinds"]["ratemap"]["parameters"]["rm_wSizeSec"]["range"]
            made = (await client.ask("build", representation="onsetStrength"))["ok"]
            assert made["name"] in made["created"]
            views = await client.look({"what": "picture", "name": made["name"]}, {"what": "picture", "name": "nobody"})
            assert views[0]["kind"] == "onsetStrength" and "nobody" in views[1]["error"]
            refused = await client.ask("modify", nameProc="ratemap_0", nameParam="rm_decaySec", newValue="-1")
            assert "e_badNewValue" in refused["error"] and "rm_decaySec" in refused["error"]
            assert "e_noSuchProcessor" in (await client.ask("remove", name="nobody"))["error"]
            refused = (await client.ask("acquire", device="file:/none/there.wav"))["error"]  # with bass's reason
            assert refused == "e_device: /none/there.wav: No such file or directory"
            assert (await client.ask("remove", name=made["name"])) == {"about": "answer", "id": 6, "ok": {}}
            assert any(one["name"] == "scene:" for one in (await client.ask("devices"))["ok"]["devices"])
            text = (await client.ask("save"))["ok"]["setup"]
            again = await client.ask("load", setup=text)
            assert "ok" in again, (again, text)
            assert not again["ok"]["created"] and "ratemap_0" in again["ok"]["reused"]
            assert "line" in (await client.ask("load", setup="processors: [nonsense"))["error"]

    asyncio.run(scenario())


def test_a_watcher_changes_nothing(world: World) -> None:
    before = world.graph.call("/rosAFE/getProcessors")

    async def scenario(live: Live) -> None:
        async with page(live) as client:
            assert (await client.until("hello"))["watch"] is True
            for what in ("build", "usual", "modify", "remove", "acquire", "silence", "load", "devices"):
                answer = await client.ask(what, name="ratemap_0", representation="pitch", device="scene:")
                assert "--watch" in answer["error"], what
            (view,) = await client.look(ILD)
            while not client.pieces.get(view["number"]):
                await client.hear()

    with live(world.graph, "--watch") as watching:
        asyncio.run(scenario(watching))
    assert world.graph.call("/rosAFE/getProcessors") == before


def test_loads_and_states_come_with_the_status(world: World) -> None:
    async def scenario() -> dict[str, Any]:
        async with page(world.live) as client:
            await client.look(LEVELS, ILD)
            while True:
                client.said.pop("status", None)
                told = await client.until("status")
                if told["loads"].get("ratemap_0", {}).get("load", 0) > 0 and told["latencies"]:
                    return told

    told = asyncio.run(scenario())
    assert told["device"].startswith("scene:") and told["bass"] and told["rosafe"] and told["sampleRate"] == 16000
    assert told["loads"]["ratemap_0"]["blocks"] > 0 and 0 <= told["delay"] < 60
    assert all(0 < seconds < 60 for seconds in told["latencies"].values())
    assert json.dumps(told)


def ragged(message_class: Any) -> Any:
    """A message of level differences whose channels differ in length, which no rosAFE sends."""
    from rosAFE.msg import rosAFE_signalOneD

    message = message_class(sampleRate=16000, lastFrameIndex=10**6, framesOnPort=3, numberOfChannels=2)
    message.left.dataN = [rosAFE_signalOneD([1.0, 2.0, 3.0]), rosAFE_signalOneD([1.0])]
    return message


def test_malformed_messages_are_reported_once_and_shown(world: World) -> None:
    """Of the sound, of a port and of the diagnostics; the page goes on."""
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct

    from bass.msg import binaudio_portStruct

    world.graph.client()
    audio = binaudio_portStruct(
        sampleRate=16000, nChunksOnPort=1, nFramesPerChunk=5, lastFrameIndex=5, left=[1] * 5, right=[1] * 3
    )
    capture = [KeyValue("lost frames", "9" * 5000), KeyValue("device", "x" * 5000)]
    loads = [KeyValue("x", "ild, on, 1 blocks, 1.2.3 ms/s"), KeyValue("y", "ild, on, 1 blocks, " + "9" * 400 + " ms/s")]
    health = DiagnosticArray(
        status=[
            DiagnosticStatus(name="malformed: capture", values=capture),
            DiagnosticStatus(name="rosAFE: processors", values=loads),
        ]
    )
    messages = {
        "/malformed/Audio": audio,
        "/rosAFE/ildPort/ild_0": ragged(rosAFE_TimeFrequencySignalPortStruct),
        "/diagnostics": health,
    }
    publishers = {topic: rospy.Publisher(topic, type(one), queue_size=1) for topic, one in messages.items()}

    async def scenario(live: Live) -> dict[str, Any]:
        async with page(live) as client:
            await client.look(LEVELS, ILD)
            while True:
                for topic, publisher in publishers.items():
                    publisher.publish(messages[topic])
                await client.hear()
                told = client.said.get("status", {"malformed": ()})
                if len(told["malformed"]) == 2 and client.pieces and {"x", "y"} <= told["loads"].keys():
                    return dict(told)

    try:
        with live(world.graph, "--bass", "malformed") as one:
            told = asyncio.run(scenario(one))
            assert told["malformed"] == {
                "/malformed/Audio": "5 left and 3 right samples",
                "/rosAFE/ildPort/ild_0": "left: expected rows of one length, got different ones",
            }
            assert told["problem"] == "" and 0 <= told["lost"] < 1e9 and len(told["device"]) == 500
            assert told["loads"]["x"]["load"] == told["loads"]["y"]["load"] == 0.0
            assert one.process.alive and "Traceback" not in one.process.err
            for topic, why in told["malformed"].items():
                line = f"{topic}: malformed messages are ignored: {why}"
                assert one.process.err.count(line) == 1, one.process.err
    finally:
        for publisher in publishers.values():
            publisher.unregister()


def test_it_ends_in_time(world: World) -> None:
    async def scenario(live: Live) -> int:
        async with page(live) as client:
            await client.look(ILD)
            ended = asyncio.create_task(asyncio.to_thread(live.process.stop))
            with pytest.raises((ConnectionError, aiohttp.ClientError)):
                while True:
                    await client.hear()
            return await ended

    with live(world.graph) as one:
        assert asyncio.run(scenario(one)) == 0
        assert "Traceback" not in one.process.err
    ended = f"/rosafe_live_{one.process.pid}_"
    assert not [node for _, node in world.graph.readers() if node.startswith(ended)]


def test_images_for_rviz_while_somebody_subscribes(world: World) -> None:
    """Ten seconds of ratemap and level differences; their newest columns have the colours of the numbers."""
    with live(world.graph, "--images") as one:
        wait_for(lambda: not ports_of_the_page(world.graph), what=lambda: str(world.graph.readers()))
        for kind, ears in (("ratemap", 2), ("ild", 1)):
            image = world.graph.message(f"/rosafe_live/{kind}", accept=lambda m: any(m.data[-3:]))
            pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
            assert (image.encoding, image.step, image.width) == ("rgb8", 3 * image.width, 1000)
            assert image.height >= 160 * ears and np.unique(pixels[:, -20:].reshape(-1, 3), axis=0).shape[0] > 10
        assert one.process.alive
        wait_for(lambda: not ports_of_the_page(world.graph), what="an end of all subscriptions")


def test_the_commands_of_the_document(world: World) -> None:
    text = (ROOT / "docs" / "live.md").read_text("utf-8")
    commands = [line for block in re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S) for line in block.splitlines()]
    assert len(commands) == 3
    with ExitStack() as stack:
        for command in commands:
            words = [*shlex.split(command), "--port", "0", "--no-browser"]
            one = Live(stack.enter_context(world.graph.start(*words)))
            assert one.process.alive


def test_the_page_takes_nothing_from_elsewhere() -> None:
    for path in (ROOT / "rosafe" / "live" / "page").iterdir():
        text = path.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")  # a name, not an address
        assert not re.search(r"(https?:)?//\w+\.\w|eval\(|innerHTML|document\.write", text), path.name
