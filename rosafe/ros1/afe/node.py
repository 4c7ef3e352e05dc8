"""The rosAFE node: its services on the processor tree, its ports, its diagnostics."""

from __future__ import annotations

import functools
import importlib
import os
import re
import threading
from pathlib import Path
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe import interface
from rosafe.declarations.parameter import MAX_STRING
from rosafe.declarations.text import short_repr
from rosafe.dsp import kernels
from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, ROSAFE, Representation
from rosafe.representations import PLUGINS, PROBLEMS, STAGES, WARNINGS
from rosafe.ros1.afe import responses
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.afe.choice_fallbacks import ChoiceFallbacks
from rosafe.ros1.afe.published_tree import PublishedTree
from rosafe.ros1.afe.saved_tree import SavedTree
from rosafe.ros1.afe.trace_port import TracePort
from rosafe.ros1.afe.tree_request_service import TreeRequestService
from rosafe.ros1.component import serialization
from rosafe.ros1.component.activities import Activity, Handler
from rosafe.ros1.component.component import ComponentNode
from rosafe.ros1.component.startup import run_server
from rosafe.setups import SetupProcessor, setup_processor
from rosafe.tree.processor import Processor
from rosafe.tree.tree_planner import ExistingProcessor
from rosafe.tree.workers import workers_to_use

OPTIONS = {
    "--strict": {
        "action": "store_true",
        "help": "reject unknown values of parameters with choices, as the ROS parameter ~strict_words does (default: "
        "they are replaced as in the original, with a warning)",
    },
    "--keep": {
        "metavar": "FILE",
        "default": "",
        "help": "save connections and processors to FILE at each change, and restore them from it after a start, as "
        "soon as there is sound (default: the ROS parameter ~keep; without it, nothing is saved)",
    },
}
CATCH_UP_SECONDS = 0.1  # that getSignals waits for the blocks that have arrived


