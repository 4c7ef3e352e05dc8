"""Import and test plugins in a child process, because they may block or end it, and report the findings.

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
TRIAL_SECONDS = 300.0  # for testing the representations of one file


class PluginReport(NamedTuple):
    """Findings of the child process.

    Attributes
    ----------
    kinds : dict of str to str
        The origin of each representation that a plugin defines.
    problems, warnings : list of str
        One line for each plugin that is left out, and one for each warning.
    """

    kinds: dict[str, str]
    problems: list[str]
    warnings: list[str]


class Trial(NamedTuple):
    """Result of `rosafe.testing.check_representation` for one representation.

    Attributes
    ----------
    kind : str
        The representation.
    error : str
        The reason of a failure; empty if all checks passed.
    costs : dict of str to float
        Processor time in ms per second of sound, of this and of the built-in representations.
    """

    kind: str
    error: str
    costs: dict[str, float]


def report(extra: str = "") -> PluginReport:
    """Import all plugins and the file `extra` in a child process, whose output goes to standard error."""
    messages, end = _run([], extra, LIMIT_SECONDS)
    if messages and "kinds" in messages[-1]:
        return PluginReport(**messages[-1])
    origin = messages[-1]["importing"] if messages else "plugins"
    reason = (
        f"the process that imported it ended with {end}"
        if end
        else f"its import did not end within {LIMIT_SECONDS:g} s"
    )
    return PluginReport({}, [f"{origin}: {reason}; a node that imports it does not start either"], [])


def trials(kinds: list[str], extra: str = "") -> list[Trial]:
    """Test representations in a child process, with the file `extra` among the plugins."""
    messages, end = _run(kinds, extra, TRIAL_SECONDS)
    done = [Trial(**message) for message in messages if "kind" in message]
    if len(done) < len(kinds):
        reason = f"the process that tested it ended with {end}" if end else f"it did not end within {TRIAL_SECONDS:g} s"
        done.append(Trial(kinds[len(done)], reason, {}))
    return done


def _run(kinds: list[str], extra: str, limit: float) -> tuple[list[Any], str]:
    """Return the messages of a child process and how it ended (an empty text if it was killed after `limit` s)."""
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
    """Kill the child and the processes that plugins have started in it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def _end(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def main() -> None:
    """Run as the child process."""
    output = int(sys.argv[1])
    os.set_inheritable(output, False)

    def send(**message: object) -> None:
        os.write(output, json.dumps(message).encode() + b"\n")

    plugins.before_import = lambda origin: send(importing=origin)
    from rosafe.representations import PLUGINS, PROBLEMS, WARNINGS

    for kind in sys.argv[2:]:
        _test(kind, send)
    if not sys.argv[2:]:
        send(kinds=PLUGINS, problems=PROBLEMS, warnings=WARNINGS)
    os._exit(0)  # does not wait for threads that a plugin may have started


def _test(kind: str, send: Callable[..., None]) -> None:
    from rosafe.representations import STAGES
    from rosafe.testing import check_representation

    try:
        send(kind=kind, error="", costs=check_representation(STAGES[kind]))
    except AssertionError as problem:
        send(kind=kind, error=" ".join(str(problem).split()), costs={})
    except Exception as problem:  # raised by the plugin
        send(kind=kind, error=" ".join(f"{type(problem).__name__}: {problem}".split()), costs={})


if __name__ == "__main__":
    main()
