"""A process that opens PCMs by name with libasound, in its own folder, and prints each result as a line of JSON.

It detects each file that was written or opened for writing there (inotify), and each process that was started.
Each input line is a JSON list of a name and of whether to check the name first, as bass does.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import sys

from rosafe.audio.devices.libasound import captured_alsa_errors, checked_name, load_alsaaudio
from rosafe.interface import ComponentError
from rosafe.ros1.transport.paths import prefer_pypi_packages

WRITTEN = 0x2 | 0x8 | 0x40 | 0x80 | 0x100 | 0x200  # IN_MODIFY, CLOSE_WRITE, MOVED_FROM, MOVED_TO, CREATE, DELETE


def main() -> None:
    """Serve until stdin ends."""
    prefer_pypi_packages()
    alsa = load_alsaaudio()
    libc = ctypes.CDLL(None)
    watch = libc.inotify_init1(os.O_NONBLOCK)
    assert libc.inotify_add_watch(watch, b".", WRITTEN) > 0

    def children() -> tuple[float, ...]:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime, used.ru_stime, used.ru_minflt, used.ru_maxrss

    for line in sys.stdin:
        name, checked = json.loads(line)
        before, outcome = children(), "opened"
        with captured_alsa_errors():
            try:
                open_name = checked_name(name) if checked else name
                alsa.PCM(type=alsa.PCM_CAPTURE, mode=alsa.PCM_NONBLOCK, device=open_name).close()
            except ComponentError as problem:
                outcome = f"refused: {problem.reason}"
            except (alsa.ALSAAudioError, ValueError) as problem:
                outcome = f"failed: {problem}"
        try:
            written = bool(os.read(watch, 65536))
        except BlockingIOError:
            written = False
        print(json.dumps([outcome, written, children() != before]), flush=True)


if __name__ == "__main__":
    main()
