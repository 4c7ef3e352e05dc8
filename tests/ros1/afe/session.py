"""Shared code of the node's tests: a microphone, requests, goals, ports and their expected content."""

from __future__ import annotations

import itertools
import json
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import actionlib
import numpy as np
import rosAFE.msg
import rosgraph
import rospy
from actionlib import CommState

from rosafe import process
from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE
from rosafe.ros1.component import serialization
from tests.harness import PATIENCE, PYTHON, Graph, Process, wait_for

RATE = 20000  # Hz; low, but twice the frequency of all default channels
_topics = itertools.count(1)


def noise(frames: int, seed: int = 1) -> np.ndarray:
    """Return a binaural int32 signal, (2, frames)."""
    return np.random.default_rng(seed).integers(-(2**30), 2**30, (2, frames)).astype(np.int32)


class Microphone:
    """Publishes like bass: a window that moves over a signal, chunk by chunk, and starts with zeros."""

    def __init__(
        self, graph: Graph, sample_rate: int = RATE, chunk: int = 400, chunks: int = 10, topic: str = ""
    ) -> None:
        graph.client()
        self.topic = topic or f"/microphone{next(_topics)}/Audio"
        self.sample_rate, self.chunk, self.chunks = sample_rate, chunk, chunks
        self.index = 0  # index of the newest frame
        self._message = serialization.message_class("bass", "::binaudio::portStruct")
        self.window = np.zeros((2, chunk * chunks), np.int32)
        self._publisher = rospy.Publisher(self.topic, self._message, latch=True, queue_size=0, tcp_nodelay=True)
        self.publish()

    def publish(self) -> None:
        """Send the current window."""
        self._publisher.publish(
            self._message(
                sampleRate=self.sample_rate,
                nChunksOnPort=self.chunks,
                nFramesPerChunk=self.chunk,
                lastFrameIndex=self.index,
                left=self.window[0].copy(),
                right=self.window[1].copy(),
                stamp=self.stamp(),
            )
        )

    def stamp(self) -> dict[str, int]:
        """Return the time of the window; 0, as from a bass without stamps."""
        return {"sec": 0, "nsec": 0}

    def publish_bytes(self, data: bytes) -> None:
        """Send any bytes in place of a message."""
        message = self._message()
        message.serialize = lambda out: out.write(data)
        self._publisher.publish(message)

    def play(self, signal: np.ndarray) -> None:
        """Append `signal`, (2, n), in chunks; the last one can be shorter."""
        for start in range(0, signal.shape[1], self.chunk):
            self.lose(signal[:, start : start + self.chunk])
            self.publish()

    def lose(self, signal: np.ndarray) -> None:
        """Append `signal` without a message; the next message contains the part that is still in the window."""
        joined = np.concatenate((self.window, signal), axis=1)
        self.window = joined[:, -self.window.shape[1] :]
        self.index += signal.shape[1]

    @property
    def subscribed(self) -> bool:
        """Return whether there is a subscriber."""
        return self._publisher.get_num_connections() > 0

    def close(self) -> None:
        """Close the topic."""
        self._publisher.unregister()


