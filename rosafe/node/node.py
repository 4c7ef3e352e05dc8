"""The rosAFE node: its requests on the processor tree, its ports, its health."""

from __future__ import annotations

import functools
import importlib
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe import interface
from rosafe.component import serialization
from rosafe.component.activities import Activity, Handler
from rosafe.component.audio import AudioRing
from rosafe.component.component import ComponentNode
from rosafe.component.startup import run_server
from rosafe.declarations.parameter import MAX_STRING, short_repr
from rosafe.dsp import kernels
from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, LAYOUTS, ROSAFE, ComponentError, Representation
from rosafe.node import responses
from rosafe.node.choice_fallbacks import ChoiceFallbacks
from rosafe.node.ports import OutputPort, element
from rosafe.node.processor_health import ProcessorHealth
from rosafe.node.trace_port import TracePort
from rosafe.node.tree_request_service import TreeRequestService
from rosafe.node.tree_state_file import TreeStateFile
from rosafe.representations import PLUGINS, PROBLEMS, STAGES, WARNINGS
from rosafe.setups import Setup, dry_run, wanted
from rosafe.sound.windows import MAX_WINDOW
from rosafe.transport.log_throttle import ThrottledLog
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Failure, Tree
from rosafe.tree.tree_planner import ExistingProcessor
from rosafe.tree.workers import workers_to_use

FIRST_AUDIO_SECONDS = 1.0  # how long InputProc waits for a first message
POLL_SECONDS = 0.1  # between two looks whether there is sound for a tree that is to come back
OPTIONS = {
    "--strict": {
        "action": "store_true",
        "help": "refuse unknown words of enumerated parameters, as the ROS parameter ~strict_words does (default: they "
        "are taken as the original takes them, with a warning)",
    },
    "--keep": {
        "metavar": "FILE",
        "default": "",
        "help": "write connections and processors into FILE at each change, and bring back at the start what it holds, "
        "once there is sound (default: the ROS parameter ~keep; without it, always a fresh start)",
    },
}


