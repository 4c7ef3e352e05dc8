"""The interface of the ROS 2 node: the package `rosafe_msgs`, and the files derived from it.

Messages that ROS 1 has, too, are those of its components with names in the style of ROS 2.
"""

from __future__ import annotations

import re
from pathlib import Path

from rosafe.declarations.idl import TIME, ros_type

from .bass import BASS
from .rosafe import ROSAFE
from .service import Struct

FOLDER = "ros2/rosafe_msgs"

_RESULT: Struct = (("success", "boolean"), ("message", "string"))


def _named(struct: Struct) -> Struct:
    """Return a struct with the field names of ROS 2: lower case with underscores."""
    return tuple((re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower(), idl) for name, idl in struct)


_SHARED: dict[str, Struct] = {  # messages of ROS 1, and those fields and messages that ROS 1 may not have yet
    "SourceAudio": (
        ("header", "::Header"),
        ("id", "unsigned long"),
        ("azimuth", "double"),
        ("sample_rate", "unsigned long"),
        ("first_sample", "unsigned long long"),
        ("samples", "sequence<short>"),
    ),
    **ROSAFE.messages,
    "SoundSource": tuple(dict((*ROSAFE.messages["SoundSource"], ("speech", "double"))).items()),
    **BASS.messages,
}

MESSAGES: dict[str, Struct] = {
    "Coordinate": (("name", "string"), ("unit", "string"), ("values", "sequence<double>")),
    "Representation": (
        ("header", "::Header"),
        *((name, "string") for name in ("processor", "kind", "output", "unit")),
        ("axes", "sequence<string>"),
        ("shape", "sequence<unsigned long>"),
        ("coordinates", "sequence<::Coordinate>"),
        ("frame_rate", "double"),
        ("first_frame", "unsigned long long"),
        ("lost_frames", "unsigned long long"),
        ("data", "sequence<double>"),
    ),
    "Processor": (
        *((name, "string") for name in ("name", "kind", "parent")),
        ("topics", "sequence<string>"),
        ("parameters", "string"),
    ),
    **{name: _named(struct) for name, struct in _SHARED.items()},
}

SERVICES: dict[str, tuple[Struct, Struct]] = {  # request and response
    "RequestRepresentation": (
        tuple((name, "string") for name in ("representation", "name", "parameters")),
        (*_RESULT, ("processors", "sequence<string>")),
    ),
    "AddProcessor": (tuple((name, "string") for name in ("kind", "name", "parent", "parameters")), _RESULT),
    "RemoveProcessor": ((("name", "string"),), (*_RESULT, ("removed", "sequence<string>"))),
    "GetTree": ((), (("processors", "sequence<::Processor>"),)),
    "SaveSetup": ((), (*_RESULT, ("setup", "string"))),
    "LoadSetup": ((("setup", "string"),), _RESULT),
    "Acquire": ((("device", "string"), ("sample_rate", "unsigned long")), _RESULT),
}

_REMARKS = {  # by field; `Message.field` if the same name has several meanings
    "Representation.header": "stamp: clock time of the first frame",
    "output": "part of the output, such as left",
    "axes": "one name for each dimension; the last one is time",
    "shape": "data is row-major, time last",
    "coordinates": "such as the frequencies of channels, for axes with such numbers",
    "frame_rate": "Hz",
    "first_frame": "absolute number of the first frame",
    "lost_frames": "missing between the previous message and this one",
    "kind": "representation, such as ild",
    "parent": "processor whose output it processes",
    "parameters": "YAML, such as 'fb_nChannels: 16, fb_lowFreqHz: 80'",
    "azimuth": "rad, left is positive, relative to header.frame_id",
    "azimuths": "rad, left is positive",
    "azimuth_std": "rad",
    "Representation.unit": "of data",
    "level": "dB full scale",
    "probability": "0 to 1",
    "speech": "probability that the source speaks; NaN: unknown",
    "head_yaw": "rad, left is positive",
    "frame_index": "audio frame of this moment",
    "SourceAudio.header": "stamp: clock time of the first sample",
    "first_sample": "samples since the source began",
    "setup": "text of a setup file (YAML)",
    "device": "such as plughw:1,0, file:take.wav or scene:",
    "sample_rate": "Hz",
    "Acquire.sample_rate": "Hz; 0 selects the rate of a file or bag, otherwise 44100",
    "RequestRepresentation.name": "of its processor; empty: chosen by the node",
    "RequestRepresentation.processors": "from the input to the representation",
    "message": "reason of a failure",
}


def ros2_type(idl: str) -> str:
    """Return the type of a field in a `.msg` file of ROS 2."""
    ros = ros_type(idl)
    of = ros.removesuffix("[]")
    others = {ros_type(TIME): "builtin_interfaces/Time", "Header": "std_msgs/Header"}
    return others.get(of, of) + ros[len(of) :]


def _text(name: str, *parts: Struct) -> str:
    """Return the text of one interface file."""

    def line(field: str, idl: str) -> str:
        remark = _REMARKS.get(f"{name}.{field}", _REMARKS.get(field, ""))
        return f"{ros2_type(idl)} {field}" + (f"  # {remark}" if remark else "") + "\n"

    return "---\n".join("".join(line(*field) for field in part) for part in parts)


def interface_files() -> dict[str, str]:
    """Return the text of each interface file by its path in the package, such as ``srv/GetTree.srv``."""
    files = {f"msg/{name}.msg": _text(name, struct) for name, struct in MESSAGES.items()}
    return files | {f"srv/{name}.srv": _text(name, *parts) for name, parts in SERVICES.items()}


def all_files(root: Path) -> dict[Path, str | None]:
    """Return the text of every derived file of the package in the checkout `root`; None for one to be deleted."""
    folder, files = root / FOLDER, interface_files()
    found: dict[Path, str | None] = dict.fromkeys(p for kind in ("msg", "srv") for p in (folder / kind).glob("*.*"))
    found.update({folder / path: text for path, text in files.items()})
    cmake = folder / "CMakeLists.txt"
    lines = "".join(f'  "{path}"\n' for path in sorted(files))
    found[cmake] = re.sub(r'(PROJECT_NAME}\n)(  ".*"\n)*', rf"\1{lines}", cmake.read_text("utf-8"))
    return found