class Session:
    """A node under test, with a microphone; most tests get it from the fixture `afe`."""

    def __init__(self, graph: Graph, process: Process, name: str = "rosAFE") -> None:
        self.graph = graph
        self.process = process
        self.name = name
        self._clients: dict[str, actionlib.ActionClient] = {}
        self.microphone: Microphone | None = None

    # --- requests ---

    def call(self, service: str, **fields: Any) -> Any:
        """Return the response of a plain service."""
        return self.graph.call(f"/{self.name}/{service}", **fields)

    def ok(self, service: str, **fields: Any) -> Any:
        """Return the response of a request that succeeds."""
        response = self.call(service, **fields)
        assert response.genom_success, response.genom_exdetail
        assert response.genom_exdetail == ""
        return response

    def refused(self, service: str, **fields: Any) -> tuple[str, Mapping[str, Any]]:
        """Return exception and detail of a request that fails."""
        response = self.call(service, **fields)
        assert not response.genom_success
        return error_of(response)

    # --- audio and processors ---

    def listen(self, **options: Any) -> Microphone:
        """Connect a new microphone to the Audio port."""
        if self.microphone is not None:
            self.microphone.close()
        self.microphone = Microphone(self.graph, **options)
        self.ok("connect_port", local="Audio", remote=self.microphone.topic)
        return self.microphone

    def build(self, *requests: str, block: int = 1600, **values: Any) -> Microphone:
        """Create a microphone, an input, and the processors of `requests` with those of the `values` that they have."""
        microphone = self.microphone if self.microphone is not None else self.listen()
        for request in ("InputProc", *requests):
            names = {p.name for p in ROSAFE.service(request).parameters}
            fields = {"nFramesPerBlock": block, **values}
            self.ok(request, **{k: v for k, v in fields.items() if k in names})
        return microphone

    def processors(self) -> dict[str, list[str]]:
        """Return the names of all processors by kind, from getParameters."""
        parameters = self.ok("getParameters").parameters
        return {
            kind: [p.name for p in getattr(parameters, kind)]
            for kind in CORE_REPRESENTATIONS
            if getattr(parameters, kind)
        }

    # --- ports ---

    def topic(self, kind: str, name: str = "") -> str:
        """Return the topic of a processor; the default of `name` is that of the request."""
        port = ROSAFE.port(CORE_REPRESENTATIONS[kind].port)
        element = name or ROSAFE.service(CORE_REPRESENTATIONS[kind].request).parameter("name").default
        return f"/{self.name}/{port.name}" + (f"/{element}" if port.multiple else "")

    def read(self, kind: str, index: int | None = None, name: str = "", timeout: float = PATIENCE) -> Any:
        """Return the newest message of a port, with arrays, or the one with lastFrameIndex `index`."""
        return self.graph.message(
            self.topic(kind, name),
            serialization.message_class("rosAFE", ROSAFE.port(CORE_REPRESENTATIONS[kind].port).idl),
            accept=lambda message: index is None or message.lastFrameIndex == index,
            timeout=timeout,
        )

    @contextmanager
    def follow(self, kind: str, name: str = "") -> Iterator[list[Any]]:
        """Collect all messages of a port, starting with the latched one."""
        message_class = serialization.message_class("rosAFE", ROSAFE.port(CORE_REPRESENTATIONS[kind].port).idl)
        with self.graph.collect(self.topic(kind, name), message_class) as messages:
            wait_for(lambda: messages, what=f"a message on {self.topic(kind, name)}")
            yield messages

    def connections(self, topic: str) -> int:
        """Return the node's number of subscribers of a topic."""
        address = rosgraph.Master("/test", master_uri=self.graph.uri).lookupNode(f"/{self.name}")
        answer: Any = xmlrpc.client.ServerProxy(address).getBusInfo("/test")
        return sum(entry[4] == topic for entry in answer[2])

    # --- state ---

    def activities(self) -> dict[int, str]:
        """Return id and name of all live activities, from a new genom_state."""
        state = self.graph.message(f"/{self.name}/genom_state", rosAFE.msg.genom_state_component)
        return {activity.id: activity.name for task in state.task for activity in task.activity}

    def wait_activities(self, names: list[str]) -> dict[int, str]:
        """Wait until the names of the live activities are `names`. Return the activities."""
        with self.graph.collect(f"/{self.name}/genom_state", rosAFE.msg.genom_state_component) as messages:

            def live() -> dict[int, str]:
                return {a.id: a.name for task in messages[-1].task for a in task.activity} if messages else {-1: "none"}

            wait_for(lambda: sorted(live().values()) == sorted(names), what=lambda: f"{names}, there are {live()}")
            return live()

    def health(self, accept: Callable[[dict[str, str]], bool], part: str = "audio") -> dict[str, str]:
        """Return the entries of /diagnostics, with level and message, as soon as `accept` is true for them."""
        return diagnosed(self.graph, f"{self.name}: {part}", accept)

    # --- goals ---

    def goal(self, service: str, **fields: Any) -> Goal:
        """Send a goal to the action `name`."""
        client = self._clients.get(service)
        if client is None:
            action = getattr(rosAFE.msg, f"{service}Action")
            client = self._clients[service] = actionlib.ActionClient(f"/{self.name}/{service}", action)
            assert client.wait_for_server(rospy.Duration(PATIENCE))
        return Goal(client, getattr(rosAFE.msg, f"{service}Goal")(**fields))

    def close(self) -> None:
        """End all subscriptions."""
        for client in self._clients.values():
            client.stop()
        if self.microphone is not None:
            self.microphone.close()


@contextmanager
def own_node(graph: Graph, *arguments: str, name: str = "own") -> Iterator[Session]:
    """Start a node for one test, if the shared node of the module must not be affected."""
    with graph.node("rosAFE-ros", "-i", name, *arguments) as process:
        session = Session(graph, process, name)
        yield session
        session.close()