class RosafeNode:
    """The component `rosAFE`. Create it after `rospy.init_node`.

    If `strict`, or the ROS parameter ``strict_words`` in its namespace, is true, unknown choices are rejected. `keep`,
    or else the ROS parameter ``keep``, names a file to which the tree is saved, and from which it is restored.
    """

    def __init__(self, instance: str, strict: bool = False, keep: str = "") -> None:
        for remark in (*(f"left out: {problem}" for problem in PROBLEMS), *WARNINGS):
            rospy.logwarn(f"plugin {remark}")
        self._node = ComponentNode(ROSAFE, lambda problem: ROSAFE.error("e_badNewValue", what=str(problem)))
        self.finished = self._node.finished
        self._audio = AudioInput(self._warn)
        self._choices = ChoiceFallbacks(strict)
        ring = self._audio.ring
        self._published = PublishedTree(self._node, _workers(), self._choices, ring.captured, ring.catch_up)
        self._tree = self._published.tree
        self._starting = threading.Lock()  # so that an interrupted InputProc does not replace the tree of a newer one
        self._input_values: dict[str, Any] = {}  # parameters of the running InputProc
        self._saved = SavedTree(
            _keep_path(keep),
            self._audio,
            self._tree,
            self._setup_processors,
            self._node.activities,
            lambda kind: self._handler(kind) if kind.parent else functools.partial(self._input_proc, restored=True),
        )
        self._data_object = self._node.advertise(
            "dataObj", serialization.message_class("rosAFE", "::rosAFE::dataObjSt")
        )
        self._serve()
        self._node.diagnostics.add("audio", lambda status: self._audio.report(status, self._tree))
        self._node.diagnostics.add("processors", self._published.health.report)
        self._node.diagnostics.add("plugins", _report_plugins)
        if self._saved.enabled:
            self._node.diagnostics.add("keep", self._saved.report)
        self._trace = TracePort(f"{self._node.name}/trace", self._tree.observe)
        self._saved.restore(self.finished)
        self._node.start()
        importlib.import_module("scipy.signal")  # after start-up was reported, but before the first request needs it

    def _serve(self) -> None:
        self._node.input_port("Audio", self._connect_audio)
        self._node.activity("InputProc", self._input_proc)
        for kind in KINDS.values():
            if kind.parent:
                check = functools.partial(self._check_creation, kind)
                self._node.activity(kind.request, self._handler(kind), check)
        self._node.function("getSignals", self._get_signals)
        self._node.function("getParameters", lambda _: {"parameters": responses.parameters(self._tree.processors)})
        self._node.function("getProcessors", self._get_processors)
        self._node.function("getRepresentation", self._get_representation)
        self._node.function("getDependencies", lambda v: {"dependencies": self._tree.dependencies(v["nameProc"])})
        self._node.function("modifyParameter", self._modify_parameter)
        self._node.function("removeProcessor", self._remove_processor)
        self._node.function("Stop", self._stop)
        self._node.function("request", TreeRequestService(self._node, lambda: self._audio.topic).build, waits=True)

    def shutdown(self, by: str) -> None:
        """End all processors."""
        self._saved.close()
        self._node.shutdown(by)
        self._tree.stop()

    def _warn(self, line: str) -> None:
        rospy.logwarn(line)
        self._node.diagnostics.changed()

    def _connect_audio(self, topic: str) -> None:
        self._audio.connect(topic)
        self._saved.save()

    # --- creation of processors ---

    def _input_proc(self, activity: Activity, values: dict[str, Any], restored: bool = False) -> None:
        if not values["name"]:
            raise ROSAFE.error("e_badNewValue", what="name: expected the name of a processor, got ''")
        activity.interrupt_waiting()
        frames = values["nFramesPerBlock"]
        reader = self._audio.open_reader(frames, activity.stop_requested.is_set)
        if reader is None:
            activity.raise_if_interrupted()
            raise ROSAFE.error("e_noData", f"no audio from {self._audio.topic}: is bass acquiring?")
        reader.next_output = self._published.next_output
        try:
            with self._starting:
                activity.raise_if_interrupted()
                buffers = values["bufferSize_s_port"], values["bufferSize_s_getSignal"]
                parameters = {p.name: values[p.name] for p in KINDS["input"].parameters if p.name in values}
                processor = self._tree.add_input(values["name"], reader, frames, *buffers, parameters)
                self._input_values = {p.name: values[p.name] for p in BLOCK_AND_BUFFERS}
                if not restored:
                    self._saved.discard()
        except BaseException:
            reader.stop()
            raise
        activity.interrupt_others()
        self._published.run(activity, processor, self._saved.save)

    def _check_creation(self, kind: Representation, values: dict[str, Any]) -> dict[str, Any]:
        """Check, in the original's order, that the parent exists, the name is free, and the parent's kind is right."""
        name = values["name"]
        self._tree.check(kind.kind, name, values["upperDepName"])
        if len(name) > MAX_STRING or not re.fullmatch(r"\w+(/\w+)*", name, re.ASCII):
            what = f"name: {short_repr(name)} also names a topic; use only letters, digits and _"
            raise ROSAFE.error("e_badNewValue", what=what)
        return values

    def _handler(self, kind: Representation) -> Handler:
        def handle(activity: Activity, values: dict[str, Any]) -> None:
            values_of_kind = {p.name: values[p.name] for p in kind.parameters if p.name in values}
            requested = STAGES[kind.kind].request_values(values_of_kind)
            warnings: dict[str, str] = {}
            resolve = self._choices.resolving(warnings)
            parameters = {p.name: resolve(p, requested[p.name]) for p in kind.parameters if p.name in requested}
            processor = self._tree.add(kind.kind, values["name"], values["upperDepName"], parameters)
            activity.warning = self._choices.note(processor, warnings)
            self._published.run(activity, processor, self._saved.save)

        return handle

    # --- other services ---

    def _setup_processors(self) -> tuple[SetupProcessor, ...]:
        """Return the processors of the tree as a setup describes them."""
        found = [processor.ask(self._describe) for processor in self._tree.processors]
        return tuple(setup_processor(processor) for processor in found if processor is not None)

    def _describe(self, processor: Processor) -> ExistingProcessor:
        parent = processor.parent
        values = processor.stage.parameters | (self._input_values if parent is None else {})
        return ExistingProcessor(processor.name, processor.kind, parent.name if parent is not None else "", values)

    def _get_signals(self, values: dict[str, Any]) -> dict[str, Any]:
        if self._audio.ring.catch_up():
            self._tree.wait_idle(CATCH_UP_SECONDS)
        return responses.response("getSignals", signals=responses.signals(self._tree.processors))

    def _get_processors(self, values: dict[str, Any]) -> dict[str, Any]:
        structs = responses.descriptions(self._tree.processors, self._node.name, self._input_values)
        return responses.response("getProcessors", processors=structs)

    def _get_representation(self, values: dict[str, Any]) -> dict[str, Any]:
        return responses.response("getRepresentation", parts=responses.representation(self._tree.find(values["name"])))

    def _modify_parameter(self, values: dict[str, Any]) -> dict[str, Any]:
        warnings: dict[str, str] = {}
        resolve = self._choices.resolving(warnings)
        processor = self._tree.modify(values["nameProc"], values["nameParam"], values["newValue"], resolve)
        self._saved.save()
        return {"warning": self._choices.note(processor, warnings)}

    def _remove_processor(self, values: dict[str, Any]) -> None:
        self._tree.remove(values["name"])
        self._saved.save()

    def _stop(self, values: dict[str, Any]) -> None:
        self._saved.discard()
        self._tree.stop()
        self._saved.save()


def _report_plugins(status: Any) -> Any:
    """Fill in a status of /diagnostics."""
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


def _keep_path(path: str) -> Path | None:
    """Return the file for the tree: `path`, or else the private ROS parameter `keep`."""
    if not path:
        path = str(rospy.get_param("~keep", ""))
        if path and not path.endswith((".yaml", ".yml")):  # any client of the master can set it to any file
            name = rospy.resolve_name("~keep")
            raise ROSAFE.error("e_badNewValue", what=f"ROS parameter {name}: expected FILE.yaml, got {path!r:.300}")
    return Path(os.path.expanduser(path)).absolute() if path else None


def _workers() -> int:
    """Return the number of workers: the private ROS parameter `workers`, else the environment, else one per core."""
    workers = rospy.get_param("~workers", None)
    if isinstance(workers, bool) or not isinstance(workers, int | str | None):
        workers = str(workers)
    try:
        return workers_to_use(workers)
    except ValueError as problem:
        source = "" if workers is None else f"the parameter {rospy.resolve_name('~workers')}: "
        raise ROSAFE.error("e_badNewValue", what=f"{source}{problem}") from None


def main(argv: list[str] | None = None) -> int:
    """Run `rosAFE-ros` and return its exit code."""
    return run_server(interface.ROSAFE, RosafeNode, argv, kernels.compiled, OPTIONS)