class RosafeNode:
    """The component `rosAFE`. Make it after `rospy.init_node`.

    Where it is `strict`, or the ROS parameter ``strict_words`` in its namespace is true, unknown words are refused.
    `keep`, or else the ROS parameter ``keep``, names a file that holds the tree at any moment; what it holds at the
    start comes back once there is sound.
    """

    def __init__(self, instance: str, strict: bool = False, keep: str = "") -> None:
        for remark in (*(f"left out: {problem}" for problem in PROBLEMS), *WARNINGS):
            rospy.logwarn(f"plugin {remark}")
        self._node = ComponentNode(ROSAFE, lambda problem: ROSAFE.error("e_badNewValue", what=str(problem)))
        self.finished = self._node.finished
        self._tree = Tree(self, _workers())
        self._words = ChoiceFallbacks(strict)
        self._ring = AudioRing(ThrottledLog(self._warn))
        self._audio: rospy.Subscriber | None = None
        self._audio_topic = ""
        self._ports: dict[Processor, OutputPort] = {}
        self._activity_by_processor: dict[Processor, Activity] = {}
        self._health = ProcessorHealth(self._tree, self._words)
        self._starting = threading.Lock()  # an InputProc that a newer one has interrupted must not replace that one's
        self._input_services: dict[str, Any] = {}  # what the InputProc that runs was asked for
        self._keeper = _keeper(keep, self._setup)
        kept = Setup() if self._keeper is None else self._keeper.saved()
        if self._keeper is not None and self._keeper.absent:
            rospy.logwarn(self._keeper.absent)
        self._tree_to_restore = Setup(None, kept.connections, kept.processors)  # what is not there yet
        self._sound = kept.sound  # which is not ours to make; but a file that has one keeps it
        self._restoring = ""  # why it is not there yet
        self._data_object = self._node.advertise(
            "dataObj", serialization.message_class("rosAFE", "::rosAFE::dataObjSt")
        )
        self._input_port = self._advertise("input")
        self._time_class = serialization.message_class("rosAFE", "::rosAFE::frameTime")
        self._frame_time = self._node.advertise("frameTime", self._time_class)

        self._node.input_port("Audio", self._connect_audio)
        self._node.activity("InputProc", self._input_proc)
        for kind in KINDS.values():
            if kind.parent:
                self._serve_processor(kind)
        self._node.function("getSignals", self._get_signals)
        self._node.function("getParameters", lambda _: {"parameters": responses.parameters(self._tree.processors)})
        self._node.function("getProcessors", self._get_processors)
        self._node.function("getRepresentation", self._get_representation)
        self._node.function("getDependencies", lambda v: {"dependencies": self._tree.dependencies(v["nameProc"])})
        self._node.function("modifyParameter", self._modify_parameter)
        self._node.function("removeProcessor", self._remove_processor)
        self._node.function("Stop", self._stop)
        self._node.function("request", TreeRequestService(self._node, lambda: self._audio_topic).build, waits=True)
        self._node.diagnostics.add("audio", self._audio_health)
        self._node.diagnostics.add("processors", self._health.report)
        self._node.diagnostics.add("plugins", _plugin_health)
        if self._keeper is not None:
            self._node.diagnostics.add("keep", self._keeping_health)
        self._trace = TracePort(f"{self._node.name}/trace", self._tree.observe)
        self._begin_to_come_back()
        self._node.start()
        importlib.import_module("scipy.signal")  # whoever has started us waits no longer; no request is to wait for it

    def shutdown(self, by: str) -> None:
        """End all processors."""
        if self._keeper is not None:
            self._keeper.close()
        self._node.shutdown(by)
        self._tree.stop()

    # --- Audio ---

    def _connect_audio(self, topic: str) -> None:
        if self._audio is not None:
            self._audio.unregister()
        feed = self._ring.connect()

        def take(message: Any) -> None:
            if message.problem:
                self._ring.refuse(message.problem)
            else:
                feed(message)

        self._audio_topic = topic
        self._audio = rospy.Subscriber(
            topic,
            serialization.tolerant_message_class("rosAFE", "::binaudio::portStruct", MAX_WINDOW),
            take,
            queue_size=None,  # all that has come is looked at: a window may be shorter than a hiccup
            buff_size=2**22,
            tcp_nodelay=True,
        )
        self._keep()

    # --- what is kept ---

    def _keep(self) -> None:
        """Have the tree as it is now in the file, if there is one."""
        if self._keeper is not None:
            self._keeper.save()

    def _setup(self) -> Setup:
        """The tree, or the one that is to come back, with the connection that there is now."""
        connections = {"Audio": self._audio_topic} if self._audio_topic else {}
        if self._tree_to_restore.processors:
            return Setup(self._sound, connections, self._tree_to_restore.processors)
        found = [processor.ask(self._found) for processor in self._tree.processors]
        return Setup(self._sound, connections, tuple(wanted(one) for one in found if one is not None))

    def _found(self, processor: Processor) -> ExistingProcessor:
        parent = processor.parent
        of_the_input = self._input_services if parent is None else {}
        values = {**processor.parameters(), **of_the_input}
        return ExistingProcessor(processor.name, processor.kind, parent.name if parent is not None else "", values)

    def _begin_to_come_back(self) -> None:
        topic = self._tree_to_restore.connections.get("Audio", "")
        if topic:
            self._connect_audio(topic)  # whether or not somebody publishes it yet
        if self._tree_to_restore.processors:
            self._restoring = f"waiting for sound on {topic or 'the Audio port'}"
            threading.Thread(target=self._restore_tree, name="come back", daemon=True).start()

    def _restore_tree(self) -> None:
        """Build the tree that was there, as soon as there is sound of a rate at which that is possible."""
        tried: set[int] = set()
        while self._tree_to_restore.processors and not self.finished.wait(POLL_SECONDS):
            rate = self._ring.sample_rate
            asked = any(activity.service.name == "InputProc" for activity in self._node.activities.live())
            if rate == 0 or rate in tried or asked:
                continue
            tried.add(rate)
            try:
                dry_run(self._tree_to_restore, rate)
                self._rebuild(self._tree_to_restore)
            except ComponentError as problem:
                self._restoring = str(problem)
                if self._tree_to_restore.processors:  # else somebody has begun another one
                    rospy.logerr(f"the tree of {self._keeper and self._keeper.path} does not come back: {problem}")
            else:
                rospy.loginfo(f"{len(self._tree_to_restore.processors)} processors are back")
                self._abort_restore()

    def _rebuild(self, setup: Setup) -> None:
        again: Handler = functools.partial(self._input_proc, comes_back=True)
        try:
            for one in setup.processors:
                values = {"name": one.name, "upperDepName": one.parent, **one.values, **one.input_values}
                handle = self._handler(one.representation) if one.parent else again
                service = ROSAFE.service(one.representation.request)
                activity = self._node.activities.start(service, handle, values, None)
                activity.begun.wait()
                if activity.error is not None:
                    raise activity.error
        except ComponentError:
            if self._tree_to_restore is setup:
                self._tree.stop()
            raise

    def _abort_restore(self) -> None:
        """From now on what is there counts."""
        self._tree_to_restore, self._restoring = Setup(), ""
        self._keep()

    # --- processors ---

    def _input_proc(self, activity: Activity, values: dict[str, Any], comes_back: bool = False) -> None:
        if not values["name"]:
            raise ROSAFE.error("e_badNewValue", what="name: '' is empty, and names a processor")
        if self._audio is None:
            raise ROSAFE.error("e_noData", "the Audio port is not connected: call connect_port first")
        activity.interrupt_waiting()
        frames = values["nFramesPerBlock"]
        reader = self._ring.open_reader(frames, FIRST_AUDIO_SECONDS, activity.stop_requested.is_set)
        if reader is None:
            activity.raise_if_interrupted()
            raise ROSAFE.error("e_noData", f"nothing has come from {self._audio_topic}: is bass acquiring?")
        try:
            with self._starting:
                activity.raise_if_interrupted()
                buffers = values["bufferSize_s_port"], values["bufferSize_s_getSignal"]
                parameters = {p.name: values[p.name] for p in KINDS["input"].parameters if p.name in values}
                processor = self._tree.add_input(values["name"], reader, frames, *buffers, parameters)
                self._input_services = {p.name: values[p.name] for p in BLOCK_AND_BUFFERS}
                if not comes_back:
                    self._tree_to_restore = Setup()  # somebody wants a tree of his own
        except BaseException:
            reader.stop()
            raise
        activity.interrupt_others()
        self._run_until_removed(activity, processor)

    def _serve_processor(self, kind: Representation) -> None:
        def check(values: dict[str, Any]) -> dict[str, Any]:
            """The original's order: parent unknown, name taken, parent of the wrong type; the values are the tree's."""
            self._tree.check(kind.kind, values["name"], values["upperDepName"])
            name = values["name"]
            if len(name) > MAX_STRING or not re.fullmatch(r"\w+(/\w+)*", name, re.ASCII):
                what = f"name: {short_repr(name)} names a topic too: letters, digits and _ only"
                raise ROSAFE.error("e_badNewValue", what=what)
            return values

        self._node.activity(kind.request, self._handler(kind), check)

    def _handler(self, kind: Representation) -> Handler:
        def handle(activity: Activity, values: dict[str, Any]) -> None:
            asked = STAGES[kind.kind].request_values(
                {p.name: values[p.name] for p in kind.parameters if p.name in values}
            )
            doubts: dict[str, str] = {}
            take = self._words.resolving(doubts)
            parameters = {p.name: take(p, asked[p.name]) for p in kind.parameters if p.name in asked}
            processor = self._tree.add(kind.kind, values["name"], values["upperDepName"], parameters)
            activity.warning = self._words.note(processor, doubts)
            self._run_until_removed(activity, processor)

        return handle

    def _run_until_removed(self, activity: Activity, processor: Processor) -> None:
        """From now on the activity is the processor: they end together."""
        self._activity_by_processor[processor] = activity
        if processor not in self._tree.processors:  # it may have ended before its activity was known
            activity.interrupt("")
        self._node.settle()
        self._keep()  # before anybody is told that it runs
        activity.running()
        activity.stop_requested.wait()
        self._activity_by_processor.pop(processor, None)
        self._tree.end(processor)
        self._words.forget(processor)
        self._keep()
        self._node.settle()
        if processor.error is not None:
            raise ComponentError("::genom::unkex", what=str(Failure.of(processor)))

    # --- what the tree tells (on its threads) ---

    def _advertise(self, kind: str, name: str = "") -> rospy.Publisher:
        message_class = serialization.message_class("rosAFE", LAYOUTS[kind].idl)
        return self._node.advertise(KINDS[kind].port, message_class, element(kind, name))

    def on_added(self, processor: Processor) -> None:
        """Open the processor's port, full of zeros."""
        if processor.kind == "input":
            port = OutputPort(processor, self._input_port, lambda: None)
        else:
            publisher = self._advertise(processor.kind, processor.name)
            port = OutputPort(processor, publisher, publisher.unregister)
        self._ports[processor] = port
        self._health.added(processor)
        port.open(self._tree.port_seconds)

    def on_executed(self, processor: Processor, seconds: float) -> None:
        """Count the work, for genom_state and /diagnostics."""
        self._node.meters[ROSAFE.service(KINDS[processor.kind].request).task].cycle(seconds)
        self._health.executed(processor, seconds)

    def on_released(self, processor: Processor, block: Block) -> None:
        """Publish the processor's window; with that of the input, the time of its newest frame."""
        self._ports[processor].append(block, self._tree.port_seconds)
        if processor.parent is None:
            self._publish_latency(block.next_index - 1)

    def _publish_latency(self, frame: int) -> None:
        line = self._ring.captured(frame)
        if line is not None:
            seconds, nanoseconds = divmod(round(line.time * 1e9), 1_000_000_000)
            if 0 <= seconds < 2**32:  # what anybody sends as a stamp may be beyond all times
                stamp = {"sec": seconds, "nsec": nanoseconds}
                self._frame_time.publish(self._time_class(stamp=stamp, frameIndex=frame, sampleRate=line.rate))

    def on_removed(self, processor: Processor) -> None:
        """Close the port and end the activity."""
        self._health.ended(processor)
        port = self._ports.pop(processor, None)  # None where it could not be opened
        if port is not None:
            port.close()
        activity = self._activity_by_processor.get(processor)
        if activity is not None:
            activity.interrupt("")

    # --- functions ---

    def _get_signals(self, values: dict[str, Any]) -> dict[str, Any]:
        return responses.response("getSignals", signals=responses.signals(self._tree.processors))

    def _get_processors(self, values: dict[str, Any]) -> dict[str, Any]:
        told = responses.descriptions(self._tree.processors, self._node.name, self._input_services)
        return responses.response("getProcessors", processors=told)

    def _get_representation(self, values: dict[str, Any]) -> dict[str, Any]:
        return responses.response("getRepresentation", parts=responses.representation(self._tree.find(values["name"])))

    def _modify_parameter(self, values: dict[str, Any]) -> dict[str, Any]:
        doubts: dict[str, str] = {}
        take = self._words.resolving(doubts)
        processor = self._tree.modify(values["nameProc"], values["nameParam"], values["newValue"], take)
        self._keep()
        return {"warning": self._words.note(processor, doubts)}

    def _remove_processor(self, values: dict[str, Any]) -> None:
        self._tree.remove(values["name"])
        self._keep()

    def _stop(self, values: dict[str, Any]) -> None:
        self._tree_to_restore = Setup()
        self._tree.stop()
        self._keep()

    # --- health ---

    def _warn(self, line: str) -> None:
        rospy.logwarn(line)
        self._node.health_changed()

    def _audio_health(self, status: Any) -> Any:
        counters, rate, root = self._ring.counters, self._ring.sample_rate, self._tree.input
        if root is not None and rate not in (0, self._tree.sample_rate):
            status.summary(
                DiagnosticStatus.ERROR, f"Audio is at {rate} Hz, the tree at {self._tree.sample_rate:g} Hz: call Stop"
            )
        elif lag := self._ring.lag:
            status.summary(DiagnosticStatus.WARN, lag)
        elif counters.lost or counters.dropped or counters.refused or counters.breaks:
            status.summary(
                DiagnosticStatus.WARN,
                f"{counters.lost} frames lost in {counters.gaps} gaps, {counters.dropped} dropped, "
                f"{counters.refused} messages refused, {counters.breaks} breaks",
            )
        else:
            status.summary(DiagnosticStatus.OK, "no frames lost" if counters.messages else "no audio yet")
        status.add("topic", self._audio_topic or "not connected")
        status.add("sample rate (Hz)", str(rate))
        status.add("frames waiting", str(self._ring.behind))
        for name, value in vars(counters).items():
            status.add(name.replace("_", " "), str(value))
        return status

    def _keeping_health(self, status: Any) -> Any:
        assert self._keeper is not None
        if doubt := self._keeper.problem or self._restoring or self._keeper.absent:
            status.summary(DiagnosticStatus.WARN, doubt)
        else:
            status.summary(DiagnosticStatus.OK, "the tree is kept")
        status.add("file", str(self._keeper.path))
        status.add("to come back", " ".join(one.name for one in self._tree_to_restore.processors) or "nothing")
        return status


