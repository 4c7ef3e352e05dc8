"""Imports point down: each folder of `rosafe` imports only the folders listed for it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness import ROOT

PACKAGE = ROOT / "rosafe"
_NUMERICS = {"declarations", "dsp", "representations"}
ALLOWED_IMPORTS: dict[str, set[str]] = {
    "declarations": set(),
    "sound": set(),
    "dsp": {"declarations"},
    "plugin": {"declarations", "dsp"},
    "representations": {"declarations", "dsp"},
    "interface": _NUMERICS,
    "tree": {*_NUMERICS, "interface"},
    "setups": {*_NUMERICS, "interface", "tree"},
    "offline": {*_NUMERICS, "interface", "tree", "sound"},
    "localization": {*_NUMERICS, "interface", "tree", "sound", "offline", "setups"},
    "validation": {"declarations", "dsp", "interface", "offline", "localization", "view"},
    "transport": {"declarations", "interface"},
    "component": {"declarations", "representations", "interface", "tree", "sound", "transport"},
    "ros": {"component", "interface"},
    "node": {*_NUMERICS, "interface", "tree", "component", "transport", "sound", "setups"},
    "bass": {"declarations", "interface", "component", "transport", "sound", "localization"},
    "http_server": set(),
    "client": {"declarations", "interface", "tree", "component", "transport", "setups"},
    "genomix": {"declarations", "interface", "tree", "component", "transport", "client", "http_server"},
    "localizer_node": {
        *("declarations", "dsp", "interface", "tree", "sound", "localization", "transport", "component", "client"),
        "ros",
    },
    "eltclsh": {"declarations", "interface", "component", "transport", "client", "genomix"},
    "view": {"interface"},
    "live": {
        *("declarations", "interface", "tree", "component", "transport", "bass", "http_server", "client", "genomix"),
        *("view", "sound", "localization"),
    },
    "demo": {"declarations", "interface", "component", "transport", "bass", "sound", "view", "localization"},
}
TOP = {"commands", "testing", "__init__"}  # may use everything
EVERYWHERE = {"py", "version", "output", "input", "missing", "terminal", "streams", "option_types", "trust"}


def imports(path: Path) -> Iterator[str]:
    """Yield the folders and modules of rosafe that a file imports, by their first name."""
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
            parts = name.split(".")
            if parts[0] == "rosafe" and len(parts) > 1:
                yield parts[1]


@pytest.mark.parametrize("folder", ALLOWED_IMPORTS)
def test_imports_point_down(folder: str) -> None:
    wrong = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in (PACKAGE / folder).rglob("*.py")
        for name in imports(path)
        if name not in ALLOWED_IMPORTS[folder] | {folder} | EVERYWHERE
    }
    assert not wrong


def test_every_folder_is_listed() -> None:
    names = {path.stem for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert names == ALLOWED_IMPORTS.keys() | TOP | EVERYWHERE


@pytest.mark.parametrize("folder", ALLOWED_IMPORTS)
def test_imports_are_acyclic(folder: str) -> None:
    def below(name: str) -> set[str]:
        return ALLOWED_IMPORTS[name].union(*map(below, ALLOWED_IMPORTS[name]))

    assert folder not in below(folder)


def test_every_module_has_a_docstring() -> None:
    missing = [
        str(path.relative_to(ROOT))
        for path in PACKAGE.rglob("*.py")
        if not (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "")
    ]
    assert not missing
