"""Import plugins in a child process, which they may block or end, and report what was found.

``python3 -m rosafe.commands._plugins FD`` is that process: it writes one JSON object per line to the file descriptor.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

from rosafe.vocabulary import plugins

LIMIT_SECONDS = 10.0  # for importing all plugins


class Report(NamedTuple):
    """What the child process found.

    Attributes
    ----------
    kinds : dict of str to str
        The origin of each representation that is no built-in one.
    problems, warnings : list of str
        A line for each plugin that is left out, and for each remark about one.
    """

    kinds: dict[str, str]
    problems: list[str]
    warnings: list[str]


def report(extra: str = "") -> Report:
    """Import all plugins, and the file `extra` too, in a child process; its output goes to standard error."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if extra:
        environment[plugins.FOLDERS] = os.pathsep.join([*plugins.named(), extra])
    with tempfile.TemporaryFile() as output:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(output.fileno())],
            env=environment,
            pass_fds=[output.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=2,
            start_new_session=True,
        )
        try:
            child.wait(LIMIT_SECONDS)
            reason = f"the process that imported it ended with {_end(child.returncode)}"
        except subprocess.TimeoutExpired:
            reason = f"its import did not end within {LIMIT_SECONDS:g} s"
        finally:
            _kill(child)
        output.seek(0)
        messages = [json.loads(line) for line in output.read().splitlines()]
    if messages and "kinds" in messages[-1]:
        return Report(**messages[-1])
    origin = messages[-1]["importing"] if messages else "plugins"
    return Report({}, [f"{origin}: {reason}; a node that imports it would not start either"], [])


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End the child and the processes that plugins have started in it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def _end(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def main() -> None:
    """The child process."""
    output = int(sys.argv[1])
    os.set_inheritable(output, False)

    def tell(**message: object) -> None:
        os.write(output, json.dumps(message).encode() + b"\n")

    plugins.before_import = lambda origin: tell(importing=origin)
    from rosafe.representations import PLUGINS, PROBLEMS, WARNINGS

    tell(
        kinds=PLUGINS,
        problems=PROBLEMS,
        warnings=WARNINGS,
    )
    os._exit(0)  # not waiting for threads that a plugin may have started


if __name__ == "__main__":
    main()
