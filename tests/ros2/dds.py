"""A client with another implementation of DDS and without ROS; its types come from the .msg and .srv files.

usage: dds.py listen TOPIC MESSAGE [DOMAIN]    prints each message as a line of JSON
       dds.py idle TOPIC MESSAGE               subscribes reliably to all messages and never reads any
       dds.py call SERVICE TYPE FIELDS         calls a service with fields as JSON, and prints the response
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import float64, int16, int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

FOLDER = Path(__file__).parents[2] / "ros2" / "rosafe_msgs"
PACKAGE = "rosafe_msgs"
LOOPBACK = '<Discovery><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
SCALARS = {
    "bool": bool,
    "float64": float64,
    "int16": int16,
    "int32": int32,
    "string": str,
    "uint32": uint32,
    "uint64": uint64,
}
OTHERS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
}
RELIABLE = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepAll)


def parse(text: str) -> dict[str, Any]:
    """Return the fields of an interface file with their types."""
    lines = [line.split("#")[0].split() for line in text.splitlines()]
    return {line[1]: of(line[0]) for line in lines if line} or {"structure_needs_at_least_one_member": uint8}


def of(kind: str) -> Any:
    """Return the type of a field."""
    if kind.endswith("[]"):
        return sequence[of(kind[:-2])]
    if kind in SCALARS:
        return SCALARS[kind]
    if kind in OTHERS:
        package, name = kind.split("/")
        return make(f"{package}::msg", name, OTHERS[kind])
    return message(kind)


def make(module: str, name: str, text: str) -> Any:
    """Return the type of a message as ROS 2 names it in DDS."""
    return make_idl_struct(name, f"{module}::dds_::{name}_", parse(text))


def message(name: str) -> Any:
    """Return the type of a message of rosafe_msgs."""
    return make(f"{PACKAGE}::msg", name, (FOLDER / "msg" / f"{name}.msg").read_text("utf-8"))


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition."""
    while not condition():
        time.sleep(0.01)


def listen(topic: str, name: str, domain: str = "0") -> None:
    """Print messages."""
    participant = DomainParticipant(int(domain))
    reader = DataReader(participant, Topic(participant, f"rt{topic}", message(name)), qos=RELIABLE)
    print("ready", flush=True)
    while True:
        for one in reader.take(100):
            print(json.dumps(dataclasses.asdict(one)), flush=True)
        time.sleep(0.01)


def idle(topic: str, name: str) -> None:
    """Read nothing."""
    participant = DomainParticipant(0)
    reader = DataReader(participant, Topic(participant, f"rt{topic}", message(name)), qos=RELIABLE)
    until(reader.get_matched_publications)
    print("matched", flush=True)
    time.sleep(3600)


def call(service: str, kind: str, fields: str) -> None:
    """Call a service."""
    request, response = (FOLDER / "srv" / f"{kind}.srv").read_text("utf-8").split("---\n")
    participant = DomainParticipant(0)
    asking = make(f"{PACKAGE}::srv", f"{kind}_Request", request)
    answering = make(f"{PACKAGE}::srv", f"{kind}_Response", response)
    writer = DataWriter(participant, Topic(participant, f"rq{service}Request", asking), qos=RELIABLE)
    reader = DataReader(participant, Topic(participant, f"rr{service}Reply", answering), qos=RELIABLE)
    until(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications())
    found: list[Any] = []
    while not found:  # the server may not know the reader yet, and then its answer is lost
        writer.write(asking(**json.loads(fields)))
        for _ in range(200):
            found += reader.take(1)
            if found:
                break
            time.sleep(0.01)
    print(json.dumps(dataclasses.asdict(found[0])), flush=True)


if __name__ == "__main__":
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    commands: dict[str, Callable[..., None]] = {"listen": listen, "idle": idle, "call": call}
    commands[sys.argv[1]](*sys.argv[2:])
    assert "rclpy" not in sys.modules
