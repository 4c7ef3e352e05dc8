"""The node among others: names, time, transforms, sound of other drivers, end."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe.ros1.transport.paths import PYPI_DIR
from tests.harness import PATIENCE, ROOT, proc, wait_for

from .client import Client, joined, seconds
from .network import Network

RATE = 16000


def test_two_nodes_side_by_side_with_other_names(ros2: Network, tmp_path: Path) -> None:
    given = ("device:=scene:", "representations:=[ild]")
    ros2.node(*given, arguments=("-r", "__ns:=/robot", "-r", "~/ild:=/levels"))
    ros2.node(*given, "frames_per_block:=441", arguments=("-r", "__node:=ears"))
    first, second = Client(ros2, tmp_path, "/robot/rosafe"), Client(ros2, tmp_path, "/ears")
    first.subscribe("/levels")
    second.subscribe("ild")
    joined(first.take("/levels", 5))
    joined(second.take("ild", 5))
    assert (first.get("input.in_doNormalize"), second.get("frames_per_block")) == (True, 441)
    (ild,) = [one for one in first.call("get_tree")["processors"] if one["name"] == "ild"]
    assert ild["topics"] == ["/levels"]
    assert first.call("stop")["success"]
    second.take("ild", 5)


HEAP = 64 * 2**20  # bytes to which glibc aligns each further pool of the allocator


def further_pools(pid: int) -> Iterator[int]:
    """Yield the addresses of the pools after the first: each begins with a pointer into itself."""
    with proc(pid, "mem").open("rb") as memory:
        for addresses, mode, *rest in map(str.split, proc(pid, "maps").read_text().splitlines()):
            begin, end = (int(address, 16) for address in addresses.split("-"))
            if mode != "rw-p" or len(rest) > 3:  # of a file
                continue
            for address in range(begin + -begin % HEAP, end, HEAP):
                with contextlib.suppress(OSError):  # no longer there
                    memory.seek(address)
                    if 0 < int.from_bytes(memory.read(8), sys.byteorder) - address < 4096:
                        yield address


def test_threads_share_two_pools_of_the_allocator(ros2: Network, tmp_path: Path, sphere_model: Path) -> None:
    """With one for each of its threads the node had 300 MB more."""
    node = ros2.node("device:=scene:", f"head:={sphere_model}", "localize:=true")
    client = Client(ros2, tmp_path)
    client.subscribe("sources", "rosafe_msgs/msg/SoundSources")
    client.take("sources", 20)
    pools = list(further_pools(node.pid))
    assert len(pools) < 4, pools  # threads of libraries may start before the limit is set


def test_memory_of_removed_processors_is_returned(ros2: Network, tmp_path: Path) -> None:
    """Also while the clock of a simulation stands still."""
    given = ("device:=scene:?seconds=600", "representations:=[ild]", "frames_per_block:=12000")
    node = ros2.node(*given, "use_sim_time:=true")
    client = Client(ros2, tmp_path)

    def resident() -> float:
        return int(proc(node.pid, "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    client.subscribe("ild")
    client.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    client.take("ild", 20)
    client.take("/diagnostics", 2)
    before = resident()
    for _ in range(4):
        assert client.call("remove_processor", name="gammatone")["success"]
        assert client.call("request", representation="ild", parameters="fb_nChannels: 128")["success"]
        client.take("ild", 5)
    assert resident() > before + 100
    assert client.call("remove_processor", name="gammatone")["success"]
    wait_for(lambda: resident() < before + 20, what=lambda: f"{resident():.0f} MiB, {before:.0f} before")


def test_a_device_alone_is_localized_in_the_world(ros2: Network, tmp_path: Path, sphere_model: Path) -> None:
    node = ros2.node(
        "device:=scene:?seconds=600",
        "sample_rate:=16000",
        f"head:={sphere_model}",
        "world_frame:=map",
        "frame_id:=ears",
    )
    client = Client(ros2, tmp_path)
    for topic, kind in (
        ("sources", "SoundSources"),
        ("posterior", "DirectionPosterior"),
        ("scene_truth", "SceneTruth"),
    ):
        client.subscribe(topic, f"rosafe_msgs/msg/{kind}")
    client.subscribe("poses", "geometry_msgs/msg/PoseArray")
    client.subscribe("/tf", "tf2_msgs/msg/TFMessage")
    client.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    (transform, *_) = client.take("/tf")[0]["transforms"]
    assert (transform["header"]["frame_id"], transform["child_frame_id"]) == ("map", "ears")

    def sources() -> Any:
        message = client.take("sources")[-1]
        return message["header"]["frame_id"] == "map" and message["sources"] and message

    message = wait_for(sources)
    (source, *_) = message["sources"]
    moment = seconds(message["header"]["stamp"])
    truths = client.take("scene_truth")
    while seconds(truths[-1]["stamp"]) < moment:
        truths += client.take("scene_truth")
    truth = min(truths, key=lambda one: abs(seconds(one["stamp"]) - moment))
    assert truth["names"] == ["talker"] and abs(source["azimuth"] - truth["azimuths"][0]) < 0.2
    assert source["level"] < 0
    # NaN at first, for how long depends on when this program reads
    wait_for(lambda: (message := sources()) and 0 <= float(message["sources"][0]["speech"]) <= 1)
    posterior = client.take("posterior")[-1]
    assert abs(sum(posterior["probability"]) - 1) < 1e-6 and len(posterior["azimuths"]) == 72
    assert wait_for(lambda: client.take("poses")[-1]["poses"])[0]["orientation"]["z"] > 0.5
    parts = {f"rosafe: {part}" for part in ("sound", "processors", "localization")}
    wait_for(lambda: {one["name"] for one in client.take("/diagnostics")[-1]["status"]} == parts)  # once in a second
    assert client.call("remove_processor", name="ratemap")["success"]
    wait_for(lambda: "/rosafe/ratemap" in client.ask("topics"))  # it is requested again
    began = time.monotonic()
    assert node.stop(signal.SIGINT) == 0 and time.monotonic() - began < PATIENCE


def test_stamps_are_times_of_the_clock_of_a_simulation(ros2: Network, tmp_path: Path) -> None:
    ros2.node("device:=scene:", "representations:=[ild]", "use_sim_time:=true")
    client = Client(ros2, tmp_path)
    client.subscribe("ild")
    newest: Any = wait_for(lambda: next((one for one in client.take("ild") if one["first_frame"] > 300), None))  # 3 s
    assert newest["header"]["stamp"] == {"sec": 0, "nanosec": 0}, "the clock has not begun"
    clock = {"clock": {"sec": 1000, "nanosec": 0}}

    def in_time() -> bool:  # a message is lost if the node does not know its publisher yet
        client.ask("publish", kind="rosgraph_msgs/msg/Clock", topic="/clock", fields=clock)
        return abs(seconds(client.take("ild")[-1]["header"]["stamp"]) - 1000) < 0.5

    wait_for(in_time)
    frame = client.take("ild")[-1]["first_frame"]
    newest = wait_for(lambda: next((one for one in client.take("ild") if one["first_frame"] > frame + 200), None))
    assert 999.5 < seconds(newest["header"]["stamp"]) <= 1000  # it stands


WAITS = """
import json, time
from types import SimpleNamespace
from rosafe.ros2 import messages
from rosafe.system.clocks import wall_difference

