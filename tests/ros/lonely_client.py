"""A client process of a node whose master dies; prints what it saw, as JSON. Run by test_faults.py."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import rospy

from rosafe.ros import generate
from tests.harness import wait_for

generate.ensure_messages()

import rosAFE.msg  # noqa: E402
import rosAFE.srv  # noqa: E402

from tests.ros.session import Microphone, noise  # noqa: E402

BLOCK = 2000


class LonelyGraph:
    """What Microphone needs of a graph."""

    def client(self) -> None:
        """This process is a node already."""


def main(node: str, master_is_dead: Path) -> None:
    """Build a tree, wait until the file says that the master is dead, and go on with what is connected."""
    rospy.init_node("lonely_client", disable_signals=True)
    microphone = Microphone(LonelyGraph())  # type: ignore[arg-type]
    calls: dict[str, Any] = {}
    for name in ("connect_port", "InputProc", "PreProc", "GammatoneProc", "getParameters", "removeProcessor", "Stop"):
        calls[name] = rospy.ServiceProxy(f"{node}/{name}", getattr(rosAFE.srv, name), persistent=True)
        calls[name].wait_for_service(10)
    assert calls["connect_port"](local="Audio", remote=microphone.topic).genom_success
    assert calls["InputProc"](nFramesPerBlock=BLOCK).genom_success
    assert calls["PreProc"]().genom_success
    assert calls["GammatoneProc"](fb_nChannels=2, name="first").genom_success
    assert calls["removeProcessor"](name="first").genom_success  # every connection has been used
    assert calls["getParameters"]().genom_success
    assert calls["Stop"]().genom_success
    assert calls["InputProc"](nFramesPerBlock=BLOCK).genom_success
    assert calls["PreProc"]().genom_success
    messages: list[Any] = []
    states: list[Any] = []
    rospy.Subscriber(
        f"{node}/preProcPort/preProc", rosAFE.msg.rosAFE_TimeDomainSignalPortStruct, messages.append, buff_size=2**22
    )
    rospy.Subscriber(f"{node}/genom_state", rosAFE.msg.genom_state_component, states.append)
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages and messages[-1].lastFrameIndex == BLOCK + 1 and states)
    print("ready", flush=True)

    wait_for(master_is_dead.exists, 30)
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages[-1].lastFrameIndex == 2 * BLOCK + 1)
    seen: dict[str, Any] = {"flows": True}
    refused = calls["GammatoneProc"](fb_nChannels=2)
    seen["GammatoneProc"] = json.loads(refused.genom_exdetail)["ex"]
    refused = calls["connect_port"](local="Audio", remote="bass/Audio")
    seen["connect_port"] = json.loads(refused.genom_exdetail)["ex"]
    parameters = calls["getParameters"]().parameters
    seen["processors"] = [len(parameters.input), len(parameters.preProc), len(parameters.gammatone)]
    told = len(states)
    wait_for(lambda: len(states) >= told + 3, what="genom_state")
    seen["states"] = True
    microphone.play(noise(BLOCK))
    wait_for(lambda: messages[-1].lastFrameIndex == 3 * BLOCK + 1)
    seen["removed"] = calls["removeProcessor"](name="preProc").genom_success
    parameters = calls["getParameters"]().parameters
    seen["left"] = [len(parameters.input), len(parameters.preProc)]
    print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
