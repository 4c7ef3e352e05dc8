"""A model of rosAFE for `rosafe.tree.tree_builder`: services that respond as the node's, without sound."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.interface import KINDS, ROSAFE, ComponentError, format_value
from rosafe.representations import STAGES
from rosafe.tree.tree_builder import Turns

RATE = 44100.0
KIND_OF_SERVICE = {kind.request: kind for kind in KINDS.values()}


@dataclass
class Processor:
    """One processor of the model."""

    kind: str
    parent: str
    stage: Stage


class Model:
    """A component with its processors by name and the calls it got; the call number `fail` fails."""

    def __init__(self, audio: bool = True, sample_rate: float = RATE) -> None:
        self.node = "/rosAFE"
        self.turns = Turns()
        self.sample_rate = sample_rate
        self.processors: dict[str, Processor] = {}
        self.calls: list[str] = []
        self.answers: list[asyncio.Task[Mapping[str, Any]]] = []
        self.connected = ""
        self.audio = audio
        self.fail: dict[int, ComponentError] = {}
        self.cancel: dict[int, asyncio.Task[Any]] = {}  # to cancel during the call of that number

    # --- as a component ---

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        # A component completes a request even if the caller no longer waits for the answer.
        call = asyncio.create_task(self._answer(len(self.calls), service, values))
        self.calls.append(service)
        self.answers.append(call)
        return await asyncio.shield(call)

    async def _answer(self, number: int, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        if number in self.cancel:
            self.cancel[number].cancel()
        await asyncio.sleep(0)  # other clients run
        if number in self.fail:
            raise self.fail[number]
        if service == "InputProc" and "InputProc" in self.calls[number + 1 :]:
            raise ComponentError("::genom::interrupted", by="InputProc")  # of two at once, the first
        result: Mapping[str, Any] = getattr(self, f"_{service}", self._make)(service, values)
        await asyncio.sleep(0)
        return result

    async def port_connected(self, port: str) -> str:
        assert port == "Audio"
        return self.connected and f"/{self.connected.removeprefix('/')}"

    async def published(self, topic: str) -> bool:
        return topic in ("/bass/Audio", "/left/Audio")

    # --- its services ---

    def _connect_port(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
        self.connected = values["remote"]
        return {}

    def _make(self, service: str, values: Mapping[str, Any]) -> dict[str, Any]:
        given = ROSAFE.service(service).from_ros(SimpleNamespace(**values), literal=True)
        kind, name, parent = KIND_OF_SERVICE[service], given.pop("name"), given.pop("upperDepName", "")
        if not parent:
            if not (self.audio and self.connected):
                raise ROSAFE.error("e_noData")
            self._replace_input(name)
            given = {}
        elif getattr(self.processors.get(parent), "kind", "") != kind.parent:
            raise ROSAFE.error("e_noUpperDependencie")
        if name in self.processors:
            raise ROSAFE.error("e_existsAlready")
        try:
            checked = {p.name: p.check(given[p.name]) for p in kind.parameters if p.name in given}
            comes: SignalFormat | float = self.processors[parent].stage.output_format if parent else self.sample_rate
            self.processors[name] = Processor(kind.kind, parent, STAGES[kind.kind](comes, **checked))
        except ValueError as problem:
            raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
        return {}

    def _replace_input(self, name: str) -> None:
        """The children of an existing input become children of the new one."""
        for old in [other for other, processor in self.processors.items() if not processor.parent]:
            del self.processors[old]
            for processor in self.processors.values():
                processor.parent = name if processor.parent == old else processor.parent

    def _getProcessors(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "processors": [
                {
                    "name": name,
                    "kind": processor.kind,
                    "rate": processor.stage.output_format.rate,
                    "upperDepName": processor.parent,
                    "parameters": [
                        {"name": parameter, "value": format_value(value)}
                        for parameter, value in {**processor.stage.parameters, **processor.stage.derived}.items()
                    ],
                }
                for name, processor in self.processors.items()
            ]
        }

    def _modifyParameter(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
        processor = self._find(values["nameProc"])
        parameter = KINDS[processor.kind].parameter(values["nameParam"])
        try:
            processor.stage.configure(**{parameter.name: parameter.read(values["newValue"])})
        except ValueError as problem:
            raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
        return {}

    def _removeProcessor(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
        assert self._find(values["name"]).parent
        gone = [name for name in self.processors if values["name"] in self.line(name)]
        for name in gone:
            del self.processors[name]
        return {}

    def _Stop(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
        self.processors.clear()
        return {}

    # --- looking at it ---

    def _find(self, name: str) -> Processor:
        if name not in self.processors:
            raise ROSAFE.error("e_noSuchProcessor")
        return self.processors[name]

    def line(self, name: str) -> Iterator[str]:
        """Return the names from a processor up to the input."""
        while name:
            yield name
            name = self._find(name).parent

    def state(self) -> dict[str, tuple[str, str, dict[str, Any]]]:
        """The complete state, for comparison."""
        return {name: (p.kind, p.parent, p.stage.parameters) for name, p in self.processors.items()}