def now():
    value = time.time()
    time.sleep(next(waits, 0.0))
    return value

sent = []
publisher = SimpleNamespace(publish=sent.append)
topics = messages.TruthTopics(SimpleNamespace(create_publisher=lambda *_: publisher), ("map", "ears"), now)
moment = time.monotonic()
wall = moment + wall_difference()
waits = iter([0.03])
topics.publish(1, moment, SimpleNamespace(head_yaw=0, azimuths=[], names=[]))
stamp = sent[0].stamp
waits = iter([0.03])
clock = SimpleNamespace(ros_time_is_active=True, now=lambda: SimpleNamespace(nanoseconds=round(now() * 1e9)))
offset = messages.clock_offset(SimpleNamespace(get_clock=lambda: clock))
print(json.dumps([stamp.sec + 1e-9 * stamp.nanosec - wall, offset]))
"""


def test_a_thread_that_waits_between_two_clocks(ros2: Network) -> None:
    process = ros2.python(WAITS, PYTHONPATH=os.pathsep.join((str(ROOT), ros2.env["PYTHONPATH"])))
    assert process.wait() == 0, process
    assert json.loads(process.out) == pytest.approx([0, 0], abs=5e-3), "s"


LATE = """
import array, itertools, json, os, threading, time
import numpy as np
import rclpy
from audio_common_msgs.msg import AudioDataStamped
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import QoSProfile
from rosafe.ros2.sound_topic import TopicSource

FRAMES, MESSAGES, RATE = 160, 150, 16000

class Late(TopicSource):
    waits = itertools.cycle([0.02, 0.0, 0.0])

    def receive(self, *message):
        time.sleep(next(self.waits))
        super().receive(*message)

def drive():
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    for number in range(MESSAGES):
        message = AudioDataStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = 1000, number * FRAMES * 10**9 // RATE
        samples = np.arange(number * FRAMES, (number + 1) * FRAMES, dtype="<i2").repeat(2)
        message.audio.data = array.array("B", samples.tobytes())
        publisher.publish(message)
        time.sleep(0.005)

rclpy.init()
ears, driver = rclpy.create_node("ears"), rclpy.create_node("driver")
publisher = driver.create_publisher(AudioDataStamped, "/audio", QoSProfile(depth=MESSAGES))
executor = MultiThreadedExecutor(4)
executor.add_node(ears)
for run in (executor.spin, drive):
    threading.Thread(target=run, daemon=True).start()
