"""The environment of the tests: ROS 2 programs of one test reach each other, and no others."""

from __future__ import annotations

from pathlib import Path

from tests.harness import wait_for

from .network import Network, network

TALK = """
import sys, time
import rclpy
from rosafe_msgs.msg import SoundSource
rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(SoundSource, "source", 1)
while publisher.get_subscription_count() == 0:
    rclpy.spin_once(node, timeout_sec=0.05)
while True:
    publisher.publish(SoundSource(id=int(sys.argv[1]), azimuth=0.1))
    rclpy.spin_once(node, timeout_sec=0.05)
"""
LISTEN = """
import rclpy
from rosafe_msgs.msg import SoundSource
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(SoundSource, "source", lambda found: print(found.id, found.azimuth), 1)
rclpy.spin(node)
"""


def test_two_programs_exchange_messages_and_other_networks_do_not_see_them(
    ros2: Network, ros2_env: dict[str, str], tmp_path: Path
) -> None:
    with network(ros2_env, tmp_path) as other:
        programs = [ros2.python(TALK, "1"), ros2.python(LISTEN), other.python(TALK, "2"), other.python(LISTEN)]
        wait_for(lambda: all(len(programs[n].out.splitlines()) > 2 for n in (1, 3)))
        assert {*programs[1].out.splitlines()[:-1]} == {"1 0.1"}
        assert {*programs[3].out.splitlines()[:-1]} == {"2 0.1"}
        assert "".join(program.err for program in programs) == ""
