"""The server of the live page on a real graph: access, messages, rate limits, subscriptions."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import socket
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import numpy as np
import pytest
import rospy

from rosafe.audio.devices.scene import Scene
from rosafe.web.live import directions
from rosafe.web.live.access import TokenAuth
from rosafe.web.live.server import MAX_CLIENTS
from rosafe.web.server.access import HttpRefusal
from tests.harness import ROOT, Graph, Process, wait_for
from tests.web.live.world import Live, build, live, localizer, page

ILD = {"what": "picture", "name": "ild_0"}
LEVELS = {"what": "levels"}
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


class World:
    """The graph, bass, and the live page."""

    def __init__(self, graph: Graph, bass: Process, live: Live) -> None:
        self.graph, self.bass, self.live = graph, bass, live


@pytest.fixture(scope="module")
def world(graph: Graph) -> Iterator[World]:
    """Start the nodes and the live page, capture the scene and build a tree."""
    with ExitStack() as stack:
        bass = stack.enter_context(graph.node("bass-ros"))
        stack.enter_context(graph.node("rosAFE-ros"))
        page = stack.enter_context(live(graph))
        build(graph, page)
        yield World(graph, bass, page)


# --- access ---


def status(world: World, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
    """Send a request over a plain socket; return the status and the complete answer."""
    host, port = world.live.address.rsplit(":", 1)
    lines = {"Host": world.live.address, "Connection": "close", **headers}
    request = f"{method} {path} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    with socket.create_connection((host, int(port)), timeout=60) as connection:
        connection.sendall(request.encode("latin-1"))
        answer = b""
        while part := connection.recv(65536):
            answer += part
    text = answer.decode("utf-8", "replace")
    return int(text.split()[1]), text


def test_data_needs_the_token(world: World) -> None:
    """The files of the page need no token. A wrong token is always rejected, a missing one by the WebSocket."""
    wrong = ("?token=", "?token=x", f"?token={world.live.token}x", f"?token={world.live.token[:-1]}", "?Token=x")
    for path in ("/socket", *(f"/socket{one}" for one in wrong), *(f"/{one}" for one in wrong[:4])):
        code, text = status(world, path, **UPGRADE)
        assert code == 403 and "rosafe live" in text and world.live.token not in text, path
    code, text = status(world, f"/socket?token={world.live.token}")  # not a WebSocket request
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
def test_a_cookie_does_not_open_the_socket(world: World, value: str) -> None:
    """Cookies are not accepted, because browsers send them to every port of a host, also to servers of other users."""
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
def test_requests_of_other_origins_are_rejected(world: World, headers: dict[str, str]) -> None:
    assert status(world, f"/socket?token={world.live.token}", **{**UPGRADE, **headers})[0] == 403
    assert status(world, "/", **headers)[0] == 403


def test_malformed_tokens_are_rejected() -> None:
    auth = TokenAuth({"robot"})
    auth.check({"Host": "robot:8090"}, {"token": auth.token})
    for query in ({"token": "\udcff\0ä"}, {"token": ""}, {}):
        with pytest.raises(HttpRefusal, match="token"):
            auth.check_token(query)


def test_the_token_is_not_logged(world: World) -> None:
    status(world, f"/nothing?token={world.live.token}")
    assert world.live.token not in world.live.process.err


def test_a_port_in_use_is_reported_in_one_line(world: World) -> None:
    port = world.live.address.rsplit(":", 1)[1]
    done = world.graph.run("rosafe", "live", "--port", port, "--no-browser", check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "--port" in done.stderr
    done = world.graph.run("rosafe", "live", "--port", "0", "--host", "192.0.2.1", "--no-browser", check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "192.0.2.1" in done.stderr


def test_the_error_without_a_master_names_roscore(graph: Graph) -> None:
    done = graph.run("rosafe", "live", "--no-browser", check=False, ROS_MASTER_URI="http://127.0.0.1:1")
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "roscore" in done.stderr


# --- plots ---


def test_columns_are_frames_of_the_port(world: World) -> None:
    """Every column of the level differences is a frame of the port, within half a quantization step."""

    async def scenario(messages: list[Any]) -> tuple[dict[str, Any], list[tuple[int, int, float, np.ndarray]]]:
        async with page(world.live) as client:
            (view,) = await client.subscribe(ILD)
            number = view["number"]
            while sum(piece[3].shape[1] for piece in client.pieces.get(number, [])) < 220 or len(messages) < 4:
                await client.receive()
            return view, client.pieces[number]

    with world.graph.collect("/rosAFE/ildPort/ild_0") as messages:
        view, pieces = asyncio.run(scenario(messages))
    assert view["unit"] == "dB" and view["rate"] == 100 and len(view["along"]) == view["rows"]
    columns = np.concatenate([piece[3] for piece in pieces], axis=1)
    step = max(np.nanmax(piece[3]) - np.nanmin(piece[3]) for piece in pieces) / 254
    candidates = [columns[:, at : at + 30] for at in range(columns.shape[1] - 29)]
    found = []  # for each message: distance of its newest 30 frames from the nearest columns, their end, its index
    for message in list(messages):
        frames = np.array([channel.data for channel in message.left.dataN])[:, -30:]
        distance = np.nan_to_num([np.abs(candidate - frames).max() for candidate in candidates], nan=np.inf)
        found.append((distance.min(), int(distance.argmin()) + 30, message.lastFrameIndex))
    distance, after, index = min(found)
    assert distance <= 0.51 * step
    first, _, end, values = pieces[-1]
    moment = end - (columns.shape[1] - after) / view["rate"]  # at the end of these columns
    assert moment == pytest.approx(index / 16000, abs=0.011)
    assert first / view["rate"] == pytest.approx(end - values.shape[1] / view["rate"], abs=0.02)


def filled(columns: np.ndarray) -> np.ndarray:
    """Return whether each column is equal to the next one."""
    same = (columns[:, 1:] == columns[:, :-1]) | np.isnan(columns[:, 1:] + columns[:, :-1])
    return np.append(same.all(axis=0), False)


def test_posterior_sources_and_truth_share_a_column(world: World) -> None:
    """Estimates are placed at the time of the audio that their stamp denotes, as is the truth of the scene."""

    async def scenario() -> tuple[dict[str, Any], list[tuple[int, int, float, np.ndarray]]]:
        async with page(world.live) as client:
            _, view = await client.subscribe(LEVELS, {"what": "directions"})
            pieces = client.pieces.setdefault(view["number"], [])
            with localizer(world.graph, offset=10.0):
                while sum(np.isfinite(piece[3][-8]).sum() for piece in pieces) < 40:
                    before = len(pieces)
                    await client.receive()
                    held = [filled(piece[3]) for piece in pieces[before:]]
                    if any((one[1:] & one[:-1]).any() for one in held):
                        pieces.clear()  # the machine was too busy for the messages of two columns: begin again
            return view, pieces

    view, pieces = asyncio.run(scenario())
    assert (len(view["azimuths"]), view["slots"], view["rows"], view["rate"]) == (72, 8, 72 + 8 * 5 + 8, 10.0)
    columns = np.concatenate([piece[3] for piece in pieces], axis=1)
    columns = columns[:, np.isfinite(columns[-8])]
    posterior, sources, truth = columns[:72], columns[72:112].reshape(8, 5, -1), columns[112:]
    assert posterior.sum(axis=0) == pytest.approx(1, abs=1e-5)
    assert np.isnan(sources[2:]).all() and np.isnan(truth[1:]).all()
    assert (sources[:2, 0].T == [7, 8]).all() and sources[0, 3] == pytest.approx(0.9)  # the most probable one first
    assert sources[1, 1] == pytest.approx(np.degrees(-2.0), abs=1e-3)
    assert sources[0, 4] == pytest.approx(0.8) and np.isnan(sources[1, 4]).all()  # who speaks
    assert sources[0, 2] == pytest.approx(np.degrees(0.05), abs=1e-3)
    assert sources[0, 1] == pytest.approx(truth[0] + 10, abs=0.5)
    peaks = np.array(view["azimuths"])[posterior.argmax(axis=0)]
    assert np.abs(peaks - sources[0, 1]).max() <= 2.6
    assert np.abs(np.diff(truth[0])).sum() > 36  # of the scene, which turns back at the sides, in at least 1.5 s
    times = []
    for first, stride, end, values in pieces:
        times.append(end - (values.shape[1] - np.arange(values.shape[1])) / view["rate"])
        assert stride == 1 and abs(first / view["rate"] - times[-1][0]) < 0.11
    columns = np.concatenate([piece[3] for piece in pieces], axis=1)
    known = np.isfinite(columns[112])
    errors = np.abs(columns[112] - Scene(16000, seconds=5.0).azimuth(np.concatenate(times) + 0.05))[known]
    # On a busy machine a column may have no message of its own. The page fills it with the values of the next one.
    held = filled(columns)[known]
    assert np.median(errors) < 2.7 and held.mean() < 0.2
    assert errors[~held].max() < 4.5, "a column lasts 0.1 s, in which the source moves by 3.6 degrees"
    assert errors[held].max(initial=0.0) < 8.1, "of the next column"


def test_unsuitable_messages_of_a_localizer_are_ignored() -> None:
    def posterior(azimuths: Any, probability: Any) -> np.ndarray:
        return directions.resampled(SimpleNamespace(azimuths=azimuths, probability=probability))

    for azimuths, probability in (([], []), ([0.0, 1.0], [1.0]), ([0.0, 1.0], [1.0, np.nan]), ([0.0] * 3601,) * 2):
        assert np.isnan(posterior(azimuths, probability)).all()
    found = posterior(np.radians([0.0, 90.0, 180.0, -90.0]), [0.0, 1.0, 0.0, 0.0])
    assert found.sum() == pytest.approx(1) and directions.GRID[found.argmax()] == 90
    assert found[directions.GRID < 0].sum() == 0
    many = [SimpleNamespace(id=n, azimuth=0.0, azimuth_std=0.1, probability=n / 100, speech=0.7) for n in range(100)]
    slots = directions.source_slots(SimpleNamespace(sources=many)).reshape(-1, directions.SOURCE_NUMBERS)
    assert slots[:, 0].tolist() == list(range(99, 91, -1)) and set(slots[:, 4]) == {0.7}


@pytest.fixture
def columns(monkeypatch: pytest.MonkeyPatch) -> tuple[directions.DirectionTopics, list[tuple[int, int]]]:
    """Return an object that gets messages from the test, and a list of its columns: number and how many."""
    monkeypatch.setattr(rospy, "Subscriber", lambda *_, **__: None)
    monkeypatch.setattr(rospy, "get_param", lambda _, default: default)
    audio = SimpleNamespace(time_at=lambda moment: moment, sample_rate=16000)
    found: list[tuple[int, int]] = []
    append = lambda number, column, _: found.append((number, column.shape[1]))  # noqa: E731
    return directions.DirectionTopics(lambda: cast(Any, audio), append, "/bass", "/localizer"), found


def pair(moment: float) -> tuple[Any, Any]:
    """Return messages of sources and posterior."""
    header = SimpleNamespace(stamp=rospy.Time.from_sec(moment), frame_id="head")
    posterior = SimpleNamespace(header=header, azimuths=[0.0, 1.0], probability=[0.5, 0.5])
    return SimpleNamespace(header=header, sources=[]), posterior


def test_a_step_back_of_the_time_begins_another_series(
    columns: tuple[directions.DirectionTopics, list[tuple[int, int]]],
) -> None:
    topics, found = columns
    for moment in (10.05, 10.15, 10.12, 10.35, 1.05, 1.15):  # 10.12: in the column of 10.15
        sources, posterior = pair(moment)
        topics._receive_sources(sources)
        topics._receive_posterior(posterior)
    assert found == [(100, 1), (101, 1), (102, 2), (10, 1), (11, 1)]


def test_messages_of_one_stamp_belong_together_in_any_order(
    columns: tuple[directions.DirectionTopics, list[tuple[int, int]]],
) -> None:
    """On a busy machine, several messages of one topic arrive before those of the other one; some never arrive."""
    topics, found = columns
    pairs = [pair(0.05 + 0.1 * number) for number in range(33)]
    for sources, _ in pairs[:3]:
        topics._receive_sources(sources)
    for _, posterior in pairs[:3]:
        topics._receive_posterior(posterior)
    assert found == [(0, 1), (1, 1), (2, 1)]
    for _, posterior in pairs[3:32]:
        topics._receive_posterior(posterior)
    for message, receive in zip(pairs[32], (topics._receive_sources, topics._receive_posterior), strict=True):
        receive(message)
    assert found[3:] == [(32, 1)]
    assert len(topics._waiting) <= 10


def test_a_page_gets_at_most_25_messages_and_200_kilobytes_per_second(world: World) -> None:
    keys = [{"what": "picture", "name": name} for name in ("ratemap_0", "ild_0", "crosscorrelation_0", "input_0")]

    async def scenario() -> tuple[float, float]:
        async with page(world.live) as client:
            await client.subscribe(LEVELS, *keys)
            begun, bytes_, messages = time.monotonic(), client.bytes, client.messages
            while time.monotonic() < begun + 3:
                await client.subscribe(LEVELS, *keys, resend=True)  # more data than the limit
                for _ in range(5):
                    await client.receive()
            seconds = time.monotonic() - begun
            return (client.bytes - bytes_) / seconds, (client.messages - messages) / seconds

    byte_rate, message_rate = asyncio.run(scenario())
    assert 0 < message_rate <= 25.5
    assert 1000 < byte_rate <= 215_000  # the interval may contain one more message


def ports_of_the_page(graph: Graph) -> set[str]:
    return {topic for topic, node in graph.readers() if node.startswith("/rosafe_live")}


def test_topics_without_a_view_are_not_subscribed(world: World) -> None:
    wait_for(lambda: not ports_of_the_page(world.graph), what=lambda: str(world.graph.readers()))

    async def scenario() -> None:
        async with page(world.live) as one, page(world.live) as two:
            shared, _ = await one.subscribe(ILD, LEVELS)
            (view,) = await two.subscribe(ILD)
            assert view["number"] == shared["number"], "pages share a view"
            both = {"/rosAFE/ildPort/ild_0", "/bass/Audio"}
            await asyncio.to_thread(lambda: wait_for(lambda: both <= ports_of_the_page(world.graph)))
            await one.subscribe()
            await asyncio.to_thread(lambda: wait_for(lambda: "/bass/Audio" not in ports_of_the_page(world.graph)))
            assert "/rosAFE/ildPort/ild_0" in ports_of_the_page(world.graph)

    asyncio.run(scenario())
    wait_for(lambda: not ports_of_the_page(world.graph), what="an end of all subscriptions")


def test_more_pages_than_the_limit_are_rejected(world: World) -> None:
    async def scenario() -> int:
        async with AsyncExitStack() as stack:
            for _ in range(MAX_CLIENTS):
                await (await stack.enter_async_context(page(world.live))).until("hello")
            with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
                await stack.enter_async_context(page(world.live))
            return caught.value.status

    assert asyncio.run(scenario()) == 503


# --- requests ---


def test_requests_and_their_errors(world: World) -> None:
    async def scenario() -> None:
        async with page(world.live) as client:
            assert (await client.until("hello"))["kinds"]["ratemap"]["parameters"]["rm_wSizeSec"]["range"]
            built = (await client.request("build", representation="onsetStrength"))["ok"]
            assert built["name"] in built["created"]
            views = await client.subscribe(
                {"what": "picture", "name": built["name"]}, {"what": "picture", "name": "missing"}
            )
            assert views[0]["kind"] == "onsetStrength" and "missing" in views[1]["error"]
            rejected = await client.request("modify", nameProc="ratemap_0", nameParam="rm_decaySec", newValue="-1")
            assert "e_badNewValue" in rejected["error"] and "rm_decaySec" in rejected["error"]
            assert "e_noSuchProcessor" in (await client.request("remove", name="missing"))["error"]
            rejected = (await client.request("acquire", device="file:/none/there.wav"))[
                "error"
            ]  # the reason given by bass
            assert rejected == "e_device: /none/there.wav: No such file or directory"
            assert (await client.request("remove", name=built["name"])) == {"about": "answer", "id": 6, "ok": {}}
            assert any(one["name"] == "scene:" for one in (await client.request("devices"))["ok"]["devices"])
            text = (await client.request("save"))["ok"]["setup"]
            again = await client.request("load", setup=text)
            assert "ok" in again, (again, text)
            assert not again["ok"]["created"] and "ratemap_0" in again["ok"]["reused"]
            assert "line" in (await client.request("load", setup="processors: [nonsense"))["error"]

    asyncio.run(scenario())


def test_a_watching_page_cannot_change_the_tree(world: World) -> None:
    before = world.graph.call("/rosAFE/getProcessors")

    async def scenario(live: Live) -> None:
        async with page(live) as client:
            assert (await client.until("hello"))["watch"] is True
            for action in ("build", "usual", "modify", "remove", "acquire", "silence", "load", "devices"):
                answer = await client.request(action, name="ratemap_0", representation="pitch", device="scene:")
                assert "--watch" in answer["error"], action
            (view,) = await client.subscribe(ILD)
            while not client.pieces.get(view["number"]):
                await client.receive()

    with live(world.graph, "--watch") as watching:
        asyncio.run(scenario(watching))
    assert world.graph.call("/rosAFE/getProcessors") == before


def test_the_status_has_loads_and_states(world: World) -> None:
    async def scenario() -> dict[str, Any]:
        async with page(world.live) as client:
            await client.subscribe(LEVELS, ILD)
            while True:
                client.latest.pop("status", None)
                latest = await client.until("status")
                measured = latest["loads"].get("ratemap_0", {}).get("load", 0) > 0 and latest["latencies"]
                if measured and latest["device"]:
                    return latest

    latest = asyncio.run(scenario())
    assert (
        latest["device"].startswith("scene:") and latest["bass"] and latest["rosafe"] and latest["sampleRate"] == 16000
    )
    assert latest["loads"]["ratemap_0"]["blocks"] > 0 and 0 <= latest["delay"] < 60
    assert all(0 < seconds < 60 for seconds in latest["latencies"].values())
    assert json.dumps(latest)


def ragged(message_class: Any) -> Any:
    """Return a message of level differences whose channels differ in length, which rosAFE never sends."""
    from rosAFE.msg import rosAFE_signalOneD

    message = message_class(sampleRate=16000, lastFrameIndex=10**6, framesOnPort=3, numberOfChannels=2)
    message.left.dataN = [rosAFE_signalOneD([1.0, 2.0, 3.0]), rosAFE_signalOneD([1.0])]
    return message


def test_malformed_messages_are_reported_once_and_shown(world: World) -> None:
    """Malformed audio, frames of a port and diagnostics do not affect the page."""
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
            await client.subscribe(LEVELS, ILD)
            while True:
                for topic, publisher in publishers.items():
                    publisher.publish(messages[topic])
                await client.receive()
                latest = client.latest.get("status", {"malformed": ()})
                if len(latest["malformed"]) == 2 and client.pieces and {"x", "y"} <= latest["loads"].keys():
                    return dict(latest)

    try:
        with live(world.graph, "--bass", "malformed") as one:
            latest = asyncio.run(scenario(one))
            assert latest["malformed"] == {
                "/malformed/Audio": "5 left and 3 right samples",
                "/rosAFE/ildPort/ild_0": "left: expected rows of one length, got different ones",
            }
            assert latest["problem"] == "" and 0 <= latest["lost"] < 1e9 and len(latest["device"]) == 500
            assert latest["loads"]["x"]["load"] == latest["loads"]["y"]["load"] == 0.0
            assert one.process.alive and "Traceback" not in one.process.err
            for topic, why in latest["malformed"].items():
                line = f"{topic}: malformed messages are ignored: {why}"
                assert one.process.err.count(line) == 1, one.process.err
    finally:
        for publisher in publishers.values():
            publisher.unregister()


def test_it_ends_while_a_page_is_open(world: World) -> None:
    async def scenario(live: Live) -> int:
        async with page(live) as client:
            await client.subscribe(ILD)
            ended = asyncio.create_task(asyncio.to_thread(live.process.stop))
            with pytest.raises((ConnectionError, aiohttp.ClientError)):
                while True:
                    await client.receive()
            return await ended

    with live(world.graph) as one:
        assert asyncio.run(scenario(one)) == 0
        assert "Traceback" not in one.process.err
    ended = f"/rosafe_live_{one.process.pid}_"
    assert not [node for _, node in world.graph.readers() if node.startswith(ended)]


def test_images_for_rviz_while_they_are_subscribed(world: World) -> None:
    """Images show ten seconds of ratemap and level differences; their newest columns have many colours."""
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


def test_the_page_loads_nothing_from_other_hosts() -> None:
    for path in (ROOT / "rosafe" / "web" / "live" / "page").iterdir():
        text = path.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")  # a namespace, not an address
        assert not re.search(r"(https?:)?//\w+\.\w|eval\(|innerHTML|document\.write", text), path.name
