"""Limits of size and complexity, names that occur once, and references to files that exist."""

from __future__ import annotations

import ast
import functools
import importlib
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.harness import ROOT
from tests.packaging.prose import SUFFIXES, sentences
from tests.packaging.test_lint import tracked

PACKAGE = ROOT / "rosafe"
Function = ast.FunctionDef | ast.AsyncFunctionDef

# --- size and complexity ----------------------------------------------------------------------------------------

MAX_CLASS_LINES = 400
MAX_ATTRIBUTES = 15  # names assigned on `self`
MAX_COMPLEXITY = 14
_BRANCHES = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.IfExp, ast.ExceptHandler, ast.comprehension)


@functools.cache
def modules() -> dict[Path, ast.Module]:
    """Return all modules of the package, parsed."""
    return {path: ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def classes() -> Iterator[tuple[Path, ast.ClassDef]]:
    for path, module in modules().items():
        for node in ast.walk(module):
            if isinstance(node, ast.ClassDef):
                yield path, node


def complexity(function: Function) -> int:
    """One more than the branches of a function; those of functions within it are their own."""
    total, waiting = 1, list(ast.iter_child_nodes(function))
    while waiting:
        node = waiting.pop()
        total += isinstance(node, _BRANCHES) + (len(node.values) - 1 if isinstance(node, ast.BoolOp) else 0)
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            waiting += ast.iter_child_nodes(node)
    return total


def assigned_on_self(node: ast.ClassDef) -> set[str]:
    return {
        target.attr
        for target in ast.walk(node)
        if isinstance(target, ast.Attribute)
        and isinstance(target.ctx, ast.Store)
        and isinstance(target.value, ast.Name)
        and target.value.id == "self"
    }


def test_the_size_of_classes_is_limited() -> None:
    found = {}
    for path, node in classes():
        lines, attributes = (node.end_lineno or 0) - node.lineno + 1, len(assigned_on_self(node))
        if lines > MAX_CLASS_LINES or attributes > MAX_ATTRIBUTES:
            found[f"{path.relative_to(ROOT)}:{node.name}"] = (lines, attributes)
    assert not found


def test_the_complexity_of_functions_is_limited() -> None:
    found = {}
    for path, module in modules().items():
        for node in ast.walk(module):
            if isinstance(node, Function) and complexity(node) > MAX_COMPLEXITY:
                found[f"{path.relative_to(ROOT)}:{node.name}"] = complexity(node)
    assert not found


def test_each_class_of_a_folder_has_a_name_of_its_own() -> None:
    names = Counter((path.parent, node.name) for path, node in classes())
    assert not [f"{folder.relative_to(ROOT)}: {name}" for (folder, name), count in names.items() if count > 1]


# --- references -------------------------------------------------------------------------------------------------

_NAME = r"(?<![\w./:<>{}$*-])[\w+-]+(?:/[\w+-]+)*\."
_PATH = re.compile(rf"{_NAME}(?:py|md|c|h|js|css|html|sh|tcl|m|rst|ipynb)\b(?![\w/*]|\.\w)")
_MODULE = re.compile(r"(?<![\w./:-])rosafe(?:\.[a-z]\w+)+(?:\.[A-Z_]\w+)*(?![\w/-])")
FOLDERS = {path.name for root in (ROOT, PACKAGE, ROOT / "tests") for path in root.iterdir() if path.is_dir()}
_UNITS = {"rosafe.launch", "rosafe.launch.py", "rosafe.target", "rosafe.service"}  # files of roslaunch and systemd


def referring(*suffixes: str) -> list[Path]:
    """Files that may name other files. A changelog names those of its time."""
    return [path for path in tracked() if path.suffix in suffixes and path.name != "CHANGELOG.md"]


def prose_of(path: Path) -> str:
    return path.read_text("utf-8") if path.suffix != ".py" else "\n".join(sentences(path))


def exists(name: str, near: Path) -> bool:
    """Whether a path exists below the root, the package, the tests, or the folder of the file that names it."""
    return any((folder / name).exists() for folder in (ROOT, PACKAGE, ROOT / "tests", *near.parents))


def test_each_path_that_is_named_exists() -> None:
    """Paths with a folder; a name alone may be one that a user chooses."""
    missing = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in referring(*SUFFIXES, ".rst", ".toml", ".txt")
        for name in _PATH.findall(prose_of(path))
        if "/" in name and name.split("/")[0] in FOLDERS and not exists(name, path)
    }
    assert not missing


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or a name in one."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            value: object = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError as problem:
            if problem.name in ("torch", "rclpy"):  # which only `rosafe.torch` and `rosafe.ros2` need
                return True
            continue
        for attribute in parts[end:]:
            if not hasattr(value, attribute):
                return False
            value = getattr(value, attribute)
        return True
    return False


def test_each_module_that_is_named_exists() -> None:
    named: dict[str, str] = {}
    for path in referring(".py", ".md", ".rst", ".c", ".h", ".sh", ".toml"):
        for name in set(_MODULE.findall(prose_of(path))) - _UNITS:
            named.setdefault(name, str(path.relative_to(ROOT)))
    assert {name: path for name, path in named.items() if not resolves(name)} == {}