def _plugin_health(status: Any) -> Any:
    remarks = [*(f"left out: {problem}" for problem in PROBLEMS), *WARNINGS]
    if remarks:
        more = f" (and {len(remarks) - 1} more)" if len(remarks) > 1 else ""
        status.summary(DiagnosticStatus.WARN, f"{remarks[0]}{more}")
    else:
        status.summary(DiagnosticStatus.OK, f"{len(PLUGINS)} plugins")
    for remark in remarks:
        status.add("plugin", remark)
    for kind, origin in PLUGINS.items():
        status.add(kind, origin)
    return status


def _keeper(path: str, describe: Callable[[], Setup]) -> TreeStateFile | None:
    if not path:
        path = str(rospy.get_param("~keep", ""))
        if path and not path.endswith((".yaml", ".yml")):  # whoever reaches the master can set it, to any file
            name = rospy.resolve_name("~keep")
            raise ROSAFE.error("e_badNewValue", what=f"ROS parameter {name}: expected FILE.yaml, got {path!r:.300}")
    return TreeStateFile(Path(os.path.expanduser(path)).absolute(), describe, rospy.logerr) if path else None


def _workers() -> int:
    """How many workers: what the private parameter `workers` says, else the environment, else one for each core."""
    wanted = rospy.get_param("~workers", None)
    if isinstance(wanted, bool) or not isinstance(wanted, int | str | None):
        wanted = str(wanted)
    try:
        return workers_to_use(wanted)
    except ValueError as problem:
        where = "" if wanted is None else f"the parameter {rospy.resolve_name('~workers')}: "
        raise ROSAFE.error("e_badNewValue", what=f"{where}{problem}") from None


def main(argv: list[str] | None = None) -> int:
    """Run the node; the `rosAFE-ros` command."""
    return run_server(interface.ROSAFE, RosafeNode, argv, kernels.compiled, OPTIONS)
