"""The node of ROS 2: parameters, services, diagnostics, start and end."""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import json
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy._rclpy_pybind11 import RCLError
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosafe_msgs.msg import Processor as ProcessorMessage
from rosafe_msgs.srv import (
    Acquire,
    AddProcessor,
    GetTree,
    LoadSetup,
    RemoveProcessor,
    RequestRepresentation,
    SaveSetup,
)
from std_srvs.srv import Trigger

from rosafe.declarations.text import did_you_mean, join_names
from rosafe.dsp import buffer_pool, kernels
from rosafe.interface import BASS, BLOCK_AND_BUFFERS, ComponentError, format_value
from rosafe.localization.live import ERROR, OK, WARN
from rosafe.localization.rotations import RotationBuffer
from rosafe.localization.settings import checked_settings
from rosafe.localization.status import NodeStatus
from rosafe.representations import PROBLEMS, WARNINGS
from rosafe.ros2.localization import Localization, SourcePublishers
from rosafe.ros2.messages import TruthTopics, clock_offset, diagnostics, subscribe_transforms
from rosafe.ros2.node_tree import NodeTree
from rosafe.ros2.outputs import Outputs, topics_of
from rosafe.ros2.parameters import ProcessorParameters
from rosafe.ros2.sound import SeparatedSound, Sound
from rosafe.ros2.sound_topic import open_device
from rosafe.system import malloc_tuning
from rosafe.system.input import read_regular
from rosafe.system.log_throttle import ThrottledLog
from rosafe.system.terminal import printable
from rosafe.tree.setups import AcquireSettings, Setup, SetupError, dry_run, read, read_parameters, write
from rosafe.tree.setups.state_file import TreeStateFile
from rosafe.tree.tree_planner import kind_of

TOPICS = ("sources", "posterior", "poses", "streams", "scene_truth")
WORLD = "world"  # the coordinate frame of a scene, if none is set
DIAGNOSTICS_SECONDS = 1.0
TRIM_SECONDS = 20.0  # between two times that freed memory is returned to the system
THREADS = 2  # of ROS: one may wait for a device whose sound another one receives
SIGNAL_SECONDS = 0.2  # between two looks whether a signal has come
END_SECONDS = 1.0  # that the threads of ROS may take at the end
PARAMETERS: dict[str, tuple[Any, str]] = {
    "device": ("", "Device to capture from, such as plughw:1,0, file:take.wav, scene: or topic:/audio; empty: none"),
    "sample_rate": (0, "Sample rate in Hz; 0: that of the source with file: and bag:, otherwise 44100"),
    "frames_per_block": (882, "Frames of sound in a block, and in a chunk of the device"),
    "setup": ("", "File of a setup with sound, processors and localizer"),
    "representations": (Parameter.Type.STRING_ARRAY, "Representations to compute from the start, such as ild"),
    "localize": (False, "Whether sources are localized; the default is true with a device and nothing else to compute"),
    "head": ("sphere", "Head: sphere, a SOFA file or a learned model"),
    "world_frame": ("", "Coordinate frame of the azimuths, by tf2; empty: they are relative to the head"),
    "frame_id": ("head", "Coordinate frame of the head: x ahead, y left, z up"),
    "speech_only": (False, "Whether only sources that speak have poses"),
    "keep": ("", "File to which the setup is saved at each change, and from which it is restored"),
}


