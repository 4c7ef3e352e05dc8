"""Generate the manual pages of the Debian packages from the help texts of the commands, in the given folder."""

from __future__ import annotations

import os
import pkgutil
import re
import subprocess
import sys
import time
from pathlib import Path

from rosafe import commands
from rosafe.system.version import VERSION

PROGRAMS = {
    "rosafe": "binaural auditory representations, and tools for the nodes",
    "rosAFE-ros": "ROS node that computes binaural auditory representations",
    "bass-ros": "ROS node that captures the sound at two ears",
    "genomixd": "HTTP server for ROS components",
    "eltclsh": "Tcl shell with line editing",
    "elwish": "Tcl shell with line editing and Tk",
}


def preformatted(*command: str) -> str:
    """Return the output of ``COMMAND -h`` in roff, as it is."""
    env = {**os.environ, "COLUMNS": "80", "PYTHONPATH": "."}
    done = subprocess.run(
        [f"scripts/{command[0]}", *command[1:], "-h"], env=env, stdout=subprocess.PIPE, text=True, check=True
    )
    assert "is not installed" not in done.stdout, done.stdout
    text = done.stdout.strip().replace("\\", "\\e").replace("-", "\\-")
    return ".nf\n" + re.sub(r"^(?=[.'])", "\\\\&", text, flags=re.MULTILINE) + "\n.fi\n"


def page(program: str, summary: str) -> str:
    date = time.strftime("%Y-%m-%d", time.gmtime(int(os.environ["SOURCE_DATE_EPOCH"])))
    text = f'.TH {program} 1 {date} "rosAFE {VERSION}" "User Commands"\n'
    text += f".SH NAME\n{program} \\- {summary}\n.SH DESCRIPTION\n{preformatted(program)}"
    if program == "rosafe":
        text += ".SH COMMANDS\n"
        for module in pkgutil.iter_modules(commands.__path__):
            if not module.ispkg and not module.name.startswith("_"):
                text += f".SS rosafe {module.name}\n{preformatted(program, module.name)}"
    return f"{text}.SH SEE ALSO\nThe documents in /usr/share/doc/rosafe/docs\n"


def main(folder: Path) -> None:
    folder.mkdir(parents=True)
    for program, summary in PROGRAMS.items():
        (folder / f"{program}.1").write_text(page(program, summary), "utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
