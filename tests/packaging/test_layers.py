"""Imports point down: what each folder of `rosafe` stands on, and nothing else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness import ROOT

PACKAGE = ROOT / "rosafe"
_NUMERICS = {"declarations", "dsp", "representations"}
STANDS_ON: dict[str, set[str]] = {
    "declarations": set(),
    "vocabulary": {"declarations"},
    "sound": set(),
    "dsp": {"declarations"},
    "plugin": {"declarations", "dsp"},
    "representations": {"declarations", "dsp"},
    "interface": _NUMERICS,
    "tree": {*_NUMERICS, "interface"},
    "setups": {*_NUMERICS, "interface", "tree"},
    "offline": {*_NUMERICS, "interface", "tree", "sound"},
    "transport": {"declarations", "interface"},
    "component": {"declarations", "representations", "interface", "tree", "sound", "transport"},
    "node": {*_NUMERICS, "interface", "tree", "component", "transport", "sound", "setups"},
    "bass": {"declarations", "interface", "component", "transport", "sound"},
    "http_server": set(),
    "client": {"declarations", "interface", "tree", "component", "transport", "setups"},
    "genomix": {"declarations", "interface", "tree", "component", "transport", "client", "http_server"},
    "eltclsh": {"declarations", "interface", "component", "transport", "client", "genomix"},
    "view": {"interface", "sound"},
    "live": {
        *("declarations", "interface", "tree", "component", "transport", "bass", "http_server", "client", "genomix"),
        *("view", "sound"),
    },
    "demo": {*_NUMERICS, "interface", "tree", "component", "transport", "bass", "sound", "view", "offline"},
}
TOP = {"commands", "testing", "ros", "__init__"}  # may use everything
EVERYWHERE = {"version", "output", "input", "missing", "terminal", "streams"}


def imports(path: Path) -> Iterator[str]:
    """The folders and modules of rosafe that a file imports, by their first name."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = path.parents[node.level - 1].relative_to(ROOT).as_posix().replace("/", ".")
            names = [f"{base}.{node.module or ''}"]
        for name in names:
            words = name.split(".")
            if words[0] == "rosafe" and len(words) > 1:
                yield words[1]


@pytest.mark.parametrize("folder", STANDS_ON)
def test_imports_point_down(folder: str) -> None:
    wrong = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in (PACKAGE / folder).rglob("*.py")
        for name in imports(path)
        if name not in STANDS_ON[folder] | {folder} | EVERYWHERE
    }
    assert not wrong


def test_every_folder_has_its_place() -> None:
    names = {path.stem for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert names == STANDS_ON.keys() | TOP | EVERYWHERE


@pytest.mark.parametrize("folder", STANDS_ON)
def test_there_is_no_circle(folder: str) -> None:
    def below(name: str) -> set[str]:
        return STANDS_ON[name].union(*map(below, STANDS_ON[name]))

    assert folder not in below(folder)


def test_every_file_says_what_lives_there() -> None:
    silent = [
        str(path.relative_to(ROOT))
        for path in PACKAGE.rglob("*.py")
        if not (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "")
    ]
    assert not silent
