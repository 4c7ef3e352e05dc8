"""The server of the component `arm`; its name is the first argument."""

from __future__ import annotations

import sys
import threading
from typing import Any

import actionlib
import arm.msg
import arm.srv
import rospy


class Arm:
    """Functions, an activity and ports as a server that genom3 has generated offers them."""

    def __init__(self, name: str) -> None:
        self.speed = arm.msg.arm_speed(arm.msg.arm_speed.SLOW)
        for service in ("connect_port", "kill", "SetSpeed", "GetSpeed", "SetPose"):
            rospy.Service(f"/{name}/{service}", getattr(arm.srv, service), getattr(self, service))
        self.state = rospy.Publisher(f"/{name}/State", arm.msg.arm_state, queue_size=1, latch=True)
        self.genom_state = rospy.Publisher(
            f"/{name}/genom_state", arm.msg.genom_state_component, queue_size=1, latch=True
        )
        self.joint = rospy.Publisher(f"/{name}/Joint/left", arm.msg.arm_point, queue_size=1, latch=True)
        self.server = actionlib.ActionServer(f"/{name}/Move", arm.msg.MoveAction, self.move, self.cancel, False)
        self.server.start()
        self.genom_state.publish(arm.msg.genom_state_component(version="1.2"))
        self.joint.publish(arm.msg.arm_point(0.5, -0.5))
        self.publish(arm.msg.arm_pose(frame="base"))

    def publish(self, pose: Any, path: Any = ()) -> None:
        stamp = rospy.Time(7, 8)
        self.state.publish(arm.msg.arm_state(pose, self.speed, list(path), b"\x01\xff", stamp))

    def connect_port(self, request: Any) -> Any:
        return arm.srv.connect_portResponse(False, '{"ex":"::genom::no_such_inport"}')

    def kill(self, request: Any) -> Any:
        threading.Timer(0.1, rospy.signal_shutdown, ["kill"]).start()
        return arm.srv.killResponse(True, "")

    def SetSpeed(self, request: Any) -> Any:
        self.speed = request.speed
        return arm.srv.SetSpeedResponse(True, "")

    def GetSpeed(self, request: Any) -> Any:
        return arm.srv.GetSpeedResponse(True, "", self.speed)

    def SetPose(self, request: Any) -> Any:
        if request.tries < 1:
            return arm.srv.SetPoseResponse(False, '{"ex":"::arm::e_tries","detail":{"least":1}}', request.pose, 0)
        self.publish(request.pose, request.path)
        return arm.srv.SetPoseResponse(True, "", request.pose, len(request.path))

    def move(self, goal: Any) -> None:
        distance = goal.get_goal().distance
        if distance < 0:
            goal.set_accepted()
            goal.set_succeeded(arm.msg.MoveResult(False, '{"ex":"::arm::e_distance"}', 0.0))
            return
        goal.set_accepted()
        if distance < 100:
            goal.set_succeeded(arm.msg.MoveResult(True, "", distance))

    def cancel(self, goal: Any) -> None:
        goal.set_succeeded(arm.msg.MoveResult(False, '{"ex":"::genom::interrupted","detail":{"by":"client"}}', 0.0))


if __name__ == "__main__":
    rospy.init_node(sys.argv[1])
    Arm(sys.argv[1])
    rospy.spin()