stopping = threading.Event()
source = Late(ears, f"/audio?format=S16LE&rate={RATE}&of=2", 0, FRAMES, stopping)
timer = threading.Timer(20, stopping.set)  # if the last message is not heard
timer.start()
heard = []
while heard[-1:] != [FRAMES * MESSAGES - 1] and (chunk := source.read()) is not None:
    heard += (chunk.samples[0] >> 16).tolist()
timer.cancel()
print(json.dumps([heard, source.lost_frames]), flush=True)
os._exit(0)  # threads of the middleware that still run would abort the process at its end
"""


def test_threads_that_get_the_messages_of_another_driver_late(ros2: Network) -> None:
    """The sound has the order of the messages, although the node has several threads. The first ones may be missed."""
    process = ros2.python(LATE, PYTHONPATH=os.pathsep.join((str(ROOT), ros2.env["PYTHONPATH"])))
    assert process.wait() == 0, process
    heard, lost = json.loads(process.out)
    assert heard == list(range(heard[0], 24000)) and lost == 0 and len(heard) >= 8000


@pytest.mark.parametrize("options", ["?format=S16LE&rate=16000&of=2", ""], ids=["options", "description"])
def test_sound_of_another_driver(options: str, ros2: Network, tmp_path: Path) -> None:
    """A driver repeats the description of its format after 5 s."""
    ros2.node("representations:=[ild]", "frames_per_block:=160")
    client, driver = Client(ros2, tmp_path), Client(ros2, tmp_path)
    client.subscribe("ild")
    message = client.call("acquire", device=f"topic:/none{options}")["message"]
    assert message.startswith(f"topic:/none{options}: the topic has no publisher; start the driver")
    message = client.call("acquire", device=f"topic:/rosout{options}")["message"]
    assert message.startswith(f"topic:/rosout{options}: messages of type rcl_interfaces/msg/Log are not used; start")
    noise = np.random.default_rng(1).integers(-2000, 2000, 320)
    data = [*np.stack((2 * noise, noise)).T.astype("<i2").tobytes()]
    description = {"channels": 2, "sample_rate": RATE, "sample_format": "S16LE", "coding_format": "wave"}
    finished = threading.Event()

    def drive() -> None:
        begin = time.time()
        for start in itertools.count(0, 320):
            whole, part = divmod(begin + start / RATE, 1)
            stamp = {"sec": int(whole), "nanosec": int(part * 1e9)}
            fields = {"header": {"stamp": stamp}, "audio": {"data": data}}
            if finished.wait(max(0.0, begin + start / RATE - time.time())):
                return
            driver.ask("publish", kind="audio_common_msgs/msg/AudioDataStamped", topic="/audio", fields=fields)
            if start in (5 * RATE, 10 * RATE) and not options:
                driver.ask("publish", kind="audio_common_msgs/msg/AudioInfo", topic="/audio_info", fields=description)

    with ThreadPoolExecutor() as pool:
        try:
            # It begins before the node knows the publisher and its type.
            acquired = pool.submit(client.call, "acquire", device=f"topic:/audio{options}")
            threading.Thread(target=drive, daemon=True).start()  # it waits for a subscriber
            assert acquired.result() == {"success": True, "message": ""}
            found = joined(client.take("ild", 40))
        finally:
            finished.set()
    assert np.allclose(found[:, 5:], -20 * np.log10(2), atol=0.01), ros2.errors


def test_sound_card_through_libasound(ros2: Network, tmp_path: Path) -> None:
    """A PCM of the machine's configuration; the command finds the working pyalsaaudio, as the nodes of ROS 1 do."""
    if not any(PYPI_DIR.glob("alsaaudio*")):
        pytest.skip("pyalsaaudio is not here: scripts/install brings it")
    noise = np.random.default_rng(1).integers(-(2**28), 2**28, RATE).astype("<i4")
    np.stack((2 * noise, noise), axis=1).tofile(tmp_path / "samples.raw")
    (tmp_path / "asound.conf").write_text(
        "</usr/share/alsa/alsa.conf>\n"
        f'pcm.recorded {{ type file slave.pcm "null" file /dev/null infile "{tmp_path}/samples.raw" format raw }}\n'
    )
    ros2.node("representations:=[ild]", "frames_per_block:=160", ALSA_CONFIG_PATH=str(tmp_path / "asound.conf"))
    client = Client(ros2, tmp_path)
    client.subscribe("ild")
    answer = client.call("acquire", device="nosuch", sample_rate=RATE)
    assert not answer["success"] and "Unknown PCM nosuch" in answer["message"]
    assert client.call("acquire", device="recorded", sample_rate=RATE) == {"success": True, "message": ""}
    found = np.array(client.take("ild")[0]["data"])
    assert np.allclose(found, -20 * np.log10(2), atol=0.01), found
