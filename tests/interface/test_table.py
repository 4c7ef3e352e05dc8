"""The interface table: types, defaults, tasks and exceptions, and the fields of messages of ROS 2.

test_files.py compares the .msg, .srv and .action files with it, test_md5.py their sums with those of the original.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rosafe import interface
from rosafe.declarations.idl import SCALARS
from rosafe.interface import BASS, ROSAFE, ComponentSpec, Service
from tests import harness

FOLDERS = {"rosAFE": harness.ROOT, "bass": harness.ROOT / "bass"}
OF_ROS_2 = harness.ROOT / "ros2" / "rosafe_msgs"
COMPONENTS = pytest.mark.parametrize("component", interface.COMPONENTS.values(), ids=lambda c: c.name)
PAIRS = [(component, service) for component in interface.COMPONENTS.values() for service in component.on_graph]
SERVICES = pytest.mark.parametrize(("component", "service"), PAIRS, ids=lambda x: x.name)


def parts(path: Path) -> list[list[tuple[str, str]]]:
    """Return the (type, name) pairs of each part of an interface file."""
    found: list[list[tuple[str, str]]] = [[]]
    for line in path.read_text("utf-8").splitlines():
        line = line.split("#")[0].strip()
        if line == "---":
            found.append([])
        elif line:
            kind, name = line.split()
            found[-1].append((kind, name))
    return found


@COMPONENTS
def test_ports_and_outputs_have_types(component: ComponentSpec) -> None:
    used = [p.idl for p in component.ports] + [idl for s in component.on_graph for _, idl in s.outputs]
    for idl in used:
        base = idl.removeprefix("sequence<").removesuffix(">")
        assert base in component.structs or base in SCALARS, idl


# The requests of representations that the original did not have.
LATER = {kind.request: kind for kind in interface.KINDS.values() if kind.kind not in interface.CORE_REPRESENTATIONS}

# The defaults of the original, in its order; REQUIRED if a parameter has no default.
DEFAULTS = {
    "InputProc": ["input", 12000, 1, 1],
    "PreProc": ["preProc", "input", False, 20, False, 0.97, False, 0.5, False, 100, False, "jepsen", False],
    "GammatoneProc": ["gammatone", "preProc", "gammatone", 80, 8000, 1, 0, (), 4, 1.018],
    "IhcProc": ["ihc", "gammatone", "dau"],
    "IldProc": ["ild", "ihc", "hann", 0.02, 0.01],
    "RatemapProc": ["ratemap", "ihc", "hann", 0.02, 0.01, "power", 0.008],
    "CrossCorrelationProc": ["crosscorrelation", "ihc", 0.02, 0.01, 0.0011, "hann"],
    "getSignals": [],
    "getDependencies": ["nameProc"],
    "getParameters": [],
    "getProcessors": [],
    "getRepresentation": ["name"],
    "modifyParameter": ["nameProc", "nameParam", "newValue"],
    "removeProcessor": ["name"],
    "request": [interface.REQUIRED, "", ""],
    "find": [interface.REQUIRED, "", ""],
    "saveSetup": [False],
    "loadSetup": [interface.REQUIRED, False],
    "removeUnused": [()],
    "Acquire": ["hw:1,0", 44100, 2205, 20],
    "DedicatedSocket": [],
    "CloseSocket": [],
    "ListDevices": [],
    "getAcquisition": [],
    "Stop": [],
    "kill": [],
    "connect_port": [interface.REQUIRED] * 2,
    "connect_service": [interface.REQUIRED] * 2,
    "abort_activity": [interface.REQUIRED],
}


@SERVICES
def test_defaults(component: ComponentSpec, service: Service) -> None:
    if service.name in LATER:
        kind = LATER[service.name]
        parent = interface.KINDS[kind.parent]
        assert [p.default for p in service.parameters] == [
            kind.name,
            parent.name,
            *(p.default for p in kind.parameters),
        ]
    else:
        assert [p.default for p in service.parameters] == DEFAULTS[service.name]


@SERVICES
def test_defaults_pass_their_own_check(component: ComponentSpec, service: Service) -> None:
    for parameter in service.parameters:
        if parameter.default is not interface.REQUIRED:
            parameter.check(parameter.default)


def test_parameter_structs_hold_the_parameters_of_the_requests() -> None:
    for kind in interface.KINDS.values():
        request = {p.name for p in ROSAFE.service(kind.request).parameters}
        own = {p.name for p in kind.parameters}
        assert own <= request or kind.kind == "input", kind.kind


def test_tasks() -> None:
    assert ROSAFE.tasks[:8] == (
        *("init", "input", "preProc", "gammatoneProc", "ihcProc", "ildProc", "ratemapProc", "crossCorrelationProc"),
    )
    assert set(ROSAFE.tasks[8:]) == {request[:1].lower() + request[1:] for request in LATER}
    assert BASS.tasks == ("capture", "socket")
    for component in interface.COMPONENTS.values():
        assert {s.task for s in component.activities} <= set(component.tasks)


def test_exceptions() -> None:
    assert list(ROSAFE.exceptions) == [
        *("e_noData", "e_noMemory", "e_existsAlready", "e_noSuchProcessor", "e_noSuchParameter"),
        *("e_noUpperDependencie", "e_badIndexParam", "e_badNewValue"),
    ]
    assert list(BASS.exceptions) == ["e_nomem", "e_nodevice", "e_device", "e_hwparams", "e_swparams"]
    for component, service in PAIRS:
        for thrown in service.throws:
            _, owner, short = thrown.split("::")
            known = interface.GENOM_EXCEPTIONS if owner == "genom" else component.exceptions
            assert short in known, f"{service.name} throws {thrown}"


@pytest.mark.parametrize(
    ("package", "name"), [(c.name, name) for c in interface.COMPONENTS.values() for name in c.messages]
)
def test_messages_of_ros_2_have_the_fields_of_ros_1(package: str, name: str) -> None:
    (own,) = parts(FOLDERS[package] / "msg" / f"{name}.msg")
    others = {"Header": "std_msgs/Header", "time": "builtin_interfaces/Time"}
    expected = [(others.get(kind, kind), field.replace("frameIndex", "frame_index")) for kind, field in own]
    (found,) = parts(OF_ROS_2 / "msg" / f"{name}.msg")
    assert found[: len(expected)] == expected
    assert all(field == field.lower() for _, field in found)


def test_files_of_ros_2_are_listed() -> None:
    listed = re.findall(r'^  "(\w+/\w+\.\w+)"$', (OF_ROS_2 / "CMakeLists.txt").read_text("utf-8"), re.MULTILINE)
    assert listed == sorted(f"{path.parent.name}/{path.name}" for path in OF_ROS_2.glob("[ms][sr][gv]/*"))
