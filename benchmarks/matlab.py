"""Time to read ports in Octave through genomixd: one second of ILD, ratemap, cross-correlation and gammatone.

``/usr/bin/python3 benchmarks/matlab.py`` starts real nodes with a private master, a genomixd, and Octave, which runs
benchmarks/ports.m. It prints median ms for cell arrays (the form of the original's scripts) and for matrices
(``'-m'``).
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import closing

import graph
import report

from rosafe.ros1.component import generate
from rosafe.system.processes import ProcessGroup

FILL_SECONDS = 2.0  # until the ports hold one second
UP_SECONDS = 20.0


def main() -> int:
    """Measure and print."""
    report.Report(report.arguments("Measure the time to read ports in Octave.").parse_args(), "Octave")
    if shutil.which("octave-cli") is None:
        print("benchmarks/matlab.py: octave-cli is not installed; run scripts/install --tests", file=sys.stderr)
        return 1
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    with graph.bench() as bench, closing(ProcessGroup(os.environ)) as children:
        children.start(graph.PYTHON, str(graph.HERE.parent / "scripts" / "genomixd"), "-p", address.rpartition(":")[2])
        bench.build(12000, 1.0, 2205)
        _await(address)
        time.sleep(FILL_SECONDS)
        env = {**os.environ, **generate.environment(), "GENOMIXD": address}
        octave = ["octave-cli", "--norc", "--quiet", "--no-history", str(graph.HERE / "ports.m")]
        return subprocess.run(octave, env=env, check=False).returncode


def _await(address: str) -> None:
    host, _, port = address.partition(":")
    end = time.monotonic() + UP_SECONDS
    while True:
        try:
            socket.create_connection((host, int(port))).close()
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)
        else:
            return


if __name__ == "__main__":
    sys.exit(main())
