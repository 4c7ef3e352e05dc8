"""Import and try plugins in a child process, which they may block or end, and report what was found.

``python3 -m rosafe.commands._plugins FD [KIND...]`` is that process: it writes one JSON object per line to the file
descriptor.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple

from rosafe.declarations import plugins

LIMIT_SECONDS = 10.0  # for importing all plugins
TRIAL_SECONDS = 300.0  # for trying the representations of one file


class PluginReport(NamedTuple):
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


class Trial(NamedTuple):
    """What `rosafe.testing.check_representation` says of one representation.

    Attributes
    ----------
    kind : str
        The representation.
    error : str
        Why it fails; empty if it passes.
    costs : dict of str to float
        Milliseconds of computing per second of sound, of this and the built-in representations.
    """

    kind: str
    error: str
    costs: dict[str, float]


def report(extra: str = "") -> PluginReport:
    """Import all plugins, and the file `extra` too, in a child process; its output goes to standard error."""
    messages, end = _run([], extra, LIMIT_SECONDS)
    if messages and "kinds" in messages[-1]:
        return PluginReport(**messages[-1])
    origin = messages[-1]["importing"] if messages else "plugins"
    reason = (
        f"the process that imported it ended with {end}"
        if end
        else f"its import did not end within {LIMIT_SECONDS:g} s"
    )
    return PluginReport({}, [f"{origin}: {reason}; a node that imports it would not start either"], [])


def trials(kinds: list[str], extra: str = "") -> list[Trial]:
    """Try representations in a child process, with the file `extra` among the plugins."""
    messages, end = _run(kinds, extra, TRIAL_SECONDS)
    done = [Trial(**message) for message in messages if "kind" in message]
    if len(done) < len(kinds):
        reason = f"the process that tried it ended with {end}" if end else f"it did not end within {TRIAL_SECONDS:g} s"
        done.append(Trial(kinds[len(done)], reason, {}))
    return done


def _run(kinds: list[str], extra: str, limit: float) -> tuple[list[Any], str]:
    """The messages of a child process, and how it ended; empty if it was ended after `limit` seconds."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if extra:
        environment[plugins.FOLDERS] = os.pathsep.join([*plugins.named(), extra])
    with tempfile.TemporaryFile() as output:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(output.fileno()), *kinds],
            env=environment,
            pass_fds=[output.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=2,
            start_new_session=True,
        )
        try:
            child.wait(limit)
            end = _end(child.returncode)
        except subprocess.TimeoutExpired:
            end = ""
        finally:
            _kill(child)
        output.seek(0)
        return [json.loads(line) for line in output.read().splitlines()], end


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

    for kind in sys.argv[2:]:
        _try(kind, tell)
    if not sys.argv[2:]:
        tell(kinds=PLUGINS, problems=PROBLEMS, warnings=WARNINGS)
    os._exit(0)  # not waiting for threads that a plugin may have started


def _try(kind: str, tell: Callable[..., None]) -> None:
    from rosafe.representations import STAGES
    from rosafe.testing import check_representation

    try:
        tell(kind=kind, error="", costs=check_representation(STAGES[kind]))
    except AssertionError as problem:
        tell(kind=kind, error=" ".join(str(problem).split()), costs={})
    except Exception as problem:  # of the plugin's code
        tell(kind=kind, error=" ".join(f"{type(problem).__name__}: {problem}".split()), costs={})


if __name__ == "__main__":
    main()
