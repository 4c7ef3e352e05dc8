"""The bass node: requests, the port Audio, the truth of a scene, diagnostics."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.audio.devices import SoundSource, device_lines, open_source
from rosafe.audio.devices.alsa import AlsaSource, DeviceBusyError
from rosafe.audio.devices.base import wall_time_ns
from rosafe.audio.stream.capture import Capture, Snapshot, check_window
from rosafe.audio.stream.truth import TruthLoop, TruthSource
from rosafe.interface import BASS, ComponentError
from rosafe.ros1.bass.socket_server import DEFAULT_HOST, DEFAULT_PORT, DedicatedSocket
from rosafe.ros1.bass.topic_source import TopicSource
from rosafe.ros1.component import serialization
from rosafe.ros1.component.activities import Activity
from rosafe.ros1.component.component import ComponentNode
from rosafe.ros1.component.startup import run_server
from rosafe.ros1.transport import master
from rosafe.ros1.transport.publisher import Publisher
from rosafe.system.log_throttle import ThrottledLog
from rosafe.system.terminal import printable

if TYPE_CHECKING:
    from rosafe.localization.scene import Truth  # imports scipy, which the options of bass-ros need not wait for

FRAMES: tuple[str, ...] = ("world", "head")  # default names of coordinate frames
MASTER_SECONDS = 1.0  # that Acquire waits for a master that does not answer


def _coordinate_frames() -> tuple[str, ...]:
    """Return the names of the world's and the head's coordinate frames; without a master, the defaults."""
    try:
        # tf2 has no leading slash
        return tuple(str(rospy.get_param(f"~{name}_frame", name)).strip("/") or name for name in FRAMES)
    except master.FAILURES:
        return FRAMES


class BassNode:
    """The component `bass`. Create it after `rospy.init_node`.

    ROS parameters, read at each DedicatedSocket: ``socket_host`` (default 127.0.0.1; empty for all interfaces) and
    ``socket_port`` (default 8081) in the node's namespace.
    """

    def __init__(self, instance: str) -> None:
        self._node = ComponentNode(BASS, lambda problem: BASS.error("e_hwparams", str(problem)))
        self.finished = self._node.finished
        self._message_class = serialization.message_class("bass", BASS.port("Audio").idl)
        self._audio = self._node.advertise("Audio", self._message_class)
        self._truth_class = importlib.import_module("bass.msg").SceneTruth
        self._truth = Publisher(f"{self._node.name}/sceneTruth", self._truth_class)
        self._snapshot: Snapshot | None = None
        self._source: SoundSource | None = None  # of the running acquisition
        self._acquired: dict[str, Any] = {}  # parameters of the running acquisition
        self._last_end = self._last_loss = "none"
        self._log_loss = ThrottledLog(rospy.logwarn)
        self._log_clients = ThrottledLog(rospy.logwarn)
        self._printing = threading.Lock()

        self._node.activity("Acquire", self._acquire)
        self._node.activity("DedicatedSocket", self._dedicated_socket)
        self._node.activity("CloseSocket", lambda activity, _: activity.interrupt_others())
        self._node.function("ListDevices", self._list_devices)
        self._node.function("Stop", lambda _: None)  # the interface table lists the activities that it interrupts
        self._node.function("getAcquisition", self._get_acquisition)
        self._node.diagnostics.add("capture", self._health)
        importlib.import_module("rosafe.audio.devices.scene")  # importing scipy takes long and must not delay a request
        self._node.start()

    def shutdown(self, by: str) -> None:
        """Stop the acquisition and the socket."""
        self._node.shutdown(by)

    # --- Acquire ---

    def _acquire(self, activity: Activity, values: dict[str, Any]) -> None:
        device, frames_per_chunk, chunks = values["device"], values["nFramesPerChunk"], values["nChunksOnPort"]
        check_window(frames_per_chunk, chunks)
        # All steps that can fail precede the end of the running acquisition, so that an error does not stop it.
        source = self._open(activity, device, values["sampleRate"], frames_per_chunk)
        try:
            truth = self._truth_of(source, activity.stop_requested.is_set)
            capture = Capture(source, frames_per_chunk, chunks, self._publish, self._note_loss)
            activity.interrupt_others()
            activity.raise_if_interrupted()
            self._source, self._acquired = source, values
            capture.publish()
            rospy.loginfo(f"acquiring from {device} at {source.sample_rate} Hz")
            activity.running()
            with truth:
                capture.run(activity.stop_requested, self._node.meters["capture"].cycle)
            self._last_end = f"{device}: {'stopped' if activity.stop_requested.is_set() else 'end of the source'}"
            rospy.loginfo(f"the acquisition has ended: {self._last_end}")
        except ComponentError as problem:
            self._last_end = str(problem)
            if activity.begun.is_set():  # the client has its response already
                rospy.logerr(f"the acquisition has ended: {problem}")
            raise
        finally:
            if self._source is source:
                self._source = None
            source.close()

    def _truth_of(self, source: SoundSource, give_up: Callable[[], bool]) -> contextlib.AbstractContextManager[object]:
        """Return a context in which the true directions of a scene are published; ComponentError for wrong names."""
        if not hasattr(source, "truth"):
            return contextlib.nullcontext()
        frames = master.bounded(_coordinate_frames, FRAMES, give_up, MASTER_SECONDS)
        if frames[0] == frames[1]:
            raise BASS.error("e_hwparams", f"world_frame: expected another frame than head_frame, got {frames[0]!r}")
        return TruthPublisher(cast(TruthSource, source), self._truth, self._truth_class, frames)

    def _open(self, activity: Activity, device: str, sample_rate: int, frames_per_chunk: int) -> SoundSource:
        if device.startswith("topic:"):
            return TopicSource(device[len("topic:") :], sample_rate, frames_per_chunk, activity.stop_requested)
        try:
            return open_source(device, sample_rate, frames_per_chunk, activity.stop_requested)
        except DeviceBusyError:
            if not isinstance(self._source, AlsaSource):
                raise
        # The device is probably in use by this node's acquisition, perhaps under another name.
        activity.interrupt_others()
        return open_source(device, sample_rate, frames_per_chunk, activity.stop_requested)

    def _note_loss(self, text: str) -> None:
        self._last_loss = text
        self._log_loss(text)

    def _publish(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        seconds, nanoseconds = divmod(snapshot.time_ns, 1_000_000_000)
        self._audio.publish(
            self._message_class(
                sampleRate=snapshot.sample_rate,
                nChunksOnPort=snapshot.chunks_on_port,
                nFramesPerChunk=snapshot.frames_per_chunk,
                lastFrameIndex=snapshot.last_frame_index,
                left=snapshot.left,
                right=snapshot.right,
                stamp={"sec": seconds, "nsec": nanoseconds},
            )
        )

    # --- other requests ---

    def _get_acquisition(self, _: dict[str, Any]) -> dict[str, Any]:
        if self._source is None:
            return {"running": False}
        return {"running": True, **self._acquired}

    def _list_devices(self, _: dict[str, Any]) -> None:
        with self._printing:
            for line in device_lines():
                print(printable(line), flush=True)

    def _dedicated_socket(self, activity: Activity, _: dict[str, Any]) -> None:
        activity.interrupt_others()  # a running server uses the address
        try:
            host = rospy.get_param("~socket_host", DEFAULT_HOST)
            port = rospy.get_param("~socket_port", DEFAULT_PORT)
        except master.FAILURES as problem:
            raise ComponentError("::genom::mwerr", what=f"no ROS master: {master.reason(problem)}") from None
        try:
            server = DedicatedSocket(lambda: self._snapshot, str(host), int(port), self._log_clients)
        except (OSError, OverflowError, ValueError, TypeError) as problem:
            code = getattr(problem, "errno", None) or 22
            reason = os.strerror(code) if code > 0 and isinstance(problem, OSError) else problem
            why = f"cannot serve {host}:{port}: {reason}; "
            why += f"set the ROS parameter {rospy.resolve_name('~socket_port')} or socket_host"
            raise ComponentError("::genom::syserr", why, code=code) from None
        activity.running()
        rospy.loginfo("DedicatedSocket: serving {}:{}".format(*server.address))
        server.serve(activity.stop_requested)

    def _health(self, status: Any) -> Any:
        source, snapshot = self._source, self._snapshot
        if source is None:
            status.summary(DiagnosticStatus.OK, "idle")
        elif problem := getattr(source, "problem", ""):
            status.summary(DiagnosticStatus.WARN, f"capturing, but {problem}")
        elif source.overruns:
            status.summary(DiagnosticStatus.WARN, f"capturing, {source.overruns} gaps so far")
        else:
            status.summary(DiagnosticStatus.OK, "capturing")
        status.add("device", source.name if source else "none")
        status.add("frames", snapshot.last_frame_index if snapshot else 0)
        status.add("lost frames", source.lost_frames if source else 0)
        status.add("overruns", source.overruns if source else 0)
        status.add("last loss", self._last_loss)
        status.add("last end", self._last_end)
        return status


# --- the truth of a scene -----------------------------------------------------------------------------------------


class TruthPublisher(TruthLoop):
    """Publishes the truth of one scene; a context.

    Parameters
    ----------
    source : TruthSource
        The scene.
    publisher : Publisher
        Of the topic sceneTruth.
    message_class : type
        `bass.msg.SceneTruth`.
    frames : tuple of two str
        Names of the world's and of the head's coordinate frame in tf.
    """

    def __init__(self, source: TruthSource, publisher: Any, message_class: Any, frames: tuple[str, ...]) -> None:
        super().__init__(source, self._publish_truth)
        self._publisher = publisher
        self._message_class = message_class
        self._transform = _HeadTransform(*frames)

    def __exit__(self, *_: object) -> None:
        """End, and take the transform back."""
        super().__exit__()
        self._transform.close()

    def _publish_truth(self, frame: int, moment: float, truth: Truth) -> None:
        stamp = rospy.Time(*divmod(wall_time_ns(moment), 1_000_000_000))
        yaw = math.radians(truth.head_yaw)
        azimuths = [math.radians(azimuth) for azimuth in truth.azimuths]
        self._publisher.publish(
            self._message_class(stamp=stamp, frameIndex=frame, head_yaw=yaw, names=list(truth.names), azimuths=azimuths)
        )
        self._transform.publish(stamp, yaw)


class _HeadTransform:
    """The transform from world to head on /tf; nothing if the messages of tf2 are not installed."""

    def __init__(self, world: str, head: str) -> None:
        try:
            from geometry_msgs.msg import TransformStamped
            from tf2_msgs.msg import TFMessage
        except ImportError:
            rospy.logwarn("the rotation of the head is not published on /tf: tf2_msgs is missing; run scripts/install")
            self._publisher = None
            return
        self._publisher = Publisher("/tf", TFMessage)
        self._message_class = TFMessage
        self._transform = TransformStamped(child_frame_id=head)
        self._transform.header.frame_id = world

    def publish(self, stamp: rospy.Time, yaw: float) -> None:
        """Publish a rotation about the z axis (rad)."""
        if self._publisher is not None:
            self._transform.header.stamp = stamp
            rotation = self._transform.transform.rotation
            rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
            self._publisher.publish(self._message_class([self._transform]))

    def close(self) -> None:
        """Unregister."""
        if self._publisher is not None:
            self._publisher.unregister()


# --- start --------------------------------------------------------------------------------------------------------


def main(argv: list[str] | None = None) -> int:
    """Run `bass-ros` and return its exit code."""
    return run_server(BASS, BassNode, argv)