class RosafeNode:
    """The node `rosafe`. `begin` starts it, `close` ends it.

    Attributes
    ----------
    node : rclpy.node.Node
    sound : Sound
    tree : NodeTree

    Raises
    ------
    ValueError
        A parameter is unknown or unsuitable: one line.
    """

    def __init__(self) -> None:
        self.node = Node("rosafe", allow_undeclared_parameters=True)
        self._given = given = {name: one.value for name, one in self.node._parameter_overrides.items()}
        self._values = self._declare(given)
        log = self.node.get_logger()
        for remark in (*(f"left out: {problem}" for problem in PROBLEMS), *WARNINGS):
            log.warning(f"plugin {remark}")
        frames = self._values["world_frame"] or WORLD, self._values["frame_id"]
        truth = TruthTopics(self.node, frames, self.now)
        self.sound = Sound(
            functools.partial(clock_offset, self.node), log, truth.publish, functools.partial(open_device, self.node)
        )
        changed = self.node.create_guard_condition(self._update)
        outputs = Outputs(self.node, self.sound, changed.trigger)
        self.tree = NodeTree(outputs, self.sound, self._values["frames_per_block"], TOPICS, log)
        self._parameters = ProcessorParameters(self.node, self.tree.tree, given, changed.trigger)
        self._sound_settings: AcquireSettings | None = None
        self._lock = threading.Lock()  # of the services, which wait until the node has begun
        self._pending: list[Callable[[], object]] = []  # to do with the first sound
        self._localizer: Mapping[str, Any] | None = None  # its settings
        self._localization: Localization | None = None
        # each with a line of its own: rclpy accepts one severity for each line that logs
        severities = {
            OK: lambda text: log.info(text),
            WARN: lambda text: log.warning(text),
            ERROR: lambda text: log.error(text),
        }
        self._status = NodeStatus(lambda: None, severities)
        self._keep = self._kept()
        self._serve()
        self._diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # that of a simulation may stand still
        self.node.create_timer(DIAGNOSTICS_SECONDS, self._diagnose, clock=steady)
        self.node.create_timer(TRIM_SECONDS, buffer_pool.trim, clock=steady)

    def now(self) -> float:
        """Return the clock time in s; with `use_sim_time` that of /clock."""
        return float(self.node.get_clock().now().nanoseconds / 1e9)

    # --- start and end ---

    def _declare(self, given: Mapping[str, Any]) -> dict[str, Any]:
        values = {}
        for name, (default, text) in PARAMETERS.items():
            descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=False)
            try:
                value = self.node.declare_parameter(name, default, descriptor).value
            except rclpy.exceptions.InvalidParameterTypeException:
                kind = "a list of texts" if name == "representations" else f"a {type(default).__name__}"
                raise ValueError(f"{name}: expected {kind}, got {given[name]!r}") from None
            values[name] = value if value is not None else []
        for name in given:
            if "." not in name and not self.node.has_parameter(name):
                hint = did_you_mean(name, PARAMETERS)
                raise ValueError(f"{name}: expected a parameter of {join_names(PARAMETERS)}, got an unknown name{hint}")
        BLOCK_AND_BUFFERS[0].check(values["frames_per_block"])
        BASS.service("Acquire").parameter("sampleRate").check(values["sample_rate"])
        return values

    def _kept(self) -> TreeStateFile | None:
        path = self._values["keep"]
        if not path:
            return None
        return TreeStateFile(Path(os.path.expanduser(path)).absolute(), self._setup, self.node.get_logger().error)

    def begin(self) -> None:
        """Acquire the device, build what the parameters name, and localize. Raises ComponentError or ValueError."""
        with self._lock:
            self._begin()

    def _begin(self) -> None:
        kernels.compiled()  # before the first block, which would be late otherwise
        importlib.import_module("scipy.signal")
        values = self._values
        device, setup = values["device"], self._start_setup()
        for representation in values["representations"]:
            kind_of(representation)
            self._pending.append(functools.partial(self.tree.request, representation, {}))
        if setup.processors:
            self._pending.insert(0, lambda: self.tree.load(setup))
        explicit = "localize" in self._given
        alone = not (setup.processors or setup.localizer or values["representations"] or explicit)
        if setup.localizer is not None or values["localize"] or (alone and (device or setup.sound)):
            self._localize(setup.localizer or {})
        if device:
            self._acquire(device, values["sample_rate"], setup)
        elif setup.sound is not None:
            self._acquire_settings(setup.sound, setup)
        self._update()

    def _start_setup(self) -> Setup:
        """Return the setup to begin with: that of the parameter, or else the kept one."""
        if path := self._values["setup"]:
            return read(read_regular(Path(os.path.expanduser(path)), 2**24).decode())
        return Setup() if self._keep is None else self._keep.saved()

    def close(self) -> None:
        """End all threads; the kept setup stays as it is."""
        if self._keep is not None:
            self._keep.close()
        self.sound.stop()
        if self._localization is not None:
            self._localization.close()
        self.tree.stop()

    # --- sound ---

    def _acquire_settings(self, sound: AcquireSettings, setup: Setup) -> None:
        self._acquire(sound.values["device"], sound.values["sampleRate"], setup)

    def _acquire(self, device: str, rate: int, setup: Setup) -> None:
        """Acquire a device, for which the processors of a setup have to be suitable; build what is pending."""

        def check(found: float) -> None:
            self.tree.check_rate(found)
            dry_run(setup, found)

        pending = list(self._pending)

        def prepare() -> None:
            for build in pending:
                build()
            self._parameters.update()

        frames = self._values["frames_per_block"]
        self.sound.acquire(device, rate, frames, check, prepare)
        del self._pending[: len(pending)]
        arguments = {"device": device, "sampleRate": rate, "nFramesPerChunk": frames}
        self._sound_settings = AcquireSettings.of(arguments)

    # --- localizer ---

    def _localize(self, given: Mapping[str, Any]) -> None:
        """Start the localizer with the settings of a setup, or else those of the parameters."""
        own = {name: self._values[name] for name in ("head", "world_frame", "speech_only")}
        settings = checked_settings({**own, "head_frame": self._values["frame_id"], **given})
        transforms = None
        if settings.world_frame:
            log = ThrottledLog(self.node.get_logger().warning, 60.0)
            transforms = RotationBuffer(settings.world_frame, settings.head_frame, log)
            subscribe_transforms(self.node, transforms)
        publishers = SourcePublishers(self.node, settings.frame_id, settings.speech_only)
        open_sound = functools.partial(SeparatedSound, self.sound)
        localization = Localization(settings, self.tree, publishers, self._status, transforms, self.now, open_sound)
        self._localizer, self._localization = dict(given), localization
        localization.start()

    # --- services ---

    def _serve(self) -> None:
        for name, service, handler in (
            ("request", RequestRepresentation, self._request),
            ("add_processor", AddProcessor, self._add_processor),
            ("remove_processor", RemoveProcessor, self._remove_processor),
            ("save_setup", SaveSetup, self._save_setup),
            ("load_setup", LoadSetup, self._load_setup),
            ("acquire", Acquire, self._serve_acquire),
            ("stop", Trigger, self._stop),
        ):
            self.node.create_service(service, f"~/{name}", self._answering(handler))
        self.node.create_service(GetTree, "~/get_tree", self._get_tree)

    def _answering(self, handler: Callable[[Any, Any], object]) -> Callable[[Any, Any], Any]:
        """Return the callback of a service, with `success` and the text of an error in `message`."""

        def answer(request: Any, response: Any) -> Any:
            try:
                with self._lock:
                    handler(request, response)
                response.success = True
            except (ComponentError, SetupError, ValueError, OSError) as problem:
                response.message = printable(getattr(problem, "what", "") or str(problem))
            self._update()
            return response

        return answer

    def _request(self, request: Any, response: Any) -> None:
        parameters = read_parameters(request.parameters)
        response.processors = self.tree.request(request.representation, parameters, request.name).names

    def _add_processor(self, request: Any, response: Any) -> None:
        kind, parameters = kind_of(request.kind), read_parameters(request.parameters)
        self.tree.add(kind, request.name, request.parent, parameters)

    def _remove_processor(self, request: Any, response: Any) -> None:
        response.removed = self.tree.remove(request.name)

    def _get_tree(self, _: Any, response: Any) -> Any:
        topics = {processor.name: topics_of(processor) for processor in self.tree.processors()}
        response.processors = [
            ProcessorMessage(
                name=one.name,
                kind=one.kind,
                parent=one.parent,
                topics=[self.node.resolve_topic_name(topic) for topic in topics.get(one.name, ())],
                parameters=", ".join(f"{name}: {format_value(value)}" for name, value in one.values.items()),
            )
            for one in self.tree.existing()
        ]
        return response

    def _setup(self) -> Setup:
        """Return the present setup."""
        return Setup(self._sound_settings, {}, self.tree.describe().processors, self._localizer)

    def _save_setup(self, _: Any, response: Any) -> None:
        response.setup = write(self._setup())

    def _load_setup(self, request: Any, response: Any) -> None:
        setup = read(request.setup)
        if setup.localizer is not None and self._localization is None:
            checked_settings(setup.localizer)
        if setup.sound is not None and setup.sound != self._sound_settings:
            self._pending.append(lambda: self.tree.load(setup))
            try:
                self._acquire_settings(setup.sound, setup)
            except BaseException:
                self._pending.pop()
                raise
        else:
            self.tree.load(setup)
        if setup.localizer is not None and self._localization is None:
            self._localize(setup.localizer)

    def _serve_acquire(self, request: Any, response: Any) -> None:
        self._acquire(request.device, request.sample_rate, Setup())

    def _stop(self, _: Any, response: Any) -> None:
        self.sound.stop()
        self.tree.stop()
        self._sound_settings = None

    # --- changes and state ---

    def _update(self) -> None:
        """Adapt parameters, the kept file and the localizer to the tree."""
        self._parameters.update()
        if self._keep is not None:
            self._keep.save()
        if self._localization is not None:
            self._localization.check_now()

    def _diagnose(self) -> None:
        parts: list[tuple[str, Callable[[Any], object]]] = [
            ("sound", self.sound.report),
            ("processors", self.tree.health.report),
        ]
        if self._localization is not None:
            parts.append(("localization", self._status.report))
        stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.node.get_fully_qualified_name().lstrip("/"), parts))


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list that gets SIGINT and SIGTERM. In a handler, Event.set could block: its lock may be held there."""
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield received
    finally:
        # A handler is removed at the end of Python, and another signal would kill the process.
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if received else handler)


def _wait(received: list[int], stop: threading.Event) -> None:
    """Wait for a signal or `stop`. A signal just before a system call does not interrupt it, so this looks again."""
    while not (received or stop.wait(SIGNAL_SECONDS)):
        pass


def _spin(executor: MultiThreadedExecutor, stop: threading.Event) -> None:
    """Handle the events of ROS until `stop`; after an unexpected error too."""
    while not stop.is_set():
        try:
            executor.spin()
        except ExternalShutdownException:
            stop.set()
        except Exception:
            if not stop.is_set():
                traceback.print_exc()


def quoted(arguments: Sequence[str]) -> list[str]:
    """Return arguments of ROS in which the values of texts are quoted: rcl reads `scene:` as an incomplete mapping."""
    texts = "|".join(name for name, (default, _) in PARAMETERS.items() if isinstance(default, str))
    rule = re.compile(rf"((?:[^:=]*:)?(?:(?:{texts}):=(?=[^'\"])|[^:=]*:=(?=[^'\"].*:$)))(.*)")
    return [f"{found[1]}{json.dumps(found[2])}" if (found := rule.fullmatch(one)) else one for one in arguments]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM, and return its exit code: 1 if it cannot start."""
    arguments = quoted(sys.argv if argv is None else argv)
    malloc_tuning.limit_arenas()
    with _signals() as received:
        try:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
            _run(received)
        except (ComponentError, SetupError, ValueError, OSError, RCLError) as problem:
            print(f"rosafe: {printable(' '.join(str(problem).split()))}", file=sys.stderr)
            return 1
        finally:
            rclpy.try_shutdown()
    return 0


def _run(received: list[int]) -> None:
    node, stop = RosafeNode(), threading.Event()
    executor = MultiThreadedExecutor(THREADS)
    executor.add_node(node.node)
    thread = threading.Thread(target=_spin, args=(executor, stop), name="ROS", daemon=True)
    thread.start()
    try:
        node.begin()
        gc.freeze()  # collecting the objects of modules would stop all threads for tens of milliseconds, without result
        _wait(received, stop)
    finally:
        stop.set()
        node.close()
        executor.shutdown(END_SECONDS)
        thread.join(END_SECONDS)
        node.node.destroy_node()


def run() -> None:
    """Run the node as a program. It ends at once: the destructors of the middleware can take longer than 2 s."""
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    run()
