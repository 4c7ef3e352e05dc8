"""The robot of the tests: plain rclpy in a process of its own, and the calls that tests make of it."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import numpy as np

from tests.harness import PYTHON, wait_for

from .network import Network

TYPES = {bool: (1, "bool_value"), int: (2, "integer_value"), float: (3, "double_value"), str: (4, "string_value")}
FIELDS = {**dict(TYPES.values()), 6: "bool_array_value", 7: "integer_array_value", 8: "double_array_value"}
FIELDS |= {9: "string_array_value"}


class Client:
    """The robot, in a network."""

    def __init__(self, ros2: Network, folder: Path, node: str = "/rosafe") -> None:
        path = folder / f"robot{len(list(folder.glob('robot*')))}"
        self.process = ros2.start(PYTHON, "-u", Path(__file__).with_name("robot.py"), path)
        wait_for(lambda: path.exists() or not self.process.alive, what=lambda: repr(self.process))
        self.node = node
        self._network = ros2
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(str(path))
        self._lines = connection.makefile("rw")

    def ask(self, command: str, **arguments: Any) -> Any:
        """Let the robot do something; AssertionError with its error."""
        self._lines.write(json.dumps([command, arguments]) + "\n")
        self._lines.flush()
        answer = json.loads(self._lines.readline() or json.dumps({"error": repr(self.process)}))
        assert not (isinstance(answer, dict) and "error" in answer), answer["error"]
        return answer

    def call(self, service: str, **fields: Any) -> Any:
        """Call a service of the node by its name."""
        kind = {
            "request": "rosafe_msgs/srv/RequestRepresentation",
            "stop": "std_srvs/srv/Trigger",
        }.get(service, f"rosafe_msgs/srv/{service.title().replace('_', '')}")
        return self._call(kind, service, fields)

    def _call(self, kind: str, service: str, fields: dict[str, Any]) -> Any:
        """Call a service, again if Fast DDS drops the answer because it has not found the client within 0.1 s."""
        arguments = {"kind": kind, "name": f"{self.node}/{service}", "fields": fields}
        answer = self.ask("call", **arguments)
        if answer is None and "client will not receive response" in self._network.errors:
            answer = self.ask("call", **arguments)
        assert answer is not None, f"{service}: no answer\n{self._network.errors}"
        return answer

    def subscribe(self, topic: str, kind: str = "rosafe_msgs/msg/Representation", **options: Any) -> None:
        """Subscribe to a topic of the node."""
        topic = topic if topic.startswith("/") else f"{self.node}/{topic}"
        self.ask("subscribe", kind=kind, topic=topic, **options)

    def take(self, topic: str, count: int = 1, seconds: float = 40.0) -> list[Any]:
        """Return at least `count` messages of a topic."""
        topic = topic if topic.startswith("/") else f"{self.node}/{topic}"
        found = self.ask("take", topic=topic, count=count, seconds=seconds)
        assert len(found) >= count, f"{topic}: expected {count} messages, got {len(found)}"
        return list(found)

    def set(self, **parameters: Any) -> list[str]:
        """Set parameters one by one, with `__` for a dot; return the reasons for which they are rejected."""
        values = [
            {"name": name.replace("__", "."), "value": {"type": TYPES[type(value)][0], TYPES[type(value)][1]: value}}
            for name, value in parameters.items()
        ]
        kind = "rcl_interfaces/srv/SetParameters"
        answer = self._call(kind, "set_parameters", {"parameters": values})
        return ["" if one["successful"] else one["reason"] or "?" for one in answer["results"]]

    def get(self, name: str) -> Any:
        """Return a parameter; None if there is none."""
        kind, fields = "rcl_interfaces/srv/GetParameters", {"names": [name]}
        (value,) = self._call(kind, "get_parameters", fields)["values"]
        return value[FIELDS[value["type"]]] if value["type"] else None


def seconds(stamp: dict[str, int]) -> float:
    """Return a time of ROS in s."""
    return stamp["sec"] + 1e-9 * stamp["nanosec"]


def joined(messages: list[Any]) -> np.ndarray:
    """Return the frames of successive messages as one array; AssertionError if one is missing."""
    arrays = [np.array(one["data"], np.float64).reshape(one["shape"]) for one in messages]
    after = [one["first_frame"] + array.shape[-1] for one, array in zip(messages, arrays, strict=True)]
    assert [one["first_frame"] for one in messages[1:]] == after[:-1]
    assert not any(one["lost_frames"] for one in messages)
    return np.concatenate(arrays, axis=-1)
