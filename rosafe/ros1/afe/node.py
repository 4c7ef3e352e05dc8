"""The rosAFE node: its services on the processor tree, its ports, its diagnostics."""

from __future__ import annotations

import functools
import importlib
import os
import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe import interface
from rosafe.declarations import ros_names
from rosafe.declarations.parameter import MAX_STRING
from rosafe.declarations.text import short_repr
from rosafe.dsp import kernels
from rosafe.interface import KINDS, REQUEST, ROSAFE, ComponentError, Representation
from rosafe.representations import PLUGINS, PROBLEMS, STAGES, WARNINGS
from rosafe.ros1.afe import messages
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.afe.choice_fallbacks import ChoiceFallbacks
from rosafe.ros1.afe.published_tree import PublishedTree
from rosafe.ros1.afe.saved_tree import SavedTree
from rosafe.ros1.afe.trace_port import TracePort
from rosafe.ros1.component import serialization
from rosafe.ros1.component.activities import Activity, Handler
from rosafe.ros1.component.component import ComponentNode
from rosafe.ros1.component.startup import run_server
from rosafe.tree.block import Source
from rosafe.tree.processor import Processor
from rosafe.tree.setups import Setup, SetupError, dry_run, plan, read, read_parameters, setup_processor, write
from rosafe.tree.tree_builder import RequestResult, TreeBuilder
from rosafe.tree.tree_planner import NewProcessor, TreePlan, kind_of
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
AUDIO = "Audio"  # the input port
INPUT_PROC = ROSAFE.service("InputProc")
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
        self._published = PublishedTree(self._node, _workers(), self._choices, self._audio.ring.captured)
        self._tree = self._published.tree
        self._builder = TreeBuilder(self._tree, self._start_activity)
        self._loading = threading.Lock()  # one setup at a time, as each may connect the port to another topic
        self._saved = SavedTree(
            _keep_path(keep),
            self._audio,
            self._describe_tree,
            lambda planner: self._builder.build(planner, self._open_input),
            lambda: any(activity.service is INPUT_PROC for activity in self._node.activities.live()),
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
        self._node.function("getParameters", lambda _: {"parameters": messages.parameters(self._tree.processors)})
        self._node.function("getProcessors", self._get_processors)
        self._node.function("getRepresentation", self._get_representation)
        self._node.function("getDependencies", lambda v: {"dependencies": self._tree.dependencies(v["nameProc"])})
        self._node.function("modifyParameter", self._modify_parameter)
        self._node.function("removeProcessor", self._remove_processor)
        self._node.function("Stop", self._stop)
        self._node.function("request", self._request, waits=True)
        self._node.function("find", lambda v: self._response(self._builder.find(_request_values(v))), waits=True)
        self._node.function("saveSetup", lambda v: {"setup": write(self._describe_tree(), v["full"])}, waits=True)
        self._node.function("loadSetup", self._load_setup, waits=True)
        self._node.function("removeUnused", self._remove_unused)

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

    def _input_proc(self, activity: Activity, values: dict[str, Any]) -> None:
        name, frames, *buffers = values.values()  # in the order of their declaration
        if not name:
            raise ROSAFE.error("e_badNewValue", what="name: expected the name of a processor, got ''")
        activity.interrupt_waiting()

        def create(reader: Source) -> Processor:
            with self._tree.lock:
                activity.raise_if_interrupted()  # then it must not replace the tree of a newer one
                return self._tree.add_input(name, reader, frames, *buffers)

        self._run_input(activity, frames, create)

    def _run_input(self, activity: Activity, frames: int, create: Callable[[Source], Processor | None]) -> None:
        """Wait for sound, and run the input that `create` adds to the tree; it may return None instead."""
        reader = self._audio.open_reader(frames, activity.stop_requested.is_set)
        if reader is None:
            activity.raise_if_interrupted()
            raise ROSAFE.error("e_noData", f"no audio from {self._audio.topic}: is bass acquiring?")
        try:
            activity.raise_if_interrupted()
            processor = create(reader)
        except BaseException:
            reader.stop()
            raise
        if processor is not None:
            self._saved.discard()
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

    # --- whole trees ---

    def _request(self, values: dict[str, Any]) -> dict[str, Any]:
        explicit = _request_values(values)
        open_input = functools.partial(self._open_input, topic=explicit.get("connect", ""))
        result = self._builder.request(explicit, open_input)
        self._saved.save()
        return self._response(result)

    def _response(self, result: RequestResult) -> dict[str, Any]:
        outputs, kind = result._asdict(), KINDS[result.kind]
        del outputs["kind"]
        return {**outputs, "port": kind.port, "topic": ros_names.port_topic(self._node.name, kind, result.name)}

    def _describe_tree(self) -> Setup:
        topic = self._audio.topic
        connections = {AUDIO: ros_names.relative(topic, self._node.name)} if topic else {}
        return Setup(None, connections, tuple(map(setup_processor, self._builder.processors())))

    def _load_setup(self, values: dict[str, Any]) -> dict[str, Any]:
        try:
            setup = read(values["setup"])
        except SetupError as problem:
            raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
        if values["check"]:
            planned = self._check_setup(setup)
        else:
            with self._loading:
                self._check_setup(setup)
                planned = self._build_setup(setup)
            self._saved.save()
        return {"created": planned.created, "reused": planned.reused}

    def _topic(self, setup: Setup) -> str:
        """Return the topic that a setup names for the Audio port; empty if it names none."""
        return ros_names.resolve(setup.connections[AUDIO], self._node.name) if setup.connections else ""

    def _check_setup(self, setup: Setup) -> TreePlan:
        """Return the plan of a setup. Raises ComponentError if it cannot be loaded, as far as this is known."""
        with self._tree.lock:
            topic, connected = self._topic(setup), self._audio.topic
            planned = plan(setup, self._builder.processors())
            rate = setup.sound.values["sampleRate"] if setup.sound is not None else 0.0
            if self._tree.input is not None:
                rate = self._tree.sample_rate
                if topic and connected and topic != connected:
                    what = f"the tree is connected to {connected}, the setup expects {topic}; call Stop first"
                    raise ROSAFE.error("e_existsAlready", what=what)
        if rate:
            dry_run(setup, rate)
        return planned

    def _build_setup(self, setup: Setup) -> TreePlan:
        """Connect the port and create the processors. If they cannot be created, connect the previous topic again."""
        topic, previous = self._topic(setup), self._audio.topic
        if topic == previous:
            topic = ""
        if topic:
            self._connect(topic)
        try:
            return self._builder.build(functools.partial(plan, setup), self._open_input)
        except BaseException:
            if topic and previous:
                self._connect_audio(previous)
            raise

    def _remove_unused(self, values: dict[str, Any]) -> dict[str, Any]:
        removed = self._builder.remove_unused(values["names"])
        self._saved.save()
        return {"removed": removed}

    def _open_input(self, new: NewProcessor, create: Callable[[Source], Processor | None], topic: str = "") -> None:
        """Let an activity InputProc wait for sound from `topic`, create the input, and run it: see `OpenInput`."""
        self._connect(topic)
        frames = new.input_values["nFramesPerBlock"]
        activity = self._node.activities.start(
            INPUT_PROC, lambda activity, _: self._run_input(activity, frames, create), {}, None
        )
        activity.begun.wait()
        error = activity.error
        if error is not None and (error.ex, error.detail.get("by")) != ("::genom::interrupted", INPUT_PROC.name):
            raise error
        for other in self._node.activities.live() if error is not None else ():
            if other.service is INPUT_PROC:  # it is newer, and may wait for sound
                other.begun.wait()

    def _connect(self, topic: str) -> None:
        """Connect the Audio port to `topic`; if this is empty, to bass/Audio, unless it is connected already."""
        if topic or not self._audio.topic:
            remote = topic or REQUEST.parameter("connect").default
            try:
                self._node.call_service("connect_port", {"local": AUDIO, "remote": remote})
            except ComponentError as problem:
                if topic or problem.ex != "::genom::no_such_outport":
                    raise

    def _start_activity(self, processor: Processor) -> None:
        """Start the activity of a processor that a request for a whole tree has created."""

        def run(activity: Activity, _: dict[str, Any]) -> None:
            self._choices.note(processor, {})
            self._published.run(activity, processor, self._saved.save)

        service = ROSAFE.service(processor.representation.request)
        self._node.activities.start(service, run, {}, None)

    # --- other services ---

    def _get_signals(self, values: dict[str, Any]) -> dict[str, Any]:
        if self._audio.ring.catch_up():
            self._tree.wait_idle(CATCH_UP_SECONDS)
        return messages.response("getSignals", signals=messages.signals(self._tree.processors))

    def _get_processors(self, values: dict[str, Any]) -> dict[str, Any]:
        structs = messages.descriptions(self._tree.processors, self._node.name, self._tree.input_values)
        return messages.response("getProcessors", processors=structs)

    def _get_representation(self, values: dict[str, Any]) -> dict[str, Any]:
        return messages.response("getRepresentation", parts=messages.representation(self._tree.find(values["name"])))

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


def _request_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of `interface.REQUEST` in a request of ROS, whose empty fields count as not given."""
    try:
        kind_of(values["representation"])
        explicit = {**read_parameters(values["parameters"]), "representation": values["representation"]}
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
    return explicit | ({"connect": values["connect"]} if values["connect"] else {})


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
