"""Generates the ROS package of the component `arm`, in the format of genom3."""

from __future__ import annotations

from pathlib import Path

from genpy import generator
from genpy.generate_initpy import write_modules

from rosafe.ros1.component.generate import split_action
from tests.harness import ROOT

ENDS = "bool genom_success\nstring genom_exdetail\n"
MESSAGES = {
    "arm_speed": "uint32 SLOW=0\nuint32 FAST=1\nuint32 value\n",
    "arm_point": "float64 x\nfloat64 y\n",
    "arm_pose": "arm_point position\nfloat64[3] angles\nstring frame\n",
    "arm_state": "arm_pose pose\narm_speed speed\narm_point[] path\nuint8[] raw\ntime stamp\n",
}
SERVICES = {
    "connect_port": f"string local\nstring remote\n---\n{ENDS}",
    "kill": f"---\n{ENDS}",
    "SetSpeed": f"arm_speed speed\n---\n{ENDS}",
    "GetSpeed": f"---\n{ENDS}arm_speed speed\n",
    "SetPose": f"arm_pose pose\narm_point[] path\nint16 tries\n---\n{ENDS}arm_pose pose\nuint32 points\n",
    "unrelated": "---\nbool good\n",
}
ACTIONS = {"Move": f"float64 distance\narm_speed speed\n---\n{ENDS}float64 moved\n---\n"}


def generate(folder: Path, without: tuple[str, ...] = ()) -> Path:
    """Write the Python package ``folder/arm``; return `folder`, which belongs on PYTHONPATH."""
    sources = folder / "share" / "arm"
    texts: dict[str, str] = {f"msg/{name}.msg": text for name, text in MESSAGES.items()}
    for path in (ROOT / "msg").glob("genom_state_*.msg"):
        texts[f"msg/{path.name}"] = path.read_text("utf-8")
    texts |= {f"srv/{name}.srv": text for name, text in SERVICES.items()}
    for name, text in ACTIONS.items():
        texts |= {f"msg/{message}.msg": body for message, body in split_action(name, text).items()}
    for name, text in texts.items():
        if Path(name).stem not in without:
            path = sources / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    debian = Path("/usr/share")
    search = {name: [str(debian / name / "msg")] for name in ("std_msgs", "actionlib_msgs")}
    search["arm"] = [str(sources / "msg")]
    for kind, generate_one in (("msg", generator.MsgGenerator()), ("srv", generator.SrvGenerator())):
        for path in sorted((sources / kind).glob(f"*.{kind}")):
            generator.reset_var()
            assert not generate_one.generate_messages("arm", [str(path)], str(folder / "arm" / kind), search)
        write_modules(str(folder / "arm" / kind))
    write_modules(str(folder / "arm"))
    return folder
