"""docs/hosts.md: two instances on one machine with the documented commands; two machines as network namespaces."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT, SCRIPTS, Graph, MasterProcess, wait_for
from tests.networks import networks

# Builds a tree on /far and prints the first lastFrameIndex that is not 0.
CLIENT = """
import queue, rospy, rosAFE.srv, bass.srv
from rosAFE.msg import rosAFE_TimeDomainSignalPortStruct as Message
rospy.init_node("client")
def call(package, name, **fields):
    answer = rospy.ServiceProxy(name, getattr(package.srv, name.split("/")[-1]))(**fields)
    assert answer.genom_success, (name, answer)
call(bass, "/bass/Acquire", device="scene:", nChunksOnPort=4)
call(rosAFE, "/far/connect_port", local="Audio", remote="/bass/Audio")
call(rosAFE, "/far/InputProc", nFramesPerBlock=2205)
call(rosAFE, "/far/PreProc")
received = queue.Queue()
rospy.Subscriber("/far/preProcPort/preProc", Message, received.put)
while not (index := received.get(timeout=60).lastFrameIndex):
    pass
print("received", index)
"""


@pytest.mark.exploration
def test_two_instances_as_in_the_document(graph: Graph) -> None:
    text = (ROOT / "docs" / "hosts.md").read_text("utf-8")
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    script = f"set -e\n{block}".replace("roscore & ", "")  # there is a master, at another than the default address
    with graph.start("bash", "-c", f"{script}\nwait", cwd=ROOT) as shell:
        try:
            wait_for(lambda: "/right/preProcPort/preProc" in shell.out or not shell.alive, what=lambda: str(shell))
            assert {"/left/preProcPort/preProc", "/right/preProcPort/preProc"} == set(shell.out.split()[-2:])
            assert shell.out.count("genom_success: True") == 7
        finally:
            for name in ("left", "right", "bass"):  # background processes have sessions of their own
                assert graph.call(f"/{name}/kill").genom_success
        assert shell.wait() == 0
    wait_for(lambda: not {"/left", "/right", "/bass"} & graph.nodes())


@dataclass
class Net:
    """A second host: a network namespace, with an address on each side."""

    name: str
    near: str
    far: str


@pytest.fixture
def net() -> Iterator[Net]:
    """Create two connected hosts; skip the test without permission."""
    if shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("network namespaces need root and the command ip")
    number = os.getpid() % 250
    net = Net(f"rosafe{os.getpid()}", f"10.213.{number}.1", f"10.213.{number}.2")
    inside = f"netns exec {net.name} ip"
    commands = [
        f"netns add {net.name}",
        f"link add vn{number} type veth peer name vf{number} netns {net.name}",
        f"addr add {net.near}/24 dev vn{number}",
        f"link set vn{number} up",
        f"{inside} addr add {net.far}/24 dev vf{number}",
        f"{inside} link set vf{number} up",
        f"{inside} link set lo up",
    ]
    with networks(commands, net.name):
        yield net


@pytest.mark.ros
def test_two_machines(net: Net, tmp_path: Path) -> None:
    """Master, bass and a client run on one host and rosAFE on the other; the client receives its results."""
    master = MasterProcess()
    graph = Graph(f"http://{net.near}:{master.port}", tmp_path)
    graph.env["ROS_IP"] = net.near
    try:
        master.start(graph.env)
        far = ["ip", "netns", "exec", net.name, str(SCRIPTS / "rosAFE-ros"), "-i", "far"]
        with graph.node("bass-ros"), graph.start(*far, ROS_IP=net.far) as process:
            graph.wait_until_up(process, "rosAFE", "far")
            received = graph.run(PYTHON, "-c", CLIENT).stdout.split()
            assert received[0] == "received" and (int(received[1]) - 1) % 2205 == 0
            assert process.stop(signal.SIGTERM) == 0
    finally:
        master.kill()
