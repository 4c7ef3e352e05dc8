"""The rosAFE node: its requests on the processor tree, its ports, its health."""

from __future__ import annotations

import importlib
import re
import threading
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe import interface
from rosafe.component import wire
from rosafe.component.activities import Activity
from rosafe.component.audio import AudioRing
from rosafe.component.component import ComponentNode
from rosafe.component.events import EventLog
from rosafe.component.startup import run_server
from rosafe.dsp import kernels
from rosafe.interface import KINDS, LAYOUTS, ROSAFE, ComponentError, Representation
from rosafe.node import reports
from rosafe.node.ports import OutputPort, element
from rosafe.node.trace_port import TracePort
from rosafe.node.words import UnknownWords
from rosafe.representations import PROBLEMS, STAGES
from rosafe.sound.windows import MAX_WINDOW
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree
from rosafe.vocabulary.parameter import MAX_STRING, shown

FIRST_AUDIO_SECONDS = 1.0  # how long InputProc waits for a first message
OPTIONS = {
    "--strict": {
        "action": "store_true",
        "help": "refuse unknown words of enumerated parameters, as the ROS parameter ~strict_words does (default: they "
        "are taken as the original takes them, with a warning)",
    }
}


class RosafeNode:
    """The component `rosAFE`. Make it after `rospy.init_node`.

    Where it is `strict`, or the ROS parameter ``strict_words`` in its namespace is true, unknown words are refused.
    """

    def __init__(self, instance: str, strict: bool = False) -> None:
        for problem in PROBLEMS:
            rospy.logwarn(f"a representation is left out: {problem}")
        self._node = ComponentNode(ROSAFE, lambda problem: ROSAFE.error("e_badNewValue", what=str(problem)))
        self.finished = self._node.finished
        self._tree = Tree(self)
        self._words = UnknownWords(strict)
        self._ring = AudioRing(EventLog(rospy.logwarn))
        self._audio: rospy.Subscriber | None = None
        self._audio_topic = ""
        self._ports: dict[Processor, OutputPort] = {}
        self._ends: dict[Processor, Activity] = {}
        self._starting = threading.Lock()  # an InputProc that a newer one has interrupted must not replace that one's
        self._of_the_input: dict[str, Any] = {}  # what the InputProc that runs was asked for
        self._data_object = self._node.advertise("dataObj", wire.message_class("rosAFE", "::rosAFE::dataObjSt"))
        self._input_port = self._advertise("input")

        self._node.input_port("Audio", self._connect_audio)
        self._node.activity("InputProc", self._input_proc)
        for kind in KINDS.values():
            if kind.parent:
                self._serve_processor(kind)
        self._node.function("getSignals", self._get_signals)
        self._node.function("getParameters", lambda _: {"parameters": reports.parameters(self._tree.processors)})
        self._node.function("getProcessors", self._get_processors)
        self._node.function("getRepresentation", self._get_representation)
        self._node.function("getDependencies", lambda v: {"dependencies": self._tree.dependencies(v["nameProc"])})
        self._node.function("modifyParameter", self._modify_parameter)
        self._node.function("removeProcessor", self._remove_processor)
        self._node.function("Stop", lambda _: self._tree.stop())
        self._node.diagnostics.add("audio", self._audio_health)
        self._node.diagnostics.add("processors", self._tree_health)
        self._trace = TracePort(f"{self._node.name}/trace", self._tree.observe)
        self._node.start()
        importlib.import_module("scipy.signal")  # whoever has started us waits no longer; no request is to wait for it

    def shutdown(self, by: str) -> None:
        """End all processors."""
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
            wire.lenient_class("rosAFE", "::binaudio::portStruct", MAX_WINDOW),
            take,
            queue_size=None,  # all that has come is looked at: a window may be shorter than a hiccup
            buff_size=2**22,
            tcp_nodelay=True,
        )

    # --- processors ---

    def _input_proc(self, activity: Activity, values: dict[str, Any]) -> None:
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
                processor = self._tree.add_input(
                    values["name"], reader, frames, values["bufferSize_s_port"], values["bufferSize_s_getSignal"]
                )
                self._of_the_input = {name: value for name, value in values.items() if name != "name"}
        except BaseException:
            reader.stop()
            raise
        activity.interrupt_others()
        self._live(activity, processor)

    def _serve_processor(self, kind: Representation) -> None:
        def check(values: dict[str, Any]) -> dict[str, Any]:
            """The original's order: parent unknown, name taken, parent of the wrong type; the values are the tree's."""
            self._tree.check(kind.kind, values["name"], values["upperDepName"])
            name = values["name"]
            if len(name) > MAX_STRING or not re.fullmatch(r"\w+(/\w+)*", name, re.ASCII):
                what = f"name: {shown(name)} names a topic too: letters, digits and _ only"
                raise ROSAFE.error("e_badNewValue", what=what)
            return values

        def handle(activity: Activity, values: dict[str, Any]) -> None:
            asked = STAGES[kind.kind].asked({p.name: values[p.name] for p in kind.parameters if p.name in values})
            doubts: dict[str, str] = {}
            take = self._words.taking(doubts)
            parameters = {p.name: take(p, asked[p.name]) for p in kind.parameters if p.name in asked}
            processor = self._tree.add(kind.kind, values["name"], values["upperDepName"], parameters)
            activity.warning = self._words.note(processor, doubts)
            self._live(activity, processor)

        self._node.activity(kind.request, handle, check)

    def _live(self, activity: Activity, processor: Processor) -> None:
        """From now on the activity is the processor: they end together."""
        self._ends[processor] = activity
        if processor not in self._tree.processors:  # it may have ended before its activity was known
            activity.interrupt("")
        self._node.settle()
        activity.running()
        activity.stop_requested.wait()
        self._ends.pop(processor, None)
        self._tree.end(processor)
        self._words.forget(processor)
        self._node.settle()
        if processor.error is not None:
            raise ComponentError("::genom::unkex", what=f"{type(processor.error).__name__}: {processor.error}"[:127])

    # --- what the tree tells (on its threads) ---

    def _advertise(self, kind: str, name: str = "") -> rospy.Publisher:
        message_class = wire.message_class("rosAFE", LAYOUTS[kind].idl)
        return self._node.advertise(KINDS[kind].port, message_class, element(kind, name))

    def added(self, processor: Processor) -> None:
        """Open the processor's port, full of zeros."""
        if processor.kind == "input":
            port = OutputPort(processor, self._input_port, lambda: None)
        else:
            publisher = self._advertise(processor.kind, processor.name)
            port = OutputPort(processor, publisher, publisher.unregister)
        self._ports[processor] = port
        port.open(self._tree.port_seconds)

    def executed(self, processor: Processor, seconds: float) -> None:
        """Count the work for genom_state."""
        self._node.meters[ROSAFE.service(KINDS[processor.kind].request).task].cycle(seconds)

    def released(self, processor: Processor, block: Block) -> None:
        """Publish the processor's window."""
        self._ports[processor].append(block, self._tree.port_seconds)

    def ended(self, processor: Processor) -> None:
        """Close the port and end the activity."""
        port = self._ports.pop(processor, None)  # None where it could not be opened
        if port is not None:
            port.close()
        if processor.error is not None:
            rospy.logerr(f"{processor.kind} {processor.name!r} failed: {processor.error!r}")
        activity = self._ends.get(processor)
        if activity is not None:
            activity.interrupt("")

    # --- functions ---

    def _get_signals(self, values: dict[str, Any]) -> dict[str, Any]:
        return reports.response("getSignals", signals=reports.signals(self._tree.processors))

    def _get_processors(self, values: dict[str, Any]) -> dict[str, Any]:
        told = reports.descriptions(self._tree.processors, self._node.name, self._of_the_input)
        return reports.response("getProcessors", processors=told)

    def _get_representation(self, values: dict[str, Any]) -> dict[str, Any]:
        return reports.response("getRepresentation", parts=reports.representation(self._tree.find(values["name"])))

    def _modify_parameter(self, values: dict[str, Any]) -> dict[str, Any]:
        doubts: dict[str, str] = {}
        take = self._words.taking(doubts)
        processor = self._tree.modify(values["nameProc"], values["nameParam"], values["newValue"], take)
        return {"warning": self._words.note(processor, doubts)}

    def _remove_processor(self, values: dict[str, Any]) -> None:
        self._tree.remove(values["name"])

    # --- health ---

    def _audio_health(self, status: Any) -> Any:
        counters, rate, root = self._ring.counters, self._ring.sample_rate, self._tree.input
        if root is not None and rate not in (0, self._tree.sample_rate):
            status.summary(
                DiagnosticStatus.ERROR, f"Audio is at {rate} Hz, the tree at {self._tree.sample_rate:g} Hz: call Stop"
            )
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

    def _tree_health(self, status: Any) -> Any:
        processors, doubts = self._tree.processors, self._words.lines
        if doubts:
            more = f" (and {len(doubts) - 1} more unknown words)" if len(doubts) > 1 else ""
            status.summary(DiagnosticStatus.WARN, f"{doubts[0]}{more}")
        else:
            status.summary(DiagnosticStatus.OK, f"{len(processors)} processors")
        for doubt in doubts:
            status.add("unknown word", doubt)
        for processor in processors:
            status.add(processor.name, f"{processor.kind}, {processor.state.value}, {processor.blocks} blocks")
        return status


def main(argv: list[str] | None = None) -> int:
    """Run the node; the `rosAFE-ros` command."""
    return run_server(interface.ROSAFE, RosafeNode, argv, kernels.compiled, OPTIONS)
