"""Files derived from the interface table: `.msg`, `.srv` and `.action` files, and their lists in CMakeLists.txt.

`python3 -m rosafe.interface` writes them; with `--check` it lists those that are out of date.
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
    """Return the text of each interface file of a package by its path in the package, such as ``srv/Stop.srv``."""
    files = {
        f"msg/{ros_type(idl)}.msg": _text(f"IDL struct {idl}", fields) for idl, fields in component.structs.items()
    }
    files |= {f"msg/{name}.msg": _text(f"message {name}", fields) for name, fields in component.messages.items()}
    for service in component.on_graph:
        files.update(_of_service(service))
    return files


def _listed(cmake: str, paths: list[str]) -> str:
    """Return the text of a CMakeLists.txt with updated lists of interface files."""
    for folder, command in _LISTS.items():
        names = sorted(path.removeprefix(f"{folder}/") for path in paths if path.startswith(f"{folder}/"))
        lines = "".join(f"  {name}\n" for name in names)
        cmake = re.sub(rf"{command}\(FILES\n[^)]*\)", f"{command}(FILES\n{lines})", cmake)
    return cmake


def all_files(root: Path, components: tuple[ComponentSpec, ...]) -> dict[Path, str | None]:
    """Return the text of every derived file in the checkout `root`; None for a file that must be deleted."""
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
    """Return the files that are out of date."""
    return [p for p, text in files.items() if (p.read_text("utf-8") if p.exists() else None) != text]


def write(files: dict[Path, str | None]) -> None:
    """Write or delete the files that are out of date."""
    for path in stale(files):
        text = files[path]
        if text is None:
            path.unlink()
        else:
            path.write_text(text, "utf-8")
