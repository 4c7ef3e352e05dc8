"""Imports: the library knows no door, a door knows no other door, no import runs up, no two files import each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from tests.harness import ROOT

PACKAGE = ROOT / "rosafe"
# The library, lowest first: each folder may import those before it.
LIBRARY = (
    *("system", "declarations", "dsp", "plugin", "representations", "interface", "tree", "tree.setups", "testing"),
    *("results.view", "audio.files", "results", "processing", "torch", "localization", "audio.devices", "audio.stream"),
    "validation",
)
# A door may import the library, and each of its folders those before it.
DOORS = {
    "ros1": ("ros1.transport", "ros1.component", "ros1.client", "ros", "ros1.afe", "ros1.bass", "ros1.localizer"),
    "ros2": ("ros2",),
    "web": ("web.server", "web.genomix", "web.live"),
}
CLIENTS = {"ros1.transport", "ros1.component", "ros1.client"}  # the part of another door that `web` may import
MAY_IMPORT: dict[str, set[str]] = {
    **{folder: set(LIBRARY[:number]) for number, folder in enumerate(LIBRARY)},
    **{folder: {*LIBRARY, *door[:number]} for door in DOORS.values() for number, folder in enumerate(door)},
    "commands.eltclsh": set(LIBRARY),
}
for _folder in DOORS["web"]:
    MAY_IMPORT[_folder] |= CLIENTS
TOP = {"commands", "__init__"}  # may import everything
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}


def folder_of(module: str) -> str:
    """Return the deepest folder, at most two levels, that has rules."""
    parts = module.split(".")
    both = ".".join(parts[:2])
    return both if parts[0] in ("audio", "ros1", "web") or both in MAY_IMPORT else parts[0]


def imports(module: str, always: bool = False) -> Iterator[str]:
    """Yield the modules of rosafe that a module imports; `always`: only those that it imports when it is imported."""
    path = MODULES[module]
    tree = ast.parse(path.read_text("utf-8"))
    for node in tree.body if always else ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(path.parents[node.level - 1].relative_to(ROOT).parts) if node.level else ""
            parent = ".".join(filter(None, (base, node.module)))
            names = [f"{parent}.{alias.name}" for alias in node.names]
        for name in names:
            found = name.removeprefix("rosafe.")
            while name.startswith("rosafe.") and found:
                if found in MODULES:
                    yield found
                    break
                found = found.rpartition(".")[0]


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_point_down(folder: str) -> None:
    wrong = {
        f"{module} imports {name}"
        for module in MODULES
        if folder_of(module) == folder
        for name in imports(module)
        if folder_of(name) not in MAY_IMPORT[folder] | {folder}
    }
    assert not wrong


def test_every_folder_is_listed() -> None:
    found = {folder_of(module) for module in MODULES} - {"audio", "ros1", "web"}
    assert found == MAY_IMPORT.keys() | TOP


def test_files_do_not_import_each_other() -> None:
    imported = {module: set(imports(module, always=True)) for module in MODULES}
    found = {(a, b) for a in imported for b in imported[a] if a < b and a in imported[b]}
    assert not {pair for pair in found if "__init__" not in {MODULES[name].stem for name in pair}}
