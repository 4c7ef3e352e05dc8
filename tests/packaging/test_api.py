"""The stable API of docs/api.md is that of the code."""

from __future__ import annotations

import inspect
import re
from operator import attrgetter

import pytest

import rosafe
from rosafe.interface import KINDS
from rosafe.system.version import VERSION
from tests.harness import ROOT

MANIFESTS = ("package.xml", "bass/package.xml", "ros2/rosafe_msgs/package.xml", "ros2/rosafe_ros2/package.xml")


def listed() -> dict[str, tuple[str, str]]:
    """Return the arguments and the first version of each name in docs/api.md."""
    section = (ROOT / "docs" / "api.md").read_text("utf-8").split("\n## ")[1]
    rows = re.findall(r"^\| `([\w.]+)` \| (?:`(.*)` )?\| ([0-9.]+) \|$", section, re.MULTILINE)
    assert len(rows) == section.count("\n|") - 2
    return {name: (arguments, version) for name, arguments, version in rows}


def arguments_of(name: str) -> str:
    """Return the arguments of a function, class or method, with their defaults; "" for other values."""
    value = attrgetter(name)(rosafe)
    if not callable(value):
        return ""
    of_instance = "." in name and not inspect.ismethod(value)  # a method, not a class method
    parameters = [*inspect.signature(value).parameters.values()][of_instance:]
    bare = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in parameters]
    return str(inspect.Signature(bare))[1:-1]


def release(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")[:2]))


def test_names_are_those_of_the_package() -> None:
    functions = {name for name in listed() if "." not in name}
    assert functions == set(rosafe.__all__) == set(dir(rosafe)) - {"__doc__", *KINDS}


def test_arguments() -> None:
    """Names, order, defaults, and whether they are accepted by position."""
    for name, (arguments, _) in listed().items():
        assert arguments == arguments_of(name), name


def test_methods_are_those_of_the_library_page() -> None:
    library = (ROOT / "docs" / "library.rst").read_text("utf-8")
    for name in set(listed()) & set(rosafe.__all__):
        found = re.search(rf"autoclass:: rosafe\.{name}\n   :members:(.*)", library)
        public = {member for member in vars(getattr(rosafe, name)) if not member.startswith("_")} if found else set()
        described = set(found[1].replace(",", " ").split()) or public if found else set()
        assert {f"{name}.{member}" for member in described} == {n for n in listed() if n.startswith(f"{name}.")}
        assert described <= public


def test_versions() -> None:
    """The names of 0.2 that remain."""
    first = {name: release(version) for name, (_, version) in listed().items()}
    major, minor = release(VERSION)[:2]
    unreleased = "## Unreleased" in (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert max(first.values()) <= (major, minor + unreleased)
    of_0_2 = {"process", "Stream", "load", "plot", "to_xarray", "__version__"}
    of_0_2 |= {f"Stream.{method}" for method in ("process", "reset", "modify", "describe")}
    assert {name for name, version in first.items() if version <= (0, 2)} == of_0_2
    assert {name for name, version in first.items() if version == (0, 4)} == {"Head.pair", "Localizer.updated_at"}


@pytest.mark.parametrize(
    ("file", "line"),
    [
        *((path, f"  <version>{VERSION}</version>") for path in MANIFESTS),
        ("CITATION.cff", f"version: {VERSION}"),
        ("SECURITY.md", f"| {VERSION.rpartition('.')[0]} | yes |"),
    ],
)
def test_files_that_name_the_version(file: str, line: str) -> None:
    assert line in (ROOT / file).read_text("utf-8").splitlines()


def test_the_date_of_the_version() -> None:
    [date] = re.findall("^date-released: '([0-9-]+)'$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
    assert f"## {VERSION} ({date})" in (ROOT / "CHANGELOG.md").read_text("utf-8").splitlines()
