"""What must exist as files: `.msg`, `.srv` and `.action`, their lists in CMakeLists.txt, and docs/parameters.md.

`python3 -m rosafe.interface` writes them anew from the table, `--check` says which are stale.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from rosafe.declarations.idl import ros_type

from .service import ComponentSpec, Service, Struct

FOLDERS = {"rosAFE": ".", "bass": "bass"}  # ROS package -> its folder in the checkout
REPLY: Struct = (("genom_success", "boolean"), ("genom_exdetail", "string"))
_LISTS = {"msg": "add_message_files", "srv": "add_service_files", "action": "add_action_files"}


def _text(title: str, *parts: Struct) -> str:
    body = "---\n".join("".join(f"{ros_type(idl)} {name}\n" for name, idl in part) for part in parts)
    return f"# {title}\n{body}"


def _of_service(service: Service) -> Iterator[tuple[str, str]]:
    request = tuple((p.name, p.idl) for p in service.parameters)
    yield f"srv/{service.name}.srv", _text(f"service {service.name}", request, (*REPLY, *service.outputs))
    if service.activity:
        yield f"action/{service.name}.action", _text(f"activity {service.name}", request, REPLY, ())


def interface_files(component: ComponentSpec) -> dict[str, str]:
    """The text of each interface file of a package, by its path there, such as ``srv/Stop.srv``."""
    files = {}
    for idl, fields in component.structs.items():
        files[f"msg/{ros_type(idl)}.msg"] = _text(f"IDL struct {idl}", fields)
    for service in component.on_graph:
        files.update(_of_service(service))
    return files


def _listed(cmake: str, paths: list[str]) -> str:
    """The text of a CMakeLists.txt with its lists of interface files as they should be."""
    for folder, command in _LISTS.items():
        names = sorted(path.removeprefix(f"{folder}/") for path in paths if path.startswith(f"{folder}/"))
        lines = "".join(f"  {name}\n" for name in names)
        cmake = re.sub(rf"{command}\(FILES\n[^)]*\)", f"{command}(FILES\n{lines})", cmake)
    return cmake


def all_files(root: Path, components: tuple[ComponentSpec, ...]) -> dict[Path, str | None]:
    """Every file below the checkout `root` that comes from the table, and its text; None for one that must go."""
    found: dict[Path, str | None] = {}
    for component in components:
        folder = root / FOLDERS[component.name]
        files = interface_files(component)
        for kind in _LISTS:
            found.update(dict.fromkeys((folder / kind).glob(f"*.{kind}")))
        found.update({folder / path: text for path, text in files.items()})
        cmake = folder / "CMakeLists.txt"
        found[cmake] = _listed(cmake.read_text("utf-8"), list(files))
    return found


def stale(files: dict[Path, str | None]) -> list[Path]:
    """Those that are not as they should be."""

    def now(path: Path) -> str | None:
        return path.read_text("utf-8") if path.exists() else None

    return [path for path, text in files.items() if now(path) != text]


def write(files: dict[Path, str | None]) -> None:
    """Make them so."""
    for path in stale(files):
        text = files[path]
        if text is None:
            path.unlink()
        else:
            path.write_text(text, "utf-8")
