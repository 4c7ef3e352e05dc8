"""The md5 sums of all messages, services and actions; clients and bags of the original remain compatible."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import tomllib

from rosafe import interface

SUMS = tomllib.loads(Path(__file__).with_name("md5.toml").read_text("utf-8"))


def listed(kind: str) -> list[tuple[str, str]]:
    """Return the packages and names of messages, services or actions."""
    return [(package, name) for package, sums in SUMS[kind].items() for name in sums]


def md5(package: str, kind: str, name: str) -> str:
    return str(getattr(importlib.import_module(f"{package}.{kind}"), name)._md5sum)


@pytest.mark.parametrize(("package", "name"), listed("messages"))
def test_message(package: str, name: str) -> None:
    assert md5(package, "msg", name) == SUMS["messages"][package][name]


@pytest.mark.parametrize(("package", "name"), listed("services"))
def test_service(package: str, name: str) -> None:
    assert md5(package, "srv", name) == SUMS["services"][package][name]


@pytest.mark.parametrize(("package", "name"), listed("actions"))
def test_action(package: str, name: str) -> None:
    found = [md5(package, "msg", name + part) for part in ("Action", "Goal", "ActionGoal")]
    assert found == SUMS["actions"][package][name]
    common = SUMS["actions_common"]
    assert {part: md5(package, "msg", name + part) for part in common} == common


def test_all_services_and_actions_are_covered() -> None:
    functions = {(c.name, s.name) for c in interface.COMPONENTS.values() for s in c.on_graph if not s.activity}
    later = {kind.request for kind in interface.KINDS.values() if kind.kind not in interface.CORE_REPRESENTATIONS}
    activities = {(c.name, s.name) for c in interface.COMPONENTS.values() for s in c.activities if s.name not in later}
    assert functions == set(listed("services"))
    assert activities == set(listed("actions"))
