"""The node and clients with another implementation of DDS: values, services, domains, attacks, idle subscribers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from tests.harness import PYTHON, ROOT, Process, freeze, wait_for
from tests.localization.conftest import modulated

from .network import Network

RATE = 16000
AZIMUTH = 40.0
SCENE = f"sample_rate: {RATE}\nsources:\n- {{name: left, file: left.wav, loop: true, azimuth: {AZIMUTH}}}\n"
# With the same numpy as the node: others may round sines differently
PROCESS = """
import sys, numpy, rosafe, soundfile
sound, rate = soundfile.read(sys.argv[1], dtype="int32")  # as devices have it
found = rosafe.process(sound.T, rate, parameters={"fb_nChannels": 16}, outputs=["ild"])
numpy.savez(sys.argv[2], **{name: found[name] for name in ("ild", "fb_cfHz", "ild_frameRate")})
"""
GARBAGE = """
import random, socket, sys, time
random.seed(1)
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
end = time.monotonic() + 3
sent = 0
while time.monotonic() < end:
    header = b"RTPS\\x02\\x03\\x01\\x0f"
    head = random.choice([b"", b"RTPS", header, header + bytes(12) + b"\\x15\\x01\\xff\\xff"])
    for port in (7400, *range(7410, 7418)):
        for address in ("127.0.0.1", "239.255.0.1"):
            sender.sendto(head + random.randbytes(random.randrange(1400)), (address, port))
            sent += 1
print(sent, flush=True)
"""


def scene(folder: Path) -> Path:
    """Write a scene with one source, whose level changes as in speech."""
    soundfile.write(folder / "left.wav", modulated(10.0, 1), RATE)
    (folder / "scene.yaml").write_text(SCENE)
    return folder / "scene.yaml"


def dds(ros2: Network, *arguments: str) -> Process:
    """Start the client without the variables of ROS 2."""
    return ros2.start(PYTHON, "-u", Path(__file__).with_name("dds.py"), *arguments)


def lines(process: Process) -> list[Any]:
    """Return the messages that a client has printed."""
    return [json.loads(line) for line in process.out.splitlines(keepends=True) if line[0] == "{" and line[-1] == "\n"]


def call(ros2: Network, service: str, kind: str, **fields: str | int) -> dict[str, Any]:
    """Call a service of the node."""
    client = dds(ros2, "call", f"/rosafe/{service}", kind, json.dumps(fields))
    assert (client.wait(), client.err) == (0, "")
    (answer,) = lines(client)
    return dict(answer)


def ready(client: Process) -> Process:
    """Wait until a client listens."""
    wait_for(lambda: client.out or not client.alive, what=lambda: f"{client}: {client.err}")
    return client


def ild_of(ros2: Network, domain: int = 0) -> Process:
    """Start a node that computes the ILD of a scene with few channels."""
    return ros2.node(
        "device:=scene:", "representations:=[ild]", f"frames_per_block:={RATE // 100}", ROS_DOMAIN_ID=str(domain)
    )


def test_values_and_services(ros2: Network, tmp_path: Path) -> None:
    sound = np.random.default_rng(1).normal(0, 0.1, (3 * RATE, 2))
    soundfile.write(tmp_path / "noise.wav", sound, RATE, subtype="PCM_16")
    ros2.node("representations:=[ild]", "gammatone.fb_nChannels:=16")
    bad = call(ros2, "request", "RequestRepresentation", representation="ild", name="", parameters="fb_nChannels: -1")
    assert bad["success"] is False and "fb_nChannels" in bad["message"] and "-1" in bad["message"]
    client = ready(dds(ros2, "listen", "/rosafe/ild", "Representation"))
    found = call(ros2, "acquire", "Acquire", device=f"file:{tmp_path}/noise.wav", sample_rate=0)
    assert found == {"success": True, "message": ""}
    tree = call(ros2, "get_tree", "GetTree", structure_needs_at_least_one_member=0)["processors"]
    assert [one["name"] for one in tree] == ["input", "preProc", "gammatone", "ihc", "ild"]
    assert "fb_nChannels: 16" in tree[2]["parameters"] and tree[4]["topics"] == ["/rosafe/ild"]
    path = f"{ros2.env['PYTHONPATH']}:{ROOT}"
    process = ros2.start(PYTHON, "-c", PROCESS, tmp_path / "noise.wav", tmp_path / "ild.npz", PYTHONPATH=path)
    assert (process.wait(), process.err) == (0, "")
    expected = np.load(tmp_path / "ild.npz")
    ild = expected["ild"]

    def end(message: dict[str, Any]) -> int:
        return int(message["first_frame"] + message["shape"][-1])

    wait_for(lambda: lines(client) and end(lines(client)[-1]) >= ild.shape[1], what=lambda: client.out[-300:])
    messages = lines(client)
    for one in messages:
        first, last = one["first_frame"], min(end(one), ild.shape[1])
        data = np.reshape(one["data"], one["shape"])
        assert np.array_equal(data[:, : last - first], ild[:, first:last])
        assert one["lost_frames"] == 0 and one["frame_rate"] == expected["ild_frameRate"]
    assert [end(one) for one in messages[:-1]] == [one["first_frame"] for one in messages[1:]]
    assert messages[0]["axes"] == ["channel", "time"]
    assert messages[0]["coordinates"][0]["values"] == list(expected["fb_cfHz"])


def test_domains(ros2: Network) -> None:
    ild_of(ros2, domain=5)
    same, other = (ready(dds(ros2, "listen", "/rosafe/ild", "Representation", domain)) for domain in "50")
    wait_for(lambda: len(lines(same)) > 20)
    assert not lines(other)


def test_subscribers_that_read_nothing_or_are_frozen_and_garbage_disturb_no_other(ros2: Network) -> None:
    """The garbage goes to the ports of DDS."""
    node = ild_of(ros2)
    client = ready(dds(ros2, "listen", "/rosafe/ild", "Representation"))
    ready(dds(ros2, "idle", "/rosafe/ild", "Representation"))
    frozen = ready(dds(ros2, "idle", "/rosafe/ild", "Representation"))
    freeze(frozen.pid)
    before = len(lines(client))
    wait_for(lambda: len(lines(client)) > before + 500)
    messages = lines(client)[before:]
    ends = [one["first_frame"] + one["shape"][-1] for one in messages]
    assert ends[:-1] == [one["first_frame"] for one in messages[1:]]
    assert not any(one["lost_frames"] for one in messages)
    warnings = [line for line in node.err.splitlines() if "WARN" in line]
    assert node.alive and all("does not keep up" in line or "has caught up" in line for line in warnings), warnings
    attack = ros2.python(GARBAGE)
    assert (attack.wait(), attack.err) == (0, "") and int(attack.out) > 1000
    before = len(lines(client))
    wait_for(lambda: len(lines(client)) > before + 50)
    assert node.alive and "Traceback" not in node.err
    assert call(ros2, "get_tree", "GetTree", structure_needs_at_least_one_member=0)["processors"]
