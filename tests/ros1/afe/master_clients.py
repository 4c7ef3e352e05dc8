"""Client processes of a node whose master is lost and returns; they print their results. Run by test_master.py."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rospy

from rosafe.ros1.component import generate
from tests.harness import run_together, wait_for

generate.ensure_messages()

import rosAFE.msg  # noqa: E402
import rosAFE.srv  # noqa: E402

import bass.srv  # noqa: E402
from tests.ros1.afe.session import Microphone, noise  # noqa: E402

BLOCK = 2000
REQUESTS = ("connect_port", "InputProc", "PreProc", "GammatoneProc", "getParameters", "removeProcessor", "Stop")


class MinimalGraph:
    """The part of a graph that Microphone needs."""

    def client(self) -> None:
        """Do nothing: this process is a node already."""


def calls(node: str) -> dict[str, Any]:
    """Return proxies with persistent connections, which need no master after the first call."""
    proxies = {}
    for name in REQUESTS:
        proxies[name] = rospy.ServiceProxy(f"{node}/{name}", getattr(rosAFE.srv, name), persistent=True)
        proxies[name].wait_for_service(10)
    return proxies


def names(call: dict[str, Any]) -> list[str]:
    """Return the names of all processors of the kinds that are used here."""
    parameters = call["getParameters"]().parameters
    return [p.name for p in (*parameters.input, *parameters.preProc, *parameters.gammatone)]


def stay(node: str, master_is_lost: Path) -> None:
    """Build a tree, wait until the file reports that the master is lost, and continue with the open connections."""
    microphone = Microphone(MinimalGraph())  # type: ignore[arg-type]
    acquire = rospy.ServiceProxy("/bass/Acquire", bass.srv.Acquire)
    assert acquire(device="scene:", sampleRate=microphone.sample_rate, nFramesPerChunk=1000).genom_success
    rospy.set_param("/bass/socket_port", 0)
    dedicated_socket = rospy.ServiceProxy("/bass/DedicatedSocket", bass.srv.DedicatedSocket, persistent=True)
    assert dedicated_socket().genom_success
    call = calls(node)
    assert call["connect_port"](local="Audio", remote=microphone.topic).genom_success
    assert call["InputProc"](nFramesPerBlock=BLOCK).genom_success
    assert call["PreProc"]().genom_success
    assert call["GammatoneProc"](fb_nChannels=2, name="first").genom_success
    assert call["removeProcessor"](name="first").genom_success
    assert names(call) == ["input", "preProc"]
    assert call["Stop"]().genom_success  # all connections have been used
    assert call["InputProc"](nFramesPerBlock=BLOCK).genom_success
    assert call["PreProc"]().genom_success
    assert call["PreProc"](name="other").genom_success
    messages: list[Any] = []
    states: list[Any] = []
    rospy.Subscriber(
        f"{node}/preProcPort/preProc", rosAFE.msg.rosAFE_TimeDomainSignalPortStruct, messages.append, buff_size=2**22
    )
    rospy.Subscriber(f"{node}/genom_state", rosAFE.msg.genom_state_component, states.append)
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages and messages[-1].lastFrameIndex == BLOCK + 1 and states)
    print("ready", flush=True)

    wait_for(master_is_lost.exists)
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages[-1].lastFrameIndex == 2 * BLOCK + 1)
    requests: list[Callable[[], Any]] = [
        lambda: call["GammatoneProc"](fb_nChannels=2, name="late"),
        lambda: call["connect_port"](local="Audio", remote="bass/Audio"),
        lambda: dedicated_socket(),  # its parameters are stored by the master
    ]
    added, *refused = run_together(len(requests), lambda number: requests[number]())
    seen: dict[str, Any] = {"GammatoneProc": added.genom_success}
    seen["connect_port"], seen["DedicatedSocket"] = (json.loads(answer.genom_exdetail)["ex"] for answer in refused)
    seen["processors"] = names(call)
    count = len(states)
    wait_for(lambda: len(states) >= count + 2, what="genom_state")
    seen["removed"] = call["removeProcessor"](name="other").genom_success
    seen["left"] = names(call)
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages[-1].lastFrameIndex == 3 * BLOCK + 1)
    print(json.dumps(seen), flush=True)


def come(node: str) -> None:
    """Use everything again, through the new master."""
    call = calls(node)
    seen: dict[str, Any] = {"processors": names(call)}
    assert call["connect_port"](local="Audio", remote="bass/Audio").genom_success
    messages: list[Any] = []
    rospy.Subscriber(
        f"{node}/gammatonePort/late", rosAFE.msg.rosAFE_TimeFrequencySignalPortStruct, messages.append, buff_size=2**22
    )
    wait_for(lambda: len(messages) > 3 and messages[-1].lastFrameIndex > 4 * BLOCK, what="audio from bass")
    seen["topics"] = sorted(name for name, _ in rospy.get_published_topics(node) if "Port/" in name)
    seen["removed"] = call["removeProcessor"](name="preProc").genom_success
    seen["left"] = sorted(name for name, _ in rospy.get_published_topics(node) if "Port/" in name)
    print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    rospy.init_node(f"client_{sys.argv[1]}", disable_signals=True)
    if sys.argv[1] == "stay":
        stay(sys.argv[2], Path(sys.argv[3]))
    else:
        come(sys.argv[2])