class Goal:
    """A goal with its transitions as seen by the client."""

    def __init__(self, client: actionlib.ActionClient, goal: Any) -> None:
        self.states: list[int] = []
        self._active, self._done = threading.Event(), threading.Event()
        self.handle = client.send_goal(goal, transition_cb=self._transition)

    def _transition(self, handle: Any) -> None:
        state = handle.get_comm_state()
        self.states.append(state)
        if state in (CommState.ACTIVE, CommState.PREEMPTING):
            self._active.set()
        if state == CommState.DONE:
            self._done.set()

    def active(self, timeout: float = PATIENCE) -> Goal:
        """Wait until it is accepted."""
        assert self._active.wait(timeout), f"not accepted, but {self.states}"
        return self

    @property
    def running(self) -> bool:
        return self._active.is_set() and not self._done.is_set()

    def result(self, timeout: float = PATIENCE) -> Any:
        """Wait for the result."""
        assert self._done.wait(timeout), f"no result, but {self.states}"
        return self.handle.get_result()

    def status(self) -> int:
        """Return the terminal state (actionlib_msgs/GoalStatus)."""
        return int(self.handle.get_goal_status())


def diagnosed(graph: Graph, name: str, accept: Callable[[dict[str, str]], bool]) -> dict[str, str]:
    """Return the entries of a part in /diagnostics, with level and message, as soon as `accept` is true for them."""
    from diagnostic_msgs.msg import DiagnosticArray

    with graph.collect("/diagnostics", DiagnosticArray) as messages:
        seen: list[dict[str, str]] = []

        def accepted() -> dict[str, str] | None:
            statuses = [s for m in list(messages) for s in m.status if s.name == name]
            seen[:] = [
                {**{v.key: v.value for v in s.values}, "level": str(s.level), "message": s.message} for s in statuses
            ]
            return next((entries for entries in seen if accept(entries)), None)

        result = wait_for(accepted, what=lambda: f"a state of {name}, last: {seen[-1:]}")
    assert result is not None
    return result


def error_of(response: Any) -> tuple[str, Mapping[str, Any]]:
    """Return exception and detail of a failed response or result, from its JSON text."""
    body = json.loads(response.genom_exdetail)
    assert set(body) <= {"ex", "detail", "what"}
    assert body.get("what") or {"what", "by"} & set(body.get("detail", {})), "there is always a reason"
    assert response.genom_exdetail == json.dumps(body, separators=(",", ":"), ensure_ascii=False)
    return body["ex"], body.get("detail", {})


# --- a subscriber in another process ---------------------------------------------------------------------------------

# Prints the index of each message.
SUBSCRIBER = """
import sys, rospy
from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct as Message
rospy.init_node("reader", anonymous=True)
rospy.Subscriber(sys.argv[1], Message, lambda m: print(m.lastFrameIndex, flush=True), buff_size=2**22)
rospy.spin()
"""


def reader(graph: Graph, topic: str) -> Process:
    """Start a process that subscribes to a topic and prints the index of each message; wait for the first one."""
    process = graph.start(PYTHON, "-c", SUBSCRIBER, topic)
    wait_for(lambda: process.out, what=lambda: str(process))
    return process


# --- expected content of ports ---------------------------------------------------------------------------------------


def expected(signal: np.ndarray, block: int, parameters: Mapping[str, Any] | None = None, rate: int = RATE) -> Any:
    """Return the result of `rosafe.process` for `signal` with the same blocks."""
    return process(signal, rate, parameters=parameters, block_frames=block)


def windowed(values: np.ndarray, seconds: float, rate: float) -> np.ndarray:
    """Return the newest `seconds` of (..., frames), with zeros before the beginning."""
    frames = int(np.floor(seconds * rate + 1e-9))
    padded = np.concatenate((np.zeros((*values.shape[:-1], frames)), values), axis=-1)
    return padded[..., padded.shape[-1] - frames :]


def ears(kind: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return `left` and `right` of a message from an output of `rosafe.process`; None for a missing `right`."""
    if kind == "ild":
        return values, np.zeros((0, 0))
    if kind == "crossCorrelation":
        return values.swapaxes(0, 1), None
    return values[0], values[1]


def assert_holds(message: Any, kind: str, values: np.ndarray) -> None:
    """Check that the samples of a message are bit-identical to `values`, an output of `rosafe.process`."""
    left, right = ears(kind, values)
    assert message.framesOnPort == values.shape[-1]
    np.testing.assert_array_equal(message.left, left)
    if right is not None:
        np.testing.assert_array_equal(message.right, right)
