"""The stable API of docs/api.md is that of the code."""

from __future__ import annotations

import inspect
import re

import rosafe
from rosafe.version import VERSION
from tests.harness import ROOT


def listed() -> dict[str, tuple[str, str]]:
    """Return the arguments and the first version of each name in docs/api.md."""
    section = (ROOT / "docs" / "api.md").read_text("utf-8").split("\n## ")[1]
    rows = re.findall(r"^\| `(\w+)` \| ?(.*?) ?\| ([0-9.]+) \|$", section, re.MULTILINE)
    return {name: (arguments, version) for name, arguments, version in rows}


def release(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")[:2]))


def test_names_are_those_of_the_package() -> None:
    assert set(listed()) == set(rosafe.__all__) == set(dir(rosafe)) - {"__doc__"}
    for name in listed():
        assert getattr(rosafe, name) is not None


def test_arguments() -> None:
    """The first arguments keep their names and order; new ones come after them, are optional, and are listed, too."""
    for name, (arguments, _) in listed().items():
        value = getattr(rosafe, name)
        found = ", ".join(inspect.signature(value).parameters) if callable(value) else ""
        assert arguments == found, name


def test_versions() -> None:
    """The names of 0.2 still exist: their removal requires a release with a warning."""
    first = {name: release(version) for name, (_, version) in listed().items()}
    assert max(first.values()) <= max(release(VERSION), (0, 3))
    of_0_2 = {"process", "Stream", "load", "plot", "to_xarray", "__version__"}
    assert {name for name, version in first.items() if version <= (0, 2)} == of_0_2
